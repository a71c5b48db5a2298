"""Common parts of the drivers of all protocols."""
