"""Goal kinds, with one module for the fields, checks and properties of each; trirail.wire.goals imports all modules."""
