"""Result of an alignment: all measurements and corrections, and the reason why the alignment ended."""

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
    """All marks and the angle of the part are within tolerance."""
    CORRECTIONS = "corrections"
    """The permitted number of corrections has been made, but the part is not within tolerance."""
    GROWING = "growing"
    """A correction has increased the error. Causes are a wrong sign, a mirrored picture, or a camera that was moved."""
    NOISE = "noise"
    """The noise of a look exceeds the tolerance, and the remaining error is within the noise."""


class Measurement(msgspec.Struct, frozen=True):
    """Misalignment of the part, as measured by one look."""

    marks: dict[str, Pair]
    """Pixels of the marks, averaged over the pictures of the look."""
    errors: dict[str, Pair]
    """Displacement from each mark to its target, x, y in the base frame [m]."""
    worst: float
    """Greatest distance that a mark travels in the motion that aligns the part [m]."""
    shift: Pair
    """Displacement from the centroid of the marks to its target [m]."""
    turn: float
    """Rotation that aligns the part, counterclockwise [rad]."""
    misfit: float
    """Greatest distance of a mark from its target that would remain after the best rigid motion [m]."""
    distance: float
    """Relative error of the distance between two marks, for the pair with the greatest error."""
    pose: Triple
    """Measured pose of the platform: x, y [m], phi [rad]."""
    time: float
    """Time of the look on the driver's clock [s]."""


class AlignmentCorrection(msgspec.Struct, frozen=True):
    """Motion that has been made to correct the misalignment."""

    by: Triple
    """Motion of the centroid of the marks: x, y [m], phi [rad]."""
    share: float
    """Fraction of the measured error that was corrected. It may be less than 1 if the calibration is unconfirmed."""
    seconds: float
    """Time from the look before the correction until the robot was at rest [s]."""


class Alignment(msgspec.Struct, frozen=True):
    """Result and history of an alignment. The number of measurements is the number of corrections plus one."""

    why: AlignmentEnd
    measurements: tuple[Measurement, ...]
    corrections: tuple[AlignmentCorrection, ...]
    seconds: float
    """Time from the first look to the last look [s]."""
    confirmed: bool
    """True if a correction with this calibration, in this or an earlier alignment, had the predicted effect."""

    @property
    def reached(self) -> bool:
        """True if all marks and the angle of the part are within tolerance."""
        return self.why is AlignmentEnd.REACHED

    @property
    def marks(self) -> tuple[str, ...]:
        """Names of the observed marks in alphabetical order, which is the order of the rows of `residuals`."""
        return tuple(sorted({name for each in self.measurements for name in each.errors}))

    @property
    def residuals(self) -> Floats:
        """Distances of the marks from their targets, (marks, looks) [m]; NaN if a mark was not found in a look."""
        errors = [[each.errors.get(name, (math.nan, math.nan)) for each in self.measurements] for name in self.marks]
        return np.asarray(np.linalg.norm(errors, axis=2))

    @property
    def angle(self) -> float:
        """Rotation that would still be needed to align the part after the last look [rad]."""
        return self.measurements[-1].turn
