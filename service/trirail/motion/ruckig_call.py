"""Ruckig, and what of its answers has to be dealt with."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from ruckig import ControlInterface, InputParameter, Result, Ruckig, RuckigError, Synchronization, Trajectory

from trirail.errors import RefusalCode, RefusedError
from trirail.motion.paths import Path
from trirail.motion.runs import NO_TOOL, MotionState, from_ruckig, tools_of

JERK_SHARES = (1.0, 1.0 - 1e-6, 1.0 - 1e-3)
"""Ruckig finds no solution just where one kind of profile gives way to another, as for a distance of 2 a³ / j²
from rest to rest: there a hair less jerk has one."""
FASTEST = 1e6
"""A limit for where nothing moves [m/s, m/s², m/s³]."""


class Kinodynamic(NamedTuple):
    """Greatest velocity, acceleration and jerk in each coordinate [m/s, rad/s, …]."""

    velocity: Sequence[float]
    acceleration: Sequence[float]
    jerk: Sequence[float]


def solved(ruckig: Ruckig, request: InputParameter, trajectory: Trajectory) -> bool:
    """Whether Ruckig has found a trajectory. Some of its failures raise, one (-101) by not being in its own enum."""
    try:
        return ruckig.calculate(request, trajectory) in (Result.Working, Result.Finished)
    except (RuckigError, ValueError):
        return False


def solve_within(ruckig: Ruckig, request: InputParameter, trajectory: Trajectory, jerk: Sequence[float]) -> None:
    """Have Ruckig find a trajectory for a request that lacks its limits of jerk. Raises RefusedError."""
    for share in JERK_SHARES:
        request.max_jerk = [share * limit for limit in jerk]
        if solved(ruckig, request, trajectory):
            return
    raise RefusedError(
        RefusalCode.NO_PLAN, "no motion leads there from the present one: send the goal again when it holds"
    )


class Solver:
    """Asks Ruckig for paths; none of them is looked at."""

    def __init__(self) -> None:
        self._together, self._along_a_line = Ruckig(3), Ruckig(1)

    def to_rest(
        self,
        start: MotionState,
        target: Sequence[float],
        limits: Kinodynamic,
        in_sliders: bool = False,
        tool: Sequence[float] = NO_TOOL,
    ) -> Path:
        """Return the way to rest at a target, straight from rest. Raises RefusedError.

        It is one of the sliders with `in_sliders`, else one of a tool's pose, (u, v) in the platform's frame [m].
        """
        if start.at_rest:
            return self._straight(start.pose, target, limits, in_sliders, tool)
        request = _request(start, limits)
        request.target_position = list(target)
        return self._solved(self._together, request, limits.jerk, in_sliders, tool)

    def to_velocity(
        self, start: MotionState, velocity: Sequence[float], limits: Kinodynamic, tool: Sequence[float] = NO_TOOL
    ) -> Path:
        """Return the quickest way to a tool's velocity [m/s, rad/s]. Raises RefusedError."""
        request = _request(start, limits)
        request.control_interface = ControlInterface.Velocity
        request.target_velocity = list(velocity)
        return self._solved(self._together, request, limits.jerk, tool=tool)

    def _straight(
        self,
        begin: Sequence[float],
        target: Sequence[float],
        limits: Kinodynamic,
        in_sliders: bool,
        tool: Sequence[float],
    ) -> Path:
        """Return the straight way from rest to rest, in the coordinate that goes farthest; the others share its time.

        Ruckig's phase synchronisation gives up where one coordinate's velocity, acceleration or jerk would have to be
        lower than it takes alone: three goals in a hundred then left their line.
        """
        length = np.subtract(target, begin)
        farthest = float(np.abs(length).max())
        shares = length / farthest if farthest else np.zeros(3)
        with np.errstate(divide="ignore", over="ignore"):  # a coordinate that stays where it is bounds nothing
            velocity, acceleration, jerk = (np.array(limits) / np.abs(shares)).min(axis=1)
        request = InputParameter(1)
        request.target_position = [farthest]
        request.max_velocity, request.max_acceleration = [min(velocity, FASTEST)], [min(acceleration, FASTEST)]
        along = self._solved(self._along_a_line, request, [min(jerk, FASTEST)])
        pieces = along.pieces * shares[:, None]
        pieces[:, :, 0] += begin
        return Path(along.knots, pieces, in_sliders, tools_of(tool, len(pieces)))

    @staticmethod
    def _solved(
        ruckig: Ruckig,
        request: InputParameter,
        jerk: Sequence[float],
        in_sliders: bool = False,
        tool: Sequence[float] = NO_TOOL,
    ) -> Path:
        trajectory = Trajectory(request.degrees_of_freedom)
        solve_within(ruckig, request, trajectory, jerk)
        return from_ruckig(trajectory, in_sliders, tool)


def _request(start: MotionState, limits: Kinodynamic) -> InputParameter:
    """Return what Ruckig is asked from a state of motion, but for where to, and for the limits of jerk."""
    request = InputParameter(3)
    request.current_position = list(start.pose)
    request.current_velocity = list(start.velocity)
    request.current_acceleration = list(start.acceleration)
    request.max_velocity = list(limits.velocity)
    request.max_acceleration = list(limits.acceleration)
    request.synchronization = Synchronization.Phase
    return request
