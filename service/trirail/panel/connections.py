"""Connections to the panel's server, of which idle ones block neither new connections nor the shutdown."""

from __future__ import annotations

import contextlib
import resource
import socket
import threading
from collections.abc import Callable
from typing import Any

MAX_REQUESTS = 32
"""Maximum number of open connections that are not tabs; a new connection then replaces the oldest connection.

Browsers leave no such connection open.
"""
MAX_TABS = 16
"""Maximum number of tabs. In addition, tabs may use at most half of all connections."""
DESCRIPTORS_PER_CONNECTION = 4
"""Number of file descriptors for each connection: one for the connection, and three for the websockets library."""
RESERVED_DESCRIPTORS = 24
"""Number of file descriptors for the rest of the process, in addition to the descriptors that are open at the start."""
ACCEPT_DELAY_S = 0.1
"""Delay before the next attempt to accept a connection if the system had no descriptor or no memory [s]."""
CLOSE_TIMEOUT_S = 1.0
"""Time to wait until connections that are being closed have ended [s]."""


class Connections:
    """Acceptor of connections, which handles each connection in a separate thread.

    A client that opens silent connections, or uses all descriptors, does not prevent other clients from connecting.

    Parameters
    ----------
    listening
        Socket on which connections are accepted.
    handle
        Function that receives the socket and address of a connection, and closes the socket.
    refusal
        Bytes that are sent to a client before its connection is refused or replaced, if sending does not block.
    """

    def __init__(self, listening: socket.socket, handle: Callable[[socket.socket, Any], None], refusal: bytes) -> None:
        self._listening = listening
        self._handle = handle
        self._refusal = refusal
        self._requests: dict[socket.socket, None] = {}
        self._tabs: set[socket.socket] = set()
        self._changed = threading.Condition()
        self._closed = False
        limit, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
        left = limit - listening.fileno() - RESERVED_DESCRIPTORS  # the system assigns the lowest free descriptor
        self._max_connections = max(2, min(MAX_REQUESTS + MAX_TABS, left // DESCRIPTORS_PER_CONNECTION))

    def accept(self) -> None:
        """Accept connections until `close` is called."""
        while True:
            try:
                connection, address = self._listening.accept()
            except OSError:  # accept(2): no descriptor, no memory, or the client has disconnected
                if self._closed:
                    return
                self._make_room()
                with self._changed:
                    self._changed.wait(ACCEPT_DELAY_S)
                continue
            full = len(self._requests) + len(self._tabs) >= self._max_connections
            if (full and not self._make_room()) or not self._begin(connection, address):
                self._refuse(connection)
                connection.close()

    def make_tab(self, connection: socket.socket) -> bool:
        """Mark a connection as a tab, which is never replaced. Return False if there are too many tabs already."""
        with self._changed:
            if len(self._tabs) >= min(MAX_TABS, self._max_connections // 2) or connection not in self._requests:
                return False
            del self._requests[connection]
            self._tabs.add(connection)
            return True

    def close(self) -> None:
        """Stop accepting connections, close all connections, and wait up to CLOSE_TIMEOUT_S until they have ended."""
        with self._changed:
            self._closed = True
            for ended in (self._listening, *self._requests, *self._tabs):
                with contextlib.suppress(OSError):
                    ended.shutdown(socket.SHUT_RDWR)
            self._changed.wait_for(lambda: not (self._requests or self._tabs), CLOSE_TIMEOUT_S)
        self._listening.close()

    def _begin(self, connection: socket.socket, address: object) -> bool:
        """Start a thread that handles a connection. Return True if the thread was started."""
        with self._changed:
            if self._closed:
                return False
            self._requests[connection] = None
        try:
            threading.Thread(target=self._serve, args=(connection, address), name="connection", daemon=True).start()
        except RuntimeError:  # no more threads can be started
            self._forget(connection)
            return False
        return True

    def _serve(self, connection: socket.socket, address: object) -> None:
        try:
            self._handle(connection, address)
        finally:
            self._forget(connection)

    def _forget(self, connection: socket.socket) -> None:
        with self._changed:
            self._requests.pop(connection, None)
            self._tabs.discard(connection)
            self._changed.notify_all()

    def _make_room(self) -> bool:
        """Close the oldest connection that is not a tab, and wait until it has ended.

        Return False if all connections are tabs.
        """
        with self._changed:
            eldest = next(iter(self._requests), None)
            if eldest is None:
                return False
            self._refuse(eldest)
            self._changed.wait_for(lambda: eldest not in self._requests, CLOSE_TIMEOUT_S)
            self._requests.pop(eldest, None)
            return True

    def _refuse(self, connection: socket.socket) -> None:
        with contextlib.suppress(OSError):
            connection.send(self._refusal, socket.MSG_DONTWAIT)
        with contextlib.suppress(OSError):
            connection.shutdown(socket.SHUT_RDWR)
