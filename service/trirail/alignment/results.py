"""Result of an alignment: the measurements, the corrections between them, and the reason why it ended."""

from __future__ import annotations

import math
from enum import StrEnum

import msgspec
import numpy as np
from trirail_drivers.interface import Triple

from trirail.alignment.images import Pair
from trirail.alignment.rigid_motion import Floats


class AlignmentEnd(StrEnum):
    """Reason why an alignment ended."""

    REACHED = "reached"
    """Every mark and the part's angle are within tolerance."""
    CORRECTIONS = "corrections"
    """The allowed number of corrections has been used."""
    GROWING = "growing"
    """A correction increased the error, because of a wrong sign, a mirrored picture, or a camera that was moved."""
    NOISE = "noise"
    """The noise of a look exceeds the tolerance, and the remaining error is within that noise."""


class Measurement(msgspec.Struct, frozen=True):
    """Error of the part measured by one look."""

    marks: dict[str, Pair]
    """Pixels of the marks, the mean over the pictures of the look."""
    errors: dict[str, Pair]
    """Displacement of each mark to its target, x, y in the base frame [m]."""
    worst: float
    """Greatest distance that a mark travels in the motion that aligns the part [m]."""
    shift: Pair
    """Displacement of the marks' centroid to its target [m]."""
    turn: float
    """Angle between the part and its target, counterclockwise [rad]."""
    misfit: float
    """Greatest distance of a mark from its target after the best rigid motion [m]."""
    distance: float
    """Relative error of the distance between two marks, for the worst pair."""
    pose: Triple
    """Measured pose of the platform: x, y [m], phi [rad]."""
    time: float
    """Time of the look on the driver's clock [s]."""


class AlignmentCorrection(msgspec.Struct, frozen=True):
    """Correction motion that has been completed."""

    by: Triple
    """Motion of the marks' centroid: x, y [m]; phi [rad]."""
    share: float
    """Corrected share of the measured error. It is below 1 for the first correction with an unconfirmed calibration."""
    seconds: float
    """Time from the preceding look until the robot is at rest [s]."""


class Alignment(msgspec.Struct, frozen=True):
    """History of an alignment. It has one more measurement than corrections."""

    why: AlignmentEnd
    measurements: tuple[Measurement, ...]
    corrections: tuple[AlignmentCorrection, ...]
    seconds: float
    """Time from the first look to the last."""
    confirmed: bool
    """True if a correction with this calibration, here or before, had the predicted effect."""

    @property
    def reached(self) -> bool:
        """True if every mark and the part's angle are within tolerance."""
        return self.why is AlignmentEnd.REACHED

    @property
    def marks(self) -> tuple[str, ...]:
        """Names of the observed marks, sorted: the rows of `residuals`."""
        return tuple(sorted({name for each in self.measurements for name in each.errors}))

    @property
    def residuals(self) -> Floats:
        """Distance of each mark from its target at each look, (marks, looks) [m]; NaN for a mark that was not found."""
        errors = [[each.errors.get(name, (math.nan, math.nan)) for each in self.measurements] for name in self.marks]
        return np.asarray(np.linalg.norm(errors, axis=2))

    @property
    def angle(self) -> float:
        """Angle of the part at the last look [rad]."""
        return self.measurements[-1].turn
