"""Zenoh as one client of one robot uses it: it asks the service, and hears what that publishes."""

from __future__ import annotations

import contextlib
import queue
import time
import weakref
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import msgspec
import zenoh
from zenoh.ext import AdvancedSubscriber, HistoryConfig, RecoveryConfig, declare_advanced_subscriber

from trirail.client.samples import SampleReader
from trirail.client.stop_call import Outcome, Outcomes, StopOrder
from trirail.errors import RefusalCode, RefusedError, ServiceError, TrirailError
from trirail.wire import boundary, zenoh_session
from trirail.wire.access import least_role
from trirail.wire.credentials import Credentials
from trirail.wire.messages import CommandReply, ErrorReply, Event, RoleReply
from trirail.wire.starting import is_starting
from trirail.wire.state import State
from trirail.wire.text import is_name, quoted
from trirail.wire.vocabulary import Role

ROLE_WITHIN = 0.8
"""How long the answer may take which role a user has [s]."""
REPLY_WITHIN = 20.0
"""How long a command may take to be carried out [s]."""
HERE_WITHIN = 1.0
"""How long the answer may take who is connected [s]."""
POST_WITHIN = 2.0
"""How long the answer may take to what is posted [s]."""
ZENOHS_TIMEOUT = b"Timeout"
"""What Zenoh itself answers to a query whose time is over."""
OVERTAKEN_WITHIN = 1.0
"""How long a state may be on its way that an answer or an event has overtaken [s]; a service that was started again
within it, and counts from one, is heard after it."""

T = TypeVar("T", bound=msgspec.Struct)
Said = TypeVar("Said")


class SilenceError(ServiceError):
    """A query that nobody has answered."""


class Connection:
    """A session to the service of a robot at a Zenoh locator. Raises ServiceError where that cannot be reached.

    Whose it is, if that is said, all others see while it lasts.
    """

    def __init__(
        self, robot: str, connect: str, credentials: Credentials | None = None, user: str | None = None
    ) -> None:
        self.robot = robot
        self._connect = connect
        self._credentials = credentials
        self._opened = zenoh_session.open_client(connect, credentials)
        # Also at the end of a program that does not close it: Zenoh's threads must not outlive the interpreter.
        self.close = weakref.finalize(self, zenoh_session.close, self._opened)
        """End it; calls after the first do nothing."""
        self._reader = SampleReader()
        self._known = 0, 0.0
        self._here = self._opened.liveliness().declare_token(self._key("here", user)) if user is not None else None

    @property
    def skipped(self) -> int:
        """How often something was published on this robot's keys that was none of its messages."""
        return self._reader.skipped

    # ------------------------------------------------------------------ asking

    def fetch(
        self,
        parts: tuple[str, ...],
        kind: type[T],
        payload: bytes | None = None,
        within: float = REPLY_WITHIN,
        copy: str | None = None,
    ) -> T:
        """Query the key of these parts and decode the first reply that can be read as a message of `kind`.

        `copy` is the id by which the service knows the copies of a stop for one.

        Raises RefusedError where the service says no, ServiceError where nobody answers within so many seconds: nobody
        is there, or may be asked. A reply has the quality of service of its query: one that may be dropped would have
        an answer that may be.
        """
        unreadable: ServiceError | None = None
        for reply in self._session.get(**self.query(parts, payload, within), attachment=copy):
            answer = self.read(reply, kind)
            if not isinstance(answer, ServiceError):
                return answer
            unreadable = answer
        raise unreadable or self.nobody(*parts)

    def query(self, parts: tuple[str, ...], payload: bytes | None, within: float) -> dict[str, Any]:
        """Return how the key of these parts is asked, as arguments of a session's `get`."""
        boundary.check_size(len(payload or b""))
        return {
            "selector": self._key(*parts),
            "payload": payload,
            "encoding": boundary.JSON if payload else None,
            "timeout": within,
            "consolidation": zenoh.ConsolidationMode.NONE,  # at once, however many more were asked
            "congestion_control": zenoh.CongestionControl.BLOCK,
            "priority": zenoh.Priority.REAL_TIME,
            "express": True,
        }

    def read(self, reply: zenoh.Reply, kind: type[T]) -> T | ServiceError:
        """Return the message of a reply, ServiceError where it holds none. Raises RefusedError where that is a no."""
        if reply.ok is not None:
            try:
                answer: T = boundary.decode(reply.ok.payload.to_bytes(), kind, "it cannot be read")
            except RefusedError as error:
                return ServiceError(f"somebody answered at {self._connect}, but {error}")
            return self._noted(answer)
        content = reply.err.payload.to_bytes() if reply.err is not None else b""
        if content == ZENOHS_TIMEOUT:
            return ServiceError(
                f"robot {self.robot!r} at {self._connect} has not answered in time: its service, or the network to it, "
                "is overloaded or hangs; its log tells more"
            )
        refused = refusal(content)
        if isinstance(refused, RefusedError):
            raise refused
        return refused

    def stop(self, user: str, name: str, content: bytes | None, within: float) -> CommandReply:
        """Ask for a stop, quick_stop or disable, over Zenoh and at the door beside it; return the first answer.

        Raises as `ask`.
        """
        came: queue.SimpleQueue[Outcome] = queue.SimpleQueue()
        with self.copies(StopOrder.of(self.robot, user, name, content, within), came.put) as outcomes:
            try:
                while (reply := outcomes.decide(came.get())) is None:
                    pass
            except SilenceError as error:
                raise self.nobody("cmd", user, name) from error
        return reply

    @contextlib.contextmanager
    def copies(self, stop: StopOrder, deliver: Callable[[Outcome], None]) -> Iterator[Outcomes]:
        """Send all copies of a stop, and have what comes of each taken, by whatever thread; until the context ends."""
        at_door = stop.at_door(self._connect, self._credentials, lambda outcome: deliver(self._noted(outcome)))
        try:
            query = self.query(stop.parts, stop.content, stop.within) | {"attachment": stop.id}
            self._post(query, CommandReply, deliver)
            yield Outcomes(2 if at_door is not None else 1)
        finally:
            if at_door is not None:
                at_door.cancel()

    def post(
        self, parts: tuple[str, ...], kind: type[T], payload: bytes, deliver: Callable[[T | TrirailError], None]
    ) -> None:
        """Query the key of these parts without waiting: `deliver` gets a message of `kind`, or why there is none.

        It is called once, by a thread of the connection: it must be quick.
        """
        query = self.query(parts, payload, POST_WITHIN) | {"congestion_control": zenoh.CongestionControl.DROP}
        self._post(query, kind, deliver)

    def _post(self, query: dict[str, Any], kind: type[T], deliver: Callable[[T | TrirailError], None]) -> None:
        answers: list[T | TrirailError] = []

        def on_reply(reply: zenoh.Reply) -> None:
            try:
                answers.append(self.read(reply, kind))
            except RefusedError as error:
                answers.append(error)

        def on_end() -> None:
            silent = SilenceError(self._silent("is its service running?"))
            deliver(answers[0] if answers else silent)

        handler = zenoh.handlers.Callback(on_reply, on_end, indirect=False)
        self._session.get(**query, handler=handler)

    def nobody(self, *parts: str) -> ServiceError | RefusedError:
        """Return what to raise where nobody answers on the key of these parts.

        Zenoh drops what a role does not allow without a word, as it does what nobody listens to. Every certificate
        may ask for its role: the answer, within ROLE_WITHIN, tells which it was.
        """
        user = self.to_be_asked_for_role(*parts)
        try:
            reply = self.fetch(("role", user), RoleReply, within=ROLE_WITHIN) if user else None
        except (ServiceError, RefusedError):
            reply = None
        return self.why_nobody(parts, reply)

    def to_be_asked_for_role(self, *parts: str) -> str | None:
        """Return the user whose role tells why nobody answers on the key of these parts; None where none does."""
        user = self._credentials.name if self._credentials is not None else ""
        return user if is_name(user) and parts[0] != "role" else None

    def why_nobody(self, parts: tuple[str, ...], reply: RoleReply | None) -> ServiceError | RefusedError:
        """Return what to raise where nobody answers, and this did when the user's role was asked for."""
        return (reply and self._denied(parts, reply.user, reply.role)) or ServiceError(
            self._silent("is its service up, is the name right (--robot), is it linked to the router if this is one?")
        )

    def _silent(self, why: str) -> str:
        """Return the words for nobody answering."""
        if is_starting(self._connect):
            why = "the service there is starting; try again when it says that it is up"
        return f"no robot {self.robot!r} answers at {self._connect}: {why}"

    def _denied(self, parts: tuple[str, ...], user: str, role: str | None) -> RefusedError | None:
        """Return the refusal where the user's role does not allow to use the key of these parts."""
        needed = least_role(*parts)
        if role is None:
            problem = f"{user} has no role at {self.robot}: its [zenoh.users] does not name him, or he is revoked"
        elif not Role(role).includes(needed):
            problem = f"{user} is {role} at {self.robot}: {'/'.join(parts)} needs {needed}"
        else:
            return None
        return RefusedError(RefusalCode.NOT_ALLOWED, problem)

    # ------------------------------------------------------------------ hearing

    def states(self, timeout: float | None) -> Iterator[State]:
        """Yield states as they come, the newest where this is too slow; end after `timeout` seconds without one."""
        received: queue.Queue[State] = queue.Queue(maxsize=1)

        def keep_newest(state: State) -> None:
            with contextlib.suppress(queue.Empty):
                received.get_nowait()
            with contextlib.suppress(queue.Full):
                received.put_nowait(state)

        with self.subscribe_to_states(keep_newest):
            yield from _until_silent(received, timeout)

    def overtaken(self, state: State) -> bool:
        """Whether a state is of before the newest answer or event that this client has."""
        return state.seq < self._known[0] and not self._forgets()

    def events(self, history: bool, timeout: float | None) -> Iterator[Event]:
        """Yield events in order, each once, with `history` the past first; end after `timeout` seconds without one."""
        received: queue.Queue[Event] = queue.Queue()
        with self.subscribe_to_events(once(received.put), history=history):
            yield from _until_silent(received, timeout)

    def subscribe_to_states(self, deliver: Callable[[State], None]) -> zenoh.Subscriber[None]:
        """Have every state taken, until the subscriber's context ends."""
        return self._session.declare_subscriber(self._key("state"), self._reader.messages(State, deliver))

    def subscribe_to_events(self, deliver: Callable[[Event], None], *, history: bool) -> AdvancedSubscriber[Any]:
        """Have every event taken, with `history` the past too, that of a gateway that was started again as well."""
        return declare_advanced_subscriber(
            self._session,
            self._key("event"),
            self._reader.messages(Event, lambda event: deliver(self._noted(event))),
            history=HistoryConfig(detect_late_publishers=True) if history else None,
            recovery=RecoveryConfig(periodic_queries=None, heartbeat=True),
        )

    def records(self, deliver: Callable[[bytes], None]) -> zenoh.Subscriber[None]:
        """Have every batch of records taken, until the subscriber's context ends."""
        return self._session.declare_subscriber(self._key("records"), self._reader.batches(deliver))

    def users(self) -> list[str]:
        """Return the users who have a session to this robot, by name."""
        here = self._session.liveliness().get(self._key("here", "*"), timeout=HERE_WITHIN)
        return sorted({str(reply.ok.key_expr).rpartition("/")[2] for reply in here if reply.ok is not None})

    @property
    def session(self) -> zenoh.Session:
        """The session, for who does not wait for its answers in a thread. Raises ServiceError once it is closed."""
        return self._session

    @property
    def _session(self) -> zenoh.Session:
        if not self.close.alive:
            raise ServiceError("the connection is closed: open a new one, as Robot(…)")
        return self._opened

    def _noted(self, said: Said) -> Said:
        """Note from which state on shows what the service has said; return it."""
        seq = said.seq if isinstance(said, CommandReply) else said.cycle if isinstance(said, Event) else 0
        if seq and (seq > self._known[0] or self._forgets()):
            self._known = seq, time.monotonic()
        return said

    def _forgets(self) -> bool:
        return time.monotonic() - self._known[1] > OVERTAKEN_WITHIN

    def _key(self, *parts: str) -> str:
        return zenoh_session.key(self.robot, *parts)


def once(deliver: Callable[[Event], object]) -> Callable[[Event], None]:
    """Return what takes events of which some come again: each is taken once, in order.

    A gateway that was started again tells the past once more; a service that was, counts from one.
    """
    last = 0, 0.0

    def take_new(event: Event) -> None:
        nonlocal last
        if event.seq > last[0] or event.time > last[1]:
            last = event.seq, event.time
            deliver(event)

    return take_new


def robots_at(connect: str) -> list[str]:
    """Return the names of the robots whose services answer at a Zenoh locator. Raises ServiceError if none can."""
    session = zenoh_session.open_client(connect)
    try:
        alive = session.liveliness().get(zenoh_session.key("*", "alive"), timeout=1.0)
        return sorted({str(reply.ok.key_expr).split("/")[1] for reply in alive if reply.ok is not None})
    finally:
        zenoh_session.close(session)


def _until_silent(received: queue.Queue[T], timeout: float | None) -> Iterator[T]:
    """Yield what is received, until nothing is for `timeout` seconds: only what is to be yielded may be put there."""
    while True:
        try:
            yield received.get(timeout=timeout)
        except queue.Empty:
            return


def refusal(payload: bytes) -> RefusedError | ServiceError:
    """Return what to raise for an error reply: ServiceError if it is none, but words of somebody else's."""
    try:
        error: ErrorReply = boundary.decode(payload, ErrorReply, "not an error reply")
    except RefusedError:
        return ServiceError(f"no answer from the service: {quoted(payload.decode(errors='replace'))}")
    return RefusedError(error.code, error.message, slider=error.slider, value=error.value, limit=error.limit)
