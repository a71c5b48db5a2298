"""Display names of sliders and drives, which are the labels in [geometry], and a reserved name.

Programs, keys and records always use the letters A, B and C.
"""

from __future__ import annotations

from trirail_drivers.interface import NAMES

Labels = tuple[str, str, str]
BLACK_BOX = "fault"
"""Name with which the file names of black boxes begin, which a robot cannot have."""


def label(name: str, labels: Labels) -> str:
    """Return the display name of slider A, B or C."""
    return labels[NAMES.index(name)]


def drive(name: str, labels: Labels) -> str:
    """Return the display name of a drive.

    The name is the letter of the drive's table, such as [drives.A], with the label of its slider if it has one.
    """
    slider = label(name, labels)
    return f"drive {name}" if slider == name else f"drive {name} ({slider})"
