"""Requests that an alignment yields to its driver, and the observations that it receives in reply."""

from __future__ import annotations

from typing import Literal, NamedTuple

from trirail_drivers.interface import Triple

from trirail.alignment.camera_calibration import Marks
from trirail.alignment.images import Pair
from trirail.alignment.results import Measurement


class StageMotion(NamedTuple):
    """Request for a motion to a pose or, with a `tool`, for a move of that point from its measured position."""

    by: Triple
    """Target pose x, y [m], phi [rad]; with a tool, the relative move."""
    tool: Pair | None = None
    """Point of the platform in its own frame [m]."""
    approach: Triple | None = None
    """Offset x, y [m], phi [rad] of an intermediate pose beyond the target, so that backlash stays on one side."""


class Observation(NamedTuple):
    """Pixels of the marks, the measured platform pose x, y [m], phi [rad], and the time [s] of one picture."""

    marks: Marks
    pose: Triple
    time: float
    sliders: Triple | None = None
    """Measured positions of the sliders A, B, C [m]; None if they are those that the geometry gives for the pose."""


class LookReport(NamedTuple):
    """Result of one look, which the driver passes on to the service. It needs no answer."""

    purpose: Literal["calibration", "alignment", "check"]
    observation: Observation | None = None
    """Observation of the look; None if the alignment ends without a look."""
    measurement: Measurement | None = None
    """Measurement; None in a calibration, and if the marks do not determine the part's pose."""
    correction: Triple | None = None
    """Next motion of the marks' centroid: x, y [m], phi [rad]."""
    end: str | None = None
    """Reason why the procedure ends; None while it continues."""
    words: str = ""
    """Error message if the procedure ends because of an error."""
    noise: float | None = None
    """Noise of a completed calibration [pixel]."""


LOOK: Literal["look"] = "look"
"""Request for an Observation without a motion."""
AlignmentRequest = Literal["look"] | StageMotion | LookReport
