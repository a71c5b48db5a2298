"""The kinds of goals, a file for each, with its fields, checks and properties. All are read in."""
