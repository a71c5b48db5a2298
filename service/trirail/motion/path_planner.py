"""Planner of jerk-limited paths from any state of motion. Each path is checked from start to end before use."""

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
from trirail.motion.paths import ROUNDING, Path, constant_law, evaluate_path
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
from trirail.quantities import apart, as_familiar_unit, beyond, worded
from trirail.wire.kinds.trajectory import MAX_DURATION_S
from trirail.wire.messages import GoalReply

MIN_LIMIT_SHARE = 0.1
"""Lowest factor on a limit in one replanning step, if a plan from a moving robot does not fit."""
MAX_REPLANS = 3
"""Greatest number of plans from a moving robot. Each plan has lower limits than the previous plan."""
MAX_SLOWDOWN_CHECKS = 16
"""Greatest number of slowdowns of a path, each followed by a check whether the path fits."""
SECANT_CHECKS = 2
"""Number of checks that fail before the slowdowns are computed with the secant method."""
MAX_SECANT_POWER = 4.0
"""Greatest power of the factor that is left, by which a path is slowed with the secant method."""
LIMIT_UTILISATION = 0.97
"""Fraction of a limit that a replanned path aims at. The margin prevents rounding errors from exceeding the limit."""
MAX_JOG_PLANS = 12
"""Greatest number of plans for a jog. Each plan is slower, shorter, or has softer ramps than the previous plan. If no
plan fits, a robot at rest refuses the jog, and a moving robot brakes."""
MAX_JOG_SHARE = 0.9
"""Greatest factor on the velocity of a jog from rest, if its ramps do not fit before a limit."""
MAX_PATH_RATE = 2.0
"""Highest rate of the time along a path. It corresponds to an override of 200 %."""
RATE_UNITS = "/s", "/s²", "/s³"
TOO_FAST_IN_MOTION = RefusedError(
    RefusalCode.TOO_FAST,
    "the robot cannot move from its present motion onto this path within the limits of its sliders",
)


class Plan(NamedTuple):
    """Path that stays within all limits, with information for the reply to the goal."""

    path: Path
    reply: GoalReply = GoalReply("", None)
    """Reply to the sender of the goal, without the goal's id and without the duration."""
    bound: str | None = None
    """Name of the limit before which a jog brakes, or which the target of a track exceeds."""


def slowed(factor: float) -> GoalReply:
    """Return the reply to a goal if the limits make its motion `factor` times slower than requested."""
    return GoalReply("", None, slowed=factor)


class PathPlanner:
    """Planner of paths within the limits of the platform and the sliders."""

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
        """Check that the platform's centre is within its position limits when the tool is at a pose.

        `tool` is the point of the platform that `target` refers to, (u, v) in the platform's frame [m]. A robot that
        starts beyond a limit may move to a target that is closer to the limit.

        Raises
        ------
        RefusedError
            A coordinate exceeds its limit. The error has the value and the limit.
        """
        if violation := self.bounds.pose_violation_from(centre_motion(rest(target), tool).pose, start):
            asked = _suggestion(violation.value, violation.limit, violation.unit)
            raise RefusedError(
                RefusalCode.OUT_OF_WORKSPACE,
                f"the goal is outside the workspace: {violation}{asked}",
                value=violation.value,
                limit=violation.limit,
            )

    def check_sliders(self, target: Sequence[float], start: Sequence[float]) -> None:
        """Check that slider positions are within the travel of the sliders.

        A slider that starts beyond its travel may move towards the permitted range. Raises RefusedError with the
        slider, the value and the limit.
        """
        rows = zip(LEGS, self.bounds.labels, target, start, self._travel, strict=True)
        for name, label, position, begin, (low, high) in rows:
            if not min(low, begin) <= position <= max(high, begin):
                limit = low if position < low else high
                text = beyond(f"slider {label}: position", position, limit, "m")
                raise RefusedError(RefusalCode.OUT_OF_WORKSPACE, text, slider=name, value=position, limit=limit)

    def check_velocity(self, velocity: Sequence[float]) -> None:
        """Check the velocity of a jog against the platform's limits. Raises RefusedError with value and limit."""
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
        """Return the limits for a plan: the lower of the platform's limits and the given limits of the goal.

        Raises RefusedError if a given limit exceeds the platform's limit.
        """
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
        """Plan a motion that ends at rest at a pose. If the robot starts at rest, the path is straight in pose space.

        If a straight path is too fast for a slider or the platform, the planner uses the faster of two paths on the
        same line: the time-optimal path, or the original path slowed by a constant factor.

        Parameters
        ----------
        start : MotionState
            State of the platform's centre.
        target : (3,)
            Pose of the tool in the base frame [m, rad].
        speed : float
            Fraction of full speed. At 0.5, the motion takes twice as long as at full speed.
        limits : Kinodynamic, optional
            Limits of the tool's motion. The platform's limits also apply to the centre of the platform.
        tool : (2,)
            Point that moves on the straight line, in the platform's frame [m].

        Raises
        ------
        RefusedError
            The path leaves the workspace, or the path starts in motion and is too fast. In the first case, the error
            contains the slider, the value and the limit.
        """
        self.check_pose(target, start.pose, tool)
        return self._plan_to_rest(start, tool_motion(start, tool), target, limits or self.platform, speed, tool=tool)

    def plan_to_sliders(self, start: MotionState, target: Sequence[float], speed: float = 1.0) -> Plan:
        """Plan a motion that ends at rest at slider positions [m].

        If the robot starts at rest, the path is straight in slider space. In all other respects, this method works like
        plan_to_pose.
        """
        rows = np.zeros((6, 3))
        inverse_into(self._legs, np.array(start), rows)
        sliders = MotionState(*rows[:3].tolist())
        self.check_sliders(target, sliders.pose)
        return self._plan_to_rest(start, sliders, target, self._sliders, speed, in_sliders=True)

    def plan_jog(
        self, start: MotionState, velocity: Sequence[float], timeout: float, tool: Sequence[float] = NO_TOOL
    ) -> Plan:
        """Plan a jog: a ramp to a velocity, a part at constant velocity, and braking before a limit of the workspace.

        The control stops the jog when its time-out elapses. The constant part may last MAX_PATH_RATE times `timeout`,
        because the time along the path may run faster than real time. A velocity that is too high for the platform or
        the sliders is lowered. If only the ramp exceeds a limit, the ramp becomes softer and the velocity does not
        change.

        Parameters
        ----------
        start : MotionState
            State of the platform's centre.
        velocity : (3,)
            Velocity of the tool [m/s, rad/s].
        timeout : float
            Longest duration of the jog without a renewal, in real time [s].
        tool : (2,)
            Point that has the requested velocity, and about which the platform turns, in the platform's frame [m].

        Raises
        ------
        RefusedError
            The robot would not move, or even braking would leave the workspace.
        """
        longest = MAX_PATH_RATE * timeout
        slower, softer, hold, bound = 1.0, 1.0, longest, None
        highest = zip(velocity, self.platform.velocity, strict=True)
        share = min([1.0, *(limit / abs(value) for value, limit in highest if value)])
        for _ in range(MAX_JOG_PLANS):
            asked = [share / slower * value for value in velocity]
            limits = _scaled_limits(self.platform, slower, softer)
            begin = tool_motion(start, tool)
            ramp, brake, path = self._jog_path(begin, asked, hold, tool, limits)
            if bound is not None and np.abs(path.end - begin.pose).max() <= ROUNDING:
                break
            result = self.checker.sample(path, constant_law(1.0), 0.0, path.duration, start.pose)
            if result.fits or (result.within_limits and not start.at_rest):
                return Plan(path, slowed(slower / share), bound)
            if math.isnan(result.leaves_at):
                if self._can_hold(path, ramp, brake, start.pose):
                    softer *= result.slowdown_factor / LIMIT_UTILISATION
                else:
                    factor = result.slowdown_factor / LIMIT_UTILISATION
                    slower *= factor
                    hold *= factor  # the way stays the same
                    if hold >= longest:
                        hold, bound = longest, None
                continue
            bound = self.checker.bound(path, result.leaves_at, start.pose)
            if not any(velocity):
                break
            possible, planned = _distances(path, result.leaves_at, begin.pose, asked)
            if start.at_rest and possible <= 0.0:
                break
            speed, constant = max(map(abs, asked)), path.duration - ramp - brake
            # End the constant part earlier, so that the robot is at rest where the last plan left the workspace.
            hold = constant - (planned - possible) / speed
            if hold < self._period:
                # The ramps alone are too long. From rest, their length falls at least with velocity^(3/2).
                least = planned - (constant - self._period) * speed
                share *= min(MAX_JOG_SHARE, (possible / least) ** (2.0 / 3.0)) if start.at_rest else 0.5
                hold = longest
        if start.at_rest and any(velocity):
            raise _jog_refusal(bound, result)
        path = self._solver.to_velocity(tool_motion(start, tool), ZERO_RATES, self.platform, tool)
        if not self.checker.keeps_limits(self.checker.worst_shares(path, start.pose)):
            raise TOO_FAST_IN_MOTION
        return Plan(path, bound=bound)

    def plan_trajectory(self, start: MotionState, points: Sequence[Point], stretch: bool) -> Plan:
        """Plan a path through timed points. Successive points are connected by quintics.

        If `stretch` is set, a trajectory that is too fast is slowed by a constant factor.

        Raises
        ------
        RefusedError
            The trajectory is too fast, leaves the workspace, does not begin at the robot's pose, or does not begin and
            end at rest.
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
                f"let it last {self._fitting_milliseconds(path, start.pose) / 1e3:.10g} s, "
                'or send it with "stretch": true (trirail follow --stretch)',
                value=slower,
                limit=1.0,
            )
        return Plan(path, slowed(slower))

    def path_to_velocity(
        self, start: MotionState, velocity: Sequence[float], limits: Kinodynamic | None = None
    ) -> Path:
        """Return the quickest path to a velocity within limits of the platform, by default the platform's own limits.

        Limits of the sliders are not checked. Raises RefusedError if no path is possible.
        """
        return self._solver.to_velocity(start, velocity, limits or self.platform)

    def distance(self, pose: Sequence[float], target: Sequence[float]) -> float:
        """Return an upper bound of the distance that any point of the platform travels between two poses [m]."""
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
        """Plan a motion to rest. `begin` is the state `start`, converted to slider positions or to a tool's motion."""
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
        shares, asked = np.full(3, speed), 0.0
        for _ in range(MAX_REPLANS):
            lower = Kinodynamic(*(np.array(limits) * shares[:, None]).tolist())
            path = self._solver.to_rest(begin, target, lower, in_sliders, tool)
            asked = asked or path.duration
            worst = self.checker.worst_shares(path, start.pose)
            if self.checker.keeps_limits(worst):
                return Plan(path, slowed(max(1.0, path.duration / asked)))
            shares = shares * np.clip(LIMIT_UTILISATION / worst.max(axis=0), MIN_LIMIT_SHARE, 1.0)
        raise TOO_FAST_IN_MOTION

    def _time_optimal_path(self, path: Path, limits: Kinodynamic, asked: float, pose: Sequence[float]) -> Path | None:
        """Return the time-optimal path along the line of a path that is too fast.

        The result takes at least `asked` [s]. Returns None if the method fails or if the resulting path does not fit.
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
        """Slow a path by at least `factor` until it fits the limits. Return the slowed path and the final factor.

        One slowdown may not be enough. A peak of the jerk that is shorter than a sampling step lasts longer in the
        slower path, and may only then be sampled. The jerk over a cycle also falls more slowly than with the third
        power of the factor if the path has an acceleration at an end, or if the path lasts only a few cycles. The
        secant method then finds the power of the factor with which the path must be slowed. Raises RefusedError if the
        path does not fit, or would last longer than MAX_DURATION_S.
        """
        factors, left = [], []
        for check in range(MAX_SLOWDOWN_CHECKS):
            slow = stretched(path, factor)
            if slow.duration > MAX_DURATION_S:
                raise RefusedError(
                    RefusalCode.TOO_FAST,
                    f"the path would last {slow.duration:.3g} s within its limits: the maximum is {MAX_DURATION_S:g} s",
                    value=slow.duration,
                    limit=MAX_DURATION_S,
                )
            factor_left = slowdown_factor(self.checker.worst_shares(slow, pose))
            if factor_left <= 1.0:
                return slow, factor
            factors.append(factor)
            left.append(factor_left)
            power = 1.0
            if check >= SECANT_CHECKS and left[-1] < left[-2]:
                power = math.log(factors[-1] / factors[-2]) / math.log(left[-2] / left[-1])
            factor *= (factor_left * ROUNDING_FACTOR) ** min(max(power, 1.0), MAX_SECANT_POWER)
        raise RefusedError(
            RefusalCode.TOO_FAST, f"the path exceeds its limits even when it is slowed {factor:.3g} times"
        )

    def _fitting_milliseconds(self, path: Path, pose: Sequence[float]) -> int:
        """Return the duration of a path that fits, rounded up to whole milliseconds at which it also fits [ms].

        If a path lasts less than a cycle, the jerk over a cycle may rise when the path lasts longer. Raises
        RefusedError as _slow_down does.
        """
        duration = math.ceil(1e3 * path.duration)
        while True:
            rounded = stretched(path, 1e-3 * duration / path.duration)
            factor = slowdown_factor(self.checker.worst_shares(rounded, pose))
            if factor <= 1.0:
                return duration
            path, _ = self._slow_down(rounded, factor, pose)
            duration = max(duration + 1, math.ceil(1e3 * path.duration))

    def _can_hold(self, path: Path, ramp: float, brake: float, pose: Sequence[float]) -> bool:
        """Return whether a jog is within the limits during its part at constant velocity."""
        first, until = ramp + self._period, path.duration - brake - 2.0 * self._period
        return first >= until or self.checker.sample(path, constant_law(1.0), first, until, pose).slowdown_factor <= 1.0

    def _jog_path(
        self, start: MotionState, velocity: Sequence[float], hold: float, tool: Sequence[float], limits: Kinodynamic
    ) -> tuple[float, float, Path]:
        """Return the duration of the ramp, the duration of braking [s], and the complete path of a jog."""
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


def _distances(path: Path, time: float, begin: Sequence[float], velocity: Sequence[float]) -> tuple[float, float]:
    """Return how far a jog goes until a time [s], less ROUNDING, and until its end, from `begin` along its velocity.

    The distances are those of the coordinate with the highest velocity [m, rad].
    """
    motion = np.zeros((3, 3))
    evaluate_path(path.knots, path.pieces, time, motion)
    along = np.array(velocity) / max(map(abs, velocity))
    along /= along @ along
    return float((motion[0] - begin) @ along) - ROUNDING, float((path.end - begin) @ along)


def _jog_refusal(bound: str | None, result: SampleResult) -> RefusedError:
    """Return the error that refuses a jog because it would not move the robot."""
    if bound is not None:
        text = f"the jog cannot start: the robot would pass the limit of {bound} before it could brake"
        return RefusedError(RefusalCode.OUT_OF_WORKSPACE, text)
    text = (
        f"the jog exceeds a limit of {most_exceeded(result.worst)} at any speed: choose a tool nearer to the platform"
    )
    return RefusedError(RefusalCode.TOO_FAST, text)


def _scaled_limits(limits: Kinodynamic, factor: float, softer: float) -> Kinodynamic:
    """Return the limits for a motion that is `factor` times slower.

    Accelerations are also divided by `softer`², and jerks by `softer`³.
    """
    powers = factor ** np.arange(1.0, 4.0) * softer ** np.array((0.0, 2.0, 3.0))
    return Kinodynamic(*(np.array(limits) / powers[:, None]).tolist())


def _suggestion(value: float, limit: float, unit: str) -> str:
    likely = as_familiar_unit(value, limit, unit)
    return "" if likely is None else f": did you mean {worded(likely, unit)}?"
