"""Summary of a recorded session: goals and outcomes, tracking, timing, faults and warnings."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

import msgspec
import numpy as np
from numpy.typing import NDArray
from trirail_drivers.interface import NAMES, Triple

from trirail.naming import Labels
from trirail.telemetry import provenance
from trirail.telemetry.journal import Line
from trirail.telemetry.recording import RecordedAlignment, Recording
from trirail.wire.event_codes import EventCode
from trirail.wire.goals import kind_name
from trirail.wire.messages import Event
from trirail.wire.packets import CommandRequest, GoalRequest
from trirail.wire.state import Percentiles
from trirail.wire.vocabulary import MODES, AcquireLease, Mode

ENABLED_MODES = tuple(MODES.index(mode) for mode in (Mode.HOLDING, Mode.MOVING, Mode.STOPPING))
"""Indices in MODES of the modes in which the drives follow the setpoints."""
UNKNOWN_LABEL = "unknown"
"""Text for values that are not in the recording, such as the outcome of a goal that had not ended yet."""


class GoalSummary(msgspec.Struct, frozen=True):
    """Summary of a goal from its arrival at the control to its end.

    Times are nominal times since the start of the loop [s].
    """

    id: str
    user: str
    kind: str
    outcome: str
    given: float | None
    """Time of the request; None if that is not in the recording."""
    ended: float | None
    message: str
    settle: float | None = None
    """Time from the end of the path until the robot was in position [s].

    None if the goal is not done or does not settle.
    """


class AlignmentSummary(msgspec.Struct, frozen=True):
    """Summary of an alignment, a camera calibration, or a check."""

    id: str
    """Prefix of the ids of the alignment's goals."""
    user: str
    purpose: str
    end: str
    """Reason why the alignment ended; "unknown" if that is not recorded."""
    message: str
    """Error message if an error ended the alignment; otherwise empty."""
    began: float
    """Nominal time of the first look, since the start of the loop [s]."""
    seconds: float
    """Time from the first look to the end [s]."""
    looks: int
    corrections: int
    residuals: dict[str, list[float | None]]
    """Distance of each mark from its target in each look [m]; None if the mark was not found in that look."""


class Incident(msgspec.Struct, frozen=True):
    """Fault or warning."""

    t: float
    """Nominal time since the start of the loop [s]."""
    wall: str
    level: str
    message: str


class Tracking(msgspec.Struct, frozen=True):
    """Following error of one slider while the drives are enabled [m].

    The values are the maximum, the root mean square, and the root mean square while the robot moves.
    """

    slider: str
    max: float
    rms: float
    moving_rms: float


class Summary(msgspec.Struct, frozen=True):
    """Summary of a session."""

    name: str
    began: str
    """Wall-clock time of the first record, in ISO 8601 format and UTC."""
    duration: float
    """Time from the first to the last record [s]."""
    cycles: int
    lacking: int
    """Number of cycles from the first record to the end of the recording that have no record."""
    missed: int
    """Number of ticks that the loop missed."""
    rate_hz: int
    software: str
    labels: Labels
    """Configured labels of the sliders A, B, C."""
    modes: dict[str, float]
    """Recorded time in each mode that occurred [s]."""
    unrecorded: float
    """Time in the cycles that have no record, in which the mode is unknown [s]."""
    distance: Triple
    """Distance over which each slider was commanded to move while the drives were enabled [m].

    Measured positions also change by single counts of the encoders, by homing, which sets their zero, and by hand.
    """
    tracking: list[Tracking]
    lateness_us: Percentiles
    cycle_us: Percentiles
    commands: dict[str, int]
    """Number of times that each command was given; renewals of a lease are not counted."""
    goals: list[GoalSummary]
    alignments: list[AlignmentSummary]
    faults: list[Incident]
    warnings: list[Incident]


def summarise(recording: Recording) -> Summary:
    """Summarise a recorded session."""
    records = recording.records
    period = _period(recording)
    cycles = records["cycle"]
    lacking = _last_cycle(recording) - int(cycles[0]) + 1 - len(records)
    software = provenance.recorded_by(recording.texts)
    modes, counts = np.unique(records["mode"], return_counts=True)
    return Summary(
        name=recording.name,
        began=_iso(recording.wall[0]),
        duration=float(recording.t[-1] - recording.t[0]),
        cycles=len(records),
        lacking=lacking,
        missed=int(records["overruns"][-1] - records["overruns"][0]),
        rate_hz=round(1.0 / period),
        software=str(software) if software else UNKNOWN_LABEL,
        labels=provenance.labels(recording.texts),
        modes={str(MODES[mode]): float(count * period) for mode, count in zip(modes, counts, strict=True)},
        unrecorded=lacking * period,
        distance=_distance(records),
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
    """Return the time of a cycle [s], which is a whole number of microseconds."""
    # After days, the steps of t are less exact: a float of 10^6 s has a resolution of 10^-10 s.
    cycle = int(recording.records["cycle"][-1])
    return round(float(recording.t[-1]) / cycle, 6) if cycle else 1e-3


def _distance(records: NDArray[np.void]) -> Triple:
    enabled = np.isin(records["mode"], ENABLED_MODES)
    steps = np.abs(np.diff(records["commanded_position"] - records["backlash"], axis=0))
    a, b, c = steps[enabled[1:] & enabled[:-1]].sum(axis=0).tolist()
    return a, b, c


def _tracking(records: NDArray[np.void]) -> Iterator[Tracking]:
    enabled = np.isin(records["mode"], ENABLED_MODES)
    error = np.abs(records["following_error"])
    moving = enabled & (records["commanded_velocity"] != 0.0).any(axis=1)
    for number, slider in enumerate(NAMES):
        enabled_error, moving_error = error[enabled, number], error[moving, number]
        yield Tracking(slider, float(enabled_error.max(initial=0.0)), _rms(enabled_error), _rms(moving_error))


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else 0.0


def _percentiles(nanoseconds: NDArray[np.int64]) -> Percentiles:
    return Percentiles(*(np.percentile(nanoseconds, (50.0, 99.0, 99.9, 100.0)) / 1e3).tolist())


def _commands(recording: Recording) -> dict[str, int]:
    """Count the commands. The renewals of a lease, which are requests with the same id, are not counted."""
    counts, leases = Counter[str](), set[tuple[str, str]]()
    for request in (entry.given for entry in recording.requests):
        if not isinstance(request, CommandRequest):
            continue
        if isinstance(request.content, AcquireLease) and request.content.id is not None:
            lease = request.user, request.content.id
            if lease in leases:
                continue
            leases.add(lease)
        counts[str(request.name)] += 1
    return dict(counts)


def _goals(recording: Recording, period: float) -> Iterator[GoalSummary]:
    """Yield the goals in the order of their requests.

    A jog, in which many velocities are sent as requests with the same id, counts as one goal.
    """
    ends: dict[str, Event] = {}
    for line in recording.events:
        if line.event is not None and line.event.kind == "goal" and line.event.id is not None:
            ends.setdefault(line.event.id, line.event)
    seen: set[str] = set()
    for entry in recording.requests:
        request = entry.given
        if not isinstance(request, GoalRequest) or request.id in seen:
            continue
        seen.add(request.id)
        end = ends.pop(request.id, None)
        yield GoalSummary(request.id, request.user, kind_name(request.goal), *_end(end, round(entry.cycle * period, 6)))
    # Goals that were requested before the recording began.
    for name, end in ends.items():
        yield GoalSummary(name, end.user or "", UNKNOWN_LABEL, *_end(end, None))


def _end(event: Event | None, start: float | None) -> tuple[str, float | None, float | None, str, float | None]:
    if event is None:
        return UNKNOWN_LABEL, start, None, "its end is not in the recording", None
    return event.outcome or UNKNOWN_LABEL, start, round(event.t, 6), event.reason or event.message, event.settle


def _alignment(recorded: RecordedAlignment) -> AlignmentSummary:
    last, seen = recorded.looks[-1], [bool(look.marks) for look in recorded.looks]
    rows = {
        name: [None if np.isnan(way) else float(way) for way in row[seen]]
        for name, row in zip(recorded.marks, recorded.residuals, strict=True)
        if not np.isnan(row).all()
    }
    corrections = sum(look.correction is not None for look in recorded.looks)
    return AlignmentSummary(
        recorded.id,
        recorded.user,
        recorded.purpose,
        recorded.end,
        last.words,
        round(recorded.t[0], 6),
        last.seconds,
        sum(seen),
        corrections,
        rows,
    )


def _last_cycle(recording: Recording) -> int:
    """Return the last cycle of a recording, which has no record if an event reports that the last ones are missing."""
    last = int(recording.records["cycle"][-1])
    for event in (line.event for line in recording.events):
        if event is not None and event.event_code is EventCode.RECORDING_INCOMPLETE:
            last = max(last, event.cycle - 1)
    return last


def _incident(line: Line) -> Incident:
    return Incident(line.t, _iso(line.wall), line.level, line.text)


def _iso(wall: np.datetime64) -> str:
    return str(np.datetime_as_string(wall, unit="ms")) + "Z"
