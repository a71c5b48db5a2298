"""From a goal to a motion within every limit: paths, the laws of their time, planning and what is checked before."""
