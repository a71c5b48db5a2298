"""Makes drives on a bus out of a configuration, and refuses settings that no drive could carry out."""
