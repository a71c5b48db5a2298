"""What each child process of the service does, and what it says to the supervisor, in lines of JSON.

It says what it compiles, once that it is up, what is to be in the log, and what it has measured.
"""

from __future__ import annotations

import os
import select
import socket
import sys
from contextlib import suppress
from functools import partial
from pathlib import Path

import msgspec

from trirail.config import Config
from trirail.errors import TrirailError
from trirail.processes.heartbeats import Heartbeats
from trirail.processes.ports import Ports
from trirail.wire import links
from trirail.wire.messages import Event
from trirail.wire.plan_packets import MAX_PLANNING


class Order(msgspec.Struct, frozen=True):
    """What a child process is told to do."""

    config: Config
    record: str | None
    """Recording file to write, None for one named by the time."""


COMPILING = "compiling"
"""The key of what is said of a function that is being compiled."""
HAPPENED = "happened"
"""The key of an event, for the service's log."""
MEASURED = "measured"
"""The key of what a process has measured, for the metrics."""
LOG_WITHIN = 0.05
"""How long a line for the log waits for a supervisor whose own output is held up, before it is left out [s]."""


class Child:
    """A child process as it sees itself."""

    def __init__(
        self, name: str, order: Order, runtime: Path, heartbeats: Heartbeats, sockets: list[int], voice: int
    ) -> None:
        self.name = name
        self.order = order
        self.runtime = runtime
        self.heartbeats = heartbeats
        self.sockets = sockets
        """Those that the loop listens on."""
        # It stays open: its end is how the supervisor learns of this process's end.
        self._voice = voice

    def ready(self, content: object) -> None:
        """Say that it is up, and whatever else has no haste."""
        with suppress(BrokenPipeError):  # a supervisor that was killed: the loop ends by itself, and the others with it
            os.write(self._voice, msgspec.json.encode(content) + b"\n")

    def compiling(self, function: str) -> None:
        """Say which function is being compiled."""
        self.ready({COMPILING: function})

    def log(self, event: Event) -> None:
        """Say what has happened."""
        if select.select([], [self._voice], [], LOG_WITHIN)[1]:
            self.ready({HAPPENED: event})

    def measured(self, content: msgspec.Struct) -> None:
        """Say what has been measured: no more than a pipe takes at once, for in a second it comes again."""
        line = msgspec.json.encode({MEASURED: content}) + b"\n"
        if len(line) <= select.PIPE_BUF and select.select([], [self._voice], [], 0.0)[1]:
            with suppress(BrokenPipeError):
                os.write(self._voice, line)


def run(child: Child) -> int:
    """Do what a child of that name does; return its exit code."""
    try:
        return _run(child)
    except TrirailError as error:
        print(f"trirail: {error}", file=sys.stderr, flush=True)  # noqa: T201 - a process says why it ends
        return os.EX_CONFIG


def _run(child: Child) -> int:
    # Each process imports what it needs and no more: the loop must not load Zenoh or Rerun, the gateway no mathematics.
    name, config = child.name, child.order.config
    if name in ("loop", "planner"):
        from trirail.kinematics.compiled import tell_of_compiling

        tell_of_compiling(child.compiling)
    if name == "drives":
        from trirail.processes import drives_process

        return drives_process.main(config, child.runtime, child.ready)
    if name == "loop":
        from trirail.processes import drives_process, loop_process
        from trirail.processes.rehearsal import rehearse

        gateway, recorder, planner = (socket.socket(fileno=number) for number in child.sockets)
        ports = Ports(links.Port(gateway), links.Port(recorder), links.Port(planner, MAX_PLANNING))
        bus = partial(drives_process.bus, config, child.runtime)
        return loop_process.main(config, bus, ports, child.heartbeats, child.ready, rehearse)
    if name == "planner":
        from trirail.processes import planner_process

        return planner_process.main(config, child.runtime / name, child.heartbeats.of(name), child.ready)
    heart = child.heartbeats.of(name)
    link = links.connect(child.runtime / name)
    if name == "gateway":
        from trirail.processes import gateway as gate

        return gate.main(config, link, heart.beat, child.ready, child.log, child.measured, child.heartbeats.hurrying)
    from trirail.processes import recording

    return recording.main(config, child.order.record, link, heart, child.ready, child.measured)
