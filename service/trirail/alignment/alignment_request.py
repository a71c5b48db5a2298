"""Requests that an alignment procedure yields to its driver, and the observations that the driver sends in reply."""

from __future__ import annotations

from typing import Literal, NamedTuple

from trirail_drivers.interface import Triple

from trirail.alignment.camera_calibration import Marks
from trirail.alignment.images import Pair
from trirail.alignment.results import Measurement


class StageMotion(NamedTuple):
    """Request for a motion of the platform to a pose or, if a `tool` is given, for a relative move of the tool."""

    by: Triple
    """Target pose x, y [m], phi [rad]; if a tool is given, the move relative to the measured pose."""
    tool: Pair | None = None
    """Point of the platform that makes the relative move, in the platform's frame [m]."""
    approach: Triple | None = None
    """Offset x, y [m], phi [rad] from the target to an intermediate pose. If every motion arrives from the same
    intermediate offset, the backlash is always on the same side."""


class Observation(NamedTuple):
    """Marks in one picture, or their mean over several pictures, with the measured pose of the platform."""

    marks: Marks
    pose: Triple
    """Measured pose x, y [m], phi [rad]."""
    time: float
    """Time of the picture on the driver's clock [s]."""
    sliders: Triple | None = None
    """Measured positions of the sliders A, B, C [m]; if None, they are computed from the pose."""


class LookReport(NamedTuple):
    """Report about one look, which the driver forwards to the service. The procedure ignores the driver's answer."""

    purpose: Literal["calibration", "alignment", "check"]
    observation: Observation | None = None
    """Observation of the look; None if the report is not about a look."""
    measurement: Measurement | None = None
    """Measured error of the part; None in a calibration, and if the marks do not determine the part's pose."""
    correction: Triple | None = None
    """Next motion of the marks' centroid: x, y [m], phi [rad]; None if no motion follows."""
    end: str | None = None
    """Reason why the procedure ends; None if the procedure continues."""
    words: str = ""
    """Error message; empty if there is no error."""
    noise: float | None = None
    """Noise of the marks in a completed calibration [pixel]; None in other reports."""


LOOK: Literal["look"] = "look"
"""Request for a new picture without a motion. The driver answers with an Observation."""
AlignmentRequest = Literal["look"] | StageMotion | LookReport
