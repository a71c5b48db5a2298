"""Display names of sliders and drives: the labels of [geometry]. Programs, keys and records use the letters A, B, C."""

from __future__ import annotations

from trirail_drivers.interface import NAMES

Labels = tuple[str, str, str]


def label(name: str, labels: Labels) -> str:
    """Return the display name of slider A, B or C."""
    return labels[NAMES.index(name)]


def drive(name: str, labels: Labels) -> str:
    """Return the display name of a drive: the letter of its table [drives.A], and its slider's label if it has one."""
    slider = label(name, labels)
    return f"drive {name}" if slider == name else f"drive {name} ({slider})"
