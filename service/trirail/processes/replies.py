"""Answers to queries, sent by threads of their own, and refusals, which are announced to everyone at a limited rate.

A client that takes no answer holds up no other. A stop is sent over Zenoh and to the door: it is carried out once,
and each copy is answered alike. The slower copy may arrive when the robot moves again: it must not stop goals that
were sent after the first was confirmed.
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
from trirail.processes.memory_budget import Budget
from trirail.wire import boundary, zenoh_session
from trirail.wire.event_codes import EventCode
from trirail.wire.links import PacketLink
from trirail.wire.messages import ErrorReply, Notice
from trirail.wire.packets import Announcement, message
from trirail.wire.sizes import MAX_REFUSED
from trirail.wire.text import is_name, quoted

REMEMBERED = 60.0
"""Time for which an answer is kept for a later copy; no client waits longer for one [s]."""
COPIES_KEPT = 4096
"""Most stops remembered at a time; beyond that the oldest are forgotten."""

_Id = tuple[str, str, bytes]


class _Stop:
    """State of one stop."""

    def __init__(self, came: float) -> None:
        self.came = came
        self.answer: msgspec.Struct | None = None
        self.waiting: list[Incoming] = []


class Copies:
    """Stops that have arrived, by key, id and content. One without an id has no copies. `clock` gives seconds."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._stops: dict[_Id, _Stop] = {}  # in the order in which they came

    def first(self, incoming: Incoming) -> bool:
        """Return whether it is the first copy; a later one waits for the answer of the first, or has it `known`."""
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
        """Return the answer to the first copy; None if there is none yet."""
        stop = self._stops.get(_id(incoming))
        return stop.answer if stop is not None else None

    def answered(self, incoming: Incoming, content: msgspec.Struct) -> list[Incoming]:
        """Record an answer, and return the other copies that wait for it. A stop not carried out is not remembered."""
        stop = self._stops.get(_id(incoming))
        if stop is None or stop.answer is not None:
            return []
        stop.answer = content
        if isinstance(content, ErrorReply) and content.code == RefusalCode.BUSY:
            del self._stops[_id(incoming)]
        waiting, stop.waiting = stop.waiting, []
        return waiting

    def _forget(self) -> None:
        """Forget stops whose copies have expired."""
        while self._stops:
            name, oldest = next(iter(self._stops.items()))
            if len(self._stops) < COPIES_KEPT and self._clock() - oldest.came < REMEMBERED:
                return
            del self._stops[name]


def _id(stop: Incoming) -> _Id:
    return stop.key, stop.id, stop.payload


THREADS = 32
"""Number of askers that may take no answer and hold up no other."""
CLOSE_WITHIN = 2.0
"""Longest time for the last answers [s]."""


class Replies:
    """Sender of answers, to each asker in order. None is dropped before the transport gives its asker up."""

    def __init__(self, robot: str) -> None:
        self._robot = robot
        self.copies = Copies()
        self._changed = threading.Condition()
        # Not bounded: dropping a query notifies its asker, which may wait as long as an answer.
        self._of: dict[str, deque[tuple[Incoming, msgspec.Struct]]] = {}
        self._idle: deque[str] = deque()
        """Askers with answers of which none is being sent, in the order of their turns."""
        self._closed = False
        self._threads = [threading.Thread(target=self._run, name="replies", daemon=True) for _ in range(THREADS)]
        for thread in self._threads:
            thread.start()

    @property
    def waiting(self) -> int:
        """Number of answers that wait for their turn."""
        with self._changed:
            return sum(map(len, self._of.values()))

    def send(self, incoming: Incoming, content: msgspec.Struct) -> None:
        """Answer a message alone; nothing for a put. Safe from any thread."""
        if incoming.at_door is not None:
            incoming.at_door(content)
        if incoming.query is None:
            return
        # The asker of a command is its user, not its name: a user that reads no answer to one reads none to others.
        # Queries for a role, of whatever user, share one place.
        asker = f"{incoming.kind}/{incoming.user}"
        with self._changed:
            if asker not in self._of:
                self._of[asker] = deque()
                self._idle.append(asker)
                self._changed.notify()
            self._of[asker].append((incoming, content))

    def send_now(self, incoming: Incoming, content: msgspec.Struct) -> None:
        """Answer a message alone, in this thread, which waits for as long as the asker takes no answer."""
        if incoming.at_door is not None:
            incoming.at_door(content)
        if incoming.query is not None:
            with contextlib.suppress(zenoh.ZError):  # the asker has gone
                self._answer(incoming, incoming.query, content)

    def answer(self, incoming: Incoming, content: msgspec.Struct) -> None:
        """Answer a message carried out or refused, all that were read as one with it, and the copies of each."""
        for each in (incoming, *incoming.alike):
            self.send(each, content)
            for copy in self.copies.answered(each, content):
                self.send(copy, content)

    def fresh(self, incoming: Incoming) -> Incoming | None:
        """Return a stop, and those read as one with it, without copies: these get the answer of the first.

        Its number is the newest. None if there are only copies.
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
        """Send the waiting answers, for a limited time."""
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
            self.send_now(incoming._replace(at_door=None), content)
            del incoming, content  # a query ends with its last reference
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
                of_robot = incoming.kind in ("info", "poses")  # the key of the query may have wildcards
                key = zenoh_session.key(self._robot, incoming.kind) if of_robot else incoming.key
                query.reply(key, payload, encoding=encoding)


REFUSALS_PER_SECOND = 10
"""Refusals of one user a second that are announced to everyone; the rest only get their error reply."""
REFUSALS_OF_ALL = 50
"""The same for all users."""


class Refusals:
    """Answers to rejected messages, which the loop also announces to everyone: a put has no answer."""

    def __init__(self, link: PacketLink, replies: Replies) -> None:
        self._link = link
        self._replies = replies
        self._told: Counter[str] = Counter()
        self._told_since = 0.0
        self._overruns: deque[tuple[str, ErrorReply]] = deque(maxlen=REFUSALS_OF_ALL)
        self._budget = Budget(MAX_REFUSED, MAX_REFUSED)

    def not_kept(self, incoming: Incoming, error: ErrorReply) -> None:
        """Answer a message that the inbox does not keep; safe from any thread, announced by `tell_of_overruns`.

        If such answers hold too much memory, the sender's own thread of Zenoh sends this one: then nothing more is
        received of a sender that takes no answer, until the transport gives it up.
        """
        self._overruns.append((incoming.user, error))
        hold = self._budget.hold(incoming.user, incoming.held)
        if hold is None:
            self._replies.send_now(incoming, error)
        else:
            self._replies.send(incoming._replace(hold=hold), error)

    def tell_of_overruns(self) -> None:
        """Announce whose messages were not kept."""
        while self._overruns:
            user, why = self._overruns.popleft()
            self.warn_everyone(why.message, user if is_name(user) else "", why.code)

    def refuse(self, incoming: Incoming, refusal: RefusedError) -> None:
        """Answer a rejected message, and announce it to everyone."""
        text = quoted(str(refusal))
        self._replies.answer(incoming, ErrorReply(refusal.code, text))
        self.warn_everyone(text, incoming.user if is_name(incoming.user) else "", refusal.code)

    def warn_everyone(self, text: str, user: str = "", code: RefusalCode = RefusalCode.INTERNAL) -> None:
        """Have the loop announce a refusal, at a limited rate."""
        now = time.monotonic()
        if now - self._told_since >= 1.0:
            self._told.clear()
            self._told_since = now
        if self._told[user] < REFUSALS_PER_SECOND and self._told.total() < REFUSALS_OF_ALL:
            self._told[user] += 1
            notice = Notice("refused", "warning", text, user=user, code=code, event_code=EventCode.REFUSED)
            self._link.send(message(Announcement(notice)))
