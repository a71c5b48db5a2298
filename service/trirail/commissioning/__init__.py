"""Commissioning of real drives: one drive at a time, slowly, each step judged, and a corrected configuration."""
