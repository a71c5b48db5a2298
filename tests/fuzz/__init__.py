"""Whatever comes from outside: generated, at every boundary."""
