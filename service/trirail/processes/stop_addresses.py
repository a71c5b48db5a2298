"""The sockets that the door for stops listens on, and from where a connection to one comes."""

from __future__ import annotations

import socket
import struct
from pathlib import Path
from typing import Any

from trirail.errors import ServiceError
from trirail.wire.stop_door import StopAddress


def listen(address: StopAddress) -> list[socket.socket]:
    """Listen at every address that a host's name stands for. Raises ServiceError where that cannot be."""
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
            opened.listen(socket.SOMAXCONN)
            opened.setblocking(False)
    except OSError as error:
        for opened in listening:
            opened.close()
        raise ServiceError(
            f"cannot listen for stops at {address}, beside zenoh.listen: {(error.strerror or str(error)).lower()}; "
            "another service may hold it: end that, or set zenoh.listen to another address"
        ) from error
    return listening


def source(connected: socket.socket, address: object) -> str:
    """Return whose share a connection is of: its address, or the process at the other end of a Unix socket."""
    if connected.family == socket.AF_UNIX:
        credentials = connected.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
        return str(struct.unpack("3i", credentials)[0])
    return str(address[0]) if isinstance(address, tuple) else ""
