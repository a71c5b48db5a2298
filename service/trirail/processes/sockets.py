"""Sockets of the gateway, the limit of file descriptors, and a reserve of descriptors for important connections."""

from __future__ import annotations

import contextlib
import errno
import ipaddress
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
"""Mode of a Unix socket. Connecting needs write permission, which the owner and the group have."""


def raise_descriptor_limit() -> None:
    """Raise the limit of file descriptors of this process and its children to the hard limit."""
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    with contextlib.suppress(ValueError, OSError):  # some kernels refuse to set an unlimited number
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))


def descriptor_limit() -> int:
    """Return the limit of file descriptors of this process."""
    return resource.getrlimit(resource.RLIMIT_NOFILE)[0]


def descriptors_used() -> int:
    """Return the number of file descriptors that this process has open."""
    counted = Path("/proc/self/fd").stat().st_size  # the number since Linux 6.2; 0 in earlier versions
    try:
        return counted or len(os.listdir("/proc/self/fd")) - 1  # listing the folder uses one descriptor itself
    except OSError:  # no descriptor is free
        return descriptor_limit()


def connections(ports: Container[int]) -> list[tuple[str, int]]:
    """Return the peers of TCP connections to local ports, including connections that the peer has closed."""
    # proc(5), /proc/net/tcp: addresses are words in host byte order, and states are those of the kernel's tcp_states.h.
    peers = []
    for table in ("tcp", "tcp6"):
        with contextlib.suppress(OSError):  # the machine may have no IPv6
            for line in Path(f"/proc/self/net/{table}").read_text(encoding="ascii").splitlines()[1:]:
                _, here, there, state, *_ = line.split()
                if state in _CONNECTED and int(here.rpartition(":")[2], 16) in ports:
                    peers.append(_address(there))
    return peers


_CONNECTED = ("01", "08")
"""States of a connection in /proc/net/tcp: ESTABLISHED and CLOSE_WAIT."""


def _address(written: str) -> tuple[str, int]:
    words, _, port = written.partition(":")
    packed = b"".join(struct.pack("=I", int(words[at : at + 8], 16)) for at in range(0, len(words), 8))
    address = ipaddress.ip_address(packed)
    return str(getattr(address, "ipv4_mapped", None) or address), int(port, 16)


def disconnect(peers: Container[tuple[str, int]]) -> None:
    """Shut down every connection of this process to these hosts and ports, including connections of libraries.

    This needs two free descriptors. If there are none, no connection is shut down.
    """
    try:
        numbers = os.listdir("/proc/self/fd")
    except OSError:
        return
    for number in map(int, numbers):
        with contextlib.suppress(OSError):  # the descriptor has been closed meanwhile, or is not connected
            if not stat.S_ISSOCK(os.fstat(number).st_mode):
                continue
            with socket.socket(fileno=os.dup(number)) as connection:
                if connection.getpeername()[:2] in peers:
                    connection.shutdown(socket.SHUT_RDWR)


class Reserve:
    """Reserve of file descriptors, which cannot be used for anything else in this process."""

    def __init__(self, count: int) -> None:
        self._count = count
        self._null = os.open(os.devnull, os.O_RDONLY | os.O_CLOEXEC)
        self._kept: list[int] = []
        self.refill()

    def __len__(self) -> int:
        return len(self._kept)

    def release(self) -> None:
        """Close one reserved descriptor, so that a connection can be opened. Raises IndexError if none is left."""
        os.close(self._kept.pop())

    def close(self, descriptor: int) -> None:
        """Close a connection's descriptor and reserve it again, in one step."""
        os.dup2(self._null, descriptor, inheritable=False)
        self._kept.append(descriptor)

    def refill(self, opened: int = 0) -> None:
        """Fill the reserve up to its full number minus `opened`, the number in use, as far as the system allows."""
        with contextlib.suppress(OSError):
            while len(self._kept) < self._count - opened:
                self._kept.append(os.dup(self._null))

    def end(self) -> None:
        """Close all descriptors of the reserve."""
        for descriptor in (*self._kept, self._null):
            os.close(descriptor)
        self._kept = []


def listen(address: StopAddress) -> list[socket.socket]:
    """Listen on a Unix socket, or on every address of a host name that this machine has. Raises OSError on failure."""
    if isinstance(address.where, str):
        file = Path(address.where)
        if file.is_socket():
            _remove_unused(address.where)
        elif os.path.lexists(file):
            raise FileExistsError(errno.EEXIST, "this file exists and is not a socket; move it away", address.where)
        places: list[tuple[socket.AddressFamily, Any]] = [(socket.AF_UNIX, address.where)]
    else:
        host, port = address.where
        resolved = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
        places = list(dict.fromkeys((family, where) for family, _, _, _, where in resolved))  # hosts(5) may repeat one
    listening: list[socket.socket] = []
    for number, place in enumerate(places, 1):
        try:
            listening.append(_listen(*place))
        except OSError as error:
            if error.errno not in _ABSENT or (number == len(places) and not listening):
                for opened in listening:
                    close(opened)
                raise
    return listening


def _remove_unused(file: str) -> None:
    """Remove a Unix socket that a killed gateway has left. Raises OSError if a program listens on the socket."""
    with socket.socket(socket.AF_UNIX) as probe:
        probe.setblocking(False)
        if probe.connect_ex(file) != errno.ECONNREFUSED:
            raise OSError(errno.EADDRINUSE, os.strerror(errno.EADDRINUSE), file)
    os.unlink(file)


def close(listening: socket.socket) -> None:
    """Stop listening, and remove the file of a Unix socket."""
    if listening.family == socket.AF_UNIX:
        with contextlib.suppress(OSError):  # the file or its folder has been deleted
            os.unlink(listening.getsockname())
    listening.close()


_ABSENT = (errno.EADDRNOTAVAIL, errno.EAFNOSUPPORT)
"""Errors for an address that this machine does not have, such as that of localhost in IPv6 on a machine without it."""


def _listen(family: socket.AddressFamily, where: Any) -> socket.socket:
    opened = socket.socket(family)
    try:
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        opened.bind(where)
        if isinstance(where, str):
            Path(where).chmod(SOCKET_MODE)
        opened.listen(socket.SOMAXCONN)
        opened.setblocking(False)
    except OSError:
        opened.close()
        raise
    return opened


def source(connected: socket.socket, address: object) -> str:
    """Return the source of a connection: the address of the peer or, for a Unix socket, the process id of the peer."""
    if connected.family == socket.AF_UNIX:
        credentials = connected.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
        return str(struct.unpack("3i", credentials)[0])
    return str(address[0]) if isinstance(address, tuple) else ""
