"""Loop equation of a leg of either mechanism, solved with 60 digits and without any code of the service."""

from __future__ import annotations

from collections.abc import Sequence
from decimal import Decimal, localcontext

DIGITS = 60
Point = tuple[Decimal, Decimal]


def cos_sin(angle: float | Decimal) -> Point:
    """Return the cosine and the sine of an angle, computed from their power series."""
    with localcontext() as context:
        context.prec = DIGITS + 10
        x, term = Decimal(angle), Decimal(1)
        sums = [Decimal(0), Decimal(0), Decimal(0), Decimal(0)]  # of every fourth term
        for n in range(1, 200):
            sums[(n - 1) % 4] += term
            term = term * x / n
    return sums[0] - sums[2], sums[1] - sums[3]


def travels(
    anchor: Sequence[float],
    rail_angle: float,
    home: float,
    held: Sequence[float],
    cross_angle: float,
    turns: bool,
    pose: Sequence[float | Decimal],
) -> tuple[Decimal, Decimal]:
    """Return the positions of slider and cross slide for a pose of the platform [m].

    The equation is anchor + (home + slider) u(rail) + passive u(cross) = G + R(phi) held. If the cross slide `turns`
    with the platform, phi is added to `cross_angle`. The solution uses Cramer's rule.
    """
    with localcontext() as context:
        context.prec = DIGITS
        x, y, phi = map(Decimal, pose)
        c, s = cos_sin(phi)
        rail = cos_sin(rail_angle)
        cross = cos_sin(Decimal(cross_angle) + phi if turns else cross_angle)
        u, v = map(Decimal, held)
        way = x + c * u - s * v - Decimal(anchor[0]), y + s * u + c * v - Decimal(anchor[1])
        delta = rail[0] * cross[1] - rail[1] * cross[0]
        slider = (way[0] * cross[1] - way[1] * cross[0]) / delta - Decimal(home)
        return slider, (rail[0] * way[1] - rail[1] * way[0]) / delta
