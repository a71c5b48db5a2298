"""From a goal to a motion within every limit: paths, how their time runs, planning and what is checked before."""
