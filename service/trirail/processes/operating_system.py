"""The service's use of the operating system: programs, processes by name, signals, and reports to systemd.

Reports to systemd, if it asks for them, follow sd_notify(3) and sd_watchdog_enabled(3).
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Final

from trirail.errors import ServiceError
from trirail.processes.heartbeats import Heart


def python(*arguments: str) -> list[str]:
    """Return the command that runs this interpreter, with nothing of the current folder on its path.

    Otherwise, with `-m` and `-c`, Python would import a file `msgspec.py` from there, whatever its origin.
    """
    return [sys.executable, "-P", *arguments]


ONE_THREAD: Final = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
"""Environment in which numpy's libraries start no threads: a fork carries none over, and the service's matrices
are small."""
TITLE = "trirail: "
"""Prefix of the names of the service's processes in `ps` and the like."""


def processes(service: int) -> dict[str, int]:
    """Return the process ids of a service's processes by name; `service` is the supervisor's."""
    found = {"supervisor": service}
    for pid in [grandchild for parent in _children(service) for grandchild in (parent, *_children(parent))]:
        with contextlib.suppress(OSError):
            called = Path(f"/proc/{pid}/cmdline").read_bytes().rstrip(b"\0").decode()
            if called.startswith(TITLE):
                found[called.removeprefix(TITLE)] = pid
    return found


def child(service: int, name: str) -> int:
    """Return the process id of one of a service's processes. Raises ServiceError if there is none."""
    try:
        return processes(service)[name]
    except KeyError:
        raise ServiceError(f"the service has no process {name}") from None


def title(name: str) -> str:
    """Return the name of one of the service's processes in `ps` and the like."""
    return TITLE + name


def _children(process: int) -> list[int]:
    with contextlib.suppress(OSError):
        return [int(pid) for pid in Path(f"/proc/{process}/task/{process}/children").read_text("ascii").split()]
    return []


class Signals:
    """Source for select of SIGTERM, SIGINT and, unless it is ignored, as under nohup, SIGHUP.

    The kernel may hand a signal to any thread, but only the main thread runs Python's handlers, and nothing wakes that
    from a lock if another one was interrupted.
    """

    def __enter__(self) -> Signals:
        self.reader, self._writer = socket.socketpair()
        self._writer.setblocking(False)
        numbers = [signal.SIGTERM, signal.SIGINT]
        if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
            numbers.append(signal.SIGHUP)
        self._before = {number: signal.signal(number, lambda _signal, _frame: None) for number in numbers}
        self._wakeup = signal.set_wakeup_fd(self._writer.fileno(), warn_on_full_buffer=False)
        return self

    def first(self) -> signal.Signals:
        """Return the signal that came first; wait for one."""
        return signal.Signals(self.reader.recv(1)[0])

    def __exit__(self, *_: object) -> None:
        signal.set_wakeup_fd(self._wakeup)
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self.reader.close()
        self._writer.close()


SEND_WITHIN = 0.3
"""Longest wait for a systemd that does not read [s]."""
FEEDS = 4
"""Number of feeds within the watchdog's time: systemd advises at least two."""


def notify(state: str) -> None:
    """Notify systemd of a state, such as `READY=1`."""
    address = os.environ.get("NOTIFY_SOCKET")
    if address:
        # A failure of systemd must not keep the robot from being stopped.
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender, contextlib.suppress(OSError):
            sender.settimeout(SEND_WITHIN)
            sender.connect("\0" + address[1:] if address.startswith("@") else address)
            sender.send(state.encode())


class Watchdog:
    """Feeds of systemd's watchdog while all hearts have beaten since the last one; else systemd ends the service."""

    def __init__(
        self,
        hearts: Sequence[Heart],
        environment: Mapping[str, str] = os.environ,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._hearts = hearts
        self._clock = clock
        self._due = clock()
        self._every = _microseconds(environment) * 1e-6 / FEEDS
        self._fed = [0] * len(hearts)

    def feed(self) -> None:
        """Feed it if due."""
        now = self._clock()
        counts = [heart.count for heart in self._hearts]
        beating = all(count and count != before for count, before in zip(counts, self._fed, strict=True))
        if self._every and now >= self._due and beating:
            self._due, self._fed = now + self._every, counts
            notify("WATCHDOG=1")


def _microseconds(environment: Mapping[str, str]) -> int:
    """Return the watchdog's time [µs]; 0 if there is none, or not for this process."""
    wanted, process = environment.get("WATCHDOG_USEC", ""), environment.get("WATCHDOG_PID", str(os.getpid()))
    return int(wanted) if wanted.isdecimal() and process == str(os.getpid()) else 0
