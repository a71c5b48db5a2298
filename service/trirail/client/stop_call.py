"""Stop sent in two ways in parallel, to the service's stop port and over Zenoh; the first reply counts.

Both copies have the same id, so the service carries out the stop once. A separate thread connects to the stop port, and
tries again if the port closes the connection without a reply, as it may under a flood.
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
from trirail.wire.credentials import Credentials
from trirail.wire.decoding import decoded
from trirail.wire.messages import CommandReply, ErrorReply
from trirail.wire.stop_protocol import MAX_LINE, StopAddress, StopAnswer, StopRequest, encode, stop_address

HEARD_WITHIN: Final = 2.0
"""Time-out of a connection to the stop port before another attempt [s]."""
AGAIN_AFTER: Final = 0.05
"""Delay between two attempts [s]."""

Outcome = CommandReply | TrirailError


class NoDoorError(ServiceError):
    """Raised when a stop gets no reply at the stop port."""


class StopOrder(NamedTuple):
    """Stop, quick_stop or disable to send, with the content of each copy."""

    robot: str
    user: str
    name: str
    content: bytes | None
    within: float
    """Time-out for carrying it out [s]."""
    id: str
    """Id shared by both copies, so that the service carries the stop out once."""

    @classmethod
    def create(cls, robot: str, user: str, name: str, content: bytes | None, within: float) -> StopOrder:
        """Return a stop with a new id."""
        return cls(robot, user, name, content, within, uuid.uuid4().hex)

    @property
    def parts(self) -> tuple[str, str, str]:
        """Parts of the key over Zenoh."""
        return "cmd", self.user, self.name

    def at_door(
        self, locator: str, credentials: Credentials | None, deliver: Callable[[Outcome], None]
    ) -> StopCall | None:
        """Send the stop to the stop port of a locator, and deliver the outcome; return None if it has no port."""
        address = stop_address(locator)
        content = (self.content or b"").decode()
        line = encode(StopRequest(zenoh_session.key(self.robot, *self.parts), self.id, content))
        if address is None or len(line) > MAX_LINE:
            return None
        return StopCall(address, credentials, line, self.within, deliver)


class Outcomes:
    """Collector of the outcomes of a stop's copies."""

    def __init__(self, copies: int) -> None:
        self._copies = copies
        self._errors: list[TrirailError] = []

    def decide(self, outcome: Outcome) -> CommandReply | None:
        """Add an outcome; return the reply, or None while another copy may still bring one.

        Raises RefusedError or ServiceError if no copy got a reply. A refusal as busy does not count while another copy
        is pending.
        """
        if isinstance(outcome, CommandReply):
            return outcome
        if isinstance(outcome, RefusedError) and outcome.code is not RefusalCode.BUSY:
            raise outcome
        self._errors.append(outcome)
        if len(self._errors) < self._copies:
            return None
        raise min(self._errors, key=lambda error: (isinstance(error, NoDoorError), isinstance(error, ServiceError)))


class StopCall:
    """Stop sent to the stop port of a locator; a thread delivers the outcome once."""

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
        self._thread = threading.Thread(target=self._run, name="stop at the door", daemon=True)
        self._thread.start()

    def join(self) -> None:
        """Wait until the outcome has been delivered."""
        self._thread.join()

    def cancel(self) -> None:
        """Stop trying to reach the stop port."""
        self._cancelled.set()

    def _run(self) -> None:
        try:
            self._deliver(self._query_until_answered())
        except TrirailError as error:
            self._deliver(error)
        except Exception as error:  # noqa: BLE001 - the caller gets an outcome in any case
            self._deliver(NoDoorError(f"cannot send a stop to {self._address}: {error!r}"))

    def _query_until_answered(self) -> CommandReply:
        """Send the request until there is an answer. Raises RefusedError for a refusal, ServiceError for no answer."""
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
                why = error  # it closed the connection before reading the request
            except OSError as error:
                raise NoDoorError(f"no stop port answers at {self._address}: {error}") from error
            self._cancelled.wait(AGAIN_AFTER)
        raise NoDoorError(f"no answer from the stop port {self._address}: {why}")

    def _try(self, secured: ssl.SSLContext | None, left: float) -> CommandReply:
        with contextlib.ExitStack() as opened:
            connection = opened.enter_context(_connect(self._address, HEARD_WITHIN))
            if secured is not None and not isinstance(self._address.where, str):
                connection = opened.enter_context(
                    secured.wrap_socket(connection, server_hostname=self._address.where[0])
                )
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
    """Return the reply in an answer's line. Raises RefusedError for a refusal, NoDoorError for an invalid answer."""
    try:
        answer = decoded(line, StopAnswer)
    except (msgspec.MsgspecError, ValueError) as error:
        raise NoDoorError(f"the program at the stop port is not a service of trirail: {error}") from error
    if answer.reply is not None:
        return answer.reply
    no = answer.error or ErrorReply(RefusalCode.INTERNAL, "an empty answer")
    if no.code is RefusalCode.UNKNOWN_KEY:
        raise NoDoorError(f"the stop port belongs to another robot: {no.message}")
    raise RefusedError(no.code, no.message, slider=no.slider, value=no.value, limit=no.limit)
