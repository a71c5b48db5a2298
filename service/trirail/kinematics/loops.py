"""Results of the compiled mechanisms: a closed leg, and the line of a leg before the platform turns."""

from __future__ import annotations

from typing import NamedTuple

from trirail.kinematics.arrays import Vector

__all__ = ["ClosedLeg", "SlideLine"]


class ClosedLeg(NamedTuple):
    """Leg that is closed by the pose of the platform."""

    slider: float  # lambda_10
    passive: float  # position of the cross slide
    delta: float  # delta_i of (18), the sine of the angle from rail to cross slide
    cross: Vector  # direction of the cross slide, in T_0
    to_centre: Vector  # from the pivot to G, in T_0


class SlideLine(NamedTuple):
    """Line along which the cross slide lets the platform move while the slider is fixed, at phi = 0.

    With n as the normal of the cross slide, and with either n or the arm of the platform turning with phi, the leg
    requires n . G = a cos phi + b sin phi - c.
    """

    rail: Vector  # direction of the rail
    u: Vector  # direction of the cross slide
    n: Vector  # its normal, (beta_1, beta_2, 0) of (18)
    point: Vector  # a point of the line: the slider's pivot, or its carriage
    a: float
    b: float
    c: float
