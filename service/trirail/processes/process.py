"""What each child process of the service begins with: `trirail.processes.process NAME RUNTIME READY BEATS [SOCKETS…]`.

Its order comes on standard input; READY is a descriptor on which it says, in lines of JSON, what it compiles, once that
it is up, and what is to be in the log; BEATS that of the heartbeats.
"""

from __future__ import annotations

import os
import select
import signal
import socket
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import msgspec

from trirail.config import Config
from trirail.errors import TrirailError
from trirail.processes.heartbeats import Heartbeats
from trirail.processes.realtime import die_with_parent
from trirail.wire import links
from trirail.wire.decoding import decoded, prepare
from trirail.wire.messages import Event
from trirail.wire.planning import MAX_PLANNING


class Order(msgspec.Struct, frozen=True):
    """What a child process is told to do."""

    config: Config
    record: str | None
    """Recording file to write, None for one named by the time."""


prepare(Order)

COMPILING = "compiling"
"""The key of what is said of a function that is being compiled."""
HAPPENED = "happened"
"""The key of an event, for the service's log."""
MEASURED = "measured"
"""The key of what a process has measured, for the metrics."""
LOG_WITHIN = 0.05
"""How long a line for the log waits for a supervisor whose own output is held up, before it is left out [s]."""


def _main(
    name: str,
    runtime: Path,
    heartbeats: Heartbeats,
    ready: Callable[[object], None],
    log: Callable[[Event], None],
    measured: Callable[[msgspec.Struct], None],
    sockets: list[int],
) -> int:
    order = decoded(sys.stdin.buffer.read(), Order)
    config = order.config
    # Each process imports what it needs and no more: the loop must not load Zenoh or Rerun, the gateway no mathematics.
    if name != "gateway":
        from trirail.kinematics.compiled import tell_of_compiling

        tell_of_compiling(lambda function: ready({COMPILING: function}))
    if name == "loop":
        from trirail.processes import loop

        gateway, recorder, planner = (socket.socket(fileno=number) for number in sockets)
        ports = loop.Ports(links.Port(gateway), links.Port(recorder), links.Port(planner, MAX_PLANNING))
        return loop.main(config, ports, heartbeats, ready)
    if name == "planner":
        from trirail.processes import planner as thinking

        return thinking.main(config, runtime / name, heartbeats.of(name), ready)
    link = links.connect(runtime / name)
    if name == "gateway":
        from trirail.processes import gateway as gate

        return gate.main(config, link, heartbeats.of("gateway").beat, ready, log, measured)
    from trirail.processes import recording

    return recording.main(config, order.record, link, heartbeats.of(name), ready, measured)


def main() -> int:
    """Run one child process; return its exit code."""
    name, runtime, descriptor, beats, *sockets = sys.argv[1:]
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the terminal sends it to all; the supervisor alone acts on it
    if name == "loop":
        # The others end by themselves once it has gone, so that what it says of its end is published and on disk.
        die_with_parent(signal.SIGTERM)

    def ready(content: object) -> None:
        # The descriptor stays open: its end is how the supervisor learns of this process's end.
        with suppress(BrokenPipeError):  # a supervisor that was killed: the loop ends by itself, and the others with it
            os.write(int(descriptor), msgspec.json.encode(content) + b"\n")

    def log(event: Event) -> None:
        if select.select([], [int(descriptor)], [], LOG_WITHIN)[1]:
            ready({HAPPENED: event})

    def measured(content: msgspec.Struct) -> None:
        line = msgspec.json.encode({MEASURED: content}) + b"\n"
        # No more than a pipe takes at once: nobody waits for a supervisor here, and in a second it comes again.
        if len(line) <= select.PIPE_BUF and select.select([], [int(descriptor)], [], 0.0)[1]:
            with suppress(BrokenPipeError):
                os.write(int(descriptor), line)

    hearts, numbers = Heartbeats(int(beats)), [int(number) for number in sockets]
    try:
        return _main(name, Path(runtime), hearts, ready, log, measured, numbers)
    except TrirailError as error:
        print(f"trirail: {error}", file=sys.stderr, flush=True)  # noqa: T201 - a process says why it ends
        return os.EX_CONFIG


if __name__ == "__main__":
    code = main()
    sys.stderr.flush()
    # Everything is closed by now. Rerun's file sink, when a disk has failed it, would keep the interpreter from ending.
    os._exit(code)
