"""The Python client, trajectories from files, and a service of one's own for demos and tools."""
