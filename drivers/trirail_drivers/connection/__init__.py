"""Connection to the drives that a configuration describes, and checks of its settings."""
