"""A recorded session again, in process and without waiting: the same control, given the same, cycle by cycle.

What the control decides depends on its configuration, on what the drives say at each SYNC, and on what it is given:
goals, commands, mishaps, and what the planner has answered. All of that is in a recording, with the cycle that it
belongs to, so the setpoints must come out the same to the last bit. What the planner is asked comes of that as well: it
is planned once more, and compared with what was answered. With another configuration the recorded answers of drives
and planner mean nothing any more: then simulated drives take their place, on a clock that goes on by one period a
cycle, and a planner that answers in the next one.
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
from trirail_drivers.interface import DriveFault, DriveGroup, Feedback, MissingProtection, PowerState, Triple

from trirail.config import Config
from trirail.control.control import Control, Given
from trirail.control.local_planner import LocalPlanner
from trirail.errors import ServiceError
from trirail.motion.motion_planner import MotionPlanner, revision
from trirail.telemetry import provenance
from trirail.telemetry.reading import Recording
from trirail.wire.packets import ControlInput, DrivesFault, PlannerLost
from trirail.wire.plan_packets import PlanAnswer, PlanRequest
from trirail.wire.vocabulary import MODES, Mode

SETPOINTS = ("commanded_position", "commanded_velocity")
"""The fields of a record that were sent to the drives."""
_FLAGS = (("age", int), ("follows", bool), ("homed", bool))


class Comparison(NamedTuple):
    """How a session's setpoints came out again."""

    cycles: int
    """So many were compared."""
    lacking: int
    """So many at the end were not, since what came before them is not in the recording."""
    requests: int
    """Goals, commands and mishaps that were given."""
    plans: int
    """Answers of the planner that were given; none where it was asked anew instead."""
    plans_differing: int
    """So many of them are not the same to the last bit when the same is planned again."""
    differing: int
    """Cycles whose setpoints or mode are not the same to the last bit."""
    first: int | None
    """The first of them."""
    position: Triple
    """Greatest difference of a setpoint, of each slider [m]."""
    velocity: Triple
    """Greatest difference of the velocity feed-forward, of each slider [m/s]."""


def again(recording: Recording, config: Config, *, simulated: bool) -> Comparison:
    """Run a session once more and compare.

    The drives are those of the recording or, if `simulated`, those of the configuration's simulation. Raises
    ServiceError where the recording does not begin with a robot without power: what it did before is not known.
    """
    records, given = _whole(recording)
    _check(recording, records, config)
    clock = _Clock(config.period)
    drives = _simulated(records, config, clock) if simulated else _Recorded(records)
    requests = [what for what in given if not isinstance(what.given, PlanAnswer | PlannerLost)]
    planner: _RecordedPlanner | LocalPlanner
    if len(requests) < len(given) and _plans_alike(recording, config):
        planner = _RecordedPlanner(config)
    else:
        planner, given = LocalPlanner(config), requests
    try:
        made, modes = _run(Control(config, drives, planner), drives, planner, clock, records, given)
    finally:
        clock.run()
        drives.close()
    sent = np.stack([records[name] for name in SETPOINTS], axis=1)
    differs = (made.view(np.int64) != sent.view(np.int64)).any(axis=(1, 2)) | (modes != records["mode"])
    greatest = np.abs(made - sent).max(axis=0).tolist()
    return Comparison(
        cycles=len(records),
        lacking=len(recording.records) - len(records),
        requests=len(requests),
        plans=planner.given if isinstance(planner, _RecordedPlanner) else 0,
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
    clock: _Clock,
    records: NDArray[np.void],
    given: Sequence[ControlInput],
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Return what is sent to the drives in each cycle, (N, 2, 3), and the modes, (N,)."""
    clock.step()
    drives.sync()
    control.start(drives.read())
    control.modes.cycle = int(records["cycle"][0])
    waiting = deque(given)
    made = np.zeros((len(records), 2, 3))
    modes = np.zeros(len(records), np.uint8)
    for row in range(len(records)):
        clock.step()
        drives.sync()
        _cycle(control, drives, planner, list(_due(waiting, control.cycles + 1)))
        made[row] = control.setpoints.rows[:2]
        modes[row] = MODES.index(control.state.mode)
        control.conclude()
    return made, modes


def _cycle(
    control: Control, drives: DriveGroup, planner: _RecordedPlanner | LocalPlanner, given: Sequence[ControlInput]
) -> None:
    """Do what the loop does in a cycle after its SYNC."""
    said = [what for what in given if not isinstance(what.given, DrivesFault)]
    decided = [what for what in said if not what.urgent]
    if isinstance(drives, _Recorded):
        for what in given:
            if isinstance(what.given, DrivesFault):
                drives.fail(what.given.message)
    for waiting in (False, True):
        heard = [what for what in decided if what.waiting is waiting]
        inputs: list[Given] = [(what.given, what.now_ns) for what in heard]  # type: ignore[misc]
        if isinstance(planner, LocalPlanner):
            inputs += [(answer, 0) for answer in planner.answers()]
        else:
            planner.compare(heard)
        if inputs or not waiting:
            control.decide(inputs)
    for what in said:
        if what.urgent:
            control.handle(what.given, what.now_ns)  # type: ignore[arg-type]
    control.execute(drives.read())
    control.ledger.answers.clear()
    control.ledger.notices.clear()


def _due(waiting: deque[ControlInput], cycle: int) -> Iterator[ControlInput]:
    while waiting and waiting[0].cycle <= cycle:
        yield waiting.popleft()


def _whole(recording: Recording) -> tuple[NDArray[np.void], list[ControlInput]]:
    """Return the records up to the first gap, in them or in what the control was given, and what it was given."""
    records, given = recording.records, recording.requests
    steps = np.diff(records["cycle"]) != 1
    length = int(np.argmax(steps)) + 1 if steps.any() else len(records)
    first, last = int(records["cycle"][0]), int(records["cycle"][length - 1])
    known = [what for place, what in enumerate(given) if what.seq - given[0].seq == place]
    if len(known) < len(given):  # something was given after the last one that is known, nobody knows when
        last = max(first, min(last, known[-1].cycle))
    return records[: last - first + 1], [what for what in known if first <= what.cycle <= last]


def _check(recording: Recording, records: NDArray[np.void], config: Config) -> None:
    begins, cycle = MODES[int(records["mode"][0])], int(records["cycle"][0])
    if begins is not Mode.DISABLED:
        raise ServiceError(
            f"the recording begins at cycle {cycle} in mode {begins}, and what led there is not in it: a replay needs "
            "one that begins disabled. Of a rotated one (-part2 and on) give all files; a black box, and what a "
            "recorder wrote that was started again meanwhile, have none before: trirail report and export read it"
        )
    rate = round(1.0 / float(np.median(np.diff(recording.t[:1000])))) if len(recording.t) > 1 else 0
    if rate and rate != config.loop.rate_hz:
        raise ServiceError(f"loop.rate_hz = {config.loop.rate_hz}: the recording has {rate} cycles a second")


def _plans_alike(recording: Recording, config: Config) -> bool:
    """Whether what was planned in a recording can be used with a configuration: nothing that plans depend on differs.

    Where the recording has no configuration, the one that is given is taken for its own.
    """
    recorded = provenance.configuration(recording.texts)
    return recorded is None or revision(recorded) == revision(config)


class _RecordedPlanner:
    """Plans what is asked again, and compares it with what was answered: its answers are those of the recording."""

    def __init__(self, config: Config) -> None:
        self.given = 0
        self.differing = 0
        self._planner = MotionPlanner(config)
        self._planned: dict[int, PlanAnswer] = {}

    def request_plan(self, request: PlanRequest) -> None:
        """See trirail.control.plan_requests.PlannerPort."""
        self._planned[request.number] = self._planner.plan(request)

    def compare(self, given: Sequence[ControlInput]) -> None:
        """Count the answers among what is given in a cycle, and those that would be others now."""
        for what in given:
            if isinstance(what.given, PlanAnswer):
                self.given += 1
                self.differing += self._planned.get(what.given.number) != what.given


class _Recorded:
    """Drives that say what they said in the recording, and take anything: trirail_drivers.interface.DriveGroup."""

    bus_load = 0.0
    missing_protections: tuple[MissingProtection, ...] = ()
    traffic = 0

    def __init__(self, records: NDArray[np.void]) -> None:
        positions: list[Any] = records["position"].tolist()
        flags: list[Any] = [map(tuple, records[name].astype(kind).tolist()) for name, kind in _FLAGS]
        homing = records["homing"].astype(bool).tolist()
        states: list[Any] = [tuple(map(PowerState, state)) for state in records["drive_state"].tolist()]
        self._said = [
            Feedback(tuple(position), state, None, age=age, follows=follows, homed=homed, homing=now)
            for position, state, age, follows, homed, now in zip(positions, states, *flags, homing, strict=True)
        ]
        self._row = -1
        self._fault: DriveFault | None = None

    def fail(self, message: str | None) -> None:
        """Say from now on that something is wrong; with None, that nothing is."""
        self._fault = DriveFault("", "recorded", 0, message) if message is not None else None

    def sync(self) -> None:
        """Go on by a cycle."""
        self._row += 1

    def read(self) -> Feedback:
        """Return what was said in this one; before the first cycle, what is said in it."""
        return self._said[max(0, self._row - 1)]._replace(fault=self._fault)

    @property
    def reported_faults(self) -> tuple[DriveFault | None, ...]:
        """Return that no drive has told of a fault: what was wrong is told by `read`."""
        return None, None, None

    def configure(self, period: float, fastest: float | None = None) -> None:
        """See trirail_drivers.interface.DriveGroup."""

    def write(self, position: Triple, velocity: Triple) -> None:
        """See trirail_drivers.interface.DriveGroup."""

    def enable(self, alone: str | None = None) -> None:
        """See trirail_drivers.interface.DriveGroup."""

    def home(self) -> None:
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


class _Clock:
    """The simulated drives' time, which a cycle moves on by one period; it runs by itself once that is over."""

    def __init__(self, period: float) -> None:
        self._now = 0.0
        self._period = period
        self._over: float | None = None

    def __call__(self) -> float:
        return self._now if self._over is None else self._now + time.monotonic() - self._over

    def step(self) -> None:
        """Go on by a period."""
        self._now += self._period

    def run(self) -> None:
        """Run from now on: drives that are let go of have to come to stand."""
        self._over = time.monotonic()


def _simulated(records: NDArray[np.void], config: Config, clock: _Clock) -> DriveGroup:
    """Return simulated drives that stand where the recorded ones stood."""
    start: Any = tuple(records["position"][0].tolist())
    behaviour = msgspec.structs.replace(config.can.simulated, start=start)
    can = msgspec.structs.replace(config.can, interface="simulated", simulated=behaviour)  # never real drives
    drives = connect(can, config.drives, clock)
    drives.configure(config.period, config.limits.slider.fastest)
    return drives
