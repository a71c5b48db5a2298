"""Ports of the loopback that nobody else picks between their choice and their use."""

from __future__ import annotations

import itertools
import os
import re
import socket

FIRST, EACH = 10_000, 1000
"""Below what the kernel gives to who asks for any port, so many for each worker of the tests; the thousand above each
worker's are those of doors for stops."""
_WORKER = int(re.sub(r"\D", "", os.environ.get("PYTEST_XDIST_WORKER", "")) or 0) % 10
_COUNT = itertools.count(os.getpid())


def free_port() -> int:
    """Return a port that nobody listens on, another one each time."""
    for number in itertools.islice(_COUNT, EACH):
        port = FIRST + 2 * EACH * _WORKER + number % EACH
        with socket.socket() as probe:
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
            return port
    raise AssertionError("all ports of this worker are taken")
