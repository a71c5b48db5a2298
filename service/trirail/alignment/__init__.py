"""Alignment of a part by camera marks: mark detection, camera calibration by stage moves, and corrections."""
