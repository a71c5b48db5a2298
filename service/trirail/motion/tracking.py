"""Planning of the motion of a track, which follows a moving target.

The motion is smooth if the target is near, and as fast as the limits allow if the target is far. The planner assumes
that the velocity of the target remains constant. In a frame that moves with the target, the motion to the target ends
at rest at the origin. Accelerations and jerks are the same in this frame, and the velocity limits are shifted by the
velocity of the target. Every path ends at rest. The robot therefore brakes if no further reports about the target
arrive.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from ruckig import InputParameter, Ruckig, Synchronization, Trajectory

from trirail.errors import RefusedError
from trirail.kinematics.arrays import Array
from trirail.motion.feasibility import SampleResult
from trirail.motion.path_planner import LIMIT_UTILISATION, MIN_LIMIT_SHARE, TOO_FAST_IN_MOTION, PathPlanner, Plan
from trirail.motion.paths import Path, constant_law
from trirail.motion.quintic import Point, quintic_between
from trirail.motion.ruckig_call import Kinodynamic, solve_within
from trirail.motion.runs import ZERO_RATES, MotionState, cut, from_ruckig, joined, nominal_motion

CATCH_UP_S = 0.05
"""Shortest duration of a smooth motion to the target [s]. The platform lags behind a target with acceleration a by
0.15 a CATCH_UP_S². With a shorter duration, the platform would follow more closely, but would also follow more of the
noise in the reports."""
SMOOTH_DURATION_FACTOR = 1.25
"""Shortest duration of a smooth motion to the target, relative to the quickest motion. From rest to rest, the smooth
motion then stays within the same acceleration and jerk limits with a margin of one fifth."""
MAX_REPLANS = 10
"""Greatest number of plans to meet a target. Each plan has lower limits than the previous plan."""
MAX_SEPARATE_REPLANS = 3
"""Number of replans that lower the limits of velocity, acceleration and jerk separately, as far as each is exceeded.
Later replans slow the motion as a whole, which always leads to a path that fits if the robot starts at rest."""
MAX_SHORTENINGS = 2
"""Greatest number of times that a path is shortened because it leaves the workspace."""
BORDER_BISECTIONS = 12
"""Number of bisection steps to find the last pose within reach on the line to a target that is out of reach."""


class _TrackTarget(NamedTuple):
    """Target within reach, with its pose at the start of the path and its constant velocity.

    `bound` is the name of the limit that the requested target exceeds, or None.
    """

    pose: Sequence[float]
    velocity: Sequence[float]
    bound: str | None


class Tracker:
    """Planner of motions towards moving targets, within the limits of platform and sliders."""

    def __init__(self, planner: PathPlanner) -> None:
        self._planner, self._platform = planner, planner.platform
        self._bounds, self._checker = planner.bounds, planner.checker
        self._ruckig = Ruckig(3)

    def follow(self, start: MotionState, pose: Sequence[float], velocity: Sequence[float], hold: float) -> Plan:
        """Plan a motion that meets a target, moves at the velocity of the target, and then stops.

        If the target is too fast, the platform follows as fast as the limits allow. If the target is out of reach, the
        platform moves on the straight line towards the target, as far as the workspace allows.

        Parameters
        ----------
        start : MotionState
            State of the platform's centre.
        pose, velocity : (3,)
            Pose and velocity of the target at the start of the path [m, rad, m/s, rad/s].
        hold : float
            Time after which the platform brakes, even if it has not met the target [s].

        Raises
        ------
        RefusedError
            Even braking would leave the workspace.
        """
        for target in self._reachable_targets(start, pose, velocity):
            plan = self._plan_meeting(start, target, hold)
            if plan is not None:
                return plan
        path = self._planner.path_to_velocity(start, ZERO_RATES)
        if not self._checker.keeps_limits(self._checker.worst_shares(path, start.pose)):
            raise TOO_FAST_IN_MOTION
        return Plan(path)

    # ------------------------------------------------------------------ inside

    def _reachable_targets(
        self, start: MotionState, pose: Sequence[float], velocity: Sequence[float]
    ) -> Iterator[_TrackTarget]:
        """Yield two targets to try: the target clipped to the platform's limits, and the last pose within reach.

        The last pose within reach is on the straight line from the platform to the clipped target.
        """
        low, high = self._bounds.box
        met = np.add(pose, CATCH_UP_S * np.array(velocity))
        inside = np.clip(met, low, high)
        waits = inside != met
        violation = self._bounds.pose_violation(met) if waits.any() else None
        target = np.where(waits, inside, pose)
        yield _TrackTarget(target.tolist(), np.where(waits, 0.0, velocity).tolist(), violation and violation.bound)
        border, bound = self._border(start.pose, target)
        yield _TrackTarget(border, ZERO_RATES, bound)

    def _border(self, pose: Sequence[float], target: Array) -> tuple[Sequence[float], str | None]:
        """Return the last pose within reach on the line from `pose` to `target`, and the limit that ends the line.

        If the target is within reach, the result is the target and None.
        """
        begin, way = np.array(pose), target - pose
        low, high = 0.0, 1.0
        bound = self._checker.exceeded_bound(target.tolist())
        if bound is None:
            return target.tolist(), None
        for _ in range(BORDER_BISECTIONS):
            middle = (low + high) / 2.0
            exceeded = self._checker.exceeded_bound((begin + middle * way).tolist())
            if exceeded is None:
                low = middle
            else:
                high, bound = middle, exceeded
        border: list[float] = (begin + low * way).tolist()
        return border, bound

    def _plan_meeting(self, start: MotionState, target: _TrackTarget, hold: float) -> Plan | None:
        """Plan a motion that meets the target, if necessary with lower limits. Returns None if no path fits."""
        shares = np.ones(3)
        for replan in range(MAX_REPLANS):
            limits = Kinodynamic(*(np.array(self._platform) * shares[:, None]).tolist())
            bounds = [
                LIMIT_UTILISATION * most / abs(v) for v, most in zip(target.velocity, limits.velocity, strict=True) if v
            ]
            share = min([1.0, *bounds])
            velocity = [share * v for v in target.velocity]
            try:
                quickest = self._quickest_meeting(start, target.pose, velocity, limits)
                smooth = _smooth_meeting(
                    start, target.pose, velocity, max(CATCH_UP_S, SMOOTH_DURATION_FACTOR * quickest.duration)
                )
                too_fast = None
                for meeting in (smooth, quickest):
                    path, result, bound = self._follow_and_brake(start, meeting, velocity, hold, limits)
                    if result.fits or (result.within_limits and not start.at_rest):
                        return Plan(path, bound=bound or target.bound)
                    if math.isnan(result.leaves_at):
                        too_fast = result
            except RefusedError:
                return None
            if too_fast is None:
                return None
            if replan < MAX_SEPARATE_REPLANS:
                shares = shares * np.clip(LIMIT_UTILISATION / too_fast.worst.max(axis=0), MIN_LIMIT_SHARE, 1.0)
            else:
                shares = shares * (LIMIT_UTILISATION / too_fast.slowdown_factor) ** np.arange(1.0, 4.0)
        return None

    def _follow_and_brake(
        self, start: MotionState, meeting: Path, velocity: Sequence[float], hold: float, limits: Kinodynamic
    ) -> tuple[Path, SampleResult, str | None]:
        """Extend a path that meets the target: move with the target until `hold` [s], and then brake within `limits`.

        If the path would leave the workspace after it has met the target, it brakes earlier. Returns the path, the
        result of sampling it, and the name of the limit that makes the path brake earlier, or None.
        """
        way, until, bound = _extend_meeting(meeting, velocity, hold), hold, None
        for _ in range(MAX_SHORTENINGS + 1):
            brake = self._planner.path_to_velocity(nominal_motion(way, until), ZERO_RATES, limits)
            path = joined([cut(way, until), brake])
            result = self._checker.sample(path, constant_law(1.0), 0.0, path.duration, start.pose)
            if math.isnan(result.leaves_at) or result.leaves_at <= max(meeting.duration, brake.duration):
                break
            bound = self._checker.bound(path, result.leaves_at, start.pose)
            until = max(0.0, min(until, result.leaves_at) - brake.duration)
        return path, result, bound

    def _quickest_meeting(
        self, start: MotionState, pose: Sequence[float], velocity: Sequence[float], limits: Kinodynamic
    ) -> Path:
        """Return the quickest path to a target, computed in a frame that moves with it. Raises RefusedError."""
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


def _smooth_meeting(start: MotionState, pose: Sequence[float], velocity: Sequence[float], duration: float) -> Path:
    """Return the path that meets a target after `duration` [s] with the least mean square of the jerk."""
    met = np.add(pose, duration * np.array(velocity))
    return quintic_between(Point(0.0, *start), Point(duration, met.tolist(), velocity, ZERO_RATES))


def _extend_meeting(meeting: Path, velocity: Sequence[float], hold: float) -> Path:
    """Return a path to a target, extended by a motion at the target's velocity until `hold` [s]."""
    if meeting.duration >= hold:
        return meeting
    going = np.zeros((1, 3, 6))
    going[0, :, 0], going[0, :, 1] = meeting.end, velocity
    return joined([meeting, Path(np.array([0.0, hold - meeting.duration]), going)])
