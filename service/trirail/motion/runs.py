"""Runs: motions of the platform, each with a path, a law of time, and the current state."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from ruckig import Trajectory

from trirail.kinematics.arrays import Array
from trirail.motion.marks import GoalMarks
from trirail.motion.paths import (
    CENTRE_TOOLS,
    LAST_PIECE_S,
    Path,
    constant_law,
    evaluate,
    passing_time,
    path_motion,
    platform_at_law_time,
    transfer_to_point,
)

ZERO_RATES = (0.0, 0.0, 0.0)
NO_TOOL = (0.0, 0.0)
"""Tool that is the platform's centre itself [m]."""
KNOT_TOLERANCE_S = 1e-9
"""Interval below which two knots are merged [s]."""


class MotionState(NamedTuple):
    """Pose x, y [m], phi [rad], and its first and second derivatives with respect to time."""

    pose: Sequence[float]
    velocity: Sequence[float]
    acceleration: Sequence[float]

    @property
    def at_rest(self) -> bool:
        """Whether velocity and acceleration are zero."""
        return not any(self.velocity) and not any(self.acceleration)


def rest(pose: Sequence[float]) -> MotionState:
    """Return the state of a robot that is at rest at a pose."""
    return MotionState(tuple(pose), ZERO_RATES, ZERO_RATES)


def tool_motion(motion: MotionState, tool: Sequence[float]) -> MotionState:
    """Return the motion of a tool, (u, v) in the platform's frame [m], given the motion of the platform's centre."""
    rows = np.array(motion, dtype=np.float64)
    transfer_to_point(rows, *tool)
    return MotionState(*rows.tolist())


def centre_motion(motion: MotionState, tool: Sequence[float]) -> MotionState:
    """Return the motion of the platform's centre, given the motion of a tool, (u, v) in the platform's frame [m]."""
    u, v = tool
    return tool_motion(motion, (-u, -v))


class LawState(NamedTuple):
    """State of a law: time along the path [s], rate of the time along the path, and change of the rate [1/s]."""

    s: float
    rate: float
    change: float


class OwnBounds(NamedTuple):
    """Bounds of one goal, which are lower than those of the robot."""

    rate: float = math.inf
    """Greatest rate that the goal allows."""
    limits: Array | None = None
    """Greatest velocity, acceleration and jerk of the goal's point in x, y and phi, (3, 3) with a row for each
    coordinate; None if the robot's limits apply.
    """


class Seam(NamedTuple):
    """Time along a path at which one goal ends and the next one begins."""

    s: float
    """Time along the path [s]."""
    before: Path
    """Path without the next goal and the goals after it. Up to the seam, it equals the whole path."""
    own: OwnBounds = OwnBounds()
    """Bounds of the next goal."""


class GoalSpan(NamedTuple):
    """Times along the path at which the current goal begins and ends [s], and time of the law at which it ends [s]."""

    begun: float
    end: float
    arrival_time: float


class Run:
    """Motion along a path under a law. The owner advances `time` by one period per cycle."""

    def __init__(self, legs: Array, path: Path, law: Path, target: float) -> None:
        self.path = path
        self.law = law
        self.target = target
        """Rate of the time along the path at the end of the law."""
        self.time = 0.0
        """Time since the start of the law [s]."""
        self.furthest = np.full(1, -np.inf)
        """Greatest time along the path that has been commanded, (1,) [s]. It never decreases."""
        self.own = OwnBounds()
        """Bounds of the current goal."""
        self.seams: deque[Seam] = deque()
        self.marks: deque[GoalMarks] = deque()
        """Marks of the current goal and of the following goals on the path, in order; empty if no goal has marks."""
        self._begun = 0.0
        self._withdrawn: Seam | None = None
        """Seam at the end of the current goal, if the goals after it have been withdrawn but the path is longer."""
        self._goal_span = GoalSpan(0.0, 0.0, 0.0)
        self._span_law: Path | None = None
        self._legs = legs
        self._near = np.zeros(3)
        self._out = np.zeros((3, 3))
        self._law_out = np.zeros((3, 1))

    @property
    def law_state(self) -> LawState:
        """Current state of the law."""
        return self.law_state_at(self.time)

    def law_state_at(self, time: float) -> LawState:
        """Return the state of the law at a time since its start [s]."""
        evaluate(self.law.knots, self.law.pieces, time, self._law_out)
        s, rate, change = self._law_out[:, 0].tolist()
        return LawState(s, rate, change)

    @property
    def arrived(self) -> bool:
        """Whether the end of the path has been reached."""
        return self.law_state.s >= self.path.duration

    @property
    def at_rest(self) -> bool:
        """Whether the motion is at rest, at the end of the path or because the law has stopped it."""
        at = self.law_state
        return at.s >= self.path.duration or (self.target == 0.0 and at.rate == at.change == 0.0)

    @property
    def goal_span(self) -> GoalSpan:
        """Span of the current goal, computed again only after a change of the law or of the goal."""
        begun, seam = self._begun, self._next_seam
        end = seam.s if seam is not None else self.path.duration
        if self._span_law is not self.law or self._goal_span[:2] != (begun, end):
            self._goal_span, self._span_law = GoalSpan(begun, end, self.arrival_at(end)), self.law
        return self._goal_span

    @property
    def remaining(self) -> float:
        """Time until the end of the current goal [s]. If the law leads to a standstill, full speed is assumed."""
        _, end, arrival = self.goal_span
        return max(0.0, arrival - self.time if self.target else end - self.law_state.s)

    @property
    def end_time(self) -> float:
        """Time of the law at which the motion is at rest [s]."""
        stops = LAST_PIECE_S if self.target else float(self.law.knots[-2])
        return min(self.arrival_at(self.path.duration), stops)

    def arrival_at(self, s: float) -> float:
        """Return the time of the law at which the time along the path is `s` [s]; infinite if it never is."""
        return arrival_time(self.law, self.target, s)

    @property
    def progress(self) -> float:
        """Completed fraction of the current goal, from 0 to 1, as a fraction of its time along the path."""
        begun, end, _ = self.goal_span
        return max(0.0, min(1.0, (self.law_state.s - begun) / (end - begun))) if end > begun else 1.0

    def destination(self, near: Sequence[float]) -> Sequence[float]:
        """Return the target pose of the current goal. For a path in slider space, `near` selects the branch."""
        seam = self._next_seam
        return self._end_of(seam.before if seam is not None else self.path, near)

    @property
    def _next_seam(self) -> Seam | None:
        """Seam at the end of the current goal; None if the goal ends with the path."""
        return self.seams[0] if self.seams else self._withdrawn

    @property
    def allowed_rate(self) -> float:
        """Greatest rate that all goals on the path allow."""
        return min((self.own.rate, *(seam.own.rate for seam in self.seams)))

    def end(self, near: Sequence[float]) -> Sequence[float]:
        """Return the pose at the end of the path, which is the target of the last goal; `near` selects the branch."""
        return self._end_of(self.path, near)

    def _end_of(self, path: Path, near: Sequence[float]) -> Sequence[float]:
        self._near[:] = near
        code = platform_at_law_time(self._legs, *path, *constant_law(1.0)[:2], path.duration, self._near, self._out)
        return [math.nan] * 3 if code else self._out[0].tolist()

    def copy(self) -> Run:
        """Return an independent copy of the run."""
        other = Run(self._legs, self.path, self.law, self.target)
        other.time, other.seams, other._begun = self.time, self.seams.copy(), self._begun
        other.own, other._withdrawn = self.own, self._withdrawn
        other.furthest[:] = self.furthest
        other.marks = self.marks.copy()
        return other

    def append(self, s: float, path: Path, marks: GoalMarks | None = None, own: OwnBounds | None = None) -> None:
        """Replace the path after the time `s` by another path, which begins with the same state of motion.

        Marks of earlier goals after `s` are not used, unless the new goal is dropped. The part of the path that the
        motion has passed is removed, so that the path does not grow as long as goals follow each other.
        """
        before = without_passed(self.path, self.law_state.s)
        longer = joined([cut(before, s), path])
        self.marks.append(marks or GoalMarks())
        self.marks[-1].begin = s
        self.seams.append(Seam(s, before, own or OwnBounds()))
        self.path = longer

    def drop(self, number: int) -> None:
        """Remove the goals after seam `number`, counted from zero, and restore the path before this seam."""
        self.path = self.seams[number].before
        while len(self.seams) > number:
            self.seams.pop()
            if self.marks:
                self.marks.pop()

    def withdraw_following(self) -> None:
        """Withdraw the goals after the current goal, and all marks. The path does not change."""
        self._withdrawn = self._next_seam
        self.seams.clear()
        self.marks.clear()

    def pass_seams(self) -> int:
        """Remove the seams that the motion has passed. Return the number of goals that have thereby ended."""
        s, passed = self.law_state.s, 0
        while self.seams and s >= self.seams[0].s:
            seam = self.seams.popleft()
            self._begun, self.own, self._withdrawn = seam.s, seam.own, None
            if self.marks:
                self.marks.popleft()
            passed += 1
        return passed

    def change_law(self, law: Path, target: float) -> None:
        """Continue the motion under another law, which begins now."""
        self.law, self.target, self.time = law, target, 0.0

    def state(self, ahead: float, near: Sequence[float]) -> MotionState:
        """Return the state of motion `ahead` seconds from now; all values are NaN if no pose is possible."""
        self._near[:] = near
        code = platform_at_law_time(self._legs, *self.path, *self.law[:2], self.time + ahead, self._near, self._out)
        if code:
            self._out[:] = np.nan
        return MotionState(*self._out.tolist())


def nominal_motion(path: Path, s: float) -> MotionState:
    """Return the motion at a time along a path [s] at full speed, of the platform's centre or of the sliders."""
    out = np.zeros((3, 3))
    path_motion(path.knots, path.pieces, path.tools, s, out)
    return MotionState(*out.tolist())


def arrival_time(law: Path, target: float, s: float) -> float:
    """Return the time of a law at which the time along the path reaches `s` [s]; infinite if it never does.

    `target` is the rate of the time along the path at the end of the law.
    """
    last = law.pieces[-1, 0]
    begins, at, rate = float(law.knots[-2]), float(last[0]), float(last[1])
    if at >= s:
        return passing_time(law.knots, law.pieces, s, begins)
    return begins + (s - at) / rate if rate > 0.0 and target > 0.0 else np.inf


def from_ruckig(trajectory: Trajectory, in_sliders: bool = False, tool: Sequence[float] = ZERO_RATES[:2]) -> Path:
    """Convert a trajectory of Ruckig to a path of a tool. The pieces are cubics between changes of the jerk."""
    knots, pieces = _cubics(trajectory)
    return Path(np.array(knots), np.array(pieces), in_sliders, repeat_tool(tool, len(pieces)))


def _cubics(trajectory: Trajectory) -> tuple[list[float], list[list[list[float]]]]:
    """Return the knots of a trajectory of Ruckig [s], and for each piece the coefficients of each coordinate."""
    duration: float = trajectory.duration
    times = {0.0, duration}
    for profile in trajectory.profiles[0]:
        time = 0.0
        for span in (*profile.brake.t, *profile.t):
            time += span
            times.add(time)
    knots = [0.0]
    for time in sorted(times):
        if time - knots[-1] > KNOT_TOLERANCE_S and time <= duration:
            knots.append(time)
    if len(knots) == 1:
        knots.append(max(duration, KNOT_TOLERANCE_S))
    states = [tuple(zip(*trajectory.at_time(time), strict=True)) for time in knots]
    pieces = []
    for before, after, begin, end in zip(states[:-1], states[1:], knots[:-1], knots[1:], strict=True):
        jerks = ((then[2] - now[2]) / (end - begin) for now, then in zip(before, after, strict=True))
        pieces.append([[p, v, a / 2.0, jerk / 6.0, 0.0, 0.0] for (p, v, a), jerk in zip(before, jerks, strict=True)])
    return knots, pieces


def repeat_tool(tool: Sequence[float], number: int) -> Array:
    """Return Path.tools for a path with `number` pieces that all describe the same point of the platform [m]."""
    return np.tile(np.array(tool, dtype=np.float64), (number, 1)) if any(tool) else CENTRE_TOOLS


def law_from_ruckig(trajectory: Trajectory, target: float) -> Path:
    """Convert a one-dimensional trajectory of Ruckig to a law that continues at the final rate `target`."""
    knots, pieces = _cubics(trajectory)
    end = Path(np.array(knots[-2:]), np.array(pieces[-1:])).end[0]
    knots.append(knots[-1] + LAST_PIECE_S)
    pieces.append([[end, target, 0.0, 0.0, 0.0, 0.0]])
    return Path(np.array(knots), np.array(pieces))


def joined(paths: Sequence[Path]) -> Path:
    """Return one path that consists of the given paths in sequence."""
    ends = np.cumsum([path.duration for path in paths])
    knots = [paths[0].knots, *(path.knots[1:] + end for path, end in zip(paths[1:], ends, strict=False))]
    tools = CENTRE_TOOLS
    if any(len(path.tools) for path in paths):
        tools = np.concatenate([path.tools if len(path.tools) else np.zeros((len(path.pieces), 2)) for path in paths])
    return Path(np.concatenate(knots), np.concatenate([path.pieces for path in paths]), paths[0].in_sliders, tools)


def without_passed(path: Path, s: float) -> Path:
    """Return a path without the pieces that the motion has passed at the time `s` along the path [s], except the last.

    The times along the path do not change, so that its first knot may be later than zero.
    """
    first = max(0, int(np.searchsorted(path.knots, s, side="right")) - 2)
    return path._replace(knots=path.knots[first:], pieces=path.pieces[first:], tools=path.tools[first:])


def cut(path: Path, s: float) -> Path:
    """Return the part of a path from its start to the time `s` [s]."""
    if s >= path.duration:
        return path
    last = max(1, int(np.searchsorted(path.knots, s - KNOT_TOLERANCE_S)))
    return path._replace(knots=np.append(path.knots[:last], s), pieces=path.pieces[:last], tools=path.tools[:last])


def stretched(path: Path, factor: float) -> Path:
    """Return a path that is `factor` times slower. Derivatives that are too small for a float become zero."""
    with np.errstate(over="ignore"):  # the fifth power of a factor of 1e62 overflows
        powers = factor ** np.arange(6.0)
    return path._replace(knots=path.knots * factor, pieces=path.pieces / powers)
