"""Results of the compiled functions of the mechanisms."""

from __future__ import annotations

from typing import NamedTuple

from trirail.kinematics.arrays import Vector

__all__ = ["ClosedLeg", "SlideLine"]


class ClosedLeg(NamedTuple):
    """Joint positions and directions of a leg for a given pose of the platform."""

    slider: float  # lambda_10
    passive: float  # position of the cross slide
    delta: float  # delta_i of (18), the sine of the angle from the rail to the cross slide
    cross: Vector  # direction of the cross slide, in T_0
    to_centre: Vector  # vector from the pivot to G, in T_0


class SlideLine(NamedTuple):
    """Line along which the platform can move at phi = 0 while the slider of the leg is fixed.

    If n is the normal of the cross slide, the leg requires n . G = a cos phi + b sin phi - c. Depending on the
    mechanism, either n rotates with phi, or the arm of the platform.
    """

    rail: Vector  # direction of the rail
    u: Vector  # direction of the cross slide
    n: Vector  # normal of the cross slide, (beta_1, beta_2, 0) of (18)
    point: Vector  # a point of the line: the pivot of the slider, or the carriage
    a: float
    b: float
    c: float
