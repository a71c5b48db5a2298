"""Replay of a recorded session: the same control code runs with the recorded inputs, cycle by cycle.

The replay runs in a single process, as fast as possible. The decisions of the control depend on the configuration, on
the feedback of the drives at each SYNC, and on the inputs, which are goals, commands, disturbances and the planner's
answers. A recording contains all of these, each with the number of its cycle. Therefore the setpoints of the replay
must equal the recorded setpoints in every bit. The control also makes the same requests to the planner. The replay
plans these requests again, and compares the results with the recorded answers, which may differ by rounding.

With another configuration, the recorded feedback of the drives and the recorded answers of the planner are not valid.
The replay then uses simulated drives, whose clock advances by one period per cycle, and a planner that answers in the
next cycle.
"""

from __future__ import annotations

import itertools
import time
from collections import deque
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray
from trirail_drivers.connection.opening import connect
from trirail_drivers.interface import (
    NAMES,
    Counts,
    DriveFault,
    DriveGroup,
    Feedback,
    MissingProtection,
    PowerState,
    Travel,
    Triple,
    Unready,
    UnreadyDrives,
)

from trirail.analysis.plan_comparison import is_same_plan
from trirail.config import Config
from trirail.control.control import Control, TimedInput
from trirail.control.feedback import Snapshot
from trirail.control.local_planner import LocalPlanner
from trirail.errors import ServiceError
from trirail.motion.motion_planner import MotionPlanner, revision
from trirail.motion.rules import RULES
from trirail.telemetry import provenance
from trirail.telemetry.recording import Recording
from trirail.wire.packets import ControlInput, DecidedAhead, DrivesFault, PlannerLost
from trirail.wire.plan_packets import PlanAnswer, PlanRequest
from trirail.wire.vocabulary import MODES, Mode

SETPOINT_FIELDS = ("commanded_position", "commanded_velocity")
"""Fields of a record that contain the setpoints for the drives."""
_FLAG_FIELDS = (("age", int), ("follows", bool), ("homed", bool))


class Comparison(NamedTuple):
    """Comparison of a recorded session with its replay."""

    cycles: int
    """Number of compared cycles."""
    lacking: int
    """Number of cycles that were not compared, because they follow a gap in the recording."""
    requests: int
    """Number of replayed inputs, such as goals, commands and disturbances, without the planner's answers."""
    plans: int
    """Number of recorded answers from the planner that were used; 0 if the replay made all plans itself."""
    plans_differing: int
    """Number of recorded answers that differ by more than rounding from the plan that the replay made for the same
    request.
    """
    plans_rounded: int
    """Number of recorded answers that differ from this plan only by rounding, which depends on the processor."""
    differing: int
    """Number of cycles in which any bit of the setpoints, the mode or the outputs differs from the recording."""
    first: int | None
    """Number of the first cycle that differs; None if no cycle differs."""
    position: Triple
    """Largest difference of the position setpoint for each slider [m]."""
    velocity: Triple
    """Largest difference of the velocity feed-forward for each slider [m/s]."""


def replay_session(recording: Recording, config: Config, *, simulated: bool) -> Comparison:
    """Run a session again, and compare its setpoints, modes and outputs with the recorded values.

    Parameters
    ----------
    recording
        Session to replay.
    config
        Configuration with which the control runs.
    simulated
        True to run simulated drives with this configuration, False to use the recorded feedback of the drives.

    Raises
    ------
    ServiceError
        The robot is not disabled at the start of the recording, or the recording lacks the first inputs, so that the
        state of the control is unknown. Or the rate of the recording differs from the configured rate.
    """
    records, inputs = _replayable_part(recording)
    _check_recording(recording, records, config)
    clock = _SimulatedClock(config.period)
    drives = _simulated_drives(records, config, clock) if simulated else _RecordedDrives(records)
    requests = [entry for entry in inputs if not isinstance(entry.given, PlanAnswer | PlannerLost)]
    number = sum(not isinstance(entry.given, DecidedAhead) for entry in requests)
    planner: _RecordedPlanner | LocalPlanner
    # Recorded feedback belongs to the recorded plans, even if the recording ends before the first of them.
    if _has_same_plans(recording, config) and (not simulated or len(requests) < len(inputs)):
        planner = _RecordedPlanner(config)
    else:
        planner, inputs = LocalPlanner(config), requests
    software = provenance.recorded_by(recording.texts)
    control = Control(config, drives, planner, software.rules if software is not None else RULES)
    try:
        setpoints, modes, outputs = _run(control, drives, planner, clock, records, inputs)
    finally:
        clock.run()
        drives.close()
    recorded = np.stack([records[name] for name in SETPOINT_FIELDS], axis=1)
    # The values are compared as integers, so that all bits must match, including the sign of a zero.
    differs = (setpoints.view(np.int64) != recorded.view(np.int64)).any(axis=(1, 2)) | (modes != records["mode"])
    differs |= (outputs != records["outputs"]).any(axis=1)
    greatest = np.abs(setpoints - recorded).max(axis=0).tolist()
    return Comparison(
        cycles=len(records),
        lacking=len(recording.records) - len(records),
        requests=number,
        plans=planner.answers if isinstance(planner, _RecordedPlanner) else 0,
        plans_differing=planner.differing if isinstance(planner, _RecordedPlanner) else 0,
        plans_rounded=planner.rounded if isinstance(planner, _RecordedPlanner) else 0,
        differing=int(differs.sum()),
        first=int(records["cycle"][np.argmax(differs)]) if differs.any() else None,
        position=tuple(greatest[0]),
        velocity=tuple(greatest[1]),
    )


def _run(
    control: Control,
    drives: DriveGroup,
    planner: _RecordedPlanner | LocalPlanner,
    clock: _SimulatedClock,
    records: NDArray[np.void],
    inputs: Sequence[ControlInput],
) -> tuple[NDArray[np.float64], NDArray[np.uint8], NDArray[np.int64]]:
    """Run the control through all N cycles of `records`, and return its commands.

    These are the setpoints, which are positions [m] and velocities [m/s], (N, 2, 3), the modes, (N,), and the output
    words of the drives, (N, 3).
    """
    clock.step()
    drives.sync()
    control.start(drives.read())
    control.modes.cycle = int(records["cycle"][0])
    pending = deque(inputs)
    ahead = _Ahead(control, planner, pending)
    setpoints = np.zeros((len(records), 2, 3))
    modes = np.zeros(len(records), np.uint8)
    outputs = np.zeros((len(records), 3), np.int64)
    for row in range(len(records)):
        clock.step()
        drives.sync()
        ahead.begin_cycle()
        entries = list(_due_inputs(pending, control.cycles + 1))
        _run_cycle(control, drives, planner, entries, ahead)
        setpoints[row] = control.setpoints.rows[:2]
        modes[row] = MODES.index(control.state.mode)
        outputs[row] = control.outputs.words
        ahead.end_cycle()
    return setpoints, modes, outputs


def _run_cycle(
    control: Control,
    drives: DriveGroup,
    planner: _RecordedPlanner | LocalPlanner,
    entries: Sequence[ControlInput],
    ahead: _Ahead,
) -> None:
    """Decide as the loop did before a cycle, and run the same steps that the loop ran after the SYNC of the cycle."""
    inputs = [entry for entry in entries if not isinstance(entry.given, DrivesFault)]
    if isinstance(drives, _RecordedDrives):
        for entry in entries:
            if isinstance(entry.given, DrivesFault):
                drives.set_fault(entry.given)
    # Earlier versions handled inputs that arrived while the loop waited for its tick separately, after the others.
    for waiting in (False, True) if not ahead.under_way else ():
        batch = _batch([entry for entry in inputs if not entry.urgent and entry.waiting is waiting], planner)
        if batch or not (waiting or ahead.decided):
            control.decide(batch)
    for entry in inputs:
        if entry.urgent:
            control.handle(entry.given, entry.now_ns)  # type: ignore[arg-type]
    control.execute(drives.read())
    control.ledger.answers.clear()
    control.ledger.notices.clear()


def _batch(entries: Sequence[ControlInput], planner: _RecordedPlanner | LocalPlanner) -> list[TimedInput]:
    """Return inputs for the control, with the answers of a planner that makes the plans itself."""
    batch: list[TimedInput] = [(entry.given, entry.now_ns) for entry in entries]  # type: ignore[misc]
    if isinstance(planner, LocalPlanner):
        batch += [(answer, 0) for answer in planner.answers()]
    else:
        planner.compare(entries)
    return batch


class _Ahead:
    """Decisions that the control made while further cycles ran, see trirail.processes.cycle_caller.

    The control then knew the feedback before these cycles, and its decisions took effect after them.
    """

    def __init__(
        self, control: Control, planner: _RecordedPlanner | LocalPlanner, pending: deque[ControlInput]
    ) -> None:
        self._control = control
        self._planner = planner
        self._pending = pending
        self._last = 0
        """Last cycle that ran beside the decision."""
        self._known: Snapshot | None = None
        self.decided = False
        """Whether the decision for the present cycle was made ahead."""

    @property
    def under_way(self) -> bool:
        """Whether the present cycle ran beside a decision."""
        return self._known is not None

    def begin_cycle(self) -> None:
        """Decide before the present cycle if a fault in this cycle ended the cycles beside the decision."""
        inputs, cycle = self._inputs(self._last + 1), self._control.modes.cycle
        if not self.under_way or len(inputs) == len(self._pending):
            return
        after = self._pending[len(inputs)]
        if after.given == DecidedAhead(0) and after.cycle == cycle:
            self._decide_in_vain(cycle)
            self._pending.popleft()

    def end_cycle(self) -> None:
        """Evaluate the present cycle, or leave this to the decision beside which the cycle ran."""
        control, cycle, self.decided = self._control, self._control.modes.cycle, False
        if self.under_way and cycle == self._last:
            self._decide()
            control.end_ahead()
        if self.under_way:
            control.modes.cycle += 1
        elif (ahead := self._next_ahead(cycle)) is None:
            if not self.decided:
                control.conclude()
        else:
            if not self.decided and ahead.again:
                control.conclude()
                control.decide(_batch(self._popped(cycle + 1), self._planner))
            elif not self.decided:
                control.modes.cycle += 1
            self._pending.popleft()
            self._last, self._known = cycle + ahead.cycles, control.measured.snapshot()
            control.begin_ahead(ahead.cycles)

    def _next_ahead(self, cycle: int) -> DecidedAhead | None:
        """Return the note of a decision that was made beside the cycles after cycle `cycle`; None if there is none."""
        number = len(self._inputs(cycle + 1))
        following = self._pending[number] if number < len(self._pending) else None
        if following is None or following.cycle != cycle + 1 or not isinstance(following.given, DecidedAhead):
            return None
        return following.given

    def _decide(self) -> None:
        """Decide with the feedback from before the cycles beside the decision."""
        assert self._known is not None
        with self._control.measured.as_of(self._known):
            self._control.conclude()
            self._control.decide(_batch(self._popped(self._last + 1), self._planner))
        self._known, self._control.ahead, self.decided = None, 0, True

    def _decide_in_vain(self, cycle: int) -> None:
        """Decide although a fault in cycle `cycle` ends the cycles beside the decision, and go back to that cycle."""
        control = self._control
        arrays, missing = control.commanded_arrays(), self._last + 1 - cycle
        before = [array.copy() for array in arrays]
        with control.measured.as_of(control.measured.snapshot()):
            control.advance(missing)
            control.modes.cycle = self._last
            self._decide()
        for array, copy in zip(arrays, before, strict=True):
            array[:] = copy
        control.return_to(cycle - 1)

    def _popped(self, cycle: int) -> list[ControlInput]:
        """Remove and return the inputs that a decision before cycle `cycle` took into account."""
        return [self._pending.popleft() for _ in self._inputs(cycle)]

    def _inputs(self, cycle: int) -> list[ControlInput]:
        """Return the next inputs, as far as a decision before cycle `cycle` took them into account."""

        def belongs(entry: ControlInput) -> bool:
            later = entry.urgent or entry.waiting or isinstance(entry.given, DrivesFault | DecidedAhead)
            return entry.cycle == cycle and not later

        return list(itertools.takewhile(belongs, self._pending))


def _due_inputs(pending: deque[ControlInput], cycle: int) -> Iterator[ControlInput]:
    while pending and pending[0].cycle <= cycle:
        yield pending.popleft()


def _replayable_part(recording: Recording) -> tuple[NDArray[np.void], list[ControlInput]]:
    """Return the records before the first gap in the records or in the inputs, and the inputs that concern them."""
    records, inputs = recording.records, recording.requests
    steps = np.diff(records["cycle"]) != 1
    length = int(np.argmax(steps)) + 1 if steps.any() else len(records)
    first = int(records["cycle"][0])
    known = [entry for index, entry in enumerate(inputs) if entry.seq - inputs[0].seq == index]
    if len(known) < len(inputs):
        length = min(length, _first_uncertain(known) - first)
    if length < 1:
        raise ServiceError(
            f"the recording lacks input {known[-1].seq + 1} of the control, which may belong to its first cycle, "
            f"{first}, so that no cycle can be replayed. Record the session again"
        )
    concern = [index for index, entry in enumerate(known) if entry.cycle < first + length]
    return records[:length], [entry for entry in known[: max(concern, default=-1) + 1] if entry.cycle >= first]


def _first_uncertain(known: Sequence[ControlInput]) -> int:
    """Return the first cycle to which an input may belong that is missing after the known ones.

    This is the cycle of the last known input or, if that input belongs to a decision beside several cycles, the first
    of these cycles: a missing input may have ended them (DecidedAhead).
    """
    last = known[-1].cycle
    ahead = next((entry for entry in reversed(known) if isinstance(entry.given, DecidedAhead)), None)
    if ahead is not None and isinstance(ahead.given, DecidedAhead) and ahead.cycle + ahead.given.cycles >= last:
        return min(last, ahead.cycle)
    return last


def _check_recording(recording: Recording, records: NDArray[np.void], config: Config) -> None:
    begins, cycle = MODES[int(records["mode"][0])], int(records["cycle"][0])
    first = recording.requests[0].seq if recording.requests else 1
    if begins is not Mode.DISABLED or first != 1:
        what = f"in mode {begins}" if begins is not Mode.DISABLED else f"with input {first} of the control"
        raise ServiceError(
            f"the recording begins at cycle {cycle} {what}; a replay needs a recording that begins in mode disabled, "
            "with the first input of the control. Give all files of a rotated recording (-part2 and so on). A black "
            "box, or the file of a recorder that was restarted, cannot be replayed: read it with trirail report and "
            "trirail export"
        )
    rate = round(1.0 / float(np.median(np.diff(recording.t[:1000])))) if len(recording.t) > 1 else 0
    if rate and rate != config.loop.rate_hz:
        raise ServiceError(
            f"loop.rate_hz: {config.loop.rate_hz} Hz, but the recording has {rate} cycles per second; set loop.rate_hz "
            f"to {rate}"
        )


def _has_same_plans(recording: Recording, config: Config) -> bool:
    """Return True if all values that affect plans are the same in `config` and in the recorded configuration.

    If the recording has no configuration, the values are assumed to be the same.
    """
    recorded = provenance.configuration(recording.texts)
    return recorded is None or revision(recorded) == revision(config)


class _RecordedPlanner:
    """Planner that plans each request again, only to compare the plans with the recorded answers.

    The control uses the recorded answers.
    """

    def __init__(self, config: Config) -> None:
        self.answers = 0
        self.differing = self.rounded = 0
        self._planner = MotionPlanner(config)
        self._planned: dict[int, PlanAnswer] = {}

    def request_plan(self, request: PlanRequest) -> None:
        """See trirail.control.plan_requests.PlannerPort."""
        self._planned[request.number] = self._planner.plan(request)

    def compare(self, entries: Sequence[ControlInput]) -> None:
        """Count the recorded answers among the inputs of a cycle, and those that differ from the new plans."""
        for entry in entries:
            if isinstance(entry.given, PlanAnswer):
                planned = self._planned.get(entry.given.number)
                self.answers += 1
                if planned != entry.given:
                    same = is_same_plan(planned, entry.given)
                    self.rounded, self.differing = self.rounded + same, self.differing + (not same)


class _RecordedDrives:
    """Implementation of DriveGroup that returns the recorded feedback, and ignores setpoints and commands."""

    bus_load = next_sync = 0.0
    missing_protections: tuple[MissingProtection, ...] = ()
    traffic = 0
    path_outputs = (True, True, True)

    def __init__(self, records: NDArray[np.void]) -> None:
        positions: list[Any] = records["position"].tolist()
        flags: list[Any] = [map(tuple, records[name].astype(kind).tolist()) for name, kind in _FLAG_FIELDS]
        homing = records["homing"].astype(bool).tolist()
        inputs: list[Any] = list(map(tuple, records["inputs"].tolist()))
        states: list[Any] = [tuple(map(PowerState, state)) for state in records["drive_state"].tolist()]
        self._feedback = [
            Feedback(tuple(position), state, None, age=age, follows=follows, homed=homed, homing=now, inputs=words)
            for position, state, age, follows, homed, now, words in zip(
                positions, states, *flags, homing, inputs, strict=True
            )
        ]
        self._row = -1
        self._fault: DriveFault | None = None
        self._unready: UnreadyDrives = (None, None, None)

    def set_fault(self, fault: DrivesFault) -> None:
        """Set the fault and the drives that are not ready, which `read` reports from now on."""
        self._fault = DriveFault("", "recorded", 0, fault.message) if fault.message is not None else None
        a, b, c = (Unready(f"drive {name} was not ready") if name in fault.unready else None for name in NAMES)
        self._unready = a, b, c

    def sync(self) -> None:
        """Advance by one cycle."""
        self._row += 1

    def read(self) -> Feedback:
        """Return the recorded feedback of the current cycle; before the first cycle, return that of the first cycle."""
        return self._feedback[max(0, self._row - 1)]._replace(fault=self._fault, unready=self._unready)

    def observe(self) -> Feedback:
        """See trirail_drivers.interface.DriveGroup."""
        return self.read()

    @property
    def counts(self) -> tuple[Counts, Counts, Counts]:
        """Zeros: a recording contains no counts."""
        return Counts(), Counts(), Counts()

    @property
    def reported_faults(self) -> tuple[DriveFault | None, ...]:
        """None for each drive, because `read` reports the faults."""
        return None, None, None

    def configure(
        self, period: float, fastest: float | None = None, *, travel: Travel | None = None, awaits: bool = False
    ) -> None:
        """See trirail_drivers.interface.DriveGroup."""

    def write(self, position: Triple, velocity: Triple) -> None:
        """See trirail_drivers.interface.DriveGroup."""

    def enable(self, alone: str | None = None) -> None:
        """See trirail_drivers.interface.DriveGroup."""

    def home(self) -> None:
        """See trirail_drivers.interface.DriveGroup."""

    def set_outputs(self, words: Sequence[int]) -> None:
        """See trirail_drivers.interface.DriveGroup."""

    def stop_homing(self) -> None:
        """See trirail_drivers.interface.DriveGroup."""

    def disable(self) -> None:
        """See trirail_drivers.interface.DriveGroup."""

    def quick_stop(self) -> None:
        """See trirail_drivers.interface.DriveGroup."""

    def reset(self) -> None:
        """See trirail_drivers.interface.DriveGroup."""

    def close(self) -> None:
        """See trirail_drivers.interface.DriveGroup."""


class _SimulatedClock:
    """Clock of the simulated drives, which advances by one period per cycle, and in real time after the replay."""

    def __init__(self, period: float) -> None:
        self._now = 0.0
        self._period = period
        self._released_at: float | None = None

    def __call__(self) -> float:
        return self._now if self._released_at is None else self._now + time.monotonic() - self._released_at

    def step(self) -> None:
        """Advance by one period."""
        self._now += self._period

    def run(self) -> None:
        """Advance in real time from now on, because closing the drives waits until they are at rest."""
        self._released_at = time.monotonic()


def _simulated_drives(records: NDArray[np.void], config: Config, clock: _SimulatedClock) -> DriveGroup:
    """Return simulated drives that start at the recorded positions."""
    start: Any = tuple(records["position"][0].tolist())
    behaviour = msgspec.structs.replace(config.can.simulated, start=start)
    can = msgspec.structs.replace(config.can, interface="simulated", simulated=behaviour)  # never real drives
    drives = connect(can, config.drives, clock, io=config.drive_io)
    drives.configure(config.period, config.limits.slider.fastest)
    return drives
