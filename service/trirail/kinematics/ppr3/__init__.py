"""3-PPR mechanism: a cross slide of fixed direction is on the driven carriage, and the pivot is on the cross slide."""
