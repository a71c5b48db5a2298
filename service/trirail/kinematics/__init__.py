"""The paper's recursion, the robot made of it, and its calibration; pure mathematics, compiled."""
