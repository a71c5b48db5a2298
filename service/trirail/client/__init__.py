"""The Python client, trajectories from files, and private services for demos and tools."""
