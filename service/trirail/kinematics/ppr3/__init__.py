"""3-PPR mechanism: the cross slide is on the driven carriage and keeps its direction, and the pivot is on top of it."""
