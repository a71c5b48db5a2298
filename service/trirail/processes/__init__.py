"""The service's processes and what they need of the system: supervisor, loop, gateway, recording."""
