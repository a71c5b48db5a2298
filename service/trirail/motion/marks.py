"""Location of marks on a planned path. The result is the times along the path at which outputs switch."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from trirail.errors import RefusalCode, RefusedError
from trirail.kinematics.arrays import Array
from trirail.motion.paths import ROUNDING, Path, path_motion, platform_at_each
from trirail.wire.marks import Mark, PlacedMark

SWITCH: Final = np.dtype([("s", "<f8"), ("width", "<f8"), ("mark", "<i4"), ("on", "<i4")], align=True)
"""Layout of a switch: time along the path [s], duration of the pulse [s] (NaN if the switch is not a pulse), index of
the mark in the goal, and new value of the output."""
HIGHEST_RATE: Final = 2.0
"""Rate of the time along the path at the highest override."""
MAX_SWITCHES = 10_000
"""Greatest number of switches of one goal."""
SAMPLES = 24
"""Number of samples per piece of a path, between which the length of the path is integrated."""
BISECTIONS = 50
"""Number of bisection steps after which an interval between samples is narrower than the resolution of a float."""
LEAST_LENGTH = 1e-9
"""Length of a path below which the tool counts as stationary [m]."""
_NO_SWITCHES: Final[NDArray[np.void]] = np.zeros(0, SWITCH)
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(5)


class Placed(NamedTuple):
    """Switches and positions of a goal's marks on the path."""

    switches: NDArray[np.void]
    """Switches, (n,) of dtype SWITCH, in the order of the time along the path."""
    marks: tuple[PlacedMark, ...]


def place_marks(
    marks: Sequence[Mark],
    path: Path,
    legs: Array,
    start: Sequence[float],
    period: float,
    beat: Callable[[], None] = lambda: None,
) -> Placed:
    """Locate the marks of a goal on its path.

    Parameters
    ----------
    marks
        Marks of the goal.
    path
        Path of this goal, without the paths of other goals.
    legs
        Geometry.packed(), which is only used for a path in slider space.
    start
        Pose of the platform's centre at the start of the path: x, y [m], phi [rad].
    period
        Period of the cycle [s].
    beat
        Function that is called repeatedly, since a path in slider space takes long if it has many marks.

    Raises
    ------
    RefusedError
        A mark is not on the path, two switches are too close to each other, or a section contains another switch of
        its output.

    """
    if not marks:
        return Placed(_NO_SWITCHES, ())
    trace = _Trace(path, legs, start, beat)
    rows: list[tuple[float, float, int, int]] = []
    placed = []
    for number, mark in enumerate(marks):
        own = list(_switches(number, mark, trace))
        if len(rows) + len(own) > MAX_SWITCHES:
            raise _refusal(number, mark, f"has {len(own):,} switches; the maximum for a goal is {MAX_SWITCHES:,}")
        rows += own
        s = own[0][0]
        pose = trace.pose_at(s)
        switched = sum(on == mark.value for *_, on in own)
        placed.append(
            PlacedMark(number, mark.output, mark.value, pose, float(trace.lengths_at(np.array([s]))[0]), s, switched)
        )
    switches = np.array(rows, SWITCH)
    switches = switches[np.argsort(switches["s"], kind="stable")]
    for output in {mark.output for mark in marks}:
        of_output = switches[[marks[number].output == output for number in switches["mark"]]]
        _check_sections(of_output, marks)
        _check_spacing(of_output, marks, period)
    return Placed(switches, tuple(placed))


def pulse_cycles(widths: Array, period: float) -> Array:
    """Return the durations of pulses in cycles, from their widths [s]; NaN if a switch is not a pulse."""
    return np.maximum(np.rint(widths / period), 1.0)


class GoalMarks:
    """Marks of a goal on the path of a run, and a record of the switches that have taken place."""

    def __init__(self, goal: str = "", marks: Sequence[Mark] = (), switches: bytes = b"") -> None:
        """Create the marks from the packed rows of SWITCH. Raises ValueError if `switches` do not match the marks."""
        self.goal = goal
        """Id of the goal."""
        self.begin = 0.0
        """Time along the path of the run at which the path of this goal begins [s]."""
        self._marks = tuple(marks)
        self._rows = np.frombuffer(switches, SWITCH) if switches else _NO_SWITCHES
        self._of: dict[str, tuple[NDArray[np.void], NDArray[np.bool]]] = {}
        """Switches of each output, and whether the goal later switches the output back."""
        self._passed: dict[str, int] = {}
        """Number of switches of each output that have taken place."""
        if switches and not (np.isfinite(self._rows["s"]).all() and np.all(self._rows["mark"] < len(self._marks))):
            raise ValueError(f"switches that do not belong to the {len(self._marks)} marks of goal {goal!r}")

    @property
    def has_switches(self) -> bool:
        """Whether the goal switches outputs."""
        return len(self._rows) > 0

    def pending(self, output: str, end: float) -> tuple[NDArray[np.void], NDArray[np.bool]]:
        """Return the remaining switches of an output, up to the time `end` along the path of the run.

        Returns
        -------
        switches : (n,) of dtype SWITCH
            Switches, with the time along the path of the run.
        opens : (n,)
            Whether the goal later switches the output back.

        """
        switches, opens = self._switches_of(output)
        rows, opens = switches[self._passed.get(output, 0) :].copy(), opens[self._passed.get(output, 0) :]
        rows["s"] += self.begin
        within = rows["s"] <= end
        return rows[within], opens[within]

    def note_passed(self, output: str, number: int) -> None:
        """Record that the next `number` switches of an output have taken place."""
        self._passed[output] = self._passed.get(output, 0) + number

    def _switches_of(self, output: str) -> tuple[NDArray[np.void], NDArray[np.bool]]:
        if output not in self._of:
            named = np.array([mark.output == output for mark in self._marks], np.bool)
            closes = np.array([mark.closes for mark in self._marks], np.bool)
            values = np.array([mark.value for mark in self._marks], np.bool)
            rows = self._rows[named[self._rows["mark"]]] if len(self._rows) else self._rows
            marks = rows["mark"]
            self._of[output] = rows, closes[marks] & (values[marks] == rows["on"].astype(np.bool))
        return self._of[output]


class _Trace:
    """Arc length and coordinates of a tool as functions of the time along its path."""

    def __init__(self, path: Path, legs: Array, start: Sequence[float], beat: Callable[[], None]) -> None:
        self._path, self._legs, self._beat = path, legs, beat
        self._near = np.array(start, dtype=np.float64)
        shares = np.linspace(0.0, 1.0, SAMPLES, endpoint=False)
        spans = np.diff(path.knots)
        times = np.append((path.knots[:-1, None] + shares * spans[:, None]).ravel(), path.duration)
        self.times = np.union1d(times, self._turning_points(times))
        self.coordinates = self.states(self.times)[0]
        self._lengths = np.append(0.0, np.cumsum(self._integrate(self.times[:-1], self.times[1:])))

    @property
    def duration(self) -> float:
        return self._path.duration

    @property
    def length(self) -> float:
        return float(self._lengths[-1])

    def states(self, times: Array) -> tuple[Array, Array]:
        """Return the tool's coordinates x, y [m], phi [rad] at times along the path, (n, 3), and their velocities."""
        if self._path.in_sliders:
            return self._platform_states(times)
        knots, pieces = self._path.knots, self._path.pieces
        piece = np.clip(np.searchsorted(knots, times, side="right") - 1, 0, len(pieces) - 1)
        t = np.clip(times, knots[0], knots[-1]) - knots[piece]
        powers = t[:, None] ** np.arange(6.0)
        slopes = np.arange(1.0, 6.0) * powers[:, :5]
        p = pieces[piece]
        return np.einsum("nij,nj->ni", p, powers), np.einsum("nij,nj->ni", p[:, :, 1:], slopes)

    def _platform_states(self, times: Array) -> tuple[Array, Array]:
        self._beat()
        order = np.argsort(times, kind="stable")
        motion = np.zeros((len(times), 3, 3))
        if platform_at_each(self._legs, *self._path, times[order], self._near.copy(), motion):
            raise RefusedError(RefusalCode.BAD_MARK, "marks cannot be placed on a path through a singular pose")
        states = np.empty_like(motion)
        states[order] = motion
        return states[:, 0], states[:, 1]

    def _turning_points(self, times: Array) -> Array:
        """Return the times at which a coordinate turns round between two consecutive `times`."""
        rates = self.states(times)[1]
        turns = (rates[:-1] * rates[1:] < 0.0) & (np.abs(rates[:-1]) + np.abs(rates[1:]) > ROUNDING)
        k, axis = np.nonzero(turns)
        low, high, before = times[k], times[k + 1], np.sign(rates[k, axis])
        for _ in range(BISECTIONS if len(k) else 0):
            self._beat()
            middle = (low + high) / 2.0
            same = np.sign(self.states(middle)[1][np.arange(len(k)), axis]) == before
            low, high = np.where(same, middle, low), np.where(same, high, middle)
        return high

    def pose_at(self, s: float) -> tuple[float, float, float]:
        """Return the pose of the platform's centre at a time along the path."""
        if self._path.in_sliders:
            x, y, phi = self._platform_states(np.array([s]))[0][0].tolist()
        else:
            motion = np.zeros((3, 3))
            path_motion(self._path.knots, self._path.pieces, self._path.tools, s, motion)
            x, y, phi = motion[0].tolist()
        return x, y, phi

    def _integrate(self, begins: Array, ends: Array) -> Array:
        """Return the length of the tool's path between pairs of times, computed by Gaussian quadrature [m]."""
        half = (ends - begins) / 2.0
        times = (begins + half)[:, None] + half[:, None] * _NODES
        velocities = self.states(times.ravel())[1]
        return half * (np.hypot(velocities[:, 0], velocities[:, 1]).reshape(times.shape) @ _WEIGHTS)

    def lengths_at(self, times: Array) -> Array:
        """Return the length that the tool has travelled at each time along the path [m]."""
        k = np.clip(np.searchsorted(self.times, times, side="right") - 1, 0, len(self.times) - 2)
        lengths: Array = self._lengths[k] + self._integrate(self.times[k], times)
        return lengths

    def times_at(self, lengths: Array) -> Array:
        """Return the times along the path at which the tool has travelled the given lengths [m]."""
        k = np.clip(np.searchsorted(self._lengths, lengths, side="left") - 1, 0, len(self.times) - 2)
        left, low, high = lengths - self._lengths[k], self.times[k].copy(), self.times[k + 1].copy()
        for _ in range(BISECTIONS):
            middle = (low + high) / 2.0
            short = self._integrate(self.times[k], middle) < left
            low, high = np.where(short, middle, low), np.where(short, high, middle)
        return high

    def crossing(self, coordinate: int, value: float) -> float | None:
        """Return the first time at which a coordinate reaches or crosses a value; None if it never does."""
        offset = self.coordinates[:, coordinate] - value
        offset[np.abs(offset) <= ROUNDING] = 0.0  # rounding may end the path a little before its target
        if offset[0] == 0.0:
            return 0.0
        crossed = np.flatnonzero(np.sign(offset[1:]) != np.sign(offset[0]))
        if not len(crossed):
            return None
        low, high = self.times[crossed[0]], self.times[crossed[0] + 1]
        for _ in range(BISECTIONS):
            middle = (low + high) / 2.0
            beyond = np.sign(self.states(np.array([middle]))[0][0, coordinate] - value) != np.sign(offset[0])
            low, high = (low, middle) if beyond else (middle, high)
        return float(high)


def _switches(number: int, mark: Mark, trace: _Trace) -> Iterator[tuple[float, float, int, int]]:
    """Yield the switches of a mark as rows of SWITCH."""
    width = mark.pulse_width if mark.pulse_width is not None else np.nan
    if mark.start is None:
        yield _time_of(number, mark, trace), width, number, int(mark.value)
        return
    begin, end = mark.start, mark.end if mark.end is not None else trace.length
    for name, length in (("start", mark.start), ("end", end)):
        _check_length(number, mark, name, length, trace.length)
    if mark.increment is None:
        begins, ends = trace.times_at(np.array([begin, end], np.float64)).tolist()
        yield begins, np.nan, number, int(mark.value)
        # The platform may turn after the tool has travelled the whole length.
        yield ends if mark.end is not None else trace.duration, np.nan, number, int(not mark.value)
        return
    count = int((end - mark.start) / mark.increment * (1.0 + 1e-12)) + 1
    if count > MAX_SWITCHES:
        raise _refusal(number, mark, f"has {count:,} pulses; the maximum for a goal is {MAX_SWITCHES:,}")
    for s in trace.times_at(begin + mark.increment * np.arange(count, dtype=np.float64)).tolist():
        yield s, width, number, int(mark.value)


def _time_of(number: int, mark: Mark, trace: _Trace) -> float:
    """Return the time along the path at which the path reaches a mark that has a single position."""
    if mark.at is not None:
        coordinate, value = mark.at.coordinate
        s = trace.crossing(coordinate, value)
        if s is None:
            here = np.round(trace.coordinates[:, coordinate], 9) + 0.0  # [nm]; 0.0 turns -0 into 0
            name = ("x", "y", "phi")[coordinate]
            scale, unit = (1e3, "mm") if coordinate < 2 else (1.0, "rad")
            text = (
                f"is at {name} = {value * scale:g} {unit}; the path goes from {here.min() * scale:g} to "
                f"{here.max() * scale:g} {unit}"
            )
            raise _refusal(number, mark, text)
        return s
    for name, time in (("after_start_s", mark.after_start_s), ("before_target_s", mark.before_target_s)):
        if time is not None:
            if time > trace.duration:
                raise _refusal(number, mark, f"is at {name} = {time:g} s; the path takes {trace.duration:g} s")
            return time if name == "after_start_s" else trace.duration - time
    if mark.before_target == 0.0:
        return trace.duration  # even if the tool does not travel at the end of the path
    for name, length in (("after_start", mark.after_start), ("before_target", mark.before_target)):
        if length is not None:
            _check_length(number, mark, name, length, trace.length)
            travelled = length if name == "after_start" else max(0.0, trace.length - length)
            return float(trace.times_at(np.array([travelled]))[0])
    share = mark.at_path_fraction or 0.0
    if trace.length < LEAST_LENGTH:
        raise _refusal(
            number, mark, "has at_path_fraction, but the tool does not travel on the path: use after_start_s or at"
        )
    return float(trace.times_at(np.array([share * trace.length]))[0])


def _check_length(number: int, mark: Mark, name: str, length: float, whole: float) -> None:
    if length > whole * (1.0 + 1e-9) + LEAST_LENGTH:
        raise _refusal(number, mark, f"is at {name} = {length * 1e3:g} mm; the path is {whole * 1e3:g} mm long")


def _check_sections(switches: NDArray[np.void], marks: Sequence[Mark]) -> None:
    """Raise RefusedError if an output switches inside a section of another mark.

    An output has one state to which the end of the goal returns it. The section would therefore no longer be closed.
    """
    begins = np.array([mark.start is not None and mark.increment is None for mark in marks])[switches["mark"]]
    begins &= switches["on"] == np.array([mark.value for mark in marks])[switches["mark"]]
    inside = begins[:-1] & (switches["mark"][1:] != switches["mark"][:-1])
    if inside.any():
        section, number = switches["mark"][np.argmax(inside) :][:2].tolist()
        raise _refusal(number, marks[number], f"switches inside the section of mark {section}: use separate sections")


def _check_spacing(switches: NDArray[np.void], marks: Sequence[Mark], period: float) -> None:
    """Raise RefusedError if two switches of an output are too close to each other at full speed.

    Two switches must not take place in the same cycle at the highest override, and the next switch must wait until a
    pulse has ended. Goals with pulses run at full speed at most.
    """
    if len(switches) < 2:
        return
    apart = period if any(mark.pulse_width is not None for mark in marks) else period * HIGHEST_RATE
    cycles = pulse_cycles(switches["width"][:-1], period)
    spacing, needed = np.diff(switches["s"]), np.where(np.isnan(cycles), apart, (cycles + 1.0) * period)
    k = int(np.argmin(spacing - needed))
    if spacing[k] < needed[k]:
        number = int(switches["mark"][k + 1])
        text = (
            f"switches {spacing[k] * 1e3:.3g} ms after the previous switch; the minimum at full speed is "
            f"{needed[k] * 1e3:.3g} ms: lower the speed, or move the marks apart"
        )
        raise _refusal(number, marks[number], text, float(spacing[k]), float(needed[k]))


def _refusal(
    number: int, mark: Mark, text: str, value: float | None = None, limit: float | None = None
) -> RefusedError:
    return RefusedError(
        RefusalCode.BAD_MARK, f"mark {number} of output {mark.output!r} {text}", value=value, limit=limit
    )
