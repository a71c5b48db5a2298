"""Recording and drawing: Rerun streams, files, black boxes, and functions that read them."""
