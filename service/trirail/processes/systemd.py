"""What systemd is told, where it asked for it: sd_notify(3), sd_watchdog_enabled(3)."""

from __future__ import annotations

import contextlib
import os
import socket
import time
from collections.abc import Callable, Mapping, Sequence

from trirail.processes.heartbeats import Heart

SEND_WITHIN = 0.3
"""How long it is waited for a systemd that does not read [s]."""
FEEDS = 4
"""So often within the watchdog's time it is fed: systemd advises twice at least."""


def notify(state: str) -> None:
    """Tell systemd of a state, `READY=1` and its like."""
    address = os.environ.get("NOTIFY_SOCKET")
    if address:
        # An end of systemd's must not keep the robot from being stopped.
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender, contextlib.suppress(OSError):
            sender.settimeout(SEND_WITHIN)
            sender.connect("\0" + address[1:] if address.startswith("@") else address)
            sender.send(state.encode())


class Watchdog:
    """Feeds systemd's watchdog while all hearts beat, each since it was fed before; else systemd ends the service."""

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
        """Feed it if that is due."""
        now = self._clock()
        counts = [heart.count for heart in self._hearts]
        beating = all(count and count != before for count, before in zip(counts, self._fed, strict=True))
        if self._every and now >= self._due and beating:
            self._due, self._fed = now + self._every, counts
            notify("WATCHDOG=1")


def _microseconds(environment: Mapping[str, str]) -> int:
    """Return the watchdog's time [µs]; 0 where there is none, or not for this process."""
    wanted, process = environment.get("WATCHDOG_USEC", ""), environment.get("WATCHDOG_PID", str(os.getpid()))
    return int(wanted) if wanted.isdecimal() and process == str(os.getpid()) else 0
