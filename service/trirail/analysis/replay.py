"""Replay of a recorded session in process, without waiting: the same control with the same inputs, cycle by cycle.

The decisions of the control depend on its configuration, on the feedback of the drives at each SYNC, and on its inputs,
which are goals, commands, disturbances and the planner's answers. A recording contains all of these, each with its
cycle, so the setpoints must be the same to the last bit. The requests to the planner follow from them as well: the
replay plans them again, and compares the result with the recorded answer.

With another configuration, the recorded answers from drives and planner are no longer valid. They are replaced by
simulated drives, whose clock advances by one period per cycle, and by a planner that answers in the next cycle.
"""

from __future__ import annotations

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
    DriveFault,
    DriveGroup,
    Feedback,
    MissingProtection,
    PowerState,
    Triple,
    Unready,
    UnreadyDrives,
)

from trirail.config import Config
from trirail.control.control import Control, TimedInput
from trirail.control.local_planner import LocalPlanner
from trirail.errors import ServiceError
from trirail.motion.motion_planner import MotionPlanner, revision
from trirail.telemetry import provenance
from trirail.telemetry.recording import Recording
from trirail.wire.packets import ControlInput, DrivesFault, PlannerLost
from trirail.wire.plan_packets import PlanAnswer, PlanRequest
from trirail.wire.vocabulary import MODES, Mode

SETPOINT_FIELDS = ("commanded_position", "commanded_velocity")
"""Fields of a record that contain the setpoints for the drives."""
_FLAG_FIELDS = (("age", int), ("follows", bool), ("homed", bool))


class Comparison(NamedTuple):
    """Comparison of the setpoints of a session with those of its replay."""

    cycles: int
    """Number of compared cycles."""
    lacking: int
    """Number of cycles at the end that were not compared, because the recording has a gap before them."""
    requests: int
    """Number of goals, commands and disturbances."""
    plans: int
    """Number of recorded answers from the planner; 0 if the replay makes all plans."""
    plans_differing: int
    """Number of recorded answers that differ in any bit from those of the replay."""
    differing: int
    """Number of cycles whose setpoints, mode or outputs differ in any bit."""
    first: int | None
    """Number of the first of these cycles."""
    position: Triple
    """Largest difference of a setpoint for each slider [m]."""
    velocity: Triple
    """Largest difference of the velocity feed-forward for each slider [m/s]."""


def replay_session(recording: Recording, config: Config, *, simulated: bool) -> Comparison:
    """Run a session again and compare the setpoints.

    Parameters
    ----------
    recording
        Session to replay.
    config
        Configuration of the control.
    simulated
        Whether to use simulated drives with this configuration instead of the recorded ones.

    Raises
    ------
    ServiceError
        The recording does not begin with a disabled robot, so its earlier state is unknown, or its rate differs from
        the configured rate.
    """
    records, inputs = _replayable_part(recording)
    _check_recording(recording, records, config)
    clock = _SimulatedClock(config.period)
    drives = _simulated_drives(records, config, clock) if simulated else _RecordedDrives(records)
    requests = [entry for entry in inputs if not isinstance(entry.given, PlanAnswer | PlannerLost)]
    planner: _RecordedPlanner | LocalPlanner
    if len(requests) < len(inputs) and _has_same_plans(recording, config):
        planner = _RecordedPlanner(config)
    else:
        planner, inputs = LocalPlanner(config), requests
    try:
        setpoints, modes, outputs = _run(Control(config, drives, planner), drives, planner, clock, records, inputs)
    finally:
        clock.run()
        drives.close()
    recorded = np.stack([records[name] for name in SETPOINT_FIELDS], axis=1)
    # Compared as integers, so that all bits must match, including the sign of a zero.
    differs = (setpoints.view(np.int64) != recorded.view(np.int64)).any(axis=(1, 2)) | (modes != records["mode"])
    differs |= (outputs != records["outputs"]).any(axis=1)
    greatest = np.abs(setpoints - recorded).max(axis=0).tolist()
    return Comparison(
        cycles=len(records),
        lacking=len(recording.records) - len(records),
        requests=len(requests),
        plans=planner.answers if isinstance(planner, _RecordedPlanner) else 0,
        plans_differing=planner.differing if isinstance(planner, _RecordedPlanner) else 0,
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
    """Return the commands of each cycle.

    These are the setpoints, position [m] and velocity [m/s], (N, 2, 3), the modes, (N,), and the output words of the
    drives, (N, 3).
    """
    clock.step()
    drives.sync()
    control.start(drives.read())
    control.modes.cycle = int(records["cycle"][0])
    pending = deque(inputs)
    setpoints = np.zeros((len(records), 2, 3))
    modes = np.zeros(len(records), np.uint8)
    outputs = np.zeros((len(records), 3), np.int64)
    for row in range(len(records)):
        clock.step()
        drives.sync()
        _run_cycle(control, drives, planner, list(_due_inputs(pending, control.cycles + 1)))
        setpoints[row] = control.setpoints.rows[:2]
        modes[row] = MODES.index(control.state.mode)
        outputs[row] = control.outputs.words
        control.conclude()
    return setpoints, modes, outputs


def _run_cycle(
    control: Control, drives: DriveGroup, planner: _RecordedPlanner | LocalPlanner, entries: Sequence[ControlInput]
) -> None:
    """Run the steps of a cycle of the loop that follow its SYNC."""
    inputs = [entry for entry in entries if not isinstance(entry.given, DrivesFault)]
    decided = [entry for entry in inputs if not entry.urgent]
    if isinstance(drives, _RecordedDrives):
        for entry in entries:
            if isinstance(entry.given, DrivesFault):
                drives.set_fault(entry.given)
    # Inputs that arrived while the loop waited for its tick were handled separately, after the others.
    for waiting in (False, True):
        received = [entry for entry in decided if entry.waiting is waiting]
        batch: list[TimedInput] = [(entry.given, entry.now_ns) for entry in received]  # type: ignore[misc]
        if isinstance(planner, LocalPlanner):
            batch += [(answer, 0) for answer in planner.answers()]
        else:
            planner.compare(received)
        if batch or not waiting:
            control.decide(batch)
    for entry in inputs:
        if entry.urgent:
            control.handle(entry.given, entry.now_ns)  # type: ignore[arg-type]
    control.execute(drives.read())
    control.ledger.answers.clear()
    control.ledger.notices.clear()


def _due_inputs(pending: deque[ControlInput], cycle: int) -> Iterator[ControlInput]:
    while pending and pending[0].cycle <= cycle:
        yield pending.popleft()


def _replayable_part(recording: Recording) -> tuple[NDArray[np.void], list[ControlInput]]:
    """Return the records up to the first gap in the records or the inputs, and the inputs of these cycles."""
    records, inputs = recording.records, recording.requests
    steps = np.diff(records["cycle"]) != 1
    length = int(np.argmax(steps)) + 1 if steps.any() else len(records)
    first, last = int(records["cycle"][0]), int(records["cycle"][length - 1])
    known = [entry for index, entry in enumerate(inputs) if entry.seq - inputs[0].seq == index]
    if len(known) < len(inputs):
        # The missing input may belong to any cycle after that of the last known input.
        last = max(first, min(last, known[-1].cycle))
    return records[: last - first + 1], [entry for entry in known if first <= entry.cycle <= last]


def _check_recording(recording: Recording, records: NDArray[np.void], config: Config) -> None:
    begins, cycle = MODES[int(records["mode"][0])], int(records["cycle"][0])
    if begins is not Mode.DISABLED:
        raise ServiceError(
            f"the recording begins at cycle {cycle} in mode {begins}; a replay needs a recording that begins in mode "
            "disabled. Give all files of a rotated recording (-part2 and so on). A black box, or the file of a "
            "recorder "
            "that was restarted, cannot be replayed: read it with trirail report and trirail export"
        )
    rate = round(1.0 / float(np.median(np.diff(recording.t[:1000])))) if len(recording.t) > 1 else 0
    if rate and rate != config.loop.rate_hz:
        raise ServiceError(
            f"loop.rate_hz: {config.loop.rate_hz} Hz, but the recording has {rate} cycles per second; set loop.rate_hz "
            f"to {rate}"
        )


def _has_same_plans(recording: Recording, config: Config) -> bool:
    """Return whether a configuration has the same values as the recorded one in everything on which plans depend.

    A recording without a configuration is assumed to have the same values.
    """
    recorded = provenance.configuration(recording.texts)
    return recorded is None or revision(recorded) == revision(config)


class _RecordedPlanner:
    """Planner whose answers come from the recording. It plans each request again and compares the results with them."""

    def __init__(self, config: Config) -> None:
        self.answers = 0
        self.differing = 0
        self._planner = MotionPlanner(config)
        self._planned: dict[int, PlanAnswer] = {}

    def request_plan(self, request: PlanRequest) -> None:
        """See trirail.control.plan_requests.PlannerPort."""
        self._planned[request.number] = self._planner.plan(request)

    def compare(self, entries: Sequence[ControlInput]) -> None:
        """Count the answers among the inputs of a cycle, and the answers that differ from the replanned ones."""
        for entry in entries:
            if isinstance(entry.given, PlanAnswer):
                self.answers += 1
                self.differing += self._planned.get(entry.given.number) != entry.given


class _RecordedDrives:
    """DriveGroup that returns the recorded feedback, and ignores setpoints and commands."""

    bus_load = 0.0
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
        """From now on, report a fault and the drives that are not ready."""
        self._fault = DriveFault("", "recorded", 0, fault.message) if fault.message is not None else None
        a, b, c = (Unready(f"drive {name} was not ready") if name in fault.unready else None for name in NAMES)
        self._unready = a, b, c

    def sync(self) -> None:
        """Advance by one cycle."""
        self._row += 1

    def read(self) -> Feedback:
        """Return the feedback of the present cycle or, before the first cycle, of the first cycle."""
        return self._feedback[max(0, self._row - 1)]._replace(fault=self._fault, unready=self._unready)

    @property
    def reported_faults(self) -> tuple[DriveFault | None, ...]:
        """None for each drive, since `read` reports the faults."""
        return None, None, None

    def configure(self, period: float, fastest: float | None = None, *, awaits: bool = False) -> None:
        """See trirail_drivers.interface.DriveGroup."""

    def write(self, position: Triple, velocity: Triple) -> None:
        """See trirail_drivers.interface.DriveGroup."""

    def enable(self, alone: str | None = None) -> None:
        """See trirail_drivers.interface.DriveGroup."""

    def home(self) -> None:
        """See trirail_drivers.interface.DriveGroup."""

    def set_outputs(self, words: Sequence[int]) -> None:
        """Do nothing."""

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
    """Clock of the simulated drives. It advances by one period per cycle, and runs by itself after the replay."""

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
        """Run by itself from now on, since drives that are closed wait until they are at rest."""
        self._released_at = time.monotonic()


def _simulated_drives(records: NDArray[np.void], config: Config, clock: _SimulatedClock) -> DriveGroup:
    """Return simulated drives that start at the recorded positions."""
    start: Any = tuple(records["position"][0].tolist())
    behaviour = msgspec.structs.replace(config.can.simulated, start=start)
    can = msgspec.structs.replace(config.can, interface="simulated", simulated=behaviour)  # never real drives
    drives = connect(can, config.drives, clock, io=config.drive_io)
    drives.configure(config.period, config.limits.slider.fastest)
    return drives
