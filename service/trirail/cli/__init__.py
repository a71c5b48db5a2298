"""The command line: `trirail`."""
