"""Announcement that a service is starting, which clients on the same machine can see before the service listens.

The announcement is an abstract AF_UNIX name (unix(7)). An abstract name is not in a file system, is visible to every
user, and disappears when its process ends.
"""

from __future__ import annotations

import hashlib
import socket
from collections.abc import Iterable
from contextlib import suppress

from trirail.wire.endpoints import fault_of, is_local, socket_file, tcp_address


class Starting:
    """Announcement that a service is starting, until `up` is called or the process ends.

    `endpoints` are the endpoints on which the service will listen.
    """

    def __init__(self, endpoints: Iterable[str]) -> None:
        self._opened = [socket.socket(socket.AF_UNIX) for _ in endpoints]
        for opened, endpoint in zip(self._opened, endpoints, strict=True):
            with suppress(OSError):  # another service is starting on this endpoint
                opened.bind(_name(endpoint))
                opened.listen(1)

    def up(self) -> None:
        """Withdraw the announcement, even if a child process has inherited the sockets."""
        for opened in self._opened:
            with suppress(OSError):
                opened.shutdown(socket.SHUT_RDWR)
            opened.close()
        self._opened.clear()


def is_starting(endpoint: str) -> bool:
    """Return True if a service that will listen on an endpoint is starting on this machine."""
    if fault_of(endpoint) or not is_local(endpoint):
        return False
    with socket.socket(socket.AF_UNIX) as opened:
        opened.setblocking(False)
        try:
            opened.connect(_name(endpoint))
        except BlockingIOError:  # the name exists, but the queue of connecting clients is full
            return True
        except OSError:
            return False
    return True


def _name(endpoint: str) -> bytes:
    """Return the abstract name for an endpoint.

    The name depends only on the port or the file, since a service that listens on a wildcard address is also reached at
    other addresses.
    """
    address, file = tcp_address(endpoint), socket_file(endpoint)
    where = f"port {address[1]}" if address is not None else f"file {file}" if file is not None else endpoint
    return b"\0trirail-starting-" + hashlib.sha256(where.encode()).hexdigest().encode()
