"""What a recorded session comes to: its goals and how they ended, how well it was driven, and what went wrong."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

import msgspec
import numpy as np
from numpy.typing import NDArray
from trirail_drivers.interface import NAMES

from trirail.naming import Labels
from trirail.telemetry import provenance
from trirail.telemetry.alignments import RecordedAlignment
from trirail.telemetry.reading import Line, Recording
from trirail.wire.messages import Event
from trirail.wire.packets import CommandRequest, GoalRequest
from trirail.wire.state import Percentiles
from trirail.wire.vocabulary import MODES, Mode

ENABLED_MODES = tuple(MODES.index(mode) for mode in (Mode.HOLDING, Mode.MOVING, Mode.STOPPING))
"""Modes in which the sliders are to be where they are commanded."""
UNKNOWN = "unknown"
"""The outcome of a goal whose end is not in the recording."""


class GoalSummary(msgspec.Struct, frozen=True):
    """A goal, from when the control took it to its end; times are nominal, since the loop's start [s]."""

    id: str
    user: str
    kind: str
    outcome: str
    given: float
    ended: float | None
    message: str
    settle: float | None = None
    """From the end of its path until the robot was in position; None of one that did not settle."""


class AlignmentSummary(msgspec.Struct, frozen=True):
    """An alignment, a calibration of cameras, or a check."""

    id: str
    """The ids of its goals begin with it."""
    user: str
    purpose: str
    end: str
    """Why it ended; unknown where that was not told."""
    message: str
    """With an end by an error what that says."""
    began: float
    """Nominal time of its first look, since the loop's start [s]."""
    seconds: float
    """From the first look to the end."""
    looks: int
    corrections: int
    residuals: dict[str, list[float | None]]
    """How far each mark was from its target at each look [m]; None where that is not known."""


class Incident(msgspec.Struct, frozen=True):
    """Something that went wrong."""

    t: float
    """Nominal time since the loop's start [s]."""
    wall: str
    level: str
    message: str


class Tracking(msgspec.Struct, frozen=True):
    """Following error of one slider while the drives were enabled [m]."""

    slider: str
    max: float
    rms: float
    moving_rms: float


class Summary(msgspec.Struct, frozen=True):
    """A session."""

    name: str
    began: str
    """Wall clock, ISO 8601, UTC."""
    duration: float
    """From the first record to the last [s]."""
    cycles: int
    lacking: int
    """Cycles between the first and the last whose records are not there."""
    missed: int
    """Ticks that the loop missed."""
    rate_hz: int
    software: str
    labels: Labels
    """What people call the sliders A, B, C."""
    modes: dict[str, float]
    """Time in each mode that occurred [s]."""
    distance: tuple[float, float, float]
    """How far each slider moved [m]."""
    tracking: list[Tracking]
    lateness_us: Percentiles
    cycle_us: Percentiles
    commands: dict[str, int]
    """How often each command was given."""
    goals: list[GoalSummary]
    alignments: list[AlignmentSummary]
    faults: list[Incident]
    warnings: list[Incident]


def summary(recording: Recording) -> Summary:
    """Sum a session up."""
    records = recording.records
    period = _period(recording)
    cycles = records["cycle"]
    software = provenance.recorded_by(recording.texts)
    modes, counts = np.unique(records["mode"], return_counts=True)
    return Summary(
        name=recording.name,
        began=_iso(recording.wall[0]),
        duration=float(recording.t[-1] - recording.t[0]),
        cycles=len(records),
        lacking=int(cycles[-1] - cycles[0]) + 1 - len(records),
        missed=int(records["overruns"][-1] - records["overruns"][0]),
        rate_hz=round(1.0 / period),
        software=str(software) if software else UNKNOWN,
        labels=provenance.labels(recording.texts),
        modes={str(MODES[mode]): float(count * period) for mode, count in zip(modes, counts, strict=True)},
        distance=tuple(np.abs(np.diff(records["position"], axis=0)).sum(axis=0).tolist()),
        tracking=list(_tracking(records)),
        lateness_us=_percentiles(records["lateness_ns"]),
        cycle_us=_percentiles(records["parts_ns"].sum(axis=1)),
        commands=_commands(recording),
        goals=list(_goals(recording, period)),
        alignments=[_alignment(each) for each in recording.alignments],
        faults=[_incident(line) for line in recording.events if line.event is not None and line.event.kind == "fault"],
        warnings=[
            _incident(line)
            for line in recording.events
            if line.level == "WARN" and (line.event is None or line.event.kind != "goal")
        ],
    )


def _period(recording: Recording) -> float:
    steps = np.diff(recording.t)
    return float(np.median(steps)) if len(steps) else 1e-3


def _tracking(records: NDArray[np.void]) -> Iterator[Tracking]:
    enabled = np.isin(records["mode"], ENABLED_MODES)
    error = np.abs(records["following_error"])
    moving = enabled & (records["commanded_velocity"] != 0.0).any(axis=1)
    for number, slider in enumerate(NAMES):
        of_all, of_motion = error[enabled, number], error[moving, number]
        yield Tracking(slider, float(of_all.max(initial=0.0)), _rms(of_all), _rms(of_motion))


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else 0.0


def _percentiles(nanoseconds: NDArray[np.int64]) -> Percentiles:
    return Percentiles(*(np.percentile(nanoseconds, (50.0, 99.0, 99.9, 100.0)) / 1e3).tolist())


def _commands(recording: Recording) -> dict[str, int]:
    given = (what.given for what in recording.requests)
    return dict(Counter(str(each.name) for each in given if isinstance(each, CommandRequest)))


def _goals(recording: Recording, period: float) -> Iterator[GoalSummary]:
    """Yield the goals in the order in which they were given; a jog's many velocities are one goal."""
    ends: dict[str, Event] = {}
    for line in recording.events:
        if line.event is not None and line.event.kind == "goal" and line.event.id is not None:
            ends.setdefault(line.event.id, line.event)
    seen: set[str] = set()
    for what in recording.requests:
        request = what.given
        if not isinstance(request, GoalRequest) or request.id in seen:
            continue
        seen.add(request.id)
        end = ends.pop(request.id, None)
        kind = type(request.goal).__name__.removesuffix("Goal").lower()
        yield GoalSummary(request.id, request.user, kind, *_end(end, round(what.cycle * period, 6)))
    for name, end in ends.items():
        yield GoalSummary(name, end.user or "", UNKNOWN, *_end(end, round(end.t, 6)))


def _end(event: Event | None, given: float) -> tuple[str, float, float | None, str, float | None]:
    if event is None:
        return UNKNOWN, given, None, "its end is not in the recording", None
    return event.outcome or UNKNOWN, given, round(event.t, 6), event.reason or event.message, event.settle


def _alignment(told: RecordedAlignment) -> AlignmentSummary:
    last, seen = told.looks[-1], [bool(look.marks) for look in told.looks]
    rows = {
        name: [None if np.isnan(way) else float(way) for way in row[seen]]
        for name, row in zip(told.marks, told.residuals, strict=True)
        if not np.isnan(row).all()
    }
    corrections = sum(look.correction is not None for look in told.looks)
    return AlignmentSummary(
        told.id,
        told.user,
        told.purpose,
        told.end,
        last.words,
        round(told.t[0], 6),
        last.seconds,
        sum(seen),
        corrections,
        rows,
    )


def _incident(line: Line) -> Incident:
    return Incident(line.t, _iso(line.wall), line.level, line.text)


def _iso(wall: np.datetime64) -> str:
    return str(np.datetime_as_string(wall, unit="ms")) + "Z"
