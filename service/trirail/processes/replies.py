"""Answers to queries, sent by threads of their own, and what is refused, which everyone is told, but not too often.

Whoever does not take an answer holds up nobody else. A stop goes over Zenoh and to the door: it is carried out once,
and each copy is answered alike. The slower copy may come when the robot moves again: it must not stop goals that were
sent after the first was confirmed.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections import Counter, deque
from collections.abc import Callable

import msgspec
import zenoh

from trirail.errors import RefusalCode, RefusedError
from trirail.processes.incoming import Incoming
from trirail.wire import boundary, zenoh_session
from trirail.wire.links import PacketLink
from trirail.wire.messages import ErrorReply
from trirail.wire.packets import RefusedRequest, message
from trirail.wire.text import is_name, quoted

REMEMBERED = 60.0
"""How long an answer is kept for a copy that is to come; nobody waits longer for one [s]."""
COPIES_KEPT = 4096
"""So many are remembered at once; beyond that the oldest are forgotten."""

_Id = tuple[str, str, bytes]


class _Stop:
    """What is known of one."""

    def __init__(self, came: float) -> None:
        self.came = came
        self.answer: msgspec.Struct | None = None
        self.waiting: list[Incoming] = []


class Copies:
    """Keeps which stops have come, by key, id and content. One without an id has no copies. `clock` gives seconds."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._stops: dict[_Id, _Stop] = {}  # in the order in which they came

    def first(self, incoming: Incoming) -> bool:
        """Whether none of it has come before; a later one waits for the answer of the first, or has it `known`."""
        if not incoming.id:
            return True
        if (stop := self._stops.get(_id(incoming))) is not None:
            if stop.answer is None:
                stop.waiting.append(incoming)
            return False
        self._forget()
        self._stops[_id(incoming)] = _Stop(self._clock())
        return True

    def known(self, incoming: Incoming) -> msgspec.Struct | None:
        """Return what the first was answered; None where it was not yet."""
        stop = self._stops.get(_id(incoming))
        return stop.answer if stop is not None else None

    def answered(self, incoming: Incoming, content: msgspec.Struct) -> list[Incoming]:
        """Note an answer, and return who else has waited for it. What was not carried out is not remembered."""
        stop = self._stops.get(_id(incoming))
        if stop is None or stop.answer is not None:
            return []
        stop.answer = content
        if isinstance(content, ErrorReply) and content.code == RefusalCode.BUSY:
            del self._stops[_id(incoming)]
        waiting, stop.waiting = stop.waiting, []
        return waiting

    def _forget(self) -> None:
        """Forget what nobody asks for any more."""
        while self._stops:
            name, oldest = next(iter(self._stops.items()))
            if len(self._stops) < COPIES_KEPT and self._clock() - oldest.came < REMEMBERED:
                return
            del self._stops[name]


def _id(stop: Incoming) -> _Id:
    return stop.key, stop.id, stop.payload


THREADS = 32
"""So many askers that take no answer hold up nobody else."""
CLOSE_WITHIN = 2.0
"""How long the last answers may take [s]."""


class Replies:
    """Sends answers, to each asker in their order. One is never dropped before the transport gives its asker up."""

    def __init__(self, robot: str) -> None:
        self._robot = robot
        self.copies = Copies()
        self._changed = threading.Condition()
        # Not bounded: a query that is let go says so to its asker, and that may wait as long as an answer.
        self._of: dict[str, deque[tuple[Incoming, msgspec.Struct]]] = {}
        self._idle: deque[str] = deque()
        """Askers with answers of which none is being sent, in the order of their turns."""
        self._closed = False
        self._threads = [threading.Thread(target=self._run, name="replies", daemon=True) for _ in range(THREADS)]
        for thread in self._threads:
            thread.start()

    @property
    def waiting(self) -> int:
        """How many answers wait for their turn."""
        with self._changed:
            return sum(map(len, self._of.values()))

    def send(self, incoming: Incoming, content: msgspec.Struct) -> None:
        """Answer a message alone; nothing for a put. Safe from any thread."""
        if incoming.at_door is not None:
            incoming.at_door(content)
        if incoming.query is None:
            return
        # Of a command the user decides and not its name: who asks for one thing and does not listen is the same.
        asker = "/".join(incoming.key.split("/")[:4])
        with self._changed:
            if asker not in self._of:
                self._of[asker] = deque()
                self._idle.append(asker)
                self._changed.notify()
            self._of[asker].append((incoming, content))

    def answer(self, incoming: Incoming, content: msgspec.Struct) -> None:
        """Answer what was carried out, or refused, and all that were read as one with it, and the copies of each."""
        for each in (incoming, *incoming.alike):
            self.send(each, content)
            for copy in self.copies.answered(each, content):
                self.send(copy, content)

    def fresh(self, incoming: Incoming) -> Incoming | None:
        """Return a stop, and those read as one with it, without the copies of others: these get the answer of those.

        Its number is the newest. None where there are but copies.
        """
        fresh = []
        for each in (incoming, *incoming.alike):
            if self.copies.first(each):
                fresh.append(each)
            elif (known := self.copies.known(each)) is not None:
                self.send(each, known)
        if not fresh:
            return None
        return fresh[0]._replace(number=fresh[-1].number, alike=tuple(fresh[1:]))

    def close(self) -> None:
        """Send what waits, for a while at most."""
        deadline = time.monotonic() + CLOSE_WITHIN
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        for thread in self._threads:
            thread.join(max(0.0, deadline - time.monotonic()))

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._idle or self._closed)
                if not self._idle:
                    return
                asker = self._idle.popleft()
                incoming, content = self._of[asker].popleft()
            if incoming.query is not None:
                with contextlib.suppress(zenoh.ZError):  # the asker has gone
                    self._answer(incoming, incoming.query, content)
            del incoming, content  # for a query ends when nobody has it any more
            with self._changed:
                if self._of[asker]:
                    self._idle.append(asker)
                    self._changed.notify()
                else:
                    del self._of[asker]

    def _answer(self, incoming: Incoming, query: zenoh.Query, content: msgspec.Struct) -> None:
        try:
            encoding = boundary.encoding(incoming.encoding)
        except RefusedError:
            encoding = boundary.JSON
        payload = boundary.encode(content, encoding)
        with query:  # dropped afterwards: else the caller waits for more until its time-out
            if isinstance(content, ErrorReply):
                query.reply_err(payload, encoding=encoding)
            else:
                of_robot = incoming.kind in ("info", "poses")  # what was asked may have wildcards
                key = zenoh_session.key(self._robot, incoming.kind) if of_robot else incoming.key
                query.reply(key, payload, encoding=encoding)


TOO_MUCH = "too many messages at once: send fewer"
REFUSALS_PER_SECOND = 10
"""What is refused of one user that is told to everyone; the rest only gets its error reply."""
REFUSALS_OF_ALL = 50
"""Likewise, of all users."""


class Refusals:
    """Answers what cannot be taken, and has the loop tell everyone of it: a put has no answer."""

    def __init__(self, link: PacketLink, replies: Replies) -> None:
        self._link = link
        self._replies = replies
        self._told: Counter[str] = Counter()
        self._told_since = 0.0
        self._overruns: deque[str] = deque(maxlen=REFUSALS_OF_ALL)

    def too_much(self, incoming: Incoming) -> None:
        """Answer what there is no room for; safe from any thread, told of by `tell_of_overruns`."""
        self._overruns.append(incoming.user)
        self._replies.send(incoming, ErrorReply(RefusalCode.BUSY, TOO_MUCH))

    def tell_of_overruns(self) -> None:
        """Tell everyone whose messages there was no room for."""
        while self._overruns:
            user = self._overruns.popleft()
            self.warn_everyone(TOO_MUCH, user if is_name(user) else "")

    def refuse(self, incoming: Incoming, refusal: RefusedError) -> None:
        """Answer what cannot be taken, and tell everyone."""
        text = quoted(str(refusal))
        self._replies.answer(incoming, ErrorReply(refusal.code, text))
        self.warn_everyone(text, incoming.user if is_name(incoming.user) else "")

    def warn_everyone(self, text: str, user: str = "") -> None:
        """Have the loop tell everyone, but not too often."""
        now = time.monotonic()
        if now - self._told_since >= 1.0:
            self._told.clear()
            self._told_since = now
        if self._told[user] < REFUSALS_PER_SECOND and self._told.total() < REFUSALS_OF_ALL:
            self._told[user] += 1
            self._link.send(message(RefusedRequest(user, text)))
