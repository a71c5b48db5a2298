"""Closed leg of the 3-PRP mechanism, compiled and based on the recursion."""

from __future__ import annotations

from trirail.kinematics.algebra import add, cross, dot, scale, subtract
from trirail.kinematics.arrays import Array, Vector
from trirail.kinematics.compiled import compiled
from trirail.kinematics.loops import ClosedLeg, SlideLine
from trirail.kinematics.recursion import BASE, link, platform_centre

__all__ = ["close", "demand", "line"]


@compiled()
def close(leg: Array, pose: Vector) -> ClosedLeg:
    """Solve (11), linear with phi_21 = phi by (8), for the positions of rail and edge that bring G to the pose."""
    first = link(BASE, leg, 0, 0.0)
    third = link(link(first, leg, 1, pose[2]), leg, 2, 0.0)
    rail, edge = first.q[2], third.q[2]
    centre = pose[0], pose[1], 0.0
    gap = subtract(centre, platform_centre(leg, third))
    delta = cross(rail, edge)[2]
    lambda_10 = cross(gap, edge)[2] / delta
    lambda_32 = cross(rail, gap)[2] / delta
    pin = add(third.p, scale(lambda_10, rail))
    return ClosedLeg(lambda_10, lambda_32, delta, edge, subtract(centre, pin))


@compiled()
def line(leg: Array, slider: float) -> SlideLine:
    """Return the edge before the platform turns, and the pin through which the slider makes the edge pass.

    The normal turns with the platform, and n . (pin - G) = c at every phi.
    """
    first = link(BASE, leg, 0, slider)
    third = link(link(first, leg, 1, 0.0), leg, 2, 0.0)
    u, pin = third.q[2], third.p
    n = u[1], -u[0], 0.0
    return SlideLine(
        first.q[2], u, n, pin, dot(n, pin), dot(u, pin), dot(n, subtract(pin, platform_centre(leg, third)))
    )


@compiled()
def demand(line: SlideLine, cosine: float, sine: float) -> tuple[Vector, Vector, float]:
    """Return the normal and the direction of the edge at phi, and the n . G that the leg requires there."""
    n = add(scale(cosine, line.n), scale(sine, line.u))
    u = subtract(scale(cosine, line.u), scale(sine, line.n))
    return n, u, dot(n, line.point) - line.c
