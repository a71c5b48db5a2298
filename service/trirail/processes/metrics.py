"""The metrics of a service, as Prometheus takes them: made at each scrape, of what was measured last."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from msgspec import structs
from prometheus_client import Metric
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily
from prometheus_client.registry import Collector
from trirail_drivers.interface import NAMES

from trirail.processes.monitoring import Health, Histogram, Running, ServiceMeasured
from trirail.processes.zenoh_links import InUse
from trirail.wire.vocabulary import MODES

PREFIX: Final = "trirail"
Values = Mapping[Any, float]
"""By a label's value, or where a metric has several labels, by a tuple of theirs."""
NONE_YET: Final[Values] = {}
PAGE: Final = os.sysconf("SC_PAGE_SIZE")
TICKS: Final = os.sysconf("SC_CLK_TCK")


class ServiceMetrics(Collector):
    """All metrics of a service."""

    def __init__(self, robot: str, version: str, health: Health) -> None:
        self._robot = robot
        self._version = version
        self._health = health

    def collect(self) -> Iterator[Metric]:
        """Yield every metric; what has not been measured yet is left out."""
        words = "The robot and the software that runs."
        yield _gauge("service_info", words, ["robot", "version"], {(self._robot, self._version): 1.0})
        yield from self._processes()
        if (service := self._health.service) is not None:
            yield from _loop(service)
            yield from _goals(service)
            yield from _can(service)
            yield from _use(service.use)
        if (recorder := self._health.recorder) is not None:
            words = "Batches that are missing, by where they should be."
            lost = {"file": recorder.lost, "live": recorder.skipped}
            yield _counter("recorder_lost_batches", words, ["sink"], lost)
            words = "Cycles that are in no recording, since the recorder was too slow for them."
            yield _counter("recorder_missing_cycles", words, value=recorder.absent)

    def _processes(self) -> Iterator[Metric]:
        words = "Whether a process does its work, as /healthz says it."
        healthy = {name: float(not trouble) for name, trouble in self._health.troubles().items()}
        yield _gauge("process_healthy", words, ["process"], healthy)
        restarts = _counter("process_restarts", "How often a process was started again.", ["process"])
        memory = _gauge("process_resident_memory_bytes", "Memory of a process.", ["process"])
        busy = _counter("process_cpu_seconds", "Processor time of a process since its start.", ["process"])
        processes = {"supervisor": Running(os.getpid(), ready=True, restarts=0), **self._health.processes}
        for name, running in processes.items():
            restarts.add_metric([name], running.restarts)
            if running.pid is not None and (used := _used(running.pid)) is not None:
                memory.add_metric([name], used[0])
                busy.add_metric([name], used[1])
        yield from (restarts, memory, busy)
        words = "How old the metrics are that a process measures."
        yield _gauge("measurement_age_seconds", words, ["process"], self._health.ages())


def _loop(service: ServiceMeasured) -> Iterator[Metric]:
    modes = {name: float(name == service.mode) for name in MODES}
    yield _gauge("mode", "1 for the mode that the robot is in, 0 for the others.", ["mode"], modes)
    yield _counter("loop_cycles", "SYNCs sent since the start.", value=service.cycles)
    yield _counter("loop_missed_ticks", "Ticks missed since the start.", value=service.overruns)
    yield _histogram("loop_lateness_seconds", "How much after its deadline a cycle began.", service.lateness)
    yield _histogram("loop_cycle_seconds", "How long a cycle worked.", service.cycle)


def _goals(service: ServiceMeasured) -> Iterator[Metric]:
    yield _counter("goals", "Goals that have ended, by outcome.", ["outcome"], service.goals)
    yield _histogram("goal_settle_seconds", "From the end of a goal's path until it was in position.", service.settle)
    faults = _counter("faults", "Faults, by cause, drive and the drive's own code.", ["cause", "drive", "code"])
    for count in service.faults:
        code = f"0x{count.fault.code:04X}" if count.fault.code else ""
        faults.add_metric([count.fault.cause, count.fault.drive, code], count.times)
    yield faults


def _can(service: ServiceMeasured) -> Iterator[Metric]:
    load = {"measured": service.bus_load_measured, "worst": service.bus_load}
    yield _gauge("can_load_ratio", "Share of the bus in use; 1 is full.", ["kind"], load)
    frames = {
        (drive, kind): count
        for drive, counts in zip(NAMES, service.traffic, strict=True)
        for kind, count in structs.asdict(counts).items()
    }
    words = "Cyclic frames of a drive that were late or lost."
    yield _counter("can_troubled_frames", words, ["drive", "kind"], frames)


def _use(use: InUse) -> Iterator[Metric]:
    used = {"sessions": use.sessions, "descriptors": use.descriptors}
    most = {"sessions": use.sessions_most, "descriptors": use.descriptors_most}
    yield _gauge("gateway_used", "What is in use of what the gateway has so many of.", ["what"], used)
    yield _gauge("gateway_most", "How many of it there are.", ["what"], most)


def _gauge(name: str, words: str, labels: list[str], values: Values = NONE_YET) -> GaugeMetricFamily:
    """Return a metric with a value for each of its labels' values."""
    made = GaugeMetricFamily(f"{PREFIX}_{name}", words, labels=labels)
    for each, value in values.items():
        made.add_metric([each] if isinstance(each, str) else each, value)
    return made


def _counter(
    name: str, words: str, labels: list[str] | None = None, values: Values = NONE_YET, value: float | None = None
) -> CounterMetricFamily:
    made = CounterMetricFamily(f"{PREFIX}_{name}", words, value=value, labels=labels)
    for each, count in values.items():
        made.add_metric([each] if isinstance(each, str) else each, count)
    return made


def _histogram(name: str, words: str, values: Histogram) -> HistogramMetricFamily:
    """A histogram as Prometheus has it: each bucket counts those below it as well."""
    buckets: list[tuple[str, float]] = []
    so_far = 0
    for bound, count in zip((*values.bounds, float("inf")), values.counts, strict=True):
        so_far += count
        buckets.append(("+Inf" if bound == float("inf") else repr(bound), so_far))
    return HistogramMetricFamily(f"{PREFIX}_{name}", words, buckets=buckets, sum_value=values.total)


def _used(pid: int) -> tuple[float, float] | None:
    """Return memory [bytes] and processor time [s] of a process, None where it has just ended; proc(5)."""
    try:
        pages = Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1]
        fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    except (OSError, IndexError):
        return None
    return int(pages) * PAGE, (int(fields[11]) + int(fields[12])) / TICKS
