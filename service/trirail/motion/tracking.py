"""A moving target met and gone with: smoothly where it is near, as fast as the limits allow where it is far.

A target is taken to keep its velocity. In the frame that goes with it, meeting it is coming to rest at the origin:
accelerations and jerks are the same there, and the limits of velocity are shifted by the target's. Whatever is planned
ends at rest: who hears no more of the target brakes, by the path itself.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from ruckig import InputParameter, Ruckig, Synchronization, Trajectory

from trirail.errors import RefusedError
from trirail.kinematics.arrays import Array
from trirail.motion.feasibility import Sampled
from trirail.motion.path_planner import GENTLEST, ROOM, TOO_FAST_IN_MOTION, PathPlanner, Plan
from trirail.motion.paths import Path, constant
from trirail.motion.quintic import Point, between
from trirail.motion.ruckig_call import Kinodynamic, solve_within
from trirail.motion.runs import STILL, MotionState, cut, from_ruckig, joined, nominal

CATCH_UP = 0.05
"""Time in which the platform comes to where its target is, smoothly, at least [s]. Behind a target whose acceleration
is a it stays by 0.15 a CATCH_UP²; a shorter one follows closer, and passes more of a target's noise on."""
EASE = 1.25
"""How many times longer than the quickest way a smooth one takes at least: it fits the same limits of acceleration and
jerk from rest to rest with a fifth to spare."""
TRIES = 3
"""How often a way is tried, with lower limits each time."""
SHORTER = 2
"""How often a path that leads out of the workspace is made to end before."""
HALVINGS = 12
"""Of the way to a target out of reach, until its last pose within reach is found."""


class _Aim(NamedTuple):
    """Where the platform is to go: a pose when the path begins, and a velocity that it keeps; and what keeps it there.

    `bound` names the limit beyond which the target itself is.
    """

    pose: Sequence[float]
    velocity: Sequence[float]
    bound: str | None


class Tracker:
    """Plans to follow moving targets, within the limits of platform and sliders."""

    def __init__(self, planner: PathPlanner) -> None:
        self._planner, self._platform = planner, planner.platform
        self._bounds, self._checker = planner.bounds, planner.checker
        self._ruckig = Ruckig(3)

    def follow(self, start: MotionState, pose: Sequence[float], velocity: Sequence[float], hold: float) -> Plan:
        """Plan to meet a target, that is at a pose when the path begins, and to keep its velocity; then to rest.

        After `hold` [s] it brakes at the latest, whether or not it has met the target. A target that is too fast is
        followed as fast as the limits allow, one out of reach as far as the border, straight on from where the platform
        is. Raises RefusedError where not even braking stays inside.
        """
        for aim in self._aims(start, pose, velocity):
            plan = self._toward(start, aim, hold)
            if plan is not None:
                return plan
        path = self._planner.to_velocity(start, STILL)
        if not self._checker.bears(self._checker.whole(path, start.pose)):
            raise TOO_FAST_IN_MOTION
        return Plan(path)

    # ------------------------------------------------------------------ inside

    def _aims(self, start: MotionState, pose: Sequence[float], velocity: Sequence[float]) -> Iterator[_Aim]:
        """Yield the target, brought inside the platform's box, and the last pose within reach on the way to it."""
        low, high = self._bounds.box
        met = np.add(pose, CATCH_UP * np.array(velocity))
        inside = np.clip(met, low, high)
        waits = inside != met
        violation = self._bounds.pose(met) if waits.any() else None
        aim = np.where(waits, inside, pose)
        yield _Aim(aim.tolist(), np.where(waits, 0.0, velocity).tolist(), violation and violation.bound)
        border, bound = self._border(start.pose, aim)
        yield _Aim(border, STILL, bound)

    def _border(self, pose: Sequence[float], aim: Array) -> tuple[Sequence[float], str | None]:
        """Return the last pose within reach on the straight way to another one, and what bounds it."""
        begin, way = np.array(pose), aim - pose
        low, high = 0.0, 1.0
        bound = self._checker.stands_beyond(aim.tolist())
        if bound is None:
            return aim.tolist(), None
        for _ in range(HALVINGS):
            middle = (low + high) / 2.0
            found = self._checker.stands_beyond((begin + middle * way).tolist())
            if found is None:
                low = middle
            else:
                high, bound = middle, found
        border: list[float] = (begin + low * way).tolist()
        return border, bound

    def _toward(self, start: MotionState, aim: _Aim, hold: float) -> Plan | None:
        """Plan with lower and lower limits until sliders and platform can take it; None where they never can."""
        shares = np.ones(3)
        for _ in range(TRIES):
            limits = Kinodynamic(*(np.array(self._platform) * shares[:, None]).tolist())
            bounds = [ROOM * most / abs(v) for v, most in zip(aim.velocity, limits.velocity, strict=True) if v]
            share = min([1.0, *bounds])
            velocity = [share * v for v in aim.velocity]
            try:
                quickest = self._quickest(start, aim.pose, velocity, limits)
            except RefusedError:
                return None
            smooth = _smooth(start, aim.pose, velocity, max(CATCH_UP, EASE * quickest.duration))
            for meeting in (smooth, quickest):
                path, found, bound = self._until(start, meeting, velocity, hold)
                if found.fits or (found.within_limits and not start.at_rest):
                    return Plan(path, bound=bound or aim.bound)
            if not math.isnan(found.leaves_at):
                return None
            shares = shares * np.clip(ROOM / found.worst.max(axis=0), GENTLEST, 1.0)
        return None

    def _until(
        self, start: MotionState, meeting: Path, velocity: Sequence[float], hold: float
    ) -> tuple[Path, Sampled, str | None]:
        """Return the way to a target and on with it up to a time, then to rest, and what was found along it.

        Where it would lead out of the workspace behind the target it brakes before that; then the bound is named.
        """
        way, until, bound = _gone_on_with(meeting, velocity, hold), hold, None
        for _ in range(SHORTER + 1):
            brake = self._planner.to_velocity(nominal(way, until), STILL)
            path = joined([cut(way, until), brake])
            found = self._checker.sample(path, constant(1.0), 0.0, path.duration, start.pose)
            if math.isnan(found.leaves_at) or found.leaves_at <= max(meeting.duration, brake.duration):
                break
            bound = self._checker.bound(path, found.leaves_at, start.pose)
            until = min(until, found.leaves_at) - brake.duration
        return path, found, bound

    def _quickest(
        self, start: MotionState, pose: Sequence[float], velocity: Sequence[float], limits: Kinodynamic
    ) -> Path:
        """Return the quickest way to a target, in the frame of the target and back. Raises RefusedError."""
        request, trajectory = InputParameter(3), Trajectory(3)
        request.current_position = np.subtract(start.pose, pose).tolist()
        request.current_velocity = np.subtract(start.velocity, velocity).tolist()
        request.current_acceleration = list(start.acceleration)
        request.max_velocity = np.subtract(limits.velocity, velocity).tolist()
        request.min_velocity = np.subtract(np.negative(limits.velocity), velocity).tolist()
        request.max_acceleration = list(limits.acceleration)
        request.synchronization = Synchronization.Phase
        solve_within(self._ruckig, request, trajectory, limits.jerk)
        relative = from_ruckig(trajectory)
        pieces = relative.pieces.copy()
        pieces[:, :, 0] += np.array(pose) + relative.knots[:-1, None] * velocity
        pieces[:, :, 1] += velocity
        return relative._replace(pieces=pieces)


def _smooth(start: MotionState, pose: Sequence[float], velocity: Sequence[float], duration: float) -> Path:
    """Return the way to a target in a time [s] with the least jerk, in the mean of its square."""
    met = np.add(pose, duration * np.array(velocity))
    return between(Point(0.0, *start), Point(duration, met.tolist(), velocity, STILL))


def _gone_on_with(meeting: Path, velocity: Sequence[float], hold: float) -> Path:
    """Return a way to a target, and on with it until `hold` is over [s]."""
    if meeting.duration >= hold:
        return meeting
    going = np.zeros((1, 3, 6))
    going[0, :, 0], going[0, :, 1] = meeting.end, velocity
    return joined([meeting, Path(np.array([0.0, hold - meeting.duration]), going)])
