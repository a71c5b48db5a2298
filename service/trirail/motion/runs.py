"""The platform's motion under way: a path, the law by which its time runs, and the state they are at."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from ruckig import Trajectory

from trirail.kinematics.arrays import Array
from trirail.motion.paths import CENTRE, FOR_EVER, Path, advance, constant, path_motion, reached, transfer, value

STILL = (0.0, 0.0, 0.0)
NO_TOOL = (0.0, 0.0)
"""The platform's centre, as a point of the platform [m]."""
SAME_TIME = 1e-9
"""Knots closer than this are one [s]."""


class MotionState(NamedTuple):
    """Platform pose, velocity and acceleration: x, y [m], phi [rad], and per second."""

    pose: Sequence[float]
    velocity: Sequence[float]
    acceleration: Sequence[float]

    @property
    def at_rest(self) -> bool:
        """Whether nothing moves."""
        return not any(self.velocity) and not any(self.acceleration)


def rest(pose: Sequence[float]) -> MotionState:
    """Stand at a pose."""
    return MotionState(tuple(pose), STILL, STILL)


def of_tool(motion: MotionState, tool: Sequence[float]) -> MotionState:
    """Return the motion of a point of the platform, (u, v) in its frame [m], from that of the platform's centre."""
    rows = np.array(motion, dtype=np.float64)
    transfer(rows, *tool)
    return MotionState(*rows.tolist())


def of_centre(motion: MotionState, tool: Sequence[float]) -> MotionState:
    """Return the motion of the platform's centre from that of a point, (u, v) in the platform's frame [m]."""
    u, v = tool
    return of_tool(motion, (-u, -v))


class Rate(NamedTuple):
    """Where a law is: time along the path [s], its rate, and the rate's change [1/s]."""

    s: float
    rate: float
    change: float


class Seam(NamedTuple):
    """Where on a path one goal ends and the next one, that waited for it, begins."""

    s: float
    """Time along the path [s]."""
    before: Path
    """The path without the next goal; the same up to the seam."""


class Course(NamedTuple):
    """The goal under way on a path: where it began and where it ends [s], and when its law comes there [s]."""

    begun: float
    end: float
    arrival: float


class Run:
    """A path and its law, advanced by one period a cycle."""

    def __init__(self, legs: Array, path: Path, law: Path, target: float) -> None:
        self.path = path
        self.law = law
        self.target = target
        """The rate that the law leads to."""
        self.time = 0.0
        """Time since the law began [s]."""
        self.furthest = np.full(1, -np.inf)
        """The time along the path that has been commanded, (1,) [s]: it never falls."""
        self.seams: deque[Seam] = deque()
        self._begun = 0.0
        self._course = Course(0.0, 0.0, 0.0)
        self._course_by: Path | None = None
        self._legs = legs
        self._near = np.zeros(3)
        self._out = np.zeros((3, 3))
        self._law_out = np.zeros((3, 1))

    @property
    def at(self) -> Rate:
        """Where the law is."""
        return self.at_time(self.time)

    def at_time(self, time: float) -> Rate:
        """Where the law is at a time of its own [s]."""
        value(self.law.knots, self.law.pieces, time, self._law_out)
        s, rate, change = self._law_out[:, 0].tolist()
        return Rate(s, rate, change)

    @property
    def arrived(self) -> bool:
        """Whether the end of the path has been reached."""
        return self.at.s >= self.path.duration

    @property
    def stands(self) -> bool:
        """Whether the law has brought the motion to a standstill, at the end of the path or before."""
        at = self.at
        return at.s >= self.path.duration or (self.target == 0.0 and at.rate == at.change == 0.0)

    @property
    def course(self) -> Course:
        """The goal under way; worked out anew where law or goal have changed."""
        begun, end = self._begun, self.seams[0].s if self.seams else self.path.duration
        if self._course_by is not self.law or self._course[:2] != (begun, end):
            self._course, self._course_by = Course(begun, end, self.reaches(end)), self.law
        return self._course

    @property
    def remaining(self) -> float:
        """Time to the end of the goal under way [s]; of one that is stopped before, at full speed."""
        _, end, arrival = self.course
        return max(0.0, arrival - self.time if self.target else end - self.at.s)

    @property
    def ends(self) -> float:
        """When it stands, in time of its law [s]."""
        stops = FOR_EVER if self.target else float(self.law.knots[-2])
        return min(self.reaches(self.path.duration), stops)

    def reaches(self, s: float) -> float:
        """When it comes to a time along the path, in time of its law [s]; infinite if it stops before."""
        return arrival(self.law, self.target, s)

    @property
    def progress(self) -> float:
        """Share that is over of the time of the goal under way."""
        begun, end, _ = self.course
        return max(0.0, min(1.0, (self.at.s - begun) / (end - begun))) if end > begun else 1.0

    def destination(self, near: Sequence[float]) -> Sequence[float]:
        """Return the pose that the goal under way leads to, on the branch of the pose `near`."""
        return self._end_of(self.seams[0].before if self.seams else self.path, near)

    def end(self, near: Sequence[float]) -> Sequence[float]:
        """Return the pose at the end of the path, that the last goal leads to, on the branch of the pose `near`."""
        return self._end_of(self.path, near)

    def _end_of(self, path: Path, near: Sequence[float]) -> Sequence[float]:
        self._near[:] = near
        code = advance(self._legs, *path, *constant(1.0)[:2], path.duration, self._near, self._out)
        return [math.nan] * 3 if code else self._out[0].tolist()

    def copy(self) -> Run:
        """Return the same motion, to be changed by itself."""
        other = Run(self._legs, self.path, self.law, self.target)
        other.time, other.seams, other._begun = self.time, self.seams.copy(), self._begun
        other.furthest[:] = self.furthest
        return other

    def append(self, s: float, path: Path) -> None:
        """Go on from a time along the path by another one, that begins with the motion that the run has there."""
        longer = joined([cut(self.path, s), path])
        self.seams.append(Seam(s, self.path))
        self.path = longer

    def drop(self, number: int) -> None:
        """Leave out the goals behind the seam of that number, counted from zero."""
        self.path = self.seams[number].before
        while len(self.seams) > number:
            self.seams.pop()

    def pass_seams(self) -> int:
        """Return how many goals have ended since the last time."""
        s, passed = self.at.s, 0
        while self.seams and s >= self.seams[0].s:
            self._begun = self.seams.popleft().s
            passed += 1
        return passed

    def change_law(self, law: Path, target: float) -> None:
        """Go on from here by another law."""
        self.law, self.target, self.time = law, target, 0.0

    def state(self, ahead: float, near: Sequence[float]) -> MotionState:
        """Evaluate so much later than now [s]; a pose that cannot be is not a number."""
        self._near[:] = near
        code = advance(self._legs, *self.path, *self.law[:2], self.time + ahead, self._near, self._out)
        if code:
            self._out[:] = np.nan
        return MotionState(*self._out.tolist())


def nominal(path: Path, s: float) -> MotionState:
    """Return the motion of the platform at a time along a path [s], at full speed; of sliders on a path in these."""
    out = np.zeros((3, 3))
    path_motion(path.knots, path.pieces, path.tools, s, out)
    return MotionState(*out.tolist())


def arrival(law: Path, target: float, s: float) -> float:
    """Return when a law that leads to a rate reaches a time along the path [s]; infinite if it stops before."""
    last = law.pieces[-1, 0]
    begins, at, rate = float(law.knots[-2]), float(last[0]), float(last[1])
    if at >= s:
        return reached(law.knots, law.pieces, s, begins)
    return begins + (s - at) / rate if rate > 0.0 and target > 0.0 else np.inf


def from_ruckig(trajectory: Trajectory, in_sliders: bool = False, tool: Sequence[float] = STILL[:2]) -> Path:
    """Take a Ruckig trajectory over as a path, of a tool: between its switching times everything is a cubic."""
    duration: float = trajectory.duration
    times = {0.0, duration}
    for profile in trajectory.profiles[0]:
        time = 0.0
        for span in (*profile.brake.t, *profile.t):
            time += span
            times.add(time)
    knots = [0.0]
    for time in sorted(times):
        if time - knots[-1] > SAME_TIME and time <= duration:
            knots.append(time)
    if len(knots) == 1:
        knots.append(max(duration, SAME_TIME))
    states = np.array([trajectory.at_time(time) for time in knots[:-1]] + [trajectory.at_time(knots[-1])])
    degrees = states.shape[2]
    pieces = np.zeros((len(knots) - 1, degrees, 6))
    pieces[:, :, 0] = states[:-1, 0]
    pieces[:, :, 1] = states[:-1, 1]
    pieces[:, :, 2] = states[:-1, 2] / 2.0
    pieces[:, :, 3] = np.diff(states[:, 2], axis=0) / np.diff(knots)[:, None] / 6.0
    return Path(np.array(knots), pieces, in_sliders, tools_of(tool, len(pieces)))


def tools_of(tool: Sequence[float], number: int) -> Array:
    """Return the tools of a path of so many pieces, all of one point of the platform [m]."""
    return np.tile(np.array(tool, dtype=np.float64), (number, 1)) if any(tool) else CENTRE


def law_from_ruckig(trajectory: Trajectory, target: float) -> Path:
    """Take a one-dimensional Ruckig trajectory over as a law: after it the rate stays what it is."""
    ramp = from_ruckig(trajectory)
    last = np.zeros((1, 1, 6))
    last[0, 0, :2] = ramp.end[0], target
    return Path(np.append(ramp.knots, ramp.knots[-1] + FOR_EVER), np.concatenate([ramp.pieces, last]))


def joined(paths: Sequence[Path]) -> Path:
    """Return one path after the other."""
    ends = np.cumsum([path.duration for path in paths])
    knots = [paths[0].knots, *(path.knots[1:] + end for path, end in zip(paths[1:], ends, strict=False))]
    tools = CENTRE
    if any(len(path.tools) for path in paths):
        tools = np.concatenate([path.tools if len(path.tools) else np.zeros((len(path.pieces), 2)) for path in paths])
    return Path(np.concatenate(knots), np.concatenate([path.pieces for path in paths]), paths[0].in_sliders, tools)


def cut(path: Path, s: float) -> Path:
    """Return a path up to a time along it [s]."""
    if s >= path.duration:
        return path
    last = max(1, int(np.searchsorted(path.knots, s - SAME_TIME)))
    return path._replace(knots=np.append(path.knots[:last], s), pieces=path.pieces[:last], tools=path.tools[:last])


def stretched(path: Path, factor: float) -> Path:
    """Return the same path, `factor` times slower: what is too slow for a float is none."""
    with np.errstate(over="ignore"):  # a factor of 1e62 has no fifth power
        powers = factor ** np.arange(6.0)
    return path._replace(knots=path.knots * factor, pieces=path.pieces / powers)
