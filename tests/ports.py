"""Ports of the loopback that nobody else picks between their choice and their use."""

from __future__ import annotations

import itertools
import os
import re
import socket

from trirail.wire.stop_protocol import PORT_OFFSET

FIRST, PORTS = 10_000, 10_000
"""First port, and number of ports. They are below those that the kernel gives to who asks for any port, in groups of
PORT_OFFSET; the group above each of these has the doors for stops."""
_WORKER = int(re.sub(r"\D", "", os.environ.get("PYTEST_XDIST_WORKER", "")) or 0)
_WORKERS = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
_COUNT = itertools.count(os.getpid())


def port(worker: int, workers: int, number: int) -> int:
    """Return one of the ports that only this worker of the tests picks, in turn by number."""
    group, place = divmod(number % (PORTS // workers) * workers + worker, PORT_OFFSET)
    return FIRST + 2 * PORT_OFFSET * group + place


def free_port() -> int:
    """Return a port that nobody listens on, another one each time."""
    for number in itertools.islice(_COUNT, PORTS // _WORKERS):
        chosen = port(_WORKER, _WORKERS, number)
        with socket.socket() as probe:
            try:
                probe.bind(("127.0.0.1", chosen))
            except OSError:
                continue
            return chosen
    raise AssertionError("all ports of this worker are taken")
