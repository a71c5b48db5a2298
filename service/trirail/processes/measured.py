"""What gateway and recorder measure for the metrics: totals since the loop began, told once a second."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from trirail.processes.zenoh_links import InUse
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


class Measurements:
    """What gateway and recorder told last, and when."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._told: dict[str, float] = {}
        self.service: ServiceMeasured | None = None
        self.recorder: RecorderMeasured | None = None

    def store(self, process: str, measured: ServiceMeasured | RecorderMeasured) -> None:
        """Keep what a process told."""
        if isinstance(measured, ServiceMeasured):
            self.service = measured
        else:
            self.recorder = measured
        self._told[process] = self._clock()

    def ages(self) -> dict[str, float]:
        """Return how old it is, by process [s]."""
        return {name: self._clock() - told for name, told in self._told.items()}


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
