"""What a goal of each kind means to the motion, and the path that leads there: a file for each, all are read in."""
