"""Work of each child process of the service, and its messages to the supervisor, in lines of JSON.

It reports functions being compiled, once that it is up, events for the log, and measurements.
"""

from __future__ import annotations

import os
import select
import signal
import socket
import sys
import time
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Final

import msgspec
from trirail_drivers.config import Can

from trirail.errors import ServiceError, TrirailError
from trirail.processes import realtime
from trirail.processes.heartbeats import BEAT_EVERY, PROCESSES, Heartbeats
from trirail.processes.order import Order
from trirail.processes.ports import Ports
from trirail.wire import links
from trirail.wire.links import LinkClosed
from trirail.wire.messages import Event
from trirail.wire.plan_packets import Overtaken, decode_plan_request, encode

COMPILING = "compiling"
"""Key of a function that is being compiled."""
HAPPENED = "happened"
"""Key of an event, for the service's log."""
MEASURED = "measured"
"""Key of a process's measurements, for the metrics."""
LOG_WITHIN = 0.05
"""Longest wait of a log line for a supervisor whose own output is held up, before it is left out [s]."""
DRIVES: Final = "drives"
"""Name of the simulated drives' process, and of its socket in the service's folder of sockets."""
DRIVES_WITHIN: Final = 60.0
"""Longest time for the drives to be there [s]."""
LOOK_EVERY: Final = 0.005
"""Interval of the checks that they are [s]."""


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
        """Sockets that the loop listens on."""
        # It stays open: by its end the supervisor learns of this process's end.
        self._voice = voice

    def ready(self, content: object) -> None:
        """Report that it is up. Its first sign of life comes before that: a hang from then on is found."""
        if self.name in PROCESSES:
            self.heartbeats.of(self.name).beat()
        self._say(content)

    def _say(self, content: object) -> None:
        with suppress(BrokenPipeError):  # a supervisor that was killed: the loop ends by itself, and the others with it
            os.write(self._voice, msgspec.json.encode(content) + b"\n")

    def compiling(self, function: str) -> None:
        """Report the function that is being compiled."""
        self._say({COMPILING: function})

    def log(self, event: Event) -> None:
        """Report an event."""
        if select.select([], [self._voice], [], LOG_WITHIN)[1]:
            self._say({HAPPENED: event})

    def measured(self, content: msgspec.Struct) -> None:
        """Report measurements, unless the pipe is full: new ones follow in a second."""
        line = msgspec.json.encode({MEASURED: content}) + b"\n"
        if len(line) <= select.PIPE_BUF and select.select([], [self._voice], [], 0.0)[1]:
            with suppress(BrokenPipeError):
                os.write(self._voice, line)


def run(child: Child) -> int:
    """Run the child of that name; return its exit code."""
    try:
        return _run(child)
    except TrirailError as error:
        print(f"trirail: {error}", file=sys.stderr, flush=True)  # noqa: T201 - a process says why it ends
        return os.EX_CONFIG


def _run(child: Child) -> int:
    # Each process imports what it needs and no more: the loop must not load Zenoh or Rerun, the gateway no mathematics.
    name, config = child.name, child.order.config
    if name in ("loop", "planner"):
        from trirail.kinematics.compiled import on_compile

        on_compile(child.compiling)
    if name == DRIVES:
        return _serve_drives(child)
    if name == "loop":
        from trirail.processes import loop_process

        gateway, recorder, planner = (socket.socket(fileno=number) for number in child.sockets)
        ports = Ports(links.Port(gateway), links.Port(recorder), links.Port(planner))
        bus = partial(_bus, config.can, child.runtime / DRIVES)
        return loop_process.main(config, bus, ports, child.heartbeats, child.ready)
    if name == "planner":
        return _plan(child)
    heart = child.heartbeats.of(name)
    link = links.connect(child.runtime / name)
    if name == "gateway":
        from trirail.processes import gateway as gate

        order, hurrying = child.order, child.heartbeats.hurrying
        return gate.main(order, link, heart.beat, child.ready, child.log, child.measured, hurrying)
    from trirail.processes import recording

    return recording.main(config, child.order.record, link, heart, child.ready, child.measured)


def _plan(child: Child) -> int:
    """Run the planner: answer the loop's requests, one at a time, until the loop has gone.

    It runs beside the loop and never on its processor; it keeps nothing, so it may be killed at any time.
    """
    from trirail.motion.motion_planner import MotionPlanner

    def beat() -> None:
        if serving:  # the first start compiles in its warm-up
            heart.beat()
            if poll.poll(0):
                raise Overtaken

    serving = False
    poll = select.poll()
    config, heart = child.order.config, child.heartbeats.of(child.name)
    planner = MotionPlanner(config, beat)
    planner.warm_up()
    lacking = realtime.stay_beside(config.loop, realtime.PLANNER_BELOW)
    link = links.connect(child.runtime / child.name)
    child.ready({"lacking": lacking})
    poll.register(link.fileno(), select.POLLIN)
    serving = True
    try:
        while True:
            heart.beat()
            poll.poll(BEAT_EVERY * 1e3)
            newest = None  # nobody waits for earlier requests any more
            while (packet := link.receive()) is not None:
                newest = packet
            if newest is not None:
                with suppress(Overtaken):
                    link.send(encode(planner.plan(decode_plan_request(newest))))
    except LinkClosed:
        heart.rest()
    return 0


def _serve_drives(child: Child) -> int:
    """Run the simulated drives until the loop has gone: it has them on a bus between processes, as real ones on theirs.

    They keep nothing, so they may be killed after it.
    """
    from trirail_drivers.connection.serving import serve

    config = child.order.config

    def begin() -> None:
        lacking = realtime.stay_beside(config.loop, realtime.DRIVES_BELOW)
        child.ready({"lacking": lacking})

    def connected() -> None:
        # The loop stops the robot first, on any signal to end; its end is the end of this process.
        signal.signal(signal.SIGTERM, signal.SIG_IGN)

    serve(child.runtime / DRIVES, config.can, config.drives, begin, connected)
    return 0


def _bus(can: Can, drives: Path) -> Can:
    """Return [can] of the bus that the loop is on; with simulated drives, once their process serves them."""
    if can.interface != "simulated":
        return can
    deadline = time.monotonic() + DRIVES_WITHIN
    while not drives.exists():
        if time.monotonic() > deadline:
            raise ServiceError(f"the simulated drives are not there within {DRIVES_WITHIN:g} s")
        time.sleep(LOOK_EVERY)
    return msgspec.structs.replace(can, interface="unix", channel=str(drives))
