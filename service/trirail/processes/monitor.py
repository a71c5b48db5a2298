"""What the supervisor keeps for whoever watches the service: each process's health, and what was measured."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from typing import Any, Final

from trirail.config import Config
from trirail.processes.health import Health, Running
from trirail.processes.heartbeats import Heartbeats
from trirail.processes.measured import Measurements, RecorderMeasured, ServiceMeasured
from trirail.wire.decoding import converted, prepare

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
