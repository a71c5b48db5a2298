"""Zenoh session of a client to the service of one robot, with queries and subscriptions."""

from __future__ import annotations

import contextlib
import math
import os
import threading
import time
import weakref
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from typing import Any, TypeVar

import msgspec
import zenoh
from zenoh.ext import AdvancedSubscriber, HistoryConfig, RecoveryConfig, declare_advanced_subscriber

from trirail.client.call_time import called_at
from trirail.client.outgoing import stops_everything
from trirail.client.samples import SampleReader
from trirail.client.stop_call import Outcome, Outcomes, StopOrder
from trirail.errors import RefusalCode, RefusedError, ServiceError, TrirailError
from trirail.wire import boundary, zenoh_session
from trirail.wire.access import least_role
from trirail.wire.call_mark import CallMark, new_connection
from trirail.wire.credentials import Credentials
from trirail.wire.messages import CommandReply, ErrorReply, Event, RoleReply
from trirail.wire.starting import is_starting
from trirail.wire.state import State
from trirail.wire.text import is_name, quoted
from trirail.wire.vocabulary import Command, Role

ROLE_WITHIN = 0.8
"""Time-out of the reply with a user's role [s]."""
REPLY_WITHIN = 20.0
"""Time-out for carrying out a command [s]."""
HERE_WITHIN = 1.0
"""Time-out of the reply with the connected users [s]."""
UNANSWERED_WITHIN = 2.0
"""Time within which a stop without a reply reaches the stop port; later, the robot may move again [s]."""
POST_WITHIN = 2.0
"""Time-out of the reply to a posted query [s]."""
CLOSED = "the connection is closed: open a new one, as Robot(…)"
FORKED = "the connection belongs to the process that opened it: open a new one in the forked process, as Robot(…)"
ZENOHS_TIMEOUT = b"Timeout"
"""Content of the error reply with which Zenoh ends a query after the query's time-out."""
MAX_OVERTAKEN_S = 1.0
"""Time after a reply or event during which the client discards older states [s].

Afterwards the client accepts every state, since a restarted service counts its states from one again."""

RECOVERY_PERIOD = timedelta(seconds=1.0)
"""Interval at which a client asks for the events that it has missed, such as the end of a goal.

The alternative is a subscription to the publisher's heartbeats. For each session of a client that had one, the gateway
kept 4 kB for as long as another client was connected (Zenoh 1.10.2)."""

T = TypeVar("T", bound=msgspec.Struct)
Message = TypeVar("Message")


class SilenceError(ServiceError):
    """Error raised if a query gets no reply."""


class Connection:
    """Session to a robot's service at a Zenoh locator.

    If `user` is given, all clients see this user among the connected users while the session is open. Raises
    ServiceError if the locator cannot be reached.
    """

    def __init__(
        self, robot: str, connect: str, credentials: Credentials | None = None, user: str | None = None
    ) -> None:
        self.robot = robot
        self._connect = connect
        self._credentials = credentials
        self._opened = zenoh_session.open_client(connect, credentials)
        # A finalizer also closes the session at the end of a program that does not call `close`. Zenoh's threads must
        # not outlive the interpreter.
        self.close = weakref.finalize(self, _close, self._opened, os.getpid())
        """End the session; calls after the first do nothing."""
        self._process = os.getpid()
        self._reader = SampleReader()
        self._known = 0, 0.0
        self._stopped_at = {name: -math.inf for name in Command if name.stops}
        """Time of the newest call of each command that stops the robot, on the monotonic clock [s]."""
        self._identity = new_connection()
        self._here = self._opened.liveliness().declare_token(self.key("here", user)) if user is not None else None

    @property
    def skipped(self) -> int:
        """Number of publications on this robot's keys that were not valid messages."""
        return self._reader.skipped

    # ------------------------------------------------------------------ asking

    def mark(self, at: float) -> CallMark:
        """Return the mark of a request for which the program called at the time `at` on the monotonic clock [s]."""
        return CallMark(self._identity, round(at * 1e9))

    def query_unanswered(self, parts: tuple[str, ...], payload: bytes | None, began: float = math.inf) -> None:
        """Send a query for the key that consists of `parts`, without waiting for a reply; `began` as in `query`."""
        handler = zenoh.handlers.Callback(_ignore, indirect=False)
        with self.open_session() as session:
            session.get(**self.query(parts, payload, REPLY_WITHIN, began), handler=handler)

    def stop_unanswered(self, user: str, name: Command, content: bytes | None) -> None:
        """Send a stop or disable to the stop port and over Zenoh, without waiting for a reply.

        The stop has the present time, which is later than the call of the request that it stops. The service therefore
        refuses this request if it arrives after the stop.
        """
        stop = StopOrder.create(self.robot, user, name, content, UNANSWERED_WITHIN, self.mark(time.monotonic()))
        # The copy of a stop of one goal has no id, so that it is carried out as well: if the first copy overtakes the
        # goal, only the copy on the goal's way comes after the goal.
        query = self.query(stop.parts, content, REPLY_WITHIN)
        if stops_everything(name, content):
            query["attachment"] = stop.id
        with self.open_session() as session:
            stop.at_door(self._connect, self._credentials, _ignore)
            session.get(**query, handler=zenoh.handlers.Callback(_ignore, indirect=False))

    def query(
        self, parts: tuple[str, ...], payload: bytes | None, within: float, began: float = math.inf
    ) -> dict[str, Any]:
        """Return the arguments of zenoh.Session.get for a query for the key that consists of `parts`.

        `began` is the time at which the program called for a request that may start motion [s]; inf for others.
        Zenoh sends a reply with the quality of service of its query, so the reply to a droppable query may be dropped.
        """
        boundary.check_size(len(payload or b""))
        return {
            "selector": self.key(*parts),
            "payload": payload,
            "encoding": boundary.JSON if payload else None,
            "attachment": str(self.mark(began)) if began < math.inf else None,
            "timeout": within,
            "consolidation": zenoh.ConsolidationMode.NONE,  # deliver each reply without waiting for further replies
            "congestion_control": zenoh.CongestionControl.BLOCK,
            "priority": zenoh.Priority.REAL_TIME,
            "express": True,
        }

    def read(self, reply: zenoh.Reply, kind: type[T]) -> T | ServiceError:
        """Return the message in a reply; a ServiceError if the reply contains no valid message.

        Raises RefusedError if the service refused the query.
        """
        if reply.ok is not None:
            try:
                answer: T = boundary.decode(reply.ok.payload.to_bytes(), kind, "its answer cannot be read")
            except RefusedError as error:
                return ServiceError(f"a program answered at {self._connect}, but {error}")
            return self._note_sequence(answer)
        content = reply.err.payload.to_bytes() if reply.err is not None else b""
        if content == ZENOHS_TIMEOUT:
            return ServiceError(
                f"robot {self.robot!r} at {self._connect} has not answered in time: its service or the network "
                "is overloaded or hangs; see the log of the service"
            )
        refused = refusal(content)
        if isinstance(refused, RefusedError):
            raise refused
        return refused

    @contextlib.contextmanager
    def copies(self, stop: StopOrder, deliver: Callable[[Outcome], None]) -> Iterator[Outcomes]:
        """Send a stop over Zenoh and, if there is one, to the stop port; pass the outcome of each copy to `deliver`.

        Any thread may call `deliver`, until the context ends. Yield the collector of the outcomes. Separate threads
        send the copies, so that a stop for which a congested link has no room does not delay the next stop.
        """
        with self.open_session():  # if the session is closed, raise the error here
            pass
        at_door = stop.at_door(self._connect, self._credentials, lambda outcome: deliver(self._note_sequence(outcome)))
        try:
            query = self.query(stop.parts, stop.content, stop.within) | {"attachment": stop.id}
            try:
                threading.Thread(target=self._post_stop, args=(query, deliver), name="zenoh stop", daemon=True).start()
            except RuntimeError:  # no thread can be started, as in StopOrder.at_door
                self._post_stop(query, deliver)
            yield Outcomes(2 if at_door is not None else 1)
        finally:
            if at_door is not None:
                at_door.cancel()

    def note_stop(self, name: Command, at: float) -> None:
        """Store the time `at` of a call that stops the robot [s]."""
        self._stopped_at[name] = max(self._stopped_at[name], at)

    def forget_pause(self, until: float) -> None:
        """Forget a pause that was called at the time `until` [s] or earlier, because it was refused or taken back."""
        if self._stopped_at[Command.PAUSE] <= until:
            self._stopped_at[Command.PAUSE] = -math.inf

    def check_stops(self, began: float) -> None:
        """Raise RefusedError if a stop was called later than a request that has not been sent yet."""
        if names := {name for name, at in self._stopped_at.items() if began < at}:
            raise RefusedError(
                RefusalCode.STOPPED, f"not sent: {' and '.join(sorted(names))} was called later and came first"
            )

    def _post_stop(self, query: dict[str, Any], deliver: Callable[[Outcome], None]) -> None:
        try:
            self._post(query, CommandReply, deliver)
        except ServiceError as error:
            deliver(error)
        except Exception as error:  # noqa: BLE001 - the caller must get an outcome in any case
            deliver(ServiceError(f"cannot send a stop over Zenoh: {error!r}"))

    def post(
        self, parts: tuple[str, ...], kind: type[T], payload: bytes, deliver: Callable[[T | TrirailError], None]
    ) -> None:
        """Query the key made of `parts` without waiting; pass a message of `kind` or the error to `deliver`.

        A thread of the connection calls `deliver` once; `deliver` must return quickly.
        """
        query = self.query(parts, payload, POST_WITHIN, called_at())
        query["congestion_control"] = zenoh.CongestionControl.DROP
        self._post(query, kind, deliver)

    def _post(self, query: dict[str, Any], kind: type[T], deliver: Callable[[T | TrirailError], None]) -> None:
        answers: list[T | TrirailError] = []

        def on_reply(reply: zenoh.Reply) -> None:
            try:
                answers.append(self.read(reply, kind))
            except RefusedError as error:
                answers.append(error)

        def on_end() -> None:
            silent = SilenceError(self._no_answer_message("check that its service is running"))
            deliver(answers[0] if answers else silent)

        handler = zenoh.handlers.Callback(on_reply, on_end, indirect=False)
        with self.open_session() as session:
            session.get(**query, handler=handler)

    def to_be_asked_for_role(self, *parts: str) -> str | None:
        """Return the user to whom the role may not allow a query of the key made of `parts`, which got no reply.

        Return None if the connection has no credentials, or if the query was itself for a role.
        """
        user = self._credentials.name if self._credentials is not None else ""
        return user if is_name(user) and parts[0] != "role" else None

    def why_nobody(self, parts: tuple[str, ...], reply: RoleReply | None) -> ServiceError | RefusedError:
        """Return the error to raise for a query without a reply. `reply` is the reply to the query for the user's role.

        Zenoh silently drops queries that a role does not allow, and also queries without a receiver. Every certificate
        may query its own role, so a reply to this query within ROLE_WITHIN shows that the receiver exists.
        """
        return (reply and self._denied(parts, reply.user, reply.role)) or ServiceError(
            self._no_answer_message(
                "check that its service is running, the name is right (--robot), and a router, if any, has a link to it"
            )
        )

    def _no_answer_message(self, why: str) -> str:
        """Return the error message for a query without a reply; `why` is the supposed reason."""
        if is_starting(self._connect):
            why = "the service is starting; try again when it reports that it is up"
        elif self._credentials is not None and self._credentials.expires <= datetime.now(UTC):
            why = f"the certificate in {self._credentials.folder} has expired; renew it with: trirail keys renew"
        return f"no robot {self.robot!r} answers at {self._connect}: {why}"

    def _denied(self, parts: tuple[str, ...], user: str, role: str | None) -> RefusedError | None:
        """Return the error to raise if the user's role does not allow the key made of `parts`; None if it does."""
        needed = least_role(*parts)
        if role is None:
            problem = (
                f"{user} has no role at robot {self.robot}: [zenoh.users] does not list the user, or the user is "
                "revoked"
            )
        elif not Role(role).includes(needed):
            problem = f"{user} is {role} at robot {self.robot}: {'/'.join(parts)} needs the role {needed}"
        else:
            return None
        return RefusedError(RefusalCode.NOT_ALLOWED, problem)

    # ------------------------------------------------------------------ subscriptions

    def overtaken(self, state: State) -> bool:
        """Return True if a state is older than the newest reply or event that this client received."""
        return state.seq < self._known[0] and not self._known_is_old()

    def subscribe_to_states(self, deliver: Callable[[State], None]) -> zenoh.Subscriber[None]:
        """Pass every state to `deliver`, until the subscriber's context ends."""
        with self.open_session() as session:
            return session.declare_subscriber(self.key("state"), self._reader.messages(State, deliver))

    def subscribe_to_events(self, deliver: Callable[[Event], None], *, history: bool) -> AdvancedSubscriber[Any]:
        """Pass every event to `deliver` until the subscriber's context ends; with `history`, begin with past events.

        Without `history`, the events that occur while the gateway restarts are missing.
        """
        with self.open_session() as session:
            return declare_advanced_subscriber(
                session,
                self.key("event"),
                self._reader.messages(Event, lambda event: deliver(self._note_sequence(event))),
                history=HistoryConfig(detect_late_publishers=True) if history else None,
                # zenoh's stub says float
                recovery=RecoveryConfig(periodic_queries=RECOVERY_PERIOD, heartbeat=None),  # type: ignore[arg-type]
            )

    def records(self, deliver: Callable[[bytes], None]) -> zenoh.Subscriber[None]:
        """Call `deliver` with every batch of records until the returned subscriber is closed."""
        with self.open_session() as session:
            return session.declare_subscriber(self.key("records"), self._reader.batches(deliver))

    def key(self, *parts: str) -> str:
        """Return the robot's key that consists of `parts`."""
        return zenoh_session.key(self.robot, *parts)

    @contextlib.contextmanager
    def open_session(self) -> Iterator[zenoh.Session]:
        """Yield the Zenoh session. Raises ServiceError in a forked process, and if the session is or becomes closed."""
        self.check_process()
        if not self.close.alive:
            raise ServiceError(CLOSED)
        try:
            yield self._opened
        except zenoh.ZError as error:
            if self.close.alive:
                raise
            raise ServiceError(CLOSED) from error

    def check_process(self) -> None:
        """Raise ServiceError in a forked process, which has no threads of Zenoh."""
        if os.getpid() != self._process:
            raise ServiceError(FORKED)

    def _note_sequence(self, message: Message) -> Message:
        """Store the number of the first state that can show a reply's effect or an event; return the message."""
        seq = message.seq if isinstance(message, CommandReply) else message.cycle if isinstance(message, Event) else 0
        if seq and (seq > self._known[0] or self._known_is_old()):
            self._known = seq, time.monotonic()
        return message

    def _known_is_old(self) -> bool:
        return time.monotonic() - self._known[1] > MAX_OVERTAKEN_S


def _close(session: zenoh.Session, process: int) -> None:
    if os.getpid() == process:
        zenoh_session.close(session)


def _ignore(_reply: object) -> None:
    """Discard a reply."""


def once(deliver: Callable[[Event], object]) -> Callable[[Event], None]:
    """Return a callback that passes each new event to `deliver`, and ignores repeated events.

    A restarted gateway repeats past events. A restarted service numbers events from one again, with another `run`. In
    events of a service without `run`, a later time shows that it has restarted.
    """
    newest: dict[str, int] = {}
    last_time = 0.0

    def deliver_new(event: Event) -> None:
        nonlocal last_time
        is_later = not event.run and event.time > last_time
        if event.seq > newest.get(event.run, 0) or is_later:
            newest[event.run], last_time = event.seq, event.time
            deliver(event)

    return deliver_new


def robots_at(connect: str) -> list[str]:
    """Return the names of the robots that answer at a Zenoh locator.

    Raises ServiceError if the locator cannot be reached.
    """
    session = zenoh_session.open_client(connect)
    try:
        alive = session.liveliness().get(zenoh_session.key("*", "alive"), timeout=1.0)
        return sorted({str(reply.ok.key_expr).split("/")[1] for reply in alive if reply.ok is not None})
    finally:
        zenoh_session.close(session)


def refusal(payload: bytes) -> RefusedError | ServiceError:
    """Return the error to raise for an error reply; a ServiceError if the reply is not an ErrorReply of the service."""
    try:
        error: ErrorReply = boundary.decode(payload, ErrorReply, "not an error reply")
    except RefusedError:
        return ServiceError(f"no valid answer from the service: {quoted(payload.decode(errors='replace'))}")
    return RefusedError(error.code, error.message, slider=error.slider, value=error.value, limit=error.limit)
