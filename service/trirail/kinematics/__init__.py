"""Kinematics of the robot, based on the recursion of the paper, and calibration. All modules are pure mathematics."""
