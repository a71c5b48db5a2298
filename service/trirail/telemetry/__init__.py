"""What is recorded and drawn: Rerun's streams, files, black boxes, and reading them again."""
