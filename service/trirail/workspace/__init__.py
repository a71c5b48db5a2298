"""Workspace, singularities and parts of the robot, and plots of them."""
