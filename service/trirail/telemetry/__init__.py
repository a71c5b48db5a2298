"""Recording and drawing of a robot with Rerun: live streams, recording files, black boxes, and reading the files."""
