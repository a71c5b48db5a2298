"""Processes of the service (supervisor, loop, planner, gateway, recorder), and their use of the operating system."""
