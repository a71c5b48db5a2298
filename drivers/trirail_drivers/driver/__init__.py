"""What the drivers of all protocols share."""
