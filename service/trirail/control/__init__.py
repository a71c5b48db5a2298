"""The robot's control, one cycle at a time: modes, goals, feedback, setpoints; no input or output."""
