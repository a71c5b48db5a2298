"""Door for stops: a server beside Zenoh's endpoints that accepts only stops, in a thread that never blocks.

Handshakes run concurrently. Each source has a share of the connections: an address until the user is known, the user
from then on. Beyond the share its oldest connection is closed, so that a flood from one source keeps no other out.
"""

from __future__ import annotations

import contextlib
import os
import selectors
import socket
import ssl
import threading
import time
from collections import deque
from collections.abc import Callable
from enum import Enum, auto
from functools import partial
from typing import Final

import msgspec

from trirail.errors import RefusalCode, RefusedError
from trirail.processes.sockets import Reserve, descriptor_limit, listen, source
from trirail.wire import tls
from trirail.wire.decoding import decoded
from trirail.wire.messages import CommandReply, ErrorReply
from trirail.wire.stop_protocol import MAX_LINE, StopAddress, StopRequest, answer_with
from trirail.wire.text import quoted

MAX_CALLERS: Final = 4096
"""Most connections, or a quarter of the process's descriptors if that is less; the descriptors are reserved."""
REQUEST_TIMEOUT_S: Final = 10.0
"""Longest time until a connection has sent its request [s]; a shorter one makes idle floods more expensive."""
ANSWER_TIMEOUT_S: Final = 20.0
"""Longest wait for the answer, which comes within 15 s [s]."""
CHECK_PERIOD_S: Final = 0.25
"""Interval between two checks for connections that have timed out [s]."""
ACCEPTED_PER_TURN: Final = 64
"""Most connections accepted before the existing ones are served."""

SERVED_PER_TURN: Final = 16
"""Most connections served before new ones are accepted: a step of a handshake takes a millisecond."""

Answer = Callable[[CommandReply | ErrorReply], None]
"""Receiver of the answer to a request, from any thread."""
RequestHandler = Callable[[str, StopRequest, Answer], None]
"""Receiver of a request, with the name in the sender's certificate; "" without certificates."""


class _Stage(Enum):
    SILENT = auto()
    TALKING = auto()
    KNOWN = auto()
    WAITING = auto()


_SHARES: Final = {_Stage.SILENT: 1 / 2, _Stage.TALKING: 1 / 8, _Stage.KNOWN: 1 / 8, _Stage.WAITING: 1 / 64}
"""Share of all connections per source: of one address while silent and in a handshake, of one user before the request
and after it."""


class _Caller:
    """Connection of a client."""

    def __init__(self, connection: socket.socket, source: str, now: float) -> None:
        self.connection = connection
        self.number = connection.fileno()
        self.stage, self.share = _Stage.SILENT, source
        self.since = now
        self.user = ""
        self.received = b""
        self.in_handshake = False


class StopDoor:
    """Server for stops; `start` begins to serve, `close` ends."""

    def __init__(self, secured: ssl.SSLContext | None, handle_request: RequestHandler) -> None:
        self._secured = secured
        self._handle_request = handle_request
        self._callers: dict[int, _Caller] = {}  # by descriptor
        self._shares: dict[tuple[_Stage, str], dict[_Caller, None]] = {}  # the longest in its stage first
        self._answers: deque[tuple[_Caller, bytes]] = deque()
        self._closing = False
        self._next_check = 0.0
        self._selector = selectors.DefaultSelector()
        self._wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._selector.register(self._wake, selectors.EVENT_READ, self._clear_wake)
        self._listening: list[socket.socket] = []
        self._max_callers = min(MAX_CALLERS, descriptor_limit() // 4)
        self._reserve = Reserve(self._max_callers)
        self._thread = threading.Thread(target=self._run, name="stop door", daemon=True)

    def listen(self, address: StopAddress) -> None:
        """Listen at an address, before `start`. Raises OSError on failure."""
        for listening in listen(address):
            self._listening.append(listening)
            self._selector.register(listening, selectors.EVENT_READ, partial(self._accept, listening))

    def start(self) -> None:
        """Begin to serve."""
        self._thread.start()

    def close(self) -> None:
        """Stop serving; requests not answered yet get no answer."""
        self._closing = True
        os.eventfd_write(self._wake, 1)
        self._thread.join()
        for listening in self._listening:
            listening.close()
        self._selector.close()
        os.close(self._wake)
        self._reserve.end()

    def _run(self) -> None:
        while not self._closing:
            ready = [key.data for key, _ in self._selector.select(CHECK_PERIOD_S if self._callers else None)]
            for woken in ready:
                if not isinstance(woken, _Caller):
                    woken()
            callers = [each for each in ready if isinstance(each, _Caller)]
            # Serve handshakes nearest to their end first, and of these the newest, so that some finish under a flood.
            callers.sort(key=lambda caller: (caller.stage.value, caller.since), reverse=True)
            for caller in callers[:SERVED_PER_TURN]:
                self._serve(caller)
            self._send_answers()
            self._drop_late()
        for caller in list(self._callers.values()):
            self._drop(caller)

    def _clear_wake(self) -> None:
        with contextlib.suppress(BlockingIOError):
            os.eventfd_read(self._wake)

    # ------------------------------------------------------------------ accept and drop

    def _accept(self, listening: socket.socket) -> None:
        for _ in range(ACCEPTED_PER_TURN):
            if not self._reserve and self._callers:
                self._drop(next(iter(self._callers.values())))
            if self._reserve:
                self._reserve.release()
            try:
                connected, address = listening.accept()
            except BlockingIOError:
                break
            except OSError:  # another thread has used the free descriptor, or the caller has disconnected
                continue
            connected.setblocking(False)
            caller = _Caller(connected, source(connected, address), time.monotonic())
            self._callers[caller.number] = caller
            self._shares.setdefault((caller.stage, caller.share), {})[caller] = None
            self._selector.register(caller.number, selectors.EVENT_READ, caller)
            self._serve(caller)  # its request has often arrived already
            self._keep_to_share(caller)
        self._reserve.refill(len(self._callers))

    def _enter(self, caller: _Caller, stage: _Stage, share: str) -> None:
        self._leave(caller)
        caller.stage, caller.share = stage, share
        self._shares.setdefault((stage, share), {})[caller] = None
        self._keep_to_share(caller)

    def _leave(self, caller: _Caller) -> None:
        share = self._shares[caller.stage, caller.share]
        del share[caller]
        if not share:
            del self._shares[caller.stage, caller.share]

    def _keep_to_share(self, caller: _Caller) -> None:
        share = self._shares.get((caller.stage, caller.share), {})
        if len(share) > self._max_callers * _SHARES[caller.stage]:
            self._drop(next(iter(share)))

    def _drop(self, caller: _Caller) -> None:
        """Close a connection, unless it is closed already."""
        if self._callers.get(caller.number) is not caller:
            return
        del self._callers[caller.number]
        self._leave(caller)
        self._selector.unregister(caller.number)
        caller.connection.detach()
        self._reserve.close(caller.number)

    def _drop_late(self) -> None:
        now = time.monotonic()
        if now < self._next_check:
            return
        self._next_check = now + CHECK_PERIOD_S
        for caller in list(self._callers.values()):
            within = ANSWER_TIMEOUT_S if caller.stage is _Stage.WAITING else REQUEST_TIMEOUT_S
            if now - caller.since > within:
                self._drop(caller)

    # ------------------------------------------------------------------ read and answer

    def _serve(self, caller: _Caller) -> None:
        if self._callers.get(caller.number) is not caller:
            return
        try:
            self._listen_to(caller)
        except (BlockingIOError, ssl.SSLWantReadError):
            return
        except (OSError, ValueError):  # disconnected, no valid certificate, or no TLS
            self._drop(caller)

    def _listen_to(self, caller: _Caller) -> None:
        """Advance a connection as far as data has arrived. Raises BlockingIOError or SSLWantReadError for no data."""
        if caller.stage is _Stage.SILENT:
            if not caller.connection.recv(1, socket.MSG_PEEK):
                raise ConnectionError
            if self._secured is not None:
                caller.connection = self._secured.wrap_socket(
                    caller.connection, server_side=True, do_handshake_on_connect=False
                )
                caller.in_handshake = True
            self._enter(caller, _Stage.TALKING, caller.share)
        if caller.in_handshake and isinstance(caller.connection, ssl.SSLSocket):
            caller.connection.do_handshake()
            caller.in_handshake = False
            caller.user = tls.peer(caller.connection)
            self._enter(caller, _Stage.KNOWN, caller.user)
        while True:
            data = caller.connection.recv(MAX_LINE)
            if not data or caller.stage is _Stage.WAITING:  # disconnected, or a second request
                raise ConnectionError
            caller.received += data
            line, ended, _ = caller.received.partition(b"\n")
            if ended:
                self._pass_on(caller, line)
            elif len(caller.received) > MAX_LINE:
                raise ConnectionError

    def _pass_on(self, caller: _Caller, line: bytes) -> None:
        answer = partial(self._answer, caller)
        try:
            request = decoded(line, StopRequest)
        except (msgspec.MsgspecError, ValueError, RecursionError) as error:
            answer(ErrorReply(RefusalCode.MALFORMED, quoted(f"not a stop: {error}")))
            return
        user = caller.user or request.key.split("/")[3:4]
        self._enter(caller, _Stage.WAITING, str(user))
        caller.received = b""
        try:
            self._handle_request(caller.user, request, answer)
        except RefusedError as refusal:
            answer(ErrorReply(refusal.code, quoted(str(refusal))))

    def _answer(self, caller: _Caller, content: CommandReply | ErrorReply) -> None:
        self._answers.append((caller, answer_with(content)))
        with contextlib.suppress(OSError):  # the door is closed
            os.eventfd_write(self._wake, 1)

    def _send_answers(self) -> None:
        while self._answers:
            caller, line = self._answers.popleft()
            if self._callers.get(caller.number) is caller:
                with contextlib.suppress(OSError):  # disconnected, or not reading: a line fits into the socket's buffer
                    caller.connection.send(line)
                self._drop(caller)
