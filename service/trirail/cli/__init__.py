"""The `trirail` command line."""
