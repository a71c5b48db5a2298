"""The sockets that the door for stops listens on, and from where a connection to one comes."""

from __future__ import annotations

import socket
import struct
from pathlib import Path
from typing import Any

from trirail.wire.stop_protocol import StopAddress

SOCKET_MODE = 0o660
"""Of a Unix socket: its owner and its group may connect, which takes the right to write; nobody else."""


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
