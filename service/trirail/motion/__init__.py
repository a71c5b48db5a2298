"""Motion planning: from a goal to a path in time that keeps every limit."""
