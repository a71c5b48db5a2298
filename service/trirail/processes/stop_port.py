"""Stop port, a server that accepts only stops, in addition to Zenoh's endpoints.

The server runs in a thread with an event loop, and each connection has its own task. TLS is used directly on the
sockets instead of with asyncio's streams. A stream would need a buffer of 256 KB per connection, which is too much in a
flood of connections, and would close the descriptor later than the reserve of descriptors needs it.

Each source may use only a share of the connections. A source is an address until the user is known, and afterwards the
user. When a source exceeds its share, its oldest connection is closed. A flood from one source therefore does not block
other sources.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
import ssl
import threading
from collections.abc import Callable
from enum import Enum, auto
from typing import Final, TypeVar

from trirail.errors import RefusalCode, RefusedError
from trirail.processes.sockets import Reserve, close, descriptor_limit, listen, source
from trirail.wire import tls
from trirail.wire.decoding import INVALID, decoded
from trirail.wire.messages import CommandReply, ErrorReply
from trirail.wire.stop_protocol import MAX_LINE, StopAddress, StopRequest, answer_with, request_without_content
from trirail.wire.text import quoted

MAX_CALLERS: Final = 4096
"""Maximum number of connections, whose descriptors are reserved.

The number is also limited to a quarter of the process's descriptors.
"""
REQUEST_TIMEOUT_S: Final = 10.0
"""Maximum time to wait for the request of a connection [s].

With a shorter time, a flood of idle connections would cost more processor time.
"""
ANSWER_TIMEOUT_S: Final = 20.0
"""Maximum time to wait for the answer to a request [s]. Normally, the answer arrives within 15 s."""
ACCEPTED_PER_TURN: Final = 64
"""Maximum number of connections that are accepted before existing connections are served."""

T = TypeVar("T")
Answer = Callable[[CommandReply | ErrorReply], None]
"""Function that sends the answer to a request. It may be called from any thread."""
RequestHandler = Callable[[str, StopRequest, Answer], None]
"""Function that handles a request, given the name in the sender's certificate; "" if certificates are not used."""


class _Stage(Enum):
    SILENT = auto()
    TALKING = auto()
    KNOWN = auto()
    WAITING = auto()


_SHARES: Final = {_Stage.SILENT: 1 / 2, _Stage.TALKING: 1 / 8, _Stage.KNOWN: 1 / 8, _Stage.WAITING: 1 / 64}
"""Share of all connections that one source may use, by the stage of the connection.

The source is an address while the connection is silent and during the handshake. It is a user before and after the
request.
"""


class _Caller:
    """Connection of a client, with the task that serves the connection and the share in which it is counted."""

    def __init__(self, connection: socket.socket, source: str) -> None:
        self.connection = connection
        self.number = connection.fileno()
        self.stage, self.share = _Stage.SILENT, source
        self.task: asyncio.Task[None] | None = None
        self.readable = asyncio.Event()


class StopPort:
    """Server of the stop port. `start` begins to serve requests, and `close` ends the server."""

    def __init__(self, secured: ssl.SSLContext | None, handle_request: RequestHandler) -> None:
        self._secured = secured
        self._handle_request = handle_request
        self._callers: dict[_Caller, None] = {}  # from the oldest to the newest connection
        self._shares: dict[tuple[_Stage, str], dict[_Caller, None]] = {}  # connections in the order of joining
        self._listening: list[socket.socket] = []
        self._max_callers = min(MAX_CALLERS, descriptor_limit() // 4)
        self._reserve = Reserve(self._max_callers)
        self._loop = asyncio.new_event_loop()
        self._closing = asyncio.Event()
        self._thread = threading.Thread(target=self._run, name="stop port", daemon=True)

    def listen(self, address: StopAddress) -> None:
        """Listen on an address. Call this method before `start`. Raises OSError if that is impossible."""
        self._listening += listen(address)

    def start(self) -> None:
        """Begin to accept and serve requests."""
        self._thread.start()

    def close(self) -> None:
        """Close the server. Requests that have not been answered receive no answer on the stop port."""
        self._loop.call_soon_threadsafe(self._closing.set)
        self._thread.join()
        self._reserve.end()

    def _run(self) -> None:
        with contextlib.closing(self._loop):
            self._loop.run_until_complete(self._serve())

    async def _serve(self) -> None:
        for listening in self._listening:
            self._loop.add_reader(listening, self._accept, listening)
        await self._closing.wait()
        for listening in self._listening:
            self._loop.remove_reader(listening)
            close(listening)
        tasks = [caller.task for caller in self._callers if caller.task is not None]
        for caller in list(self._callers):
            self._drop(caller)
        await asyncio.gather(*tasks, return_exceptions=True)

    # ------------------------------------------------------------------ accept and drop

    def _accept(self, listening: socket.socket) -> None:
        for _ in range(ACCEPTED_PER_TURN):
            if not self._reserve and self._callers:
                self._drop(next(iter(self._callers)))
            if self._reserve:
                self._reserve.release()
            try:
                connected, address = listening.accept()
            except BlockingIOError:
                break
            except OSError:  # no descriptor is left, or the client has disconnected
                continue
            connected.setblocking(False)
            caller = _Caller(connected, source(connected, address))
            self._callers[caller] = None
            self._count(caller)
            caller.task = self._loop.create_task(self._attend(caller))
            self._loop.add_reader(caller.number, caller.readable.set)
        self._reserve.refill(len(self._callers))

    def _enter(self, caller: _Caller, stage: _Stage, share: str) -> None:
        """Move a connection to another stage, in which it is counted for the source `share`."""
        self._discount(caller)
        caller.stage, caller.share = stage, share
        self._count(caller)

    def _count(self, caller: _Caller) -> None:
        share = self._shares.setdefault((caller.stage, caller.share), {})
        share[caller] = None
        if len(share) > self._max_callers * _SHARES[caller.stage]:
            self._drop(next(iter(share)))

    def _discount(self, caller: _Caller) -> None:
        share = self._shares.get((caller.stage, caller.share), {})
        share.pop(caller, None)
        if not share:
            self._shares.pop((caller.stage, caller.share), None)

    def _drop(self, caller: _Caller) -> None:
        """Close a connection, unless it is already closed."""
        if caller not in self._callers:
            return
        del self._callers[caller]
        self._discount(caller)
        self._loop.remove_reader(caller.number)
        caller.connection.detach()
        self._reserve.close(caller.number)
        if caller.task is not None:
            caller.task.cancel()

    # ------------------------------------------------------------------ one connection

    async def _attend(self, caller: _Caller) -> None:
        """Serve a connection until it is closed."""
        try:
            async with asyncio.timeout(REQUEST_TIMEOUT_S) as timeout:
                line, user = await self._request(caller)
                timeout.reschedule(self._loop.time() + ANSWER_TIMEOUT_S)
                answer = await self._answer(caller, user, line)
            self._check_open(caller)
            caller.connection.send(answer_with(answer))  # no line is longer than the socket's buffer
        except (OSError, ValueError):  # the client has disconnected, or sent an invalid request or certificate
            pass
        finally:
            caller.task = None
            self._drop(caller)

    async def _request(self, caller: _Caller) -> tuple[bytes, str]:
        """Receive the line with the request, and return it with the name in the client's certificate.

        Raises OSError or ValueError if that fails.
        """
        await caller.readable.wait()  # do not begin a handshake on a silent connection
        user = ""
        self._enter(caller, _Stage.TALKING, caller.share)
        if self._secured is not None:
            caller.connection = secured = self._secured.wrap_socket(
                caller.connection, server_side=True, do_handshake_on_connect=False
            )
            await self._when_readable(caller, secured.do_handshake)
            user = tls.peer(secured)
            self._enter(caller, _Stage.KNOWN, user)
        heard = b""
        while b"\n" not in heard and len(heard) <= MAX_LINE:
            data = await self._receive(caller)
            if not data and not heard:
                raise ConnectionError
            if not data:  # the client has finished sending, so the line is complete
                break
            heard += data
        return heard.partition(b"\n")[0], user

    async def _receive(self, caller: _Caller) -> bytes:
        """Return the next data from a connection; b"" if the client sends no more, but may still read."""
        data = await self._when_readable(caller, lambda: caller.connection.recv(MAX_LINE))
        if not data:
            self._loop.remove_reader(caller.number)  # the connection remains readable
        return data

    async def _when_readable(self, caller: _Caller, act: Callable[[], T]) -> T:
        """Try an action each time the connection becomes readable, until it succeeds; return the result."""
        while True:
            self._check_open(caller)
            caller.readable.clear()
            try:
                return act()
            except (BlockingIOError, ssl.SSLWantReadError):
                await caller.readable.wait()

    def _check_open(self, caller: _Caller) -> None:
        """Raise ConnectionError if a connection has been closed.

        OpenSSL would continue to use the number of the connection's descriptor, which may now be that of a newer
        connection.
        """
        if caller not in self._callers:
            raise ConnectionError

    async def _answer(self, caller: _Caller, user: str, line: bytes) -> CommandReply | ErrorReply:
        """Forward a request and return the answer.

        The sender of an invalid line whose key names a stop wants to stop the robot. The stop is carried out as if it
        had no content, and the answer is an error. Raises OSError if the connection breaks or the client sends further
        data before the answer.
        """
        problem = ""
        try:
            request = decoded(line, StopRequest)
        except INVALID as error:
            problem = quoted(f"not a valid stop request: {error}")
            readable = request_without_content(line)
            if readable is None:
                return ErrorReply(RefusalCode.MALFORMED, problem)
            request = readable
        self._enter(caller, _Stage.WAITING, user or str(request.key.split("/")[3:4]))
        answered: asyncio.Future[CommandReply | ErrorReply] = self._loop.create_future()

        def finish(content: CommandReply | ErrorReply) -> None:
            if not answered.done():
                answered.set_result(content)

        def answer(content: CommandReply | ErrorReply) -> None:
            with contextlib.suppress(RuntimeError):  # the stop port is closed
                self._loop.call_soon_threadsafe(finish, content)

        try:
            self._handle_request(user, request, answer)
        except RefusedError as refusal:
            return ErrorReply(refusal.code, quoted(str(refusal)))
        more = self._loop.create_task(self._receive(caller))
        try:
            await asyncio.wait((answered, more), return_when=asyncio.FIRST_COMPLETED)
            if not answered.done() and more.result():
                raise ConnectionError
            reply = await answered
        finally:
            more.cancel()
            await asyncio.gather(more, return_exceptions=True)
        if problem and isinstance(reply, CommandReply):
            return ErrorReply(RefusalCode.MALFORMED, f"{problem}; {reply.command} is carried out nevertheless")
        return reply
