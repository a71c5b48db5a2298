"""File descriptors: as many as the system lets a process have, and some that are kept for what must not lack them."""

from __future__ import annotations

import contextlib
import os
import resource
import socket
import stat
from collections.abc import Container
from pathlib import Path


def raise_limit() -> None:
    """Let this process, and those that it starts, have as many as the system's hard limit says."""
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    with contextlib.suppress(ValueError, OSError):  # an unlimited one is more than some kernels take
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))


def limit() -> int:
    """Return how many this process may have."""
    return resource.getrlimit(resource.RLIMIT_NOFILE)[0]


def used() -> int:
    """Return how many it has."""
    counted = Path("/proc/self/fd").stat().st_size  # Linux 6.2 and later; 0 before
    return counted or len(os.listdir("/proc/self/fd")) - 1  # one is that of the listing


def disconnect(peers: Container[tuple[str, int]]) -> None:
    """Shut every connection of this process down whose other end is one of these hosts and ports, whoever has it."""
    for number in map(int, os.listdir("/proc/self/fd")):
        with contextlib.suppress(OSError):  # it is closed, or connected to nobody
            if not stat.S_ISSOCK(os.fstat(number).st_mode):
                continue
            with socket.socket(fileno=os.dup(number)) as connection:
                if connection.getpeername()[:2] in peers:
                    connection.shutdown(socket.SHUT_RDWR)


class Reserve:
    """Descriptors that are held until they are needed, so that nobody else in this process uses them up."""

    def __init__(self, count: int) -> None:
        self._count = count
        self._null = os.open(os.devnull, os.O_RDONLY | os.O_CLOEXEC)
        self._kept: list[int] = []
        self.refill()

    def __len__(self) -> int:
        return len(self._kept)

    def release(self) -> None:
        """Let one go, for who opens something next. IndexError where there is none."""
        os.close(self._kept.pop())

    def close(self, descriptor: int) -> None:
        """Close what was opened in the place of one, and keep that again: at no time is it anybody's."""
        os.dup2(self._null, descriptor, inheritable=False)
        self._kept.append(descriptor)

    def refill(self, opened: int = 0) -> None:
        """Keep as many as there are to be, less what is opened in the place of some; fewer where the system says no."""
        with contextlib.suppress(OSError):
            while len(self._kept) < self._count - opened:
                self._kept.append(os.dup(self._null))

    def end(self) -> None:
        """Keep none."""
        for descriptor in (*self._kept, self._null):
            os.close(descriptor)
        self._kept = []
