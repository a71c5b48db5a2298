"""Alignment of a part by cameras: detection of marks, calibration of cameras by moves of the stage, and corrections."""
