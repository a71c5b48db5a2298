"""The 3-PRP mechanism of the paper: the pivot rides on the driven carriage, the cross slide turns with the platform."""
