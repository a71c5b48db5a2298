"""Requests that an alignment yields to its driver, and the observations that it receives in return."""

from __future__ import annotations

from typing import Literal, NamedTuple

from trirail_drivers.interface import Triple

from trirail.alignment.camera_calibration import Marks
from trirail.alignment.images import Pair
from trirail.alignment.results import Measurement


class StageMotion(NamedTuple):
    """Request for a motion: to a pose, or with a `tool` a move of that point relative to its measured position."""

    by: Triple
    """Target pose x, y [m], phi [rad] without a tool; else the relative move."""
    tool: Pair | None = None
    """Point of the platform in its own frame [m]."""
    approach: Triple | None = None
    """Offset x, y [m], phi [rad] of an intermediate pose beyond the end, so that backlash stays on one side."""


class Observation(NamedTuple):
    """Pixels of the marks, the measured platform pose x, y [m], phi [rad], and the time [s] of one picture."""

    marks: Marks
    pose: Triple
    time: float
    sliders: Triple | None = None
    """Measured positions of the sliders A, B, C [m]; None where they are those of the pose by the geometry."""


class LookReport(NamedTuple):
    """Result of one look, for the driver to pass on to the service; it needs no answer."""

    purpose: Literal["calibration", "alignment", "check"]
    observation: Observation | None = None
    """None for an end without a look."""
    measurement: Measurement | None = None
    """None in a calibration, and where the marks do not determine the part's pose."""
    correction: Triple | None = None
    """Motion of the marks' centroid that follows: x, y [m], phi [rad]."""
    end: str | None = None
    """Reason of the end, None while the procedure continues."""
    words: str = ""
    """Error message, for an end by an error."""
    noise: float | None = None
    """Noise of a completed calibration [pixel]."""


LOOK: Literal["look"] = "look"
"""Request for an Observation without a motion."""
AlignmentRequest = Literal["look"] | StageMotion | LookReport
