"""What people read for the sliders A, B, C: the labels of [geometry]. Programs, keys and records have letters."""

from __future__ import annotations

from trirail_drivers.interface import NAMES

Labels = tuple[str, str, str]


def label(name: str, labels: Labels) -> str:
    """Return what people call the slider A, B or C."""
    return labels[NAMES.index(name)]


def drive(name: str, labels: Labels) -> str:
    """Return what people call a drive: the letter of its table [drives.A], and its slider where that has a label."""
    slider = label(name, labels)
    return f"drive {name}" if slider == name else f"drive {name} ({slider})"
