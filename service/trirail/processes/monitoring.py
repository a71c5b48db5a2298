"""Measurements of gateway and recorder, and the health of all processes, kept by the supervisor for monitoring.

Measurements are totals since the loop began, sent once a second. The supervisor checks all processes periodically.
Separate threads answer monitoring requests, so that they can report a blocked supervisor as well.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from trirail.processes.heartbeats import PROCESSES, Heartbeats, Watch
from trirail.processes.zenoh_links import ResourceUse
from trirail.wire.decoding import converted, prepare
from trirail.wire.messages import Event, FaultDetail
from trirail.wire.state import FrameCounts, State

MEASUREMENT_PERIOD_S: Final = 1.0
"""Interval between two measurements [s]."""
CYCLE_BOUNDS: Final = (1e-6, 2e-6, 5e-6, 1e-5, 2e-5, 5e-5, 1e-4, 2e-4, 5e-4, 1e-3, 2e-3, 5e-3, 1e-2)
"""Bounds of the histograms of lateness and cycle [s]."""
SETTLE_BOUNDS: Final = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
"""Bounds of the histogram of settle times [s]."""
MAX_FAULT_KINDS: Final = 20
"""Maximum number of faults distinguished by cause, drive and code; all others count as OTHER."""
OTHER: Final = FaultDetail("other")


class Histogram(Struct):
    """Histogram of values."""

    bounds: tuple[float, ...]
    """Upper bounds, rising."""
    counts: list[int]
    """Number of values up to each bound and above the previous one; the last count is for values above all bounds."""
    total: float = 0.0
    """Sum of all values."""

    @classmethod
    def empty(cls, bounds: tuple[float, ...]) -> Histogram:
        """Return a histogram without values."""
        return cls(bounds, [0] * (len(bounds) + 1))

    def add(self, values: NDArray[np.float64]) -> None:
        """Add values, (n,)."""
        places = np.searchsorted(self.bounds, values)  # the first bound that is not below the value
        more = np.bincount(places, minlength=len(self.counts)).tolist()
        self.counts = [count + n for count, n in zip(self.counts, more, strict=True)]
        self.total += float(values.sum())


class FaultCount(Struct, frozen=True):
    """Number of faults of one kind."""

    fault: FaultDetail
    times: int


class ServiceMeasurements(Struct, frozen=True):
    """Measurements of the gateway."""

    mode: str
    """A trirail.wire.vocabulary.Mode."""
    cycles: int
    """This field and those up to `bus_load_measured` are as in trirail.wire.state.LoopState."""
    overruns: int
    bus_load: float
    bus_load_measured: float
    traffic: tuple[FrameCounts, FrameCounts, FrameCounts]
    """Frames of each drive that were late or lost."""
    lateness: Histogram
    """Delay of each cycle after its deadline [s]."""
    cycle: Histogram
    """Duration of each cycle's work [s]."""
    settle: Histogram
    """Time until each goal that is done was in position [s]."""
    goals: dict[str, int]
    """Number of ended goals, by outcome."""
    faults: tuple[FaultCount, ...]
    use: ResourceUse
    """Use of limited resources."""
    warnings: tuple[str, ...]
    """Warnings about resources that are nearly used up."""
    outputs: dict[str, bool] = {}
    """Value of each output of the configuration."""
    inputs: dict[str, bool] = {}
    """Value of each input of the configuration."""


class RecorderMeasurements(Struct, frozen=True):
    """Measurements of the recorder: data missing since its start."""

    lost: int
    """Batches not written to the disk."""
    skipped: int
    """Batches dropped because the live view was too slow."""
    absent: int
    """Cycles dropped because the recorder was too slow."""


class Meter:
    """Counter of the gateway's measurements; after a restart, cycles count from 0 and past events arrive again."""

    def __init__(self, send: Callable[[Struct], None], clock: Callable[[], float] = time.monotonic) -> None:
        self._send = send
        self._clock = clock
        self._due = clock()
        self._lateness, self._cycle = Histogram.empty(CYCLE_BOUNDS), Histogram.empty(CYCLE_BOUNDS)
        self._settle = Histogram.empty(SETTLE_BOUNDS)
        self._goals: dict[str, int] = {}
        self._faults: dict[FaultDetail, int] = {}

    def records(self, rows: NDArray[np.void]) -> None:
        """Count a batch of records."""
        self._lateness.add(rows["lateness_ns"] * 1e-9)
        self._cycle.add(rows["parts_ns"].sum(axis=1) * 1e-9)

    def event(self, event: Event) -> None:
        """Count an event."""
        if event.outcome is not None:
            self._goals[event.outcome] = self._goals.get(event.outcome, 0) + 1
            if event.settle is not None:
                self._settle.add(np.array([event.settle]))
        if event.kind == "fault":
            fault = event.fault or OTHER
            if fault not in self._faults and len(self._faults) >= MAX_FAULT_KINDS:
                fault = OTHER
            self._faults[fault] = self._faults.get(fault, 0) + 1

    def publish(self, newest: Callable[[], State], use: ResourceUse, warnings: tuple[str, ...]) -> None:
        """Send all measurements if they are due."""
        now = self._clock()
        if now < self._due:
            return
        self._due = now + MEASUREMENT_PERIOD_S
        state = newest()
        loop = state.loop
        self._send(
            ServiceMeasurements(
                mode=state.mode,
                cycles=loop.cycles,
                overruns=loop.overruns,
                bus_load=loop.bus_load,
                bus_load_measured=loop.bus_load_measured,
                traffic=state.sliders.traffic,
                lateness=self._lateness,
                cycle=self._cycle,
                settle=self._settle,
                goals=self._goals,
                faults=tuple(FaultCount(fault, times) for fault, times in self._faults.items()),
                use=use,
                warnings=warnings,
                outputs=state.outputs,
                inputs=state.inputs,
            )
        )


MEASURED_BY: Final = {"gateway": ServiceMeasurements, "recorder": RecorderMeasurements}
"""Type of each process's measurements."""
prepare(*MEASURED_BY.values())

MAX_SILENCE_S: Final = 3.0
"""Silence after which a process is reported as frozen [s]; the supervisor has killed most hung processes before."""
MIN_SILENT_CYCLES: Final = 3
"""Shortest time-out of the loop's heartbeat, in cycles."""


class Running(NamedTuple):
    """State of a process, as seen by the supervisor."""

    pid: int | None
    """Process id; None if it is not running."""
    ready: bool
    """Whether the process has sent its ready message."""
    restarts: int
    """Number of restarts."""


NOT_RUNNING: Final = Running(None, ready=False, restarts=0)


class Health:
    """Result of the newest check of every process, and the newest measurements; any thread may read them."""

    def __init__(
        self, heartbeats: Heartbeats, period: float, turn: float, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._clock = clock
        self._checked_at = clock()
        self._ending = False
        silent = dict.fromkeys(PROCESSES, MAX_SILENCE_S) | {"loop": max(MAX_SILENCE_S, MIN_SILENT_CYCLES * period)}
        self._watches = {name: Watch(heartbeats.heart(name), round(silent[name] / turn)) for name in PROCESSES}
        self.processes: Mapping[str, Running] = dict.fromkeys(PROCESSES, NOT_RUNNING)
        """State of each process at the newest check."""
        self._troubles: Mapping[str, str] = dict.fromkeys(PROCESSES, "starting")
        self._stored_at: dict[str, float] = {}
        self.service: ServiceMeasurements | None = None
        self.recorder: RecorderMeasurements | None = None

    def poll(self, processes: Mapping[str, Running]) -> None:
        """Check all processes; to be called in every turn of the supervisor."""
        self._troubles = {name: self._trouble(name, running) for name, running in processes.items()}
        self.processes = processes
        self._checked_at = self._clock()

    def end(self, processes: Mapping[str, Running]) -> None:
        """Check for the last time, and report the service as ending from now on."""
        self.poll(processes)
        self._ending = True

    def store(self, process: str, content: Mapping[str, Any]) -> None:
        """Store a process's measurements."""
        measured = converted(content, MEASURED_BY[process])
        if isinstance(measured, ServiceMeasurements):
            self.service = measured
        else:
            self.recorder = measured
        self._stored_at[process] = self._clock()

    def ages(self) -> dict[str, float]:
        """Return the age of the measurements, by process [s]."""
        return {name: self._clock() - stored_at for name, stored_at in self._stored_at.copy().items()}

    def troubles(self) -> dict[str, str]:
        """Return the problem of each process, including the supervisor; "" for none."""
        held_up = self._clock() - self._checked_at > MAX_SILENCE_S
        supervisor = "the service is ending" if self._ending else "no sign of life" if held_up else ""
        return {**self._troubles, "supervisor": supervisor}

    def _trouble(self, name: str, running: Running) -> str:
        silent = name in self._watches and self._watches[name].silent()
        if running.pid is None:
            return "not running"
        if not running.ready:
            return "starting"
        return "no sign of life" if silent else ""
