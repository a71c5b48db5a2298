"""Connections to the panel's server: whoever holds some, the next one gets through, and the end waits for none."""

from __future__ import annotations

import contextlib
import resource
import socket
import threading
from collections.abc import Callable
from typing import Any

ASKING = 32
"""So many connections that are no tabs may be open: browsers hold none. The next one takes the place of the eldest."""
TABS = 16
"""So many tabs, and no more than half of all connections."""
EACH = 4
"""Descriptors of a connection: its own, three of websockets."""
SPARE = 24
"""Descriptors that are left for the rest of the process, beside those that it has at first."""
PAUSE = 0.1
"""Where the system has no descriptor or no memory for a connection, it is asked again after so long [s]."""
ENDING = 1.0
"""So long may connections take to end that are closed [s]."""


class Connections:
    """Accepts on a socket, and has each connection handled in a thread of its own, until it is closed.

    `handle` is given socket and address, and closes the socket; `refusal` is sent, if that does not wait, to who has to
    go. What holds a connection open that says nothing, or all of the process's descriptors, keeps nobody else away.
    """

    def __init__(self, listening: socket.socket, handle: Callable[[socket.socket, Any], None], refusal: bytes) -> None:
        self._listening = listening
        self._handle = handle
        self._refusal = refusal
        self._asking: dict[socket.socket, None] = {}
        self._tabs: set[socket.socket] = set()
        self._changed = threading.Condition()
        self._closed = False
        limit, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
        left = limit - listening.fileno() - SPARE  # descriptors are numbered from below
        self._most = max(2, min(ASKING + TABS, left // EACH))

    def accept(self) -> None:
        """Accept until it is closed."""
        while True:
            try:
                connection, address = self._listening.accept()
            except OSError:  # accept(2): no descriptor, no memory, or whoever asked has gone
                if self._closed:
                    return
                self._make_room()
                with self._changed:
                    self._changed.wait(PAUSE)
                continue
            full = len(self._asking) + len(self._tabs) >= self._most
            if (full and not self._make_room()) or not self._begin(connection, address):
                self._refuse(connection)
                connection.close()

    def keep(self, connection: socket.socket) -> bool:
        """Whether a connection may become a tab, which is never asked to go; it is one until it ends."""
        with self._changed:
            if len(self._tabs) >= min(TABS, self._most // 2) or connection not in self._asking:
                return False
            del self._asking[connection]
            self._tabs.add(connection)
            return True

    def close(self) -> None:
        """Accept no more, end all there are, and wait for them a while."""
        with self._changed:
            self._closed = True
            for ended in (self._listening, *self._asking, *self._tabs):
                with contextlib.suppress(OSError):
                    ended.shutdown(socket.SHUT_RDWR)
            self._changed.wait_for(lambda: not (self._asking or self._tabs), ENDING)
        self._listening.close()

    def _begin(self, connection: socket.socket, address: object) -> bool:
        """Have a connection handled; return whether that could begin."""
        with self._changed:
            if self._closed:
                return False
            self._asking[connection] = None
        try:
            threading.Thread(target=self._serve, args=(connection, address), name="connection", daemon=True).start()
        except RuntimeError:  # no more threads
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
            self._asking.pop(connection, None)
            self._tabs.discard(connection)
            self._changed.notify_all()

    def _make_room(self) -> bool:
        """Have the eldest go that is no tab, and wait until it has gone; return whether there was one."""
        with self._changed:
            eldest = next(iter(self._asking), None)
            if eldest is None:
                return False
            self._refuse(eldest)
            self._changed.wait_for(lambda: eldest not in self._asking, ENDING)
            self._asking.pop(eldest, None)
            return True

    def _refuse(self, connection: socket.socket) -> None:
        with contextlib.suppress(OSError):
            connection.send(self._refusal, socket.MSG_DONTWAIT)
        with contextlib.suppress(OSError):
            connection.shutdown(socket.SHUT_RDWR)
