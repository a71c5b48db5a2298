"""3-PRP mechanism of the paper: the pivot is on the driven carriage, and the cross slide turns with the platform."""
