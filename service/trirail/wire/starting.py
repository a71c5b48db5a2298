"""A service that is starting, seen by clients on its own machine before it listens: by a name that its kernel keeps.

The name is an abstract one of AF_UNIX (unix(7)): in no file system, seen by every user, gone with its process.
"""

from __future__ import annotations

import hashlib
import socket
from collections.abc import Iterable
from contextlib import suppress

from trirail.wire.endpoints import fault_of, is_local, socket_file, tcp_address


class Starting:
    """Says that what will listen on some endpoints is starting, until it is up or its process ends."""

    def __init__(self, endpoints: Iterable[str]) -> None:
        self._opened = [socket.socket(socket.AF_UNIX) for _ in endpoints]
        for opened, endpoint in zip(self._opened, endpoints, strict=True):
            with suppress(OSError):  # another one is starting there
                opened.bind(_name(endpoint))
                opened.listen(1)

    def up(self) -> None:
        """Say it no longer; also where a process that was begun meanwhile has the sockets as well."""
        for opened in self._opened:
            with suppress(OSError):
                opened.shutdown(socket.SHUT_RDWR)
            opened.close()
        self._opened.clear()


def is_starting(endpoint: str) -> bool:
    """Whether a service is starting on this machine that will listen there."""
    if fault_of(endpoint) or not is_local(endpoint):
        return False
    with socket.socket(socket.AF_UNIX) as opened:
        opened.setblocking(False)
        try:
            opened.connect(_name(endpoint))
        except BlockingIOError:  # others have asked as well, and nobody reads it
            return True
        except OSError:
            return False
    return True


def _name(endpoint: str) -> bytes:
    """Return the name for an endpoint: that of its port or file, since one address may stand for others."""
    address, file = tcp_address(endpoint), socket_file(endpoint)
    where = f"port {address[1]}" if address is not None else f"file {file}" if file is not None else endpoint
    return b"\0trirail-starting-" + hashlib.sha256(where.encode()).hexdigest().encode()
