"""Drives on a bus, from a configuration, and checks of its settings."""
