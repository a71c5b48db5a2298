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
    """Return the command that runs this interpreter without the current folder on its path.

    With `-m` and `-c`, Python would otherwise import a file such as `msgspec.py` from the current folder.
    """
    return [sys.executable, "-P", *arguments]


ONE_THREAD: Final = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
"""Environment in which numpy's libraries start no threads: a fork would lose them, and the matrices are small."""
TITLE = "trirail: "
"""Prefix of the names of the service's processes in `ps` and the like."""


def processes(service: int) -> dict[str, int]:
    """Return the process ids of a service's processes by name; `service` is the supervisor's."""
    pids = {"supervisor": service}
    for pid in [grandchild for parent in _children(service) for grandchild in (parent, *_children(parent))]:
        with contextlib.suppress(OSError):
            called = Path(f"/proc/{pid}/cmdline").read_bytes().rstrip(b"\0").decode()
            if called.startswith(TITLE):
                pids[called.removeprefix(TITLE)] = pid
    return pids


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
    """Source of SIGTERM, SIGINT and SIGHUP for select; SIGHUP stays ignored under nohup.

    The kernel may deliver a signal to any thread, but only the main thread runs Python's handlers, and a signal in
    another thread does not wake it from a lock. A socket pair does.
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
        """Wait for a signal, and return the first that has arrived."""
        return signal.Signals(self.reader.recv(1)[0])

    def __exit__(self, *_: object) -> None:
        signal.set_wakeup_fd(self._wakeup)
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self.reader.close()
        self._writer.close()


SEND_WITHIN = 0.3
"""Longest wait for systemd to accept a notification [s]."""
FEEDS = 4
"""Notifications within the watchdog's time-out; systemd recommends at least two."""


def notify(state: str) -> None:
    """Notify systemd of a state, such as `READY=1`."""
    address = os.environ.get("NOTIFY_SOCKET")
    if address:
        # A failure of systemd must not prevent a stop of the robot.
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender, contextlib.suppress(OSError):
            sender.settimeout(SEND_WITHIN)
            sender.connect("\0" + address[1:] if address.startswith("@") else address)
            sender.send(state.encode())


class Watchdog:
    """Client of systemd's watchdog: notifies it as long as all hearts beat; otherwise systemd ends the service."""

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
        """Notify systemd if it is time and all hearts have beaten since the last notification."""
        now = self._clock()
        counts = [heart.count for heart in self._hearts]
        beating = all(count and count != before for count, before in zip(counts, self._fed, strict=True))
        if self._every and now >= self._due and beating:
            self._due, self._fed = now + self._every, counts
            notify("WATCHDOG=1")


def _microseconds(environment: Mapping[str, str]) -> int:
    """Return the time-out of systemd's watchdog [µs]; 0 if there is none for this process."""
    wanted, process = environment.get("WATCHDOG_USEC", ""), environment.get("WATCHDOG_PID", str(os.getpid()))
    return int(wanted) if wanted.isdecimal() and process == str(os.getpid()) else 0
