"""The first hour with real drives: one at a time, slowly, each step judged, and the configuration that comes of it."""
