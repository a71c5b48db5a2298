"""Paths of motion: jerk-limited, from any state of motion, and looked at along their whole length before they start."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from trirail.config import PlatformLimits, SliderLimits
from trirail.errors import RefusalCode, RefusedError
from trirail.kinematics.geometry import LEGS, Geometry
from trirail.kinematics.robot import inverse_into
from trirail.motion.feasibility import Checker, excess, fastest
from trirail.motion.limits import COORDINATES, UNITS, Bounds
from trirail.motion.paths import Path, constant
from trirail.motion.quintic import Point, check_ends, quintic
from trirail.motion.ruckig_call import Kinodynamic, Solver
from trirail.motion.runs import NO_TOOL, STILL, MotionState, joined, of_centre, of_tool, rest, stretched, tools_of
from trirail.motion.straight_lines import time_optimal
from trirail.quantities import apart, beyond, worded

GENTLEST = 0.1
"""Share of any limit below which no plan from motion is tried."""
TRIES = 3
"""How often a plan from motion is tried, with lower limits each time."""
LOOKS = 8
"""How often a slowed path is looked at, and slowed further, until it fits."""
ROOM = 0.97
"""Share of what would just fit that is made use of where rounding must not make it too fast."""
JOGS = 5
"""How often a jog is tried slower or shorter before it only brakes."""
FASTEST_OVERRIDE = 2.0
"""At how many times its nominal rate the time along a path may be told to run."""
A_HAIR_MORE = 1.0 + 1e-6
"""What rounding may lose."""
MEANT = {"m": (1e-3, 1.0), "rad": (math.pi / 180.0, 2.0)}
"""What millimetres and degrees are in SI, and from which number on they are taken to have been meant."""
RATES = "/s", "/s²", "/s³"
TOO_FAST_IN_MOTION = RefusedError(
    RefusalCode.TOO_FAST, "from its present motion the robot cannot take this path within its sliders' limits"
)


class Plan(NamedTuple):
    """A path that the robot can take."""

    path: Path
    slowed: float = 1.0
    """How many times slower it is than was asked for, for the limits' sake."""
    bound: str | None = None
    """The limit before which a jog comes to rest, or beyond which a track's target is."""
    lag: float | None = None
    """How far a point of the platform is at most from where a track's target has it, at the start [m]."""


class PathPlanner:
    """Makes paths within the platform's limits and the sliders'."""

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
        self._most = Kinodynamic(platform.velocity, platform.acceleration, platform.jerk)
        self.platform = Kinodynamic(*checker.platform_limits.T.tolist())
        self._centre = checker.centre_limits
        self._sliders = Kinodynamic(*(ROOM * checker.each_slider_limits).tolist())
        self._checked_sliders = Kinodynamic(*checker.each_slider_limits.tolist())
        self._travel = slider.positions
        self.bounds = bounds
        self.checker = checker
        self._period = period
        self._solver = Solver()
        self._reach = geometry.arm

    def check_pose(self, target: Sequence[float], tool: Sequence[float] = NO_TOOL) -> None:
        """Raise RefusedError, with coordinate, value and limit, if a pose is out of the workspace.

        The pose is that of a tool, (u, v) in the platform's frame [m]; the workspace that of the platform's centre.
        """
        if violation := self.bounds.pose(of_centre(rest(target), tool).pose):
            meant = _meant(violation.value, violation.limit, violation.unit)
            raise RefusedError(
                RefusalCode.OUT_OF_WORKSPACE,
                f"the goal is out of the workspace: {violation}{meant}",
                value=violation.value,
                limit=violation.limit,
            )

    def check_sliders(self, target: Sequence[float]) -> None:
        """Raise RefusedError, with slider, value and limit, if slider positions are beyond their travel."""
        for name, label, position, (low, high) in zip(LEGS, self.bounds.labels, target, self._travel, strict=True):
            if not low <= position <= high:
                limit = low if position < low else high
                text = beyond(f"slider {label}: position", position, limit, "m")
                raise RefusedError(RefusalCode.OUT_OF_WORKSPACE, text, slider=name, value=position, limit=limit)

    def check_velocity(self, velocity: Sequence[float]) -> None:
        """Raise RefusedError, with value and limit, if a jog is above the platform's limits."""
        for name, unit, value, limit in zip(COORDINATES, UNITS, velocity, self._most.velocity, strict=True):
            if abs(value) > limit * A_HAIR_MORE:
                most = math.copysign(limit, value)
                asked, allowed = apart(value, most, f"{unit}/s")
                meant = _meant(value, most, f"{unit}/s")
                text = f"the jog's velocity {asked} in {name} is above the limit of {allowed}{meant}"
                raise RefusedError(RefusalCode.ABOVE_LIMIT, text, value=value, limit=most)

    def lowered(
        self, velocity: Sequence[float] | None, acceleration: Sequence[float] | None, jerk: Sequence[float] | None
    ) -> Kinodynamic:
        """Return the platform's limits with a goal's own in their place. RefusedError where these are not lower."""
        asked = velocity, acceleration, jerk
        for name, per, own, limits in zip(Kinodynamic._fields, RATES, asked, self._most, strict=True):
            for coordinate, unit, value, limit in zip(COORDINATES, UNITS, own or limits, limits, strict=True):
                if value > limit:
                    shown = apart(value, limit, unit + per)
                    text = "limits.{} of {} is {}: the robot's limit is {}".format(name, coordinate, *shown)
                    raise RefusedError(RefusalCode.ABOVE_LIMIT, text, value=value, limit=limit)
        return Kinodynamic(
            *(np.minimum(own or planned, planned).tolist() for own, planned in zip(asked, self.platform, strict=True))
        )

    def to_pose(
        self,
        start: MotionState,
        target: Sequence[float],
        speed: float = 1.0,
        limits: Kinodynamic | None = None,
        tool: Sequence[float] = NO_TOOL,
    ) -> Plan:
        """Plan to rest at a pose, straight in pose space from rest; at `speed` 0.5 it takes twice as long.

        The target is the pose of a tool, (u, v) in the platform's frame [m]: it is this point that goes straight, and
        within `limits`; those of the platform hold for its centre as well.

        A path that is too fast for a slider or the platform gives way to the time-optimal one on the same line, or is
        slowed as a whole where that is not quicker. Raises RefusedError with slider or coordinate, value and limit
        where it leaves the workspace, or where it cannot be slowed since it starts in motion.
        """
        self.check_pose(target, tool)
        return self._to_rest(start, of_tool(start, tool), target, limits or self.platform, speed, tool=tool)

    def to_sliders(self, start: MotionState, target: Sequence[float], speed: float = 1.0) -> Plan:
        """Plan to rest at slider positions, straight in slider space from rest; as to_pose otherwise."""
        self.check_sliders(target)
        rows = np.zeros((6, 3))
        inverse_into(self._legs, np.array(start), rows)
        sliders = MotionState(*rows[:3].tolist())
        return self._to_rest(start, sliders, target, self._sliders, speed, in_sliders=True)

    def jog(
        self, start: MotionState, velocity: Sequence[float], timeout: float, tool: Sequence[float] = NO_TOOL
    ) -> Plan:
        """Plan to a velocity, held until `timeout` is surely over or a limit comes near, and to rest.

        It is that of a tool, (u, v) in the platform's frame [m], about which the platform turns.
        `timeout` is real time, and time along the path runs at up to twice its rate: who ends the jog is the control.
        Faster than platform or sliders may: as fast as they may. Raises RefusedError where not even braking stays
        inside.
        """
        share, slower, hold, bound = 1.0, 1.0, FASTEST_OVERRIDE * timeout, None
        for value, limit in zip(velocity, self.platform.velocity, strict=True):
            if abs(value) * share > limit:
                share = limit / abs(value)
        for _ in range(JOGS):
            asked = [share / slower * value for value in velocity]
            ramp, brake, path = self._jog(of_tool(start, tool), asked, hold, tool, _slower(self.platform, slower))
            found = self.checker.sample(path, constant(1.0), 0.0, path.duration, start.pose)
            if found.fits or (found.within_limits and not start.at_rest):
                return Plan(path, slower / share, bound)
            if math.isnan(found.leaves_at):
                slower *= found.excess / ROOM
                continue
            bound = self.checker.bound(path, found.leaves_at, start.pose)
            if hold > 0.0:
                hold = max(0.0, found.leaves_at - ramp - brake)  # to rest where it would have been out of reach
            else:
                share /= 2.0
        path = self._solver.to_velocity(of_tool(start, tool), STILL, self.platform, tool)
        if not self.checker.bears(self.checker.whole(path, start.pose)):
            raise TOO_FAST_IN_MOTION
        return Plan(path, bound=bound)

    def follow(self, start: MotionState, points: Sequence[Point], stretch: bool) -> Plan:
        """Take timed points for a path, quintic between them. Raises RefusedError.

        Too fast is refused, or slowed with `stretch`.
        """
        check_ends(points, start)
        path = quintic(points, start.pose)
        worst = self.checker.whole(path, start.pose)
        slower = excess(worst)
        if slower <= 1.0:
            return Plan(path)
        path, slower = self._slowed(path, slower, start.pose)
        if not stretch:
            raise RefusedError(
                RefusalCode.TOO_FAST,
                f"the trajectory is {slower:.3g} times too fast for {fastest(worst)}: "
                f"let it take {math.ceil(1e3 * path.duration) / 1e3:.10g} s, "
                'or send it with "stretch": true, trirail follow --stretch',
                value=slower,
                limit=1.0,
            )
        return Plan(path, slower)

    def to_velocity(self, start: MotionState, velocity: Sequence[float]) -> Path:
        """Return the quickest way to a velocity within the platform's limits, not looked at. Raises RefusedError."""
        return self._solver.to_velocity(start, velocity, self.platform)

    def nearness(self, pose: Sequence[float], target: Sequence[float]) -> float:
        """Return how far a point of the platform is at most from where it is to be [m]."""
        x, y, phi = (here - there for here, there in zip(pose, target, strict=True))
        return math.hypot(x, y) + self._reach * abs(phi)

    # ------------------------------------------------------------------ inside

    def _to_rest(
        self,
        start: MotionState,
        begin: MotionState,
        target: Sequence[float],
        limits: Kinodynamic,
        speed: float,
        in_sliders: bool = False,
        tool: Sequence[float] = NO_TOOL,
    ) -> Plan:
        """Plan from `begin`, the platform's motion `start` as that of the sliders or of a tool."""
        if start.at_rest:
            path = self._solver.to_rest(begin, target, limits, in_sliders, tool)
            slower = max(1.0 / speed, excess(self.checker.whole(path, start.pose)))
            if slower * speed > 1.0:
                quickest = self._quickest(path, limits, path.duration / speed, start.pose)
                if quickest is not None and quickest.duration < slower * path.duration:
                    return Plan(quickest, max(1.0, quickest.duration / path.duration * speed))
            if slower > 1.0:
                path, slower = self._slowed(path, slower, start.pose)
            return Plan(path, slower * speed)
        shares = np.full(3, speed)
        for _ in range(TRIES):
            lower = Kinodynamic(*(np.array(limits) * shares[:, None]).tolist())
            path = self._solver.to_rest(begin, target, lower, in_sliders, tool)
            worst = self.checker.whole(path, start.pose)
            if self.checker.bears(worst):
                return Plan(path, speed / float(shares.min()))
            shares = shares * np.clip(ROOM / worst.max(axis=0), GENTLEST, 1.0)
        raise TOO_FAST_IN_MOTION

    def _quickest(self, path: Path, limits: Kinodynamic, asked: float, pose: Sequence[float]) -> Path | None:
        """Return the time-optimal path from rest in the place of one that is too fast, no shorter than asked for [s].

        None where there is none, or none that fits.
        """
        others = self.platform if path.in_sliders else self._checked_sliders
        quickest = time_optimal(self._legs, path, limits, others, self._centre, pose)
        if quickest is None:
            return None
        try:
            path, _ = self._slowed(quickest, max(1.0, asked / quickest.duration), pose)
        except RefusedError:
            return None
        return path

    def _slowed(self, path: Path, factor: float, pose: Sequence[float]) -> tuple[Path, float]:
        """Return a path, so many times slower or as many more as it takes to fit, and how many that is.

        Slower it is not the same motion: what was over within a step, as a short jerk, lasts longer.
        """
        for _ in range(LOOKS):
            slow = stretched(path, factor)
            found = excess(self.checker.whole(slow, pose))
            if found <= 1.0:
                return slow, factor
            factor *= found * A_HAIR_MORE
        raise RefusedError(RefusalCode.TOO_FAST, f"the path does not fit its limits even {factor:.3g} times slower")

    def _jog(
        self, start: MotionState, velocity: Sequence[float], hold: float, tool: Sequence[float], limits: Kinodynamic
    ) -> tuple[float, float, Path]:
        """Return how long it takes a tool to reach a velocity, and to brake from it, and the whole path."""
        ramp = self._solver.to_velocity(start, velocity, limits, tool)
        if not any(velocity):
            return ramp.duration, 0.0, ramp
        pose = ramp.end
        held = np.zeros((1, 3, 6))
        held[0, :, 0], held[0, :, 1] = pose, velocity
        hold = max(hold, self._period)
        end = [value + hold * rate for value, rate in zip(pose, velocity, strict=True)]
        brake = self._solver.to_velocity(MotionState(end, velocity, STILL), STILL, limits, tool)
        whole = joined([ramp, Path(np.array([0.0, hold]), held, tools=tools_of(tool, 1)), brake])
        return ramp.duration, brake.duration, whole


def _slower(limits: Kinodynamic, factor: float) -> Kinodynamic:
    """Return the limits of the same motion that many times slower."""
    powers = factor ** np.arange(1.0, 4.0)
    return Kinodynamic(*(np.array(limits) / powers[:, None]).tolist())


def _meant(value: float, limit: float, unit: str) -> str:
    """Return what a bare number may have meant that is above a limit: millimetres or degrees."""
    size, least = MEANT[unit.removesuffix("/s")]
    likely = abs(value) >= least and abs(value) * size <= abs(limit)
    return f": did you mean {worded(value * size, unit)}?" if likely else ""
