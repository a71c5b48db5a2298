"""What an alignment comes to: what each look told, the corrections between them, and why it ended."""

from __future__ import annotations

import math
from enum import StrEnum

import msgspec
import numpy as np
from trirail_drivers.interface import Triple

from trirail.alignment.images import Pair
from trirail.alignment.rigid import Floats


class AlignmentEnd(StrEnum):
    """Why an alignment ended."""

    REACHED = "reached"
    """Every mark is within the tolerance, and the part's angle."""
    CORRECTIONS = "corrections"
    """As many corrections have been made as were allowed."""
    GROWING = "growing"
    """The error grew by a correction: a sign, a mirror, or a camera that was moved."""


class Measurement(msgspec.Struct, frozen=True):
    """What one look told."""

    marks: dict[str, Pair]
    """Pixels of the marks; the mean where several pictures were taken."""
    errors: dict[str, Pair]
    """How far each mark has to go to its target, x, y in the base frame [m]."""
    worst: float
    """The greatest distance that a mark goes by the motion that aligns the part [m]."""
    shift: Pair
    """How far the middle of the marks has to go [m]."""
    turn: float
    """By what angle the part has to turn [rad]."""
    misfit: float
    """The greatest distance of a mark from its target that no motion takes away [m]."""
    distance: float
    """By how much the worst distance of two marks is wrong, as a share of it."""
    pose: Triple
    """Of the platform, measured: x, y [m], phi [rad]."""
    time: float
    """When, on the clock of who looked [s]."""


class AlignmentCorrection(msgspec.Struct, frozen=True):
    """One motion that was made."""

    by: Triple
    """Of the marks' middle: x, y [m]; phi [rad]."""
    share: float
    """Of what the look before it told: below 1 for the first of a calibration that is not confirmed."""
    seconds: float
    """From the look before it until the robot stood."""


class Alignment(msgspec.Struct, frozen=True):
    """How an alignment went: one more measurement than corrections."""

    why: AlignmentEnd
    measurements: tuple[Measurement, ...]
    corrections: tuple[AlignmentCorrection, ...]
    seconds: float
    """From the first look to the last."""
    confirmed: bool
    """Whether a correction has gone where it should with this calibration, here or before."""

    @property
    def reached(self) -> bool:
        """Whether the part lies right."""
        return self.why is AlignmentEnd.REACHED

    @property
    def marks(self) -> tuple[str, ...]:
        """The marks that were seen, by name: the rows of `residuals`."""
        return tuple(sorted({name for each in self.measurements for name in each.errors}))

    @property
    def residuals(self) -> Floats:
        """How far each mark was from its target at each look, (marks, looks) [m]; NaN where it was not seen."""
        errors = [[each.errors.get(name, (math.nan, math.nan)) for each in self.measurements] for name in self.marks]
        return np.asarray(np.linalg.norm(errors, axis=2))

    @property
    def angle(self) -> float:
        """By what angle the part was still turned at the last look [rad]."""
        return self.measurements[-1].turn
