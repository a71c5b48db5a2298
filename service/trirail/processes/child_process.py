"""Entry point of each child process, and the messages that a child sends to the supervisor.

Each message is a line of JSON. A child sends the names of functions that are being compiled, one ready message, events
for the log, and measurements.
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
"""Key of a message with the name of a function that is being compiled."""
HAPPENED = "happened"
"""Key of a message with an event for the service's log."""
MEASURED = "measured"
"""Key of a message with measurements for the metrics."""
LOG_WITHIN = 0.05
"""Time after which a log line is dropped if the pipe is full because the supervisor is too slow [s]."""
DRIVES: Final = "drives"
"""Name of the process of the simulated drives, and of the socket of that process in the service's runtime folder."""
DRIVES_WITHIN: Final = 60.0
"""Maximum time to wait for the socket of the simulated drives [s]."""
LOOK_EVERY: Final = 0.005
"""Interval between checks for the socket of the simulated drives [s]."""


class Child:
    """Everything that a child process needs to run, including the pipe to the supervisor."""

    def __init__(
        self, name: str, order: Order, runtime: Path, heartbeats: Heartbeats, sockets: list[int], voice: int
    ) -> None:
        self.name = name
        self.order = order
        self.runtime = runtime
        self.heartbeats = heartbeats
        self.sockets = sockets
        """Sockets on which the loop listens."""
        # The pipe stays open until the process ends. The closed pipe shows the supervisor that the process has ended.
        self._pipe = voice
        self._unsent = b""
        """Rest of a message that has been sent in part."""
        self._is_full = False
        """True if the pipe did not take all of the newest message. The next message does not wait for the pipe."""

    def report_ready(self, content: object) -> None:
        """Report to the supervisor that the process has started.

        The first heartbeat is sent before this message, so that a hang immediately after the message is detected.
        """
        if self.name in PROCESSES:
            self.heartbeats.heart(self.name).beat()
        self._send(content)

    def report_compiling(self, function: str) -> None:
        """Report to the supervisor that a function is being compiled."""
        self._send({COMPILING: function})

    def log(self, event: Event) -> None:
        """Send an event to the supervisor for the log; drop the event if the pipe is full for LOG_WITHIN.

        Later events are dropped without waiting until the pipe has space again, because the gateway must not be slow.
        """
        self._send({HAPPENED: event}, LOG_WITHIN)

    def report_measurements(self, content: msgspec.Struct) -> None:
        """Send measurements to the supervisor; drop them if the pipe is full, because new ones follow in a second."""
        self._send({MEASURED: content}, 0.0)

    def _send(self, content: object, seconds: float | None = None) -> None:
        """Send a message. Before it, send the rest of an earlier message, since each line must be complete.

        The message is dropped if the pipe is full for `seconds`; None means that it is never dropped.
        """
        if seconds is not None and self._is_full:
            seconds = 0.0
        self._unsent = self._send_part(self._unsent, seconds)
        self._is_full = bool(self._unsent)
        if not self._unsent:
            line = msgspec.json.encode(content) + b"\n"
            rest = self._send_part(line, seconds)
            self._unsent = rest if len(rest) < len(line) else b""
            self._is_full = bool(rest)

    def _send_part(self, line: bytes, seconds: float | None) -> bytes:
        """Send as much of a line as the pipe takes, each part within `seconds`, and return the rest."""
        with suppress(BrokenPipeError):  # the supervisor was killed: first the loop, then the other processes will end
            while line and select.select([], [self._pipe], [], seconds)[1]:
                os.write(self._pipe, line[: select.PIPE_BUF])  # more would wait for space, pipe(7)
                line = line[select.PIPE_BUF :]
        return line


def run(child: Child) -> int:
    """Run the child process; return its exit code."""
    try:
        return _run(child)
    except TrirailError as error:
        print(f"trirail: {error}", file=sys.stderr, flush=True)  # noqa: T201 - a process says why it ends
        return os.EX_CONFIG


def _run(child: Child) -> int:
    # Each process imports only the modules that it needs: the loop must not load Zenoh or Rerun, and the gateway must
    # not load the mathematics.
    name, config = child.name, child.order.config
    if name in ("loop", "planner"):
        from trirail.kinematics.compiled import on_compile

        on_compile(child.report_compiling)
    if name == DRIVES:
        return _serve_drives(child)
    if name == "loop":
        from trirail.processes import loop_process

        gateway, recorder, planner = (socket.socket(fileno=number) for number in child.sockets)
        ports = Ports(links.Port(gateway), links.Port(recorder), links.Port(planner))
        bus = partial(_bus, config.can, child.runtime / DRIVES)
        return loop_process.main(config, bus, ports, child.heartbeats, child.report_ready)
    if name == "planner":
        return _plan(child)
    heart = child.heartbeats.heart(name)
    link = links.connect(child.runtime / name)
    if name == "gateway":
        from trirail.processes import gateway as gate

        shared = child.heartbeats.urgent_section, child.heartbeats.last_cycle
        reports = child.report_ready, child.log, child.report_measurements
        return gate.main(child.order, link, heart.beat, *reports, *shared)
    from trirail.processes import recording

    reported = child.report_ready, child.report_measurements, child.heartbeats.last_cycle
    return recording.main(config, child.order.record, link, heart, *reported)


def _plan(child: Child) -> int:
    """Run the planner, which answers the loop's requests one at a time until the loop has ended.

    The planner never runs on the loop's processor. It has no state, so that it can be killed at any time.
    """
    from trirail.motion.motion_planner import MotionPlanner

    def beat() -> None:
        if serving:  # no beats during the warm-up, in which the first start compiles
            heart.beat()
            if poll.poll(0):
                raise Overtaken

    serving = False
    poll = select.poll()
    config, heart = child.order.config, child.heartbeats.heart(child.name)
    planner = MotionPlanner(config, beat)
    planner.warm_up()
    lacking = realtime.stay_beside(config.loop, realtime.PLANNER_BELOW)
    link = links.connect(child.runtime / child.name)
    child.report_ready({"lacking": lacking})
    poll.register(link.fileno(), select.POLLIN)
    serving = True
    try:
        while True:
            heart.beat()
            poll.poll(BEAT_EVERY * 1e3)
            newest = None  # only the newest request is planned, because nothing waits for earlier requests
            for packet in link.packets():
                newest = packet
            if newest is not None:
                with suppress(Overtaken):
                    link.send(encode(planner.plan(decode_plan_request(newest))))
    except LinkClosed:
        heart.rest()
    return 0


def _serve_drives(child: Child) -> int:
    """Run the simulated drives until the loop has ended.

    The loop communicates with the simulated drives over a bus between processes, in the same way as with real drives
    over CAN. The process has no state to save, so that it can be killed once the loop has ended.
    """
    from trirail_drivers.connection.serving import serve

    config = child.order.config

    def begin() -> None:
        lacking = realtime.stay_beside(config.loop, realtime.DRIVES_BELOW)
        child.report_ready({"lacking": lacking})

    def connected() -> None:
        # On SIGTERM, the loop first stops the robot. This process must run until the loop disconnects.
        signal.signal(signal.SIGTERM, signal.SIG_IGN)

    serve(child.runtime / DRIVES, config.can, config.drives, begin, connected)
    return 0


def _bus(can: Can, drives: Path) -> Can:
    """Return the [can] section that the loop is to use.

    For simulated drives, wait for the socket of their process and return a section that refers to that socket. Raises
    ServiceError if the socket does not appear within DRIVES_WITHIN.
    """
    if can.interface != "simulated":
        return can
    deadline = time.monotonic() + DRIVES_WITHIN
    while not drives.exists():
        if time.monotonic() > deadline:
            raise ServiceError(f"the simulated drives did not start within {DRIVES_WITHIN:g} s")
        time.sleep(LOOK_EVERY)
    return msgspec.structs.replace(can, interface="unix", channel=str(drives))
