"""Alignment of a part with camera marks: detection of marks, calibration of cameras by stage moves, and corrections."""
