"""Results of the compiled mechanisms: a closed leg, and a leg's line before the platform turns."""

from __future__ import annotations

from typing import NamedTuple

from trirail.kinematics.arrays import Vector

__all__ = ["ClosedLeg", "SlideLine"]


class ClosedLeg(NamedTuple):
    """A leg whose last link has the platform's pose."""

    slider: float  # lambda_10
    passive: float  # of the cross slide
    delta: float  # delta_i of (18): the sine of the angle from rail to cross slide
    cross: Vector  # direction of the cross slide, in T_0
    to_centre: Vector  # from the pivot to G, in T_0


class SlideLine(NamedTuple):
    """The line that a leg's cross slide leaves to the platform while its slider stands, at phi = 0.

    With n the normal of the cross slide, and either n or the platform's arm turning with phi, the leg demands
    n . G = a cos phi + b sin phi - c.
    """

    rail: Vector  # direction of the rail
    u: Vector  # direction of the cross slide
    n: Vector  # its normal, (beta_1, beta_2, 0) of (18)
    point: Vector  # of the line: the slider's pivot, or its carriage
    a: float
    b: float
    c: float
