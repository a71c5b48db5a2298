"""Computation and plots of the robot's workspace, singularities and parts."""
