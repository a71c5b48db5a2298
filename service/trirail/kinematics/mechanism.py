"""Dispatch of compiled calls to the functions of the mechanism to which a packed leg belongs.

The mechanism is known from the second joint, which is revolute in a 3-PRP leg and prismatic in a 3-PPR leg.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from trirail.kinematics.algebra import dot
from trirail.kinematics.arrays import Array, Vector
from trirail.kinematics.compiled import compiled, inlined
from trirail.kinematics.leg import PARALLEL
from trirail.kinematics.loops import ClosedLeg, SlideLine
from trirail.kinematics.ppr3 import closure as ppr3
from trirail.kinematics.prp3 import closure as prp3
from trirail.kinematics.recursion import joint_motion

__all__ = ["MovingLeg", "beta", "close", "demand", "line", "move"]

_close_prp3, _line_prp3, _demand_prp3 = prp3.close, prp3.line, prp3.demand
_close_ppr3, _line_ppr3, _demand_ppr3 = ppr3.close, ppr3.line, ppr3.demand


class MovingLeg(NamedTuple):
    """Positions, velocities and accelerations of the joints of a leg for a motion of the platform."""

    closed: ClosedLeg
    rate: float  # of the slider
    acceleration: float  # of the slider
    passive_rate: float  # of the cross slide
    passive_acceleration: float  # of the cross slide
    regular: bool  # False if the leg is singular or a number is not finite


@inlined
def _turns_second(leg: Array) -> bool:
    """Return whether the second joint is revolute, that is, the pivot is on the carriage, as in a 3-PRP leg."""
    return bool(leg[1, 0] != 0.0)


@compiled()
def close(leg: Array, pose: Vector) -> ClosedLeg:
    """Return the joint positions of a leg for a pose of the platform."""
    return _close_prp3(leg, pose) if _turns_second(leg) else _close_ppr3(leg, pose)


@compiled()
def line(leg: Array, slider: float) -> SlideLine:
    """Return the line along which a leg allows the platform to move while its slider is fixed."""
    return _line_prp3(leg, slider) if _turns_second(leg) else _line_ppr3(leg, slider)


@compiled()
def demand(leg: Array, line: SlideLine, cosine: float, sine: float) -> tuple[Vector, Vector, float]:
    """Return the normal n and the direction of a cross slide at phi, and the value that the leg requires for n . G."""
    return _demand_prp3(line, cosine, sine) if _turns_second(leg) else _demand_ppr3(line, cosine, sine)


@compiled()
def move(leg: Array, pose: Vector, velocity: Vector, acceleration: Vector) -> MovingLeg:
    """Return the motion of the joints of a leg for a motion of the platform."""
    if _turns_second(leg):  # a single branch with two returns: merging the results would take 10 % more time
        closed = _close_prp3(leg, pose)
        rates, changes = joint_motion(leg, (closed.slider, pose[2], closed.passive), velocity, acceleration)
        return _moving(closed, rates[0], changes[0], rates[2], changes[2])
    closed = _close_ppr3(leg, pose)
    rates, changes = joint_motion(leg, (closed.slider, closed.passive, pose[2]), velocity, acceleration)
    return _moving(closed, rates[0], changes[0], rates[1], changes[1])


@inlined
def _moving(closed: ClosedLeg, rate: float, change: float, passive_rate: float, passive_change: float) -> MovingLeg:
    total = closed.slider + rate + change + closed.passive + passive_rate + passive_change
    regular = abs(closed.delta) > PARALLEL and math.isfinite(total)
    return MovingLeg(closed, rate, change, passive_rate, passive_change, regular)


@compiled()
def beta(closed: ClosedLeg) -> Vector:
    """Return the row of J2 that belongs to a leg, (18)."""
    return closed.cross[1], -closed.cross[0], dot(closed.cross, closed.to_centre)
