"""Kinds of goals; each has a module with its fields, checks and properties, and all modules are imported."""
