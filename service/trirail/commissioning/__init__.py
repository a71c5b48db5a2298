"""Commissioning of real drives with slow motions of one drive at a time; each step can correct the configuration."""
