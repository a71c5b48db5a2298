"""The gateway's own sockets, and file descriptors: how many there may be, and some kept for what must not lack them."""

from __future__ import annotations

import contextlib
import os
import resource
import socket
import stat
import struct
from collections.abc import Container
from pathlib import Path
from typing import Any

from trirail.wire.stop_protocol import StopAddress

SOCKET_MODE = 0o660
"""Of a Unix socket: its owner and its group may connect, which takes the right to write; nobody else."""


def raise_descriptor_limit() -> None:
    """Let this process, and those that it starts, have as many descriptors as the system's hard limit says."""
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    with contextlib.suppress(ValueError, OSError):  # an unlimited one is more than some kernels take
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))


def descriptor_limit() -> int:
    """Return how many descriptors this process may have."""
    return resource.getrlimit(resource.RLIMIT_NOFILE)[0]


def descriptors_used() -> int:
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


def listen(address: StopAddress) -> list[socket.socket]:
    """Listen at every address that a host's name stands for. Raises OSError where that cannot be."""
    if isinstance(address.where, str):
        Path(address.where).unlink(missing_ok=True)  # of a gateway that was killed: Zenoh's own lock is ours by now
        places: list[tuple[socket.AddressFamily, Any]] = [(socket.AF_UNIX, address.where)]
    else:
        host, port = address.where
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
        places = [(family, where) for family, _, _, _, where in found]
    listening = []
    try:
        for family, where in places:
            opened = socket.socket(family)
            listening.append(opened)
            opened.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            opened.bind(where)
            if isinstance(where, str):
                Path(where).chmod(SOCKET_MODE)
            opened.listen(socket.SOMAXCONN)
            opened.setblocking(False)
    except OSError:
        for opened in listening:
            opened.close()
        raise
    return listening


def source(connected: socket.socket, address: object) -> str:
    """Return whose share a connection is of: its address, or the process at the other end of a Unix socket."""
    if connected.family == socket.AF_UNIX:
        credentials = connected.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
        return str(struct.unpack("3i", credentials)[0])
    return str(address[0]) if isinstance(address, tuple) else ""
