"""Whether each process does its work, and what was measured: what the supervisor keeps for whoever watches.

The supervisor looks once in each of its turns; who asks does so in a thread of its own, so that a supervisor that is
held up itself, by its output for one, is told as well.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from typing import Any, Final, NamedTuple

from trirail.config import Config
from trirail.processes.heartbeats import PROCESSES, Heartbeats, Watch
from trirail.processes.measured import Measurements, RecorderMeasured, ServiceMeasured
from trirail.wire.decoding import converted, prepare

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
    """The newest look at every process; `troubles` may be asked by any thread."""

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

    def poll(self, processes: Mapping[str, Running]) -> None:
        """Look at all of them, in every turn of the supervisor's."""
        self._troubles = {name: self._trouble(name, running) for name, running in processes.items()}
        self.processes = processes
        self._looked = self._clock()

    def end(self) -> None:
        """Say that the service is ending: nobody looks any more."""
        self._ending = True

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


KINDS: Final = {"gateway": ServiceMeasured, "recorder": RecorderMeasured}
"""What each process measures."""
prepare(*KINDS.values())


class Monitor:
    """Health and measurements; while the context lasts they are served, where [telemetry] metrics_port is given."""

    def __init__(self, config: Config, heartbeats: Heartbeats, turn: float) -> None:
        self._config = config
        self.health = Health(heartbeats, config.period, turn)
        self.measured = Measurements()
        self._serving = ExitStack()

    def __enter__(self) -> Monitor:
        if self._config.telemetry.metrics_port:
            from trirail.processes.metrics_server import MetricsServer

            self._serving.enter_context(MetricsServer(self._config, self.health, self.measured))
        return self

    def __exit__(self, *_: object) -> None:
        self._serving.close()

    def poll(self, processes: Mapping[str, Running]) -> None:
        """Look at all processes, in every turn of the supervisor's."""
        self.health.poll(processes)

    def store(self, process: str, content: dict[str, Any]) -> None:
        """Take what a process has measured."""
        self.measured.store(process, converted(content, KINDS[process]))

    def end(self, processes: Mapping[str, Running]) -> None:
        """Look for the last time: the service is ending."""
        self.health.poll(processes)
        self.health.end()
