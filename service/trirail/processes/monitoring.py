"""What gateway and recorder measure, and whether each process does its work: the supervisor keeps it for who watches.

Measured are totals since the loop began, told once a second. The supervisor looks at all processes once in each of its
turns; who asks does so in a thread of its own, so that a supervisor that is held up itself, by its output for one, is
told as well.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from typing import Any, Final, NamedTuple

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from trirail.config import Config
from trirail.processes.heartbeats import PROCESSES, Heartbeats, Watch
from trirail.processes.zenoh_links import InUse
from trirail.wire.decoding import converted, prepare
from trirail.wire.messages import Event, FaultDetail
from trirail.wire.state import FrameCounts, State

TOLD_EVERY: Final = 1.0
"""How often they are told [s]."""
CYCLE_BOUNDS: Final = (1e-6, 2e-6, 5e-6, 1e-5, 2e-5, 5e-5, 1e-4, 2e-4, 5e-4, 1e-3, 2e-3, 5e-3, 1e-2)
"""Of the histograms of lateness and cycle [s]."""
SETTLE_BOUNDS: Final = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
"""Of that of settle times [s]."""
KINDS_OF_FAULT: Final = 20
"""So many faults are told apart, by cause, drive and code; what more there are count as one."""
OTHER: Final = FaultDetail("other")


class Histogram(Struct):
    """Values, counted by how large they are."""

    bounds: tuple[float, ...]
    """Rising."""
    counts: list[int]
    """How many values are at most each bound and above the one before; at the end those above all."""
    total: float = 0.0
    """Of all values."""

    @classmethod
    def of(cls, bounds: tuple[float, ...]) -> Histogram:
        """Return one without values."""
        return cls(bounds, [0] * (len(bounds) + 1))

    def add(self, values: NDArray[np.float64]) -> None:
        """Take values in, (n,)."""
        places = np.searchsorted(self.bounds, values)  # the first bound that is not below the value
        more = np.bincount(places, minlength=len(self.counts)).tolist()
        self.counts = [count + n for count, n in zip(self.counts, more, strict=True)]
        self.total += float(values.sum())


class FaultCount(Struct, frozen=True):
    """How often there was a fault of a kind."""

    fault: FaultDetail
    times: int


class ServiceMeasured(Struct, frozen=True):
    """What the gateway tells."""

    mode: str
    """A trirail.wire.vocabulary.Mode."""
    cycles: int
    """As in trirail.wire.state.LoopState, and the three below."""
    overruns: int
    bus_load: float
    bus_load_measured: float
    traffic: tuple[FrameCounts, FrameCounts, FrameCounts]
    """Frames of each drive that were late or lost."""
    lateness: Histogram
    """How much after its deadline each cycle began [s]."""
    cycle: Histogram
    """How long each cycle worked [s]."""
    settle: Histogram
    """How long goals took to be in position, of those that are done [s]."""
    goals: dict[str, int]
    """How many ended, by outcome."""
    faults: tuple[FaultCount, ...]
    use: InUse
    """Of what there is an end to."""
    warnings: tuple[str, ...]
    """What is nearly used up."""


class RecorderMeasured(Struct, frozen=True):
    """What the recorder tells: its gaps, since it was started."""

    lost: int
    """Batches that the disk did not take."""
    skipped: int
    """Batches that the live view was too slow for."""
    absent: int
    """Cycles that the recorder itself was too slow for."""


class Meter:
    """Counts what passes the gateway; one that is started again counts the cycles anew, and is told the past events."""

    def __init__(self, tell: Callable[[Struct], None], clock: Callable[[], float] = time.monotonic) -> None:
        self._tell = tell
        self._clock = clock
        self._due = clock()
        self._lateness, self._cycle = Histogram.of(CYCLE_BOUNDS), Histogram.of(CYCLE_BOUNDS)
        self._settle = Histogram.of(SETTLE_BOUNDS)
        self._goals: dict[str, int] = {}
        self._faults: dict[FaultDetail, int] = {}

    def records(self, rows: NDArray[np.void]) -> None:
        """Take in a batch of records."""
        self._lateness.add(rows["lateness_ns"] * 1e-9)
        self._cycle.add(rows["parts_ns"].sum(axis=1) * 1e-9)

    def event(self, event: Event) -> None:
        """Take in an event."""
        if event.outcome is not None:
            self._goals[event.outcome] = self._goals.get(event.outcome, 0) + 1
            if event.settle is not None:
                self._settle.add(np.array([event.settle]))
        if event.kind == "fault":
            fault = event.fault or OTHER
            if fault not in self._faults and len(self._faults) >= KINDS_OF_FAULT:
                fault = OTHER
            self._faults[fault] = self._faults.get(fault, 0) + 1

    def publish(self, newest: Callable[[], State], use: InUse, warnings: tuple[str, ...]) -> None:
        """Tell all of it, where that is due."""
        now = self._clock()
        if now < self._due:
            return
        self._due = now + TOLD_EVERY
        state = newest()
        loop = state.loop
        self._tell(
            ServiceMeasured(
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
            )
        )


MEASURED_BY: Final = {"gateway": ServiceMeasured, "recorder": RecorderMeasured}
"""What each process measures."""
prepare(*MEASURED_BY.values())

SILENT: Final = 3.0
"""A process is told as frozen that has given no sign of life for so long [s]; most have been killed for it by then."""
LEAST_CYCLES: Final = 3
"""So many cycles the loop may take for a sign of life, however long they are."""


class Running(NamedTuple):
    """What the supervisor knows of a process."""

    pid: int | None
    """None where there is none."""
    ready: bool
    """Whether it has said that it is up."""
    restarts: int
    """How often it was started again."""


NOT_RUNNING: Final = Running(None, ready=False, restarts=0)


class Health:
    """The newest look at every process, and what they measured last; any thread may ask."""

    def __init__(
        self, heartbeats: Heartbeats, period: float, turn: float, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._clock = clock
        self._looked = clock()
        self._ending = False
        silent = dict.fromkeys(PROCESSES, SILENT) | {"loop": max(SILENT, LEAST_CYCLES * period)}
        self._watches = {name: Watch(heartbeats.of(name), round(silent[name] / turn)) for name in PROCESSES}
        self.processes: Mapping[str, Running] = dict.fromkeys(PROCESSES, NOT_RUNNING)
        """What was known of each at the newest look."""
        self._troubles: Mapping[str, str] = dict.fromkeys(PROCESSES, "starting")
        self._told: dict[str, float] = {}
        self.service: ServiceMeasured | None = None
        self.recorder: RecorderMeasured | None = None

    def poll(self, processes: Mapping[str, Running]) -> None:
        """Look at all of them, in every turn of the supervisor's."""
        self._troubles = {name: self._trouble(name, running) for name, running in processes.items()}
        self.processes = processes
        self._looked = self._clock()

    def end(self, processes: Mapping[str, Running]) -> None:
        """Look for the last time: the service is ending."""
        self.poll(processes)
        self._ending = True

    def store(self, process: str, content: Mapping[str, Any]) -> None:
        """Keep what a process has measured."""
        measured = converted(content, MEASURED_BY[process])
        if isinstance(measured, ServiceMeasured):
            self.service = measured
        else:
            self.recorder = measured
        self._told[process] = self._clock()

    def ages(self) -> dict[str, float]:
        """Return how old that is, by process [s]."""
        return {name: self._clock() - told for name, told in self._told.copy().items()}

    def troubles(self) -> dict[str, str]:
        """Return what is wrong, by process, "" for nothing; the supervisor is one of them."""
        held_up = self._clock() - self._looked > SILENT
        supervisor = "the service is ending" if self._ending else "no sign of life" if held_up else ""
        return {**self._troubles, "supervisor": supervisor}

    def _trouble(self, name: str, running: Running) -> str:
        silent = name in self._watches and self._watches[name].silent()
        if running.pid is None:
            return "not running"
        if not running.ready:
            return "starting"
        return "no sign of life" if silent else ""


def metrics_server(config: Config, health: Health) -> AbstractContextManager[object]:
    """Return what serves it while the context lasts; nothing where [telemetry] metrics_port is not given."""
    if not config.telemetry.metrics_port:
        return nullcontext()
    from trirail.processes.metrics_server import MetricsServer

    return MetricsServer(config, health)
