"""What goes between an alignment and whoever drives it: looks and motions that are wanted, and reports of looks."""

from __future__ import annotations

from typing import Literal, NamedTuple

from trirail_drivers.interface import Triple

from trirail.alignment.camera_calibration import Marks
from trirail.alignment.images import Pair
from trirail.alignment.results import Measurement


class StageMotion(NamedTuple):
    """A motion that is wanted: a pose, or with a `tool` a move of that point from where the robot is measured."""

    by: Triple
    """The pose [m, rad] where there is no tool; else the move."""
    tool: Pair | None = None
    """A point of the platform in its own frame [m]."""
    approach: Triple | None = None
    """From where it comes: the robot is sent beyond the end by this first, and back then [m, rad]."""


class Sighting(NamedTuple):
    """What is sent into a conversation: what cameras show, where the robot is measured to be, and when [s]."""

    marks: Marks
    pose: Triple
    time: float


class LookReport(NamedTuple):
    """What a look told and what follows from it, for who watches: whoever drives the alignment passes it on."""

    purpose: Literal["calibration", "alignment", "check"]
    sighting: Sighting | None = None
    """None of an end without a look."""
    measurement: Measurement | None = None
    """None in a calibration, and where the marks do not tell it."""
    correction: Triple | None = None
    """The motion of the marks' middle that follows."""
    end: str | None = None
    """Why it ends."""
    words: str = ""
    """With an end by an error what that says."""
    noise: float | None = None
    """Of a calibration that has been made [pixel]."""


LOOK: Literal["look"] = "look"
"""What is wanted beside motions."""
Wish = Literal["look"] | StageMotion | LookReport
