"""Planner of jerk-limited paths from any state of motion, sampled along their whole length before they start."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from trirail.config import PlatformLimits, SliderLimits
from trirail.errors import RefusalCode, RefusedError
from trirail.kinematics.geometry import LEGS, Geometry
from trirail.kinematics.robot import inverse_into
from trirail.motion.feasibility import ROUNDING_FACTOR, Checker, SampleResult, most_exceeded, slowdown_factor
from trirail.motion.limits import COORDINATES, UNITS, Bounds
from trirail.motion.paths import Path, constant_law
from trirail.motion.quintic import Point, check_ends, quintic
from trirail.motion.ruckig_call import Kinodynamic, Solver
from trirail.motion.runs import (
    NO_TOOL,
    ZERO_RATES,
    MotionState,
    centre_motion,
    joined,
    repeat_tool,
    rest,
    stretched,
    tool_motion,
)
from trirail.motion.straight_lines import time_optimal
from trirail.quantities import apart, beyond, meant, worded
from trirail.wire.messages import GoalReply

MIN_LIMIT_SHARE = 0.1
"""Lowest share of a limit with which a plan from motion is tried."""
MAX_REPLANS = 3
"""Plans from motion, each with lower limits."""
MAX_SLOWDOWN_CHECKS = 8
"""Checks of a slowed path, each followed by a further slowdown if it does not fit."""
LIMIT_UTILISATION = 0.97
"""Share of a limit that replanning aims at, so that rounding does not exceed it."""
MAX_JOG_PLANS = 12
"""Plans of a jog, each slower, softer or shorter, before it is refused or only brakes."""
MAX_PATH_RATE = 2.0
"""Highest rate of the time along a path: an override of 200 %."""
RATE_UNITS = "/s", "/s²", "/s³"
TOO_FAST_IN_MOTION = RefusedError(
    RefusalCode.TOO_FAST, "from its present motion the robot cannot take this path within its sliders' limits"
)


class Plan(NamedTuple):
    """Path that keeps every limit."""

    path: Path
    reply: GoalReply = GoalReply("", None)
    """Reply to the goal as far as it follows from the path, without id and duration."""
    bound: str | None = None
    """Limit before which a jog brakes, or beyond which a track's target is."""


def slowed(factor: float) -> GoalReply:
    """Return the reply to a goal that the limits make slower than requested by a factor."""
    return GoalReply("", None, slowed=factor)


class PathPlanner:
    """Planner of paths within the limits of platform and sliders."""

    def __init__(
        self,
        geometry: Geometry,
        platform: PlatformLimits,
        slider: SliderLimits,
        bounds: Bounds,
        checker: Checker,
        period: float,
    ) -> None:
        self._legs = geometry.packed()
        self._robot_limits = Kinodynamic(platform.velocity, platform.acceleration, platform.jerk)
        self.platform = Kinodynamic(*checker.platform_limits.T.tolist())
        self._centre = checker.centre_limits
        self._sliders = Kinodynamic(*(LIMIT_UTILISATION * checker.each_slider_limits).tolist())
        self._checked_sliders = Kinodynamic(*checker.each_slider_limits.tolist())
        self._travel = slider.positions
        self.bounds = bounds
        self.checker = checker
        self._period = period
        self._solver = Solver()
        self._arm = geometry.arm

    def check_pose(self, target: Sequence[float], start: Sequence[float], tool: Sequence[float] = NO_TOOL) -> None:
        """Check that a pose is in the workspace of the platform's centre.

        The pose is that of a tool, (u, v) in the platform's frame [m]. A robot that starts beyond a limit may move
        nearer to it.

        Raises
        ------
        RefusedError
            A coordinate exceeds its limit; with value and limit.
        """
        if violation := self.bounds.pose_violation_from(centre_motion(rest(target), tool).pose, start):
            asked = _suggestion(violation.value, violation.limit, violation.unit)
            raise RefusedError(
                RefusalCode.OUT_OF_WORKSPACE,
                f"the goal is out of the workspace: {violation}{asked}",
                value=violation.value,
                limit=violation.limit,
            )

    def check_sliders(self, target: Sequence[float], start: Sequence[float]) -> None:
        """Check that slider positions are within their travel.

        A slider that starts beyond its travel may move nearer to it. Raises RefusedError, with slider, value and limit.
        """
        rows = zip(LEGS, self.bounds.labels, target, start, self._travel, strict=True)
        for name, label, position, begin, (low, high) in rows:
            if not min(low, begin) <= position <= max(high, begin):
                limit = low if position < low else high
                text = beyond(f"slider {label}: position", position, limit, "m")
                raise RefusedError(RefusalCode.OUT_OF_WORKSPACE, text, slider=name, value=position, limit=limit)

    def check_velocity(self, velocity: Sequence[float]) -> None:
        """Check a jog's velocity against the platform's limits. Raises RefusedError, with value and limit."""
        for name, unit, value, limit in zip(COORDINATES, UNITS, velocity, self._robot_limits.velocity, strict=True):
            if abs(value) > limit * ROUNDING_FACTOR:
                most = math.copysign(limit, value)
                asked, allowed = apart(value, most, f"{unit}/s")
                asked_for = _suggestion(value, most, f"{unit}/s")
                text = f"the jog's velocity {asked} in {name} is above the limit of {allowed}{asked_for}"
                raise RefusedError(RefusalCode.ABOVE_LIMIT, text, value=value, limit=most)

    def lower_limits(
        self, velocity: Sequence[float] | None, acceleration: Sequence[float] | None, jerk: Sequence[float] | None
    ) -> Kinodynamic:
        """Return the limits for plans, lowered to a goal's own. Raises RefusedError if these are above the robot's."""
        asked = velocity, acceleration, jerk
        for name, per, own, limits in zip(Kinodynamic._fields, RATE_UNITS, asked, self._robot_limits, strict=True):
            for coordinate, unit, value, limit in zip(COORDINATES, UNITS, own or limits, limits, strict=True):
                if value > limit:
                    shown = apart(value, limit, unit + per)
                    text = "limits.{} of {} is {}: the robot's limit is {}".format(name, coordinate, *shown)
                    raise RefusedError(RefusalCode.ABOVE_LIMIT, text, value=value, limit=limit)
        return Kinodynamic(
            *(np.minimum(own or planned, planned).tolist() for own, planned in zip(asked, self.platform, strict=True))
        )

    def plan_to_pose(
        self,
        start: MotionState,
        target: Sequence[float],
        speed: float = 1.0,
        limits: Kinodynamic | None = None,
        tool: Sequence[float] = NO_TOOL,
    ) -> Plan:
        """Plan to rest at a pose, straight in pose space if the robot starts at rest.

        A path that is too fast for a slider or the platform is replaced by the time-optimal one on the same line, or
        slowed as a whole if that is no slower.

        Parameters
        ----------
        start : MotionState
            State of the platform's centre.
        target : (3,)
            Pose of the tool in the base frame [m, rad].
        speed : float
            Share of full speed; at 0.5 the motion takes twice as long.
        limits : Kinodynamic, optional
            Limits of the tool's motion. The platform's limits hold for its centre as well.
        tool : (2,)
            Point that moves straight, in the platform's frame [m].

        Raises
        ------
        RefusedError
            The path leaves the workspace (with slider or coordinate, value and limit), or it starts in motion and
            cannot be slowed.
        """
        self.check_pose(target, start.pose, tool)
        return self._plan_to_rest(start, tool_motion(start, tool), target, limits or self.platform, speed, tool=tool)

    def plan_to_sliders(self, start: MotionState, target: Sequence[float], speed: float = 1.0) -> Plan:
        """Plan to rest at slider positions [m], straight in slider space from rest; otherwise as plan_to_pose."""
        rows = np.zeros((6, 3))
        inverse_into(self._legs, np.array(start), rows)
        sliders = MotionState(*rows[:3].tolist())
        self.check_sliders(target, sliders.pose)
        return self._plan_to_rest(start, sliders, target, self._sliders, speed, in_sliders=True)

    def plan_jog(
        self, start: MotionState, velocity: Sequence[float], timeout: float, tool: Sequence[float] = NO_TOOL
    ) -> Plan:
        """Plan a ramp to a velocity, a part at that velocity until a limit is near, and a brake.

        The control ends the jog at its time-out. The path lasts longer: `timeout` is real time, and time along the path
        may run at MAX_PATH_RATE. A velocity that is too high for platform or sliders is lowered. If only the ramp is
        too hard, it becomes softer and the velocity stays.

        Parameters
        ----------
        start : MotionState
            State of the platform's centre.
        velocity : (3,)
            Velocity of the tool [m/s, rad/s].
        timeout : float
            Time for which the jog lasts at most [s].
        tool : (2,)
            Point about which the platform turns, in the platform's frame [m].

        Raises
        ------
        RefusedError
            The robot would not move, or even a brake would leave the workspace.
        """
        share, slower, softer, hold, bound = 1.0, 1.0, 1.0, MAX_PATH_RATE * timeout, None
        for value, limit in zip(velocity, self.platform.velocity, strict=True):
            if abs(value) * share > limit:
                share = limit / abs(value)
        for _ in range(MAX_JOG_PLANS):
            asked = [share / slower * value for value in velocity]
            limits = _scaled_limits(self.platform, slower, softer)
            ramp, brake, path = self._jog_path(tool_motion(start, tool), asked, hold, tool, limits)
            result = self.checker.sample(path, constant_law(1.0), 0.0, path.duration, start.pose)
            if result.fits or (result.within_limits and not start.at_rest):
                return Plan(path, slowed(slower / share), bound)
            if math.isnan(result.leaves_at):
                if self._can_hold(path, ramp, brake, start.pose):
                    softer *= result.slowdown_factor / LIMIT_UTILISATION
                else:
                    slower *= result.slowdown_factor / LIMIT_UTILISATION
                continue
            bound = self.checker.bound(path, result.leaves_at, start.pose)
            if hold > 0.0:
                hold = max(0.0, result.leaves_at - ramp - brake)  # rest where the last plan left the workspace
            else:
                share /= 2.0
        if start.at_rest and any(velocity):
            raise _jog_refusal(bound, result)
        path = self._solver.to_velocity(tool_motion(start, tool), ZERO_RATES, self.platform, tool)
        if not self.checker.keeps_limits(self.checker.worst_shares(path, start.pose)):
            raise TOO_FAST_IN_MOTION
        return Plan(path, bound=bound)

    def plan_trajectory(self, start: MotionState, points: Sequence[Point], stretch: bool) -> Plan:
        """Plan a path through timed points, quintic between them.

        With `stretch`, a trajectory that is too fast is slowed as a whole.

        Raises
        ------
        RefusedError
            The trajectory is too fast, leaves the workspace, or does not begin and end at rest.
        """
        check_ends(points, start)
        path = quintic(points, start.pose)
        worst = self.checker.worst_shares(path, start.pose)
        slower = slowdown_factor(worst)
        if slower <= 1.0:
            return Plan(path)
        path, slower = self._slow_down(path, slower, start.pose)
        if not stretch:
            raise RefusedError(
                RefusalCode.TOO_FAST,
                f"the trajectory is {slower:.3g} times too fast for {most_exceeded(worst)}: "
                f"let it take {math.ceil(1e3 * path.duration) / 1e3:.10g} s, "
                'or send it with "stretch": true, trirail follow --stretch',
                value=slower,
                limit=1.0,
            )
        return Plan(path, slowed(slower))

    def path_to_velocity(self, start: MotionState, velocity: Sequence[float]) -> Path:
        """Return the quickest path to a velocity within the platform's limits, unchecked. Raises RefusedError."""
        return self._solver.to_velocity(start, velocity, self.platform)

    def distance(self, pose: Sequence[float], target: Sequence[float]) -> float:
        """Return the greatest distance of a point of the platform between two poses [m]."""
        x, y, phi = (here - there for here, there in zip(pose, target, strict=True))
        return math.hypot(x, y) + self._arm * abs(phi)

    # ------------------------------------------------------------------ inside

    def _plan_to_rest(
        self,
        start: MotionState,
        begin: MotionState,
        target: Sequence[float],
        limits: Kinodynamic,
        speed: float,
        in_sliders: bool = False,
        tool: Sequence[float] = NO_TOOL,
    ) -> Plan:
        """Plan from `begin`, which is `start` in the path's own coordinates: sliders or a tool."""
        if start.at_rest:
            path = self._solver.to_rest(begin, target, limits, in_sliders, tool)
            slower = max(1.0 / speed, slowdown_factor(self.checker.worst_shares(path, start.pose)))
            if slower * speed > 1.0:
                quickest = self._time_optimal_path(path, limits, path.duration / speed, start.pose)
                if quickest is not None and quickest.duration < slower * path.duration:
                    return Plan(quickest, slowed(max(1.0, quickest.duration / path.duration * speed)))
            if slower > 1.0:
                path, slower = self._slow_down(path, slower, start.pose)
            return Plan(path, slowed(slower * speed))
        shares = np.full(3, speed)
        for _ in range(MAX_REPLANS):
            lower = Kinodynamic(*(np.array(limits) * shares[:, None]).tolist())
            path = self._solver.to_rest(begin, target, lower, in_sliders, tool)
            worst = self.checker.worst_shares(path, start.pose)
            if self.checker.keeps_limits(worst):
                return Plan(path, slowed(speed / float(shares.min())))
            shares = shares * np.clip(LIMIT_UTILISATION / worst.max(axis=0), MIN_LIMIT_SHARE, 1.0)
        raise TOO_FAST_IN_MOTION

    def _time_optimal_path(self, path: Path, limits: Kinodynamic, asked: float, pose: Sequence[float]) -> Path | None:
        """Return the time-optimal path on the line of a path that is too fast; `asked` is its least duration [s].

        None if the method fails or its path does not fit.
        """
        others = self.platform if path.in_sliders else self._checked_sliders
        quickest = time_optimal(self._legs, path, limits, others, self._centre, pose)
        if quickest is None:
            return None
        try:
            path, _ = self._slow_down(quickest, max(1.0, asked / quickest.duration), pose)
        except RefusedError:
            return None
        return path

    def _slow_down(self, path: Path, factor: float, pose: Sequence[float]) -> tuple[Path, float]:
        """Return a path slowed by at least `factor` until it fits, and the factor used.

        One slowdown may not be enough: a jerk shorter than one sampling step lasts longer in the slower path.
        """
        for _ in range(MAX_SLOWDOWN_CHECKS):
            slow = stretched(path, factor)
            factor_left = slowdown_factor(self.checker.worst_shares(slow, pose))
            if factor_left <= 1.0:
                return slow, factor
            factor *= factor_left * ROUNDING_FACTOR
        raise RefusedError(RefusalCode.TOO_FAST, f"the path does not fit its limits even {factor:.3g} times slower")

    def _can_hold(self, path: Path, ramp: float, brake: float, pose: Sequence[float]) -> bool:
        """Return whether a jog's velocity itself fits, between the end of its ramp and its brake."""
        first, until = ramp + self._period, path.duration - brake - 2.0 * self._period
        return first >= until or self.checker.sample(path, constant_law(1.0), first, until, pose).slowdown_factor <= 1.0

    def _jog_path(
        self, start: MotionState, velocity: Sequence[float], hold: float, tool: Sequence[float], limits: Kinodynamic
    ) -> tuple[float, float, Path]:
        """Return the durations of a jog's ramp and brake [s], and its whole path."""
        ramp = self._solver.to_velocity_straight(start, velocity, limits, tool)
        if not any(velocity):
            return ramp.duration, 0.0, ramp
        pose = ramp.end
        held = np.zeros((1, 3, 6))
        held[0, :, 0], held[0, :, 1] = pose, velocity
        hold = max(hold, self._period)
        end = [value + hold * rate for value, rate in zip(pose, velocity, strict=True)]
        brake = self._solver.to_velocity_straight(MotionState(end, velocity, ZERO_RATES), ZERO_RATES, limits, tool)
        whole = joined([ramp, Path(np.array([0.0, hold]), held, tools=repeat_tool(tool, 1)), brake])
        return ramp.duration, brake.duration, whole


def _jog_refusal(bound: str | None, result: SampleResult) -> RefusedError:
    """Return the refusal of a jog that would not move the robot."""
    if bound is not None:
        text = f"the jog cannot move: it would pass the limit of {bound} before it could brake"
        return RefusedError(RefusalCode.OUT_OF_WORKSPACE, text)
    text = f"the jog is too fast for {most_exceeded(result.worst)}, however slow: choose a tool nearer to the platform"
    return RefusedError(RefusalCode.TOO_FAST, text)


def _scaled_limits(limits: Kinodynamic, factor: float, softer: float) -> Kinodynamic:
    """Return the limits of a motion `factor` times slower, acceleration `softer`² and jerk `softer`³ times lower."""
    powers = factor ** np.arange(1.0, 4.0) * softer ** np.array((0.0, 2.0, 3.0))
    return Kinodynamic(*(np.array(limits) / powers[:, None]).tolist())


def _suggestion(value: float, limit: float, unit: str) -> str:
    likely = meant(value, limit, unit)
    return "" if likely is None else f": did you mean {worded(likely, unit)}?"
