"""Commissioning of real drives: one drive at a time, slowly, with each step judged and the configuration corrected."""
