"""The 3-PPR mechanism: the cross slide rides on the driven carriage and keeps its direction, the pivot on top of it."""
