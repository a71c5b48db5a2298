"""Use of the operating system: commands to run, process ids by name, signals, and notifications of systemd.

Notifications are sent only if systemd has requested them. They follow sd_notify(3) and sd_watchdog_enabled(3).
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import select
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
    """Return the command that runs this Python interpreter with arguments, and without the current folder on its path.

    With `-m` and `-c`, Python would otherwise import a file such as `msgspec.py` from the current folder.
    """
    return [sys.executable, "-P", *arguments]


ONE_THREAD: Final = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
"""Environment in which numpy's libraries start no threads.

A fork would not copy the threads, and threads would not be faster, because the matrices are small.
"""
MACHINE_FILES: Final = (Path("/proc/sys/kernel/random/boot_id"), Path("/etc/machine-id"))
"""Files that identify the present start of this machine, and its file system."""


def machine() -> str:
    """Return an identifier of this machine until its next start; "" if the operating system has none.

    The identifier is a hash, because the id of a machine is confidential: machine-id(5). A container with its own file
    system counts as another machine.
    """
    try:
        start, *others = (file.read_bytes() if file.exists() else b"" for file in MACHINE_FILES)
    except OSError:
        return ""
    return hashlib.sha256(b"trirail\0".join((start, *others))).hexdigest()[:16] if start else ""


def is_here(named: str) -> bool:
    """Return whether `named` identifies this machine; "" is an unknown machine, and counts as this one."""
    return named in ("", machine())


TITLE = "trirail: "
"""Prefix of the names of the service's processes, as shown by `ps` and similar programs."""


def processes(service: int) -> dict[str, int]:
    """Return the process ids of a service's processes, by name. `service` is the process id of the supervisor."""
    pids = {"supervisor": service}
    for pid in [grandchild for parent in _children(service) for grandchild in (parent, *_children(parent))]:
        with contextlib.suppress(OSError):
            called = Path(f"/proc/{pid}/cmdline").read_bytes().rstrip(b"\0").decode()
            if called.startswith(TITLE):
                pids[called.removeprefix(TITLE)] = pid
    return pids


def child(service: int, name: str) -> int:
    """Return the process id of one of a service's processes. Raises ServiceError if no process has that name."""
    try:
        return processes(service)[name]
    except KeyError:
        raise ServiceError(f"the service has no process {name}") from None


def title(name: str) -> str:
    """Return the name of one of the service's processes, as shown by `ps` and similar programs."""
    return TITLE + name


def _children(process: int) -> list[int]:
    with contextlib.suppress(OSError):
        return [int(pid) for pid in Path(f"/proc/{process}/task/{process}/children").read_text("ascii").split()]
    return []


class Signals:
    """Receiver of the signals that end the service and of SIGTSTP, whose socket `reader` can be passed to select.

    SIGTSTP, SIGTTIN and SIGTTOU do not stop the process, because it must not freeze while the robot moves. Under nohup,
    SIGHUP is still ignored. The kernel may deliver a signal to any thread, but Python runs its handlers only in the
    main thread, which may be waiting for a lock. A signal in another thread would not wake the main thread. Data in a
    socket does.
    """

    def __enter__(self) -> Signals:
        self.reader, self._writer = socket.socketpair()
        self._writer.setblocking(False)
        numbers = [signal.SIGTERM, signal.SIGINT, signal.SIGQUIT, signal.SIGTSTP]
        if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
            numbers.append(signal.SIGHUP)
        self._before = {number: signal.signal(number, lambda _signal, _frame: None) for number in numbers}
        for number in (signal.SIGTTIN, signal.SIGTTOU):
            self._before[number] = signal.signal(number, signal.SIG_IGN)
        self._wakeup = signal.set_wakeup_fd(self._writer.fileno(), warn_on_full_buffer=False)
        return self

    def first(self) -> signal.Signals:
        """Wait for a signal, and return the first signal that has arrived."""
        return signal.Signals(self.reader.recv(1)[0])

    def __exit__(self, *_: object) -> None:
        signal.set_wakeup_fd(self._wakeup)
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self.reader.close()
        self._writer.close()


STARTER = "TRIRAIL_ENDS_WITH"
"""Environment variable with the number of the process with which a service ends, however that process ends."""


class Starter:
    """Process that has started the service for itself alone, if there is one."""

    def __init__(self) -> None:
        self._process: int | None = None
        self.gone = False
        """True if the process had ended before the service started."""
        number = os.environ.pop(STARTER, "")
        try:
            self._process = os.pidfd_open(int(number)) if number else None
        except ProcessLookupError:
            self.gone = True
        except OSError:
            pass  # a kernel that has no file descriptors of processes

    def has_ended(self) -> bool:
        """Return True if there was such a process, and it has ended."""
        if self._process is not None and select.select([self._process], [], [], 0)[0]:
            self.gone = True
        return self.gone


SEND_WITHIN = 0.3
"""Maximum time to wait until systemd accepts a notification [s]."""
FEEDS = 4
"""Number of notifications within the time-out of systemd's watchdog. systemd recommends at least two."""


def notify(state: str) -> None:
    """Notify systemd of a state, such as `READY=1`."""
    address = os.environ.get("NOTIFY_SOCKET")
    if address:
        # Errors are ignored, because a failure of systemd must not prevent a stop of the robot.
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
            sender.settimeout(SEND_WITHIN)
            sender.connect("\0" + address[1:] if address.startswith("@") else address)
            sender.send(state.encode())


class Watchdog:
    """Client of systemd's watchdog, which sends notifications as long as all given heartbeats continue.

    Without notifications, systemd ends the service.
    """

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
        """Notify systemd if a notification is due and all hearts have beaten since the last notification."""
        now = self._clock()
        counts = [heart.count for heart in self._hearts]
        beating = all(count and count != before for count, before in zip(counts, self._fed, strict=True))
        if self._every and now >= self._due and beating:
            self._due, self._fed = now + self._every, counts
            notify("WATCHDOG=1")


def _microseconds(environment: Mapping[str, str]) -> int:
    """Return the time-out of systemd's watchdog [µs]; 0 if systemd has no watchdog for this process."""
    wanted, process = environment.get("WATCHDOG_USEC", ""), environment.get("WATCHDOG_PID", str(os.getpid()))
    return int(wanted) if wanted.isdecimal() and process == str(os.getpid()) else 0
