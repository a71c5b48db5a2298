"""Compiled loop closure of a leg of the 3-PPR mechanism, based on the recursion."""

from __future__ import annotations

from trirail.kinematics.algebra import cross, dot, subtract
from trirail.kinematics.arrays import Array, Vector
from trirail.kinematics.compiled import compiled
from trirail.kinematics.loops import ClosedLeg, SlideLine
from trirail.kinematics.recursion import BASE, link, platform_centre

__all__ = ["close", "demand", "line"]


@compiled()
def close(leg: Array, pose: Vector) -> ClosedLeg:
    """Return the positions of slider and cross slide at a pose. They follow from a linear equation, as phi_32 = phi."""
    first = link(BASE, leg, 0, 0.0)
    second = link(first, leg, 1, 0.0)
    third = link(second, leg, 2, pose[2])
    rail, along = first.q[2], second.q[2]
    tip = platform_centre(leg, third)
    gap = subtract((pose[0], pose[1], 0.0), tip)
    delta = cross(rail, along)[2]
    lambda_10 = cross(gap, along)[2] / delta
    lambda_21 = cross(rail, gap)[2] / delta
    return ClosedLeg(lambda_10, lambda_21, delta, along, subtract(tip, third.p))


@compiled()
def line(leg: Array, slider: float) -> SlideLine:
    """Return the line of the cross slide for a position of the slider.

    The normal n of the cross slide is constant, and the arm e from G to the pivot rotates with the platform: n . G =
    n . carriage - n . R(phi) e.
    """
    first = link(BASE, leg, 0, slider)
    second = link(first, leg, 1, 0.0)
    third = link(second, leg, 2, 0.0)
    u, carriage = second.q[2], second.p
    n = u[1], -u[0], 0.0
    to_centre = subtract(platform_centre(leg, third), third.p)
    return SlideLine(first.q[2], u, n, carriage, dot(n, to_centre), -dot(u, to_centre), -dot(n, carriage))


@compiled()
def demand(line: SlideLine, cosine: float, sine: float) -> tuple[Vector, Vector, float]:
    """Return normal n and direction of the cross slide, and the value that the leg requires for n . G at phi."""
    return line.n, line.u, line.a * cosine + line.b * sine - line.c
