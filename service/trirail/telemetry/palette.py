"""Colours of the views; each object has the same colour wherever it appears."""

from __future__ import annotations

from trirail.wire.vocabulary import Mode

Colour = tuple[int, int, int] | tuple[int, int, int, int]
"""Red, green, blue and, for a translucent colour, opacity; each from 0 to 255."""

SLIDERS: tuple[Colour, Colour, Colour] = ((242, 108, 79), (52, 190, 145), (82, 148, 255))
"""Colours of the sliders A, B and C."""

PLATFORM: Colour = (236, 238, 242)
COMMANDED: Colour = (250, 176, 64, 90)
PIN: Colour = (20, 21, 24)
CENTRE: Colour = (76, 208, 224)
GOAL: Colour = (118, 226, 140, 170)
WORKSPACE: Colour = (120, 132, 168, 150)
FRAME: Colour = (74, 80, 92)
ANCHORS: Colour = (122, 130, 144)
ARMS: Colour = (92, 98, 110)

X: Colour = CENTRE
Y: Colour = (166, 126, 255)
PHI: Colour = (250, 176, 64)

SINGULARITY: Colour = (232, 110, 190)

LATENESS: Colour = (140, 210, 120)
CYCLE: Colour = (150, 160, 176)
BUS: Colour = (92, 132, 186)
BUDGET: Colour = (226, 82, 82)
LIMIT: Colour = (196, 148, 64)

OFF: Colour = (58, 62, 72)
OUTPUT: Colour = (56, 146, 84)
INPUT: Colour = (66, 120, 196)

MODES: dict[Mode, Colour] = {
    Mode.DISABLED: (96, 102, 114),
    Mode.ENABLING: (190, 140, 50),
    Mode.HOMING: (134, 104, 190),
    Mode.HOLDING: (44, 128, 148),
    Mode.MOVING: (56, 146, 84),
    Mode.STOPPING: (196, 104, 44),
    Mode.FAULT: (200, 56, 56),
}
"""Colour of each mode: unchanged in the live view, paler in printed reports, and as a style of Rich in terminals."""


OUTCOMES: dict[str, Colour] = {
    "done": (47, 150, 84),
    "rejected": (224, 161, 0),
    "expired": (150, 116, 20),
    "preempted": (140, 107, 177),
    "stopped": (66, 120, 196),
    "faulted": (200, 56, 56),
    "unsettled": (168, 60, 160),
    "unknown": (123, 135, 148),
}
"""Colour of each goal outcome, in print and in terminals; "unknown" is for an outcome that was not recorded."""


def pale(colour: Colour) -> Colour:
    """Return a paler colour for filled areas on a white background, halfway between the colour and white."""
    red, green, blue = colour[:3]
    return (red + 255) // 2, (green + 255) // 2, (blue + 255) // 2


def code(colour: Colour) -> str:
    """Return the colour as #rrggbb, which matplotlib and rich accept."""
    red, green, blue = colour[:3]
    return f"#{red:02x}{green:02x}{blue:02x}"


def dark(colour: Colour) -> Colour:
    """Return the colour at half its brightness, for use as a background."""
    red, green, blue = colour[:3]
    return red // 2, green // 2, blue // 2
