"""Calls to the trajectory generator Ruckig, with workarounds for inputs for which Ruckig fails."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from ruckig import ControlInterface, InputParameter, Result, Ruckig, RuckigError, Synchronization, Trajectory

from trirail.errors import RefusalCode, RefusedError
from trirail.kinematics.arrays import Array
from trirail.motion.paths import Path
from trirail.motion.runs import NO_TOOL, MotionState, from_ruckig, repeat_tool

JERK_SHARES = (1.0, 1.0 - 1e-6, 1.0 - 1e-3)
"""Fractions of the jerk limit that are tried in turn. Ruckig fails exactly at the border between two kinds of profile,
for example for a distance of 2 a³ / j² from rest to rest. With a slightly lower jerk limit, Ruckig finds a solution."""
PARALLEL_TOLERANCE = 1e-9
"""Motion across a line that is treated as rounding [m/s, m/s², m/s³]. If the greatest rate is above 1, the tolerance is
relative to the greatest rate."""
UNBOUNDED_LIMIT = 1e6
"""Limit for Ruckig in place of infinity, for motions to which no limit applies [m/s, m/s², m/s³]."""


class Kinodynamic(NamedTuple):
    """Velocity, acceleration and jerk limits of each coordinate [m/s, rad/s, …]."""

    velocity: Sequence[float]
    acceleration: Sequence[float]
    jerk: Sequence[float]


def try_solve(ruckig: Ruckig, request: InputParameter, trajectory: Trajectory) -> bool:
    """Return whether Ruckig finds a trajectory.

    Some failures raise an exception. Code -101 raises ValueError, because it is missing in Ruckig's Python enum.
    """
    try:
        return ruckig.calculate(request, trajectory) in (Result.Working, Result.Finished)
    except (RuckigError, ValueError):
        return False


def solve_within(ruckig: Ruckig, request: InputParameter, trajectory: Trajectory, jerk: Sequence[float]) -> None:
    """Solve a request with the given jerk limits or, if that fails, slightly lower limits. Raises RefusedError."""
    for share in JERK_SHARES:
        request.max_jerk = [share * limit for limit in jerk]
        if try_solve(ruckig, request, trajectory):
            return
    raise RefusedError(
        RefusalCode.NO_PLAN,
        "no motion leads from the present motion to the goal: send the goal again when the robot is at rest",
    )


class Solver:
    """Path solver based on Ruckig. The paths are not checked against the workspace."""

    def __init__(self) -> None:
        self._three_axes, self._one_axis = Ruckig(3), Ruckig(1)

    def to_rest(
        self,
        start: MotionState,
        target: Sequence[float],
        limits: Kinodynamic,
        in_sliders: bool = False,
        tool: Sequence[float] = NO_TOOL,
    ) -> Path:
        """Return the path to rest at a target. A path that starts at rest is straight. Raises RefusedError.

        If `in_sliders` is set, the target consists of slider positions. Otherwise, the target is the pose of the tool,
        (u, v) in the platform's frame [m].
        """
        if start.at_rest:
            return self._straight(start.pose, target, limits, in_sliders, tool)
        request = _request(start, limits)
        request.target_position = list(target)
        return self._solve(self._three_axes, request, limits.jerk, in_sliders, tool)

    def to_velocity(
        self, start: MotionState, velocity: Sequence[float], limits: Kinodynamic, tool: Sequence[float] = NO_TOOL
    ) -> Path:
        """Return the quickest path to a velocity of the tool [m/s, rad/s]. Raises RefusedError."""
        request = _request(start, limits)
        request.control_interface = ControlInterface.Velocity
        request.target_velocity = list(velocity)
        return self._solve(self._three_axes, request, limits.jerk, tool=tool)

    def to_velocity_straight(
        self, start: MotionState, velocity: Sequence[float], limits: Kinodynamic, tool: Sequence[float] = NO_TOOL
    ) -> Path:
        """Return a path to a velocity of the tool that is straight if the motion begins along the line of the velocity.

        Otherwise, the result is the path of to_velocity. For some straight paths, the phase synchronisation of Ruckig
        fails; see `_straight`. In these cases, one coordinate is solved, and the others are scaled copies.
        """
        direction = np.array(velocity if any(velocity) else start.velocity)
        farthest = float(np.abs(direction).max())
        path = self.to_velocity(start, velocity, limits, tool)
        moving = np.array((start.velocity, start.acceleration))
        if (
            farthest == 0.0
            or not _is_parallel(moving, direction)
            or _is_parallel(np.swapaxes(path.pieces[:, :, 1:4], 1, 2), direction)
        ):
            return path
        shares, axis = direction / farthest, int(np.abs(direction).argmax())
        sign = math.copysign(1.0, direction[axis])
        with np.errstate(divide="ignore", over="ignore"):  # a coordinate at rest sets no bound
            _, acceleration, jerk = (np.array(limits) / np.abs(shares)).min(axis=1)
        request = InputParameter(1)
        request.control_interface = ControlInterface.Velocity
        request.current_velocity = [sign * start.velocity[axis]]
        request.current_acceleration = [sign * start.acceleration[axis]]
        request.target_velocity = [sign * velocity[axis]]
        request.max_acceleration = [min(acceleration, UNBOUNDED_LIMIT)]
        along = self._solve(self._one_axis, request, [min(jerk, UNBOUNDED_LIMIT)])
        pieces = along.pieces * shares[:, None]
        pieces[:, :, 0] += start.pose
        return Path(along.knots, pieces, tools=repeat_tool(tool, len(pieces)))

    def _straight(
        self,
        begin: Sequence[float],
        target: Sequence[float],
        limits: Kinodynamic,
        in_sliders: bool,
        tool: Sequence[float],
    ) -> Path:
        """Return the straight path from rest to rest.

        Ruckig solves the motion of the coordinate with the longest way. The other coordinates are scaled copies. The
        phase synchronisation of Ruckig is not used, because it fails if a coordinate would have to use less velocity,
        acceleration or jerk than it would use alone: 3 % of the goals left their line.
        """
        length = np.subtract(target, begin)
        farthest = float(np.abs(length).max())
        shares = length / farthest if farthest else np.zeros(3)
        with np.errstate(divide="ignore", over="ignore"):  # a coordinate at rest sets no bound
            velocity, acceleration, jerk = (np.array(limits) / np.abs(shares)).min(axis=1)
        request = InputParameter(1)
        request.target_position = [farthest]
        request.max_velocity, request.max_acceleration = (
            [min(velocity, UNBOUNDED_LIMIT)],
            [min(acceleration, UNBOUNDED_LIMIT)],
        )
        along = self._solve(self._one_axis, request, [min(jerk, UNBOUNDED_LIMIT)])
        pieces = along.pieces * shares[:, None]
        pieces[:, :, 0] += begin
        return Path(along.knots, pieces, in_sliders, repeat_tool(tool, len(pieces)))

    @staticmethod
    def _solve(
        ruckig: Ruckig,
        request: InputParameter,
        jerk: Sequence[float],
        in_sliders: bool = False,
        tool: Sequence[float] = NO_TOOL,
    ) -> Path:
        trajectory = Trajectory(request.degrees_of_freedom)
        solve_within(ruckig, request, trajectory, jerk)
        return from_ruckig(trajectory, in_sliders, tool)


def _is_parallel(rows: Array, direction: Array) -> bool:
    """Return whether all rows (..., 3) are parallel to a direction (3,), within rounding."""
    unit = direction / np.abs(direction).max()  # first by the largest component, since squares of tiny ones are 0
    unit = unit / np.linalg.norm(unit)
    across = rows - (rows @ unit)[..., None] * unit
    return bool(np.abs(across).max(initial=0.0) <= PARALLEL_TOLERANCE * max(1.0, float(np.abs(rows).max(initial=0.0))))


def _request(start: MotionState, limits: Kinodynamic) -> InputParameter:
    """Return Ruckig's input for a state of motion, without a target and without jerk limits."""
    request = InputParameter(3)
    request.current_position = list(start.pose)
    request.current_velocity = list(start.velocity)
    request.current_acceleration = list(start.acceleration)
    request.max_velocity = list(limits.velocity)
    request.max_acceleration = list(limits.acceleration)
    request.synchronization = Synchronization.Phase
    return request
