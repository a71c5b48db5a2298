"""Door for stops beside Zenoh's endpoints: a thread that does TLS and framing, and waits for no connection.

Handshakes run beside each other. Each connection has a share: by its address until its user is known, by the user's
name from then on; beyond the share its oldest connection is closed, so that a new one is served whatever others hold.
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

PLACES: Final = 4096
"""Most connections, or a quarter of the process's descriptors if that is less; they are reserved for them."""
ASKED_WITHIN: Final = 10.0
"""Longest time to send a request [s]: the shorter it is, the more connections an idle holder has to open."""
ANSWERED_WITHIN: Final = 20.0
"""Longest wait for the answer, which comes within 15 s [s]."""
TURN: Final = 0.25
"""Interval of the checks for connections whose time is over [s]."""
AT_ONCE: Final = 64
"""Connections accepted before the existing ones continue."""

IN_TURN: Final = 16
"""Connections that continue before new ones are accepted: a step of a handshake takes a millisecond."""

Answer = Callable[[CommandReply | ErrorReply], None]
"""Receiver of the answer to a request, from any thread."""
Take = Callable[[str, StopRequest, Answer], None]
"""Receiver of a request, with the name in its sender's certificate, "" without certificates."""


class _Stage(Enum):
    SILENT = auto()
    TALKING = auto()
    KNOWN = auto()
    WAITING = auto()


_SHARES: Final = {_Stage.SILENT: 1 / 2, _Stage.TALKING: 1 / 8, _Stage.KNOWN: 1 / 8, _Stage.WAITING: 1 / 64}
"""Shares of the places: connections of one address that are silent or in a handshake; of one user, before the request
and after it."""


class _Caller:
    """A connection."""

    def __init__(self, connection: socket.socket, source: str, now: float) -> None:
        self.connection = connection
        self.number = connection.fileno()
        self.stage, self.share = _Stage.SILENT, source
        self.since = now
        self.user = ""
        self.heard = b""
        self.shakes_hands = False


class StopDoor:
    """Server for stops at addresses, from `start` until it is closed."""

    def __init__(self, secured: ssl.SSLContext | None, take: Take) -> None:
        self._secured = secured
        self._take = take
        self._callers: dict[int, _Caller] = {}  # by descriptor
        self._shares: dict[tuple[_Stage, str], dict[_Caller, None]] = {}  # those first that are longest in it
        self._answers: deque[tuple[_Caller, bytes]] = deque()
        self._closing = False
        self._next_look = 0.0
        self._selector = selectors.DefaultSelector()
        self._wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._selector.register(self._wake, selectors.EVENT_READ, self._woken)
        self._listening: list[socket.socket] = []
        self._places = min(PLACES, descriptor_limit() // 4)
        self._reserve = Reserve(self._places)
        self._thread = threading.Thread(target=self._run, name="stop door", daemon=True)

    def listen(self, address: StopAddress) -> None:
        """Listen at an address, before the start. Raises OSError if that is impossible."""
        for listening in listen(address):
            self._listening.append(listening)
            self._selector.register(listening, selectors.EVENT_READ, partial(self._accept, listening))

    def start(self) -> None:
        """Begin to take requests."""
        self._thread.start()

    def close(self) -> None:
        """End; requests without an answer get none here."""
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
            ready = [key.data for key, _ in self._selector.select(TURN if self._callers else None)]
            for woken in ready:
                if not isinstance(woken, _Caller):
                    woken()
            callers = [each for each in ready if isinstance(each, _Caller)]
            # Of hundreds of handshakes first those nearest to their end, and of these the newest.
            callers.sort(key=lambda caller: (caller.stage.value, caller.since), reverse=True)
            for caller in callers[:IN_TURN]:
                self._go_on(caller)
            self._send_answers()
            self._drop_late()
        for caller in list(self._callers.values()):
            self._drop(caller)

    def _woken(self) -> None:
        with contextlib.suppress(BlockingIOError):
            os.eventfd_read(self._wake)

    # ------------------------------------------------------------------ accept and drop

    def _accept(self, listening: socket.socket) -> None:
        for _ in range(AT_ONCE):
            if not self._reserve and self._callers:
                self._drop(next(iter(self._callers.values())))
            if self._reserve:
                self._reserve.release()
            try:
                connected, address = listening.accept()
            except BlockingIOError:
                break
            except OSError:  # another thread took the descriptor where they are short, or the caller has gone
                continue
            connected.setblocking(False)
            caller = _Caller(connected, source(connected, address), time.monotonic())
            self._callers[caller.number] = caller
            self._shares.setdefault((caller.stage, caller.share), {})[caller] = None
            self._selector.register(caller.number, selectors.EVENT_READ, caller)
            self._go_on(caller)  # its request is often there already
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
        if len(share) > self._places * _SHARES[caller.stage]:
            self._drop(next(iter(share)))

    def _drop(self, caller: _Caller) -> None:
        """Close a connection, unless that has been done."""
        if self._callers.get(caller.number) is not caller:
            return
        del self._callers[caller.number]
        self._leave(caller)
        self._selector.unregister(caller.number)
        caller.connection.detach()
        self._reserve.close(caller.number)

    def _drop_late(self) -> None:
        now = time.monotonic()
        if now < self._next_look:
            return
        self._next_look = now + TURN
        for caller in list(self._callers.values()):
            within = ANSWERED_WITHIN if caller.stage is _Stage.WAITING else ASKED_WITHIN
            if now - caller.since > within:
                self._drop(caller)

    # ------------------------------------------------------------------ read and answer

    def _go_on(self, caller: _Caller) -> None:
        if self._callers.get(caller.number) is not caller:
            return
        try:
            self._listen_to(caller)
        except (BlockingIOError, ssl.SSLWantReadError):
            return
        except (OSError, ValueError):  # it has gone, has no good certificate, or does not speak TLS
            self._drop(caller)

    def _listen_to(self, caller: _Caller) -> None:
        """Continue as far as there is data. Raises BlockingIOError or SSLWantReadError if there is none."""
        if caller.stage is _Stage.SILENT:
            if not caller.connection.recv(1, socket.MSG_PEEK):
                raise ConnectionError
            if self._secured is not None:
                caller.connection = self._secured.wrap_socket(
                    caller.connection, server_side=True, do_handshake_on_connect=False
                )
                caller.shakes_hands = True
            self._enter(caller, _Stage.TALKING, caller.share)
        if caller.shakes_hands and isinstance(caller.connection, ssl.SSLSocket):
            caller.connection.do_handshake()
            caller.shakes_hands = False
            caller.user = tls.peer(caller.connection)
            self._enter(caller, _Stage.KNOWN, caller.user)
        while True:
            heard = caller.connection.recv(MAX_LINE)
            if not heard or caller.stage is _Stage.WAITING:  # it has gone, or sends more than one request
                raise ConnectionError
            caller.heard += heard
            line, ended, _ = caller.heard.partition(b"\n")
            if ended:
                self._pass_on(caller, line)
            elif len(caller.heard) > MAX_LINE:
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
        caller.heard = b""
        try:
            self._take(caller.user, request, answer)
        except RefusedError as refusal:
            answer(ErrorReply(refusal.code, quoted(str(refusal))))

    def _answer(self, caller: _Caller, content: CommandReply | ErrorReply) -> None:
        self._answers.append((caller, answer_with(content)))
        with contextlib.suppress(OSError):  # it is closed
            os.eventfd_write(self._wake, 1)

    def _send_answers(self) -> None:
        while self._answers:
            caller, line = self._answers.popleft()
            if self._callers.get(caller.number) is caller:
                with contextlib.suppress(OSError):  # it has gone, or reads nothing: no line is longer than its buffer
                    caller.connection.send(line)
                self._drop(caller)
