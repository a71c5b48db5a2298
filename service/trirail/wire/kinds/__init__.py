"""The kinds of goals, a file for each: what it says, its checks, and what follows from its kind. All are read in."""
