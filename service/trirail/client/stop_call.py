"""Stop that is sent in parallel to the service's stop port and over Zenoh; the first reply counts.

Both copies have the same id, so the service carries out the stop once. A separate thread connects to the stop port, and
tries again if the port closes the connection without a reply, which may happen when the port is flooded.
"""

from __future__ import annotations

import contextlib
import socket
import ssl
import threading
import time
import uuid
from collections.abc import Callable
from typing import Final, NamedTuple

import msgspec

from trirail.errors import RefusalCode, RefusedError, ServiceError, TrirailError
from trirail.wire import tls, zenoh_session
from trirail.wire.call_mark import CallMark
from trirail.wire.credentials import Credentials
from trirail.wire.decoding import decoded
from trirail.wire.messages import CommandReply, ErrorReply
from trirail.wire.stop_protocol import MAX_LINE, StopAddress, StopAnswer, StopRequest, encode, stop_address

HEARD_WITHIN: Final = 2.0
"""Time-out of one attempt to connect to the stop port [s]."""
AGAIN_AFTER: Final = 0.05
"""Delay between two attempts to connect [s]."""

Outcome = CommandReply | TrirailError


class StopPortError(ServiceError):
    """Error raised if a stop gets no reply from the stop port."""


class StopOrder(NamedTuple):
    """Content of a stop, quick_stop or disable, shared by both copies."""

    robot: str
    user: str
    name: str
    content: bytes | None
    within: float
    """Time within which the service must carry the command out [s]."""
    id: str
    """Id by which the service recognizes the two copies as the same stop."""

    @classmethod
    def create(
        cls, robot: str, user: str, name: str, content: bytes | None, within: float, mark: CallMark | None = None
    ) -> StopOrder:
        """Return a stop with a new id, which shows the call of the stop if there is a `mark`."""
        return cls(robot, user, name, content, within, uuid.uuid4().hex if mark is None else mark.new_id())

    @property
    def parts(self) -> tuple[str, str, str]:
        """Parts of the Zenoh key of the command."""
        return "cmd", self.user, self.name

    def at_door(
        self, locator: str, credentials: Credentials | None, deliver: Callable[[Outcome], None]
    ) -> StopCall | None:
        """Send the stop to the stop port that belongs to a locator, and pass the outcome to `deliver`.

        Return None, without sending, if the locator has no stop port, the message is too long for the port, or the
        process can start no thread. The stop must then be sent over Zenoh only.
        """
        address = stop_address(locator)
        content = (self.content or b"").decode(errors="replace")
        line = encode(StopRequest(zenoh_session.key(self.robot, *self.parts), self.id, content))
        if address is None or len(line) > MAX_LINE:
            return None
        try:
            return StopCall(address, credentials, line, self.within, deliver)
        except RuntimeError:  # no memory or process is left for a thread, or the interpreter ends
            return None


class Outcomes:
    """Collector of the outcomes of a stop's copies."""

    def __init__(self, copies: int) -> None:
        self._copies = copies
        self._errors: list[TrirailError] = []

    def decide(self, outcome: Outcome) -> CommandReply | None:
        """Add the outcome of one copy; return the reply, or None if this copy failed and another copy is pending.

        Raises RefusedError if the service refuses the stop, except with code BUSY while another copy is pending. Raises
        the most informative error if all copies failed.
        """
        if isinstance(outcome, CommandReply):
            return outcome
        if isinstance(outcome, RefusedError) and outcome.code is not RefusalCode.BUSY:
            raise outcome
        self._errors.append(outcome)
        if len(self._errors) < self._copies:
            return None
        raise min(self._errors, key=lambda error: (isinstance(error, StopPortError), isinstance(error, ServiceError)))


class StopCall:
    """Stop that a thread sends to a stop port; the thread calls `deliver` once with the outcome."""

    def __init__(
        self,
        address: StopAddress,
        credentials: Credentials | None,
        line: bytes,
        within: float,
        deliver: Callable[[Outcome], None],
    ) -> None:
        self._address = address
        self._credentials = credentials
        self._line = line
        self._deadline = time.monotonic() + within
        self._deliver = deliver
        self._cancelled = threading.Event()
        self._thread = threading.Thread(target=self._run, name="stop at the port", daemon=True)
        self._thread.start()

    def join(self) -> None:
        """Wait until the outcome has been delivered."""
        self._thread.join()

    def cancel(self) -> None:
        """Do not send the stop any more, if it has not been sent yet."""
        self._cancelled.set()

    def _run(self) -> None:
        try:
            self._deliver(self._query_until_answered())
        except TrirailError as error:
            self._deliver(error)
        except Exception as error:  # noqa: BLE001 - the caller must get an outcome in any case
            self._deliver(StopPortError(f"cannot send a stop to {self._address}: {error!r}"))

    def _query_until_answered(self) -> CommandReply:
        """Send the request repeatedly until a reply arrives; return the reply.

        Raises RefusedError if the service refuses, and StopPortError if no reply arrives in time.
        """
        secured = tls.client(self._credentials) if self._address.secured and self._credentials is not None else None
        why: OSError | None = None
        while (left := self._deadline - time.monotonic()) > 0.0 and not self._cancelled.is_set():
            try:
                return self._try(secured, left)
            except (
                ConnectionResetError,
                BrokenPipeError,
                TimeoutError,
                ssl.SSLEOFError,
                ssl.SSLZeroReturnError,
            ) as error:
                why = error  # the port has closed the connection without a reply
            except OSError as error:
                raise StopPortError(f"no stop port answers at {self._address}: {error}") from error
            self._cancelled.wait(AGAIN_AFTER)
        raise StopPortError(f"no answer from the stop port {self._address}: {why}")

    def _try(self, secured: ssl.SSLContext | None, left: float) -> CommandReply:
        with contextlib.ExitStack() as opened:
            connection = opened.enter_context(_connect(self._address, HEARD_WITHIN))
            if secured is not None and not isinstance(self._address.where, str):
                connection = opened.enter_context(
                    secured.wrap_socket(connection, server_hostname=self._address.where[0])
                )
            if self._cancelled.is_set():  # the stop is confirmed, and the robot may move again
                raise StopPortError("the stop is cancelled")
            connection.sendall(self._line)
            connection.settimeout(left)
            heard = b""
            while not heard.endswith(b"\n") and len(heard) <= MAX_LINE:
                if not (more := connection.recv(MAX_LINE)):
                    raise ConnectionResetError("the service has closed the connection")
                heard += more
        return _read(heard)


def _connect(address: StopAddress, within: float) -> socket.socket:
    if not isinstance(address.where, str):
        return socket.create_connection(address.where, within)
    connection = socket.socket(socket.AF_UNIX)
    try:
        connection.settimeout(within)
        connection.connect(address.where)
    except OSError:
        connection.close()
        raise
    return connection


def _read(line: bytes) -> CommandReply:
    """Return the reply in a line from the stop port.

    Raises RefusedError if the service refuses, and StopPortError if the line is invalid or is from another robot.
    """
    try:
        answer = decoded(line, StopAnswer)
    except (msgspec.MsgspecError, ValueError) as error:
        raise StopPortError(f"the program at the stop port is not a service of trirail: {error}") from error
    if answer.reply is not None:
        return answer.reply
    no = answer.error or ErrorReply(RefusalCode.INTERNAL, "an empty answer")
    if no.code is RefusalCode.UNKNOWN_KEY:
        raise StopPortError(f"the stop port belongs to another robot: {no.message}")
    raise RefusedError(no.code, no.message, slider=no.slider, value=no.value, limit=no.limit)
