"""Python client, reader of trajectory files, and launcher of private services for demos and tools."""
