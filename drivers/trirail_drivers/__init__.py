"""Drives and buses: everything below slider setpoints."""
