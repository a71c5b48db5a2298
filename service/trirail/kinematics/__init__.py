"""Recursion of the paper, the robot built on it, and its calibration. All modules are pure mathematics, compiled."""
