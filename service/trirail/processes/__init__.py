"""The service's processes and their use of the system: supervisor, loop, gateway, recording."""
