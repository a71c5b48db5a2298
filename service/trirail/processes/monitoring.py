"""Measurements of gateway and recorder, and health of all processes, which the supervisor provides for monitoring.

Measurements are totals since the start of the loop, and are sent to the supervisor once per second. The supervisor also
counts goals and faults in the events for its log, and checks all processes periodically. Monitoring requests are
answered in separate threads, which can therefore also report that the supervisor is blocked.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple, get_args

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from trirail.processes.heartbeats import PROCESSES, Heartbeats, Watch
from trirail.processes.zenoh_links import ResourceUse
from trirail.wire.decoding import converted, prepare
from trirail.wire.messages import Event, FaultDetail, Outcome
from trirail.wire.state import FrameCounts, State

MEASUREMENT_PERIOD_S: Final = 1.0
"""Interval at which measurements are sent [s]."""
CYCLE_BOUNDS: Final = (1e-6, 2e-6, 5e-6, 1e-5, 2e-5, 5e-5, 1e-4, 2e-4, 5e-4, 1e-3, 2e-3, 5e-3, 1e-2)
"""Bounds of the histograms of lateness and of cycle time [s]."""
SETTLE_BOUNDS: Final = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
"""Bounds of the histogram of settle times [s]."""
MAX_FAULT_KINDS: Final = 20
"""Maximum number of different faults, by cause, drive and code, that are counted separately.

Further faults are counted as OTHER.
"""
OTHER: Final = FaultDetail("other")


class Histogram(Struct):
    """Numbers of values between given bounds, and the sum of all values."""

    bounds: tuple[float, ...]
    """Upper bounds of the bins, in rising order."""
    counts: list[int]
    """Number of values in each bin, whose upper bound is included. The last bin is for values above all bounds."""
    total: float = 0.0
    """Sum of all values."""

    @classmethod
    def empty(cls, bounds: tuple[float, ...]) -> Histogram:
        """Return a histogram without values."""
        return cls(bounds, [0] * (len(bounds) + 1))

    def add(self, values: NDArray[np.float64]) -> None:
        """Count values, (n,)."""
        places = np.searchsorted(self.bounds, values)  # the first bound that is not below the value
        more = np.bincount(places, minlength=len(self.counts)).tolist()
        self.counts = [count + n for count, n in zip(self.counts, more, strict=True)]
        self.total += float(values.sum())


class EventCounts:
    """Numbers of goals and faults in the events of the service, which the supervisor receives once each."""

    def __init__(self) -> None:
        self.goals: dict[str, int] = dict.fromkeys(get_args(Outcome), 0)
        """Number of goals that have ended, by outcome."""
        self.faults: dict[FaultDetail, int] = {}
        self.settle = Histogram.empty(SETTLE_BOUNDS)
        """Time from the end of the path until the robot was in position, for each goal that is done [s]."""

    def add(self, event: Event) -> None:
        """Count an event."""
        if event.outcome is not None:
            self.goals[event.outcome] = self.goals.get(event.outcome, 0) + 1
            if event.settle is not None:
                self.settle.add(np.array([event.settle]))
        if event.kind == "fault":
            fault = event.fault or OTHER
            if fault not in self.faults and len(self.faults) >= MAX_FAULT_KINDS:
                fault = OTHER
            self.faults[fault] = self.faults.get(fault, 0) + 1


class ServiceMeasurements(Struct, frozen=True):
    """Measurements that the gateway sends."""

    mode: str
    """Mode of the robot, from trirail.wire.vocabulary.Mode."""
    cycles: int
    """This field and the next three are the same as in trirail.wire.state.LoopState."""
    overruns: int
    bus_load: float
    bus_load_measured: float
    traffic: tuple[FrameCounts, FrameCounts, FrameCounts]
    """Numbers of frames of each drive that were late or lost."""
    lateness: Histogram
    """Delay of each cycle after its deadline [s]."""
    cycle: Histogram
    """Duration of each cycle's work [s]."""
    use: ResourceUse
    """Use of resources that are limited, such as file descriptors."""
    warnings: tuple[str, ...]
    """This field and the next one are the same as in trirail.wire.state.State."""
    faults: tuple[str, ...]
    outputs: dict[str, bool] = {}
    """Value of each configured output, by name."""
    inputs: dict[str, bool] = {}
    """Value of each configured input, by name."""


class RecorderMeasurements(Struct, frozen=True):
    """Measurements that the recorder sends, which count the data that has been lost since the recorder's start."""

    lost: int
    """Number of batches that were not written to the disk."""
    skipped: int
    """Number of batches that were dropped because the live view was too slow."""
    absent: int
    """Number of cycles that are missing because the recorder was too slow."""


class Meter:
    """Counter for the gateway's measurements. After a restart of the gateway, the histograms begin at 0."""

    def __init__(self, send: Callable[[Struct], None], clock: Callable[[], float] = time.monotonic) -> None:
        self._send = send
        self._clock = clock
        self._due = clock()
        self._lateness, self._cycle = Histogram.empty(CYCLE_BOUNDS), Histogram.empty(CYCLE_BOUNDS)

    def records(self, rows: NDArray[np.void]) -> None:
        """Add a batch of records to the measurements."""
        self._lateness.add(rows["lateness_ns"] * 1e-9)
        self._cycle.add(rows["parts_ns"].sum(axis=1) * 1e-9)

    def publish(self, newest: Callable[[], State], use: ResourceUse) -> None:
        """Send all measurements if MEASUREMENT_PERIOD_S has passed since they were last sent.

        `newest` returns the newest state, with its warnings.
        """
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
                use=use,
                warnings=state.warnings,
                faults=state.faults,
                outputs=state.outputs,
                inputs=state.inputs,
            )
        )


MEASURED_BY: Final = {"gateway": ServiceMeasurements, "recorder": RecorderMeasurements}
"""Type of the measurements of each process."""
prepare(*MEASURED_BY.values())

MAX_SILENCE_S: Final = 3.0
"""Duration of silence after which a process is reported as frozen [s].

The supervisor kills most hung processes earlier.
"""
MIN_SILENT_CYCLES: Final = 3
"""Minimum time-out for the loop's heartbeat, in cycles."""


class Running(NamedTuple):
    """State of a process, as seen by the supervisor."""

    pid: int | None
    """Process id; None if the process is not running."""
    ready: bool
    """True if the process has sent its ready message."""
    restarts: int
    """Number of times that the process was restarted."""


NOT_RUNNING: Final = Running(None, ready=False, restarts=0)


class Health:
    """Result of the newest check of every process, and the newest measurements. Any thread may read them."""

    def __init__(
        self, heartbeats: Heartbeats, period: float, turn: float, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._clock = clock
        self._checked_at = clock()
        self._ending = False
        silent = dict.fromkeys(PROCESSES, MAX_SILENCE_S) | {"loop": max(MAX_SILENCE_S, MIN_SILENT_CYCLES * period)}
        self._watches = {name: Watch(heartbeats.heart(name), round(silent[name] / turn)) for name in PROCESSES}
        self.processes: Mapping[str, Running] = dict.fromkeys(PROCESSES, NOT_RUNNING)
        """State of each process in the newest check."""
        self._troubles: Mapping[str, str] = dict.fromkeys(PROCESSES, "starting")
        self._stored_at: dict[str, float] = {}
        self.service: ServiceMeasurements | None = None
        self.recorder: RecorderMeasurements | None = None
        self.events = EventCounts()

    def poll(self, processes: Mapping[str, Running]) -> None:
        """Check all processes. The supervisor calls this method at a fixed interval."""
        self._troubles = {name: self._trouble(name, running) for name, running in processes.items()}
        self.processes = processes
        self._checked_at = self._clock()

    def end(self, processes: Mapping[str, Running]) -> None:
        """Check for the last time, and report the service as ending from now on."""
        self.poll(processes)
        self._ending = True

    def store(self, process: str, content: Mapping[str, Any]) -> None:
        """Store measurements that a process has sent."""
        measured = converted(content, MEASURED_BY[process])
        if isinstance(measured, ServiceMeasurements):
            self.service = measured
        else:
            self.recorder = measured
        self._stored_at[process] = self._clock()

    def ages(self) -> dict[str, float]:
        """Return the age of the newest measurements of each process [s]."""
        return {name: self._clock() - stored_at for name, stored_at in self._stored_at.copy().items()}

    def troubles(self) -> dict[str, str]:
        """Return the problem of each process, including the supervisor; "" if a process has no problem."""
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
