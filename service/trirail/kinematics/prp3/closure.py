"""Compiled loop closure of a leg of the 3-PRP mechanism, based on the recursion."""

from __future__ import annotations

from trirail.kinematics.algebra import add, cross, dot, scale, subtract
from trirail.kinematics.arrays import Array, Vector
from trirail.kinematics.compiled import compiled
from trirail.kinematics.loops import ClosedLeg, SlideLine
from trirail.kinematics.recursion import BASE, link, platform_centre

__all__ = ["close", "demand", "line"]


@compiled()
def close(leg: Array, pose: Vector) -> ClosedLeg:
    """Return the positions of slider and edge at a pose. With phi_21 = phi, (8), equation (11) is linear in them."""
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
    """Return the line of the edge at phi = 0 for a position of the slider. The edge passes through the slider's pin.

    The normal n of the edge rotates with the platform. At every phi, n . (pin - G) = c.
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
    """Return the normal n and the direction of the edge at phi, and the value that the leg requires for n . G."""
    n = add(scale(cosine, line.n), scale(sine, line.u))
    u = subtract(scale(cosine, line.u), scale(sine, line.n))
    return n, u, dot(n, line.point) - line.c
