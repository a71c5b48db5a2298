"""Fork servers as programs of their own, whose children do what a test has written."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path

from trirail.processes.fork_server import Inheritance
from trirail.processes.operating_system import python

ENDING = """
import socket
from trirail.config import SIM, load as loaded
from trirail.processes.heartbeats import Heartbeats
from trirail.processes.order import Order

runtime, record, control, beats, *sockets = sys.argv[1:]
with socket.socket(fileno=int(control)) as connected:
    order = Order(loaded(SIM), record or None)
    sockets = [int(number) for number in sockets]
    inherited = connected, order, Path(runtime), Heartbeats(int(beats)), sockets
    fork_server.serve(fork_server.Inheritance(*inherited), work)
"""


def doing(work: str, folder: Path) -> Callable[[Inheritance], subprocess.Popen[bytes]]:
    """Return what starts a program instead of forking the server, which a process of tests, having threads, must not.

    `work` is Python that imports `fork_server` and `sys` and defines `work`. A test's process has descriptors of its
    own that no child may have: the program begins without them.
    """
    script = folder / "server.py"
    script.write_text(work + ENDING)

    def start(inheritance: Inheritance) -> subprocess.Popen[bytes]:
        control, order, runtime, heartbeats, sockets = inheritance
        passed = [control.fileno(), heartbeats.descriptor, *sockets]
        command = python(str(script), str(runtime), order.record or "", *map(str, passed))
        return subprocess.Popen(command, stdin=subprocess.DEVNULL, pass_fds=passed)

    return start
