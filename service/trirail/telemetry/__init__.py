"""Recording and drawing: Rerun's streams, files, black boxes, and reading them."""
