"""Common code of the drivers for all protocols."""
