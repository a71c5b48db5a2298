"""Plans of the platform's motion: jerk-limited, from any state of motion, checked before they start."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from ruckig import ControlInterface, InputParameter, Result, Ruckig, RuckigError, Synchronization, Trajectory

from service.config import PlatformLimits
from service.errors import KinematicsError, RefusedError
from service.geometry import Geometry
from service.kinematics import inverse
from service.limits import LEGS, Bounds

SAMPLES = 64
"""Poses at which a path is checked before it is accepted."""
HEADROOM = 0.98
"""A path that was too fast is slowed to this share of the limit, for what lies between the samples."""
ATTEMPTS = 4
"""How often a path may be slowed before it is refused."""

JERK_SHARES = (1.0, 1.0 - 1e-6, 1.0 - 1e-3)
"""Ruckig finds no solution just where one kind of profile gives way to another, as for a distance of 2 a³ / j²
from rest to rest: there a hair less jerk has one."""


class MotionState(NamedTuple):
    """Platform pose, velocity and acceleration: x, y [m], phi [rad], and per second."""

    pose: Sequence[float]
    velocity: Sequence[float]
    acceleration: Sequence[float]

    @property
    def at_rest(self) -> bool:
        """Whether nothing moves."""
        return not any(self.velocity) and not any(self.acceleration)


STILL = (0.0, 0.0, 0.0)


def rest(pose: Sequence[float]) -> MotionState:
    """Stand at a pose."""
    return MotionState(tuple(pose), STILL, STILL)


class Plan:
    """A motion in time: where the platform is told to be, from 0 to `duration` seconds and after."""

    def __init__(self, trajectory: Trajectory) -> None:
        self._trajectory = trajectory
        self.duration: float = trajectory.duration

    def at(self, time: float) -> MotionState:
        """Evaluate at a time [s]; after the end the platform stands."""
        if time >= self.duration:
            return rest(self._trajectory.at_time(self.duration)[0])
        return MotionState(*self._trajectory.at_time(time))


class Planner:
    """Makes plans within the platform's limits and the sliders' bounds."""

    def __init__(self, geometry: Geometry, limits: PlatformLimits, bounds: Bounds) -> None:
        self._geometry = geometry
        self._limits = limits
        self._bounds = bounds
        self._ruckig = Ruckig(3)

    def to_pose(self, start: MotionState, target: Sequence[float], speed: float = 1.0) -> Plan:
        """Plan from any state of motion to rest at a pose; at `speed` 0.5 the same path takes twice as long.

        The whole path is checked: one that leaves the workspace is refused, one that is too fast for a slider is
        slowed. Raises RefusedError with slider or coordinate, value and limit.
        """
        if violation := self._bounds.pose(target):
            raise RefusedError(
                "out_of_workspace",
                f"the goal is out of the workspace: {violation}",
                value=violation.value,
                limit=violation.limit,
            )
        for _ in range(ATTEMPTS):
            plan = self._plan(start, target, speed)
            excess = self._excess(plan)
            if excess <= 1.0:
                return plan
            speed *= HEADROOM / excess
        raise RefusedError(
            "too_fast",
            "from its present motion the robot cannot take this path within its sliders' limits; "
            "send the goal again when it holds",
        )

    def brake(self, start: MotionState) -> Plan:
        """Plan from any state of motion to rest, along the present direction where that is straight."""
        request = self._request(start, 1.0)
        request.control_interface = ControlInterface.Velocity
        request.target_velocity = STILL
        request.target_acceleration = STILL
        return self._solve(request)

    def _plan(self, start: MotionState, target: Sequence[float], speed: float) -> Plan:
        request = self._request(start, speed)
        request.target_position = list(target)
        return self._solve(request)

    def _request(self, start: MotionState, speed: float) -> InputParameter:
        request = InputParameter(3)
        request.current_position = list(start.pose)
        request.current_velocity = list(start.velocity)
        request.current_acceleration = list(start.acceleration)
        # The same path k times slower has k times the velocity, k² the acceleration and k³ the jerk.
        request.max_velocity = [speed * limit for limit in self._limits.velocity]
        request.max_acceleration = [speed**2 * limit for limit in self._limits.acceleration]
        request.max_jerk = [speed**3 * limit for limit in self._limits.jerk]
        request.synchronization = Synchronization.Phase
        return request

    def _solve(self, request: InputParameter) -> Plan:
        trajectory = Trajectory(3)
        jerk = request.max_jerk
        for share in JERK_SHARES:
            request.max_jerk = [share * limit for limit in jerk]
            with contextlib.suppress(RuckigError):
                if self._ruckig.calculate(request, trajectory) in (Result.Working, Result.Finished):
                    return Plan(trajectory)
        raise RefusedError("no_plan", "no motion leads there from the present one: send the goal again when it holds")

    def _excess(self, plan: Plan) -> float:
        """How many times too fast the plan is for a slider. Raises RefusedError if it leaves the workspace."""
        times = np.linspace(0.0, plan.duration, SAMPLES)
        states: NDArray[np.float64] = np.array([plan.at(time) for time in times.tolist()])
        pose = states[:, 0]
        try:
            motion = inverse(self._geometry, pose, states[:, 1], states[:, 2])
        except KinematicsError as error:
            raise RefusedError("out_of_workspace", f"the path leads out of the workspace: {error}") from error
        if found := self._bounds.path(pose, motion.position, motion.passive_position):
            row, violation = found
            raise RefusedError(
                "out_of_workspace",
                f"the path leads out of the workspace after {row / (SAMPLES - 1):.0%} of its time: {violation}",
                slider=violation.what if violation.what in LEGS else None,
                value=violation.value,
                limit=violation.limit,
            )
        velocity = np.abs(motion.velocity).max() / self._bounds.velocity
        acceleration = np.abs(motion.acceleration).max() / self._bounds.acceleration
        return max(float(velocity), math.sqrt(float(acceleration)))
