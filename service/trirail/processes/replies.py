"""Replies to queries, sent by separate threads, and announcements of refusals at a limited rate.

Because of the threads, a client that does not read its replies does not block other clients. A client sends each stop
both over Zenoh and to the stop port. The service carries the stop out once, and answers both copies with the same
reply. The slower copy may arrive shortly after the robot has begun to move again. It must not stop goals that were sent
after the first copy was confirmed.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections import deque
from collections.abc import Callable

import msgspec
import zenoh

from trirail.errors import RefusalCode, RefusedError
from trirail.processes.incoming import Incoming, Pace, StopPair
from trirail.processes.memory_budget import Budget
from trirail.wire import boundary, zenoh_session
from trirail.wire.event_codes import EventCode
from trirail.wire.links import PacketLink
from trirail.wire.messages import ErrorReply, Notice
from trirail.wire.packets import Announcement, message
from trirail.wire.sizes import MAX_REFUSED
from trirail.wire.text import is_name, quoted

COPY_WITHIN_S = 2.0
"""Time after the reply to a stop within which its copy may arrive [s]. A program may then use the id again."""
MARKED_COPY_WITHIN_S = 20.0
"""The same for a stop whose id has a mark and is therefore never used again [s]. Its copy may be on its way for as long
as Zenoh keeps a link that carries nothing, which is 10 s."""
COPIES_KEPT = 4096
"""Maximum number of stops whose copy has not arrived. If there are more, the oldest are deleted."""

_Id = tuple[str, str, bytes]


class Copies:
    """Registry of the stops whose copy has not arrived.

    A stop is a copy if a stop with the same key, id and content has arrived on the other channel and has no copy yet.
    All other stops are carried out, even if a program uses an id again, or uses no id.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._pairs: dict[_Id, StopPair] = {}  # in the order of arrival

    def first(self, stop: Incoming) -> StopPair | None:
        """Return the pair of which a stop is the copy, and remove the pair. Return None if the stop is not a copy."""
        pair = self._pairs.get(_id(stop))
        if pair is None or pair.at_port == _at_port(stop) or self._is_over(pair):
            return None
        return self._pairs.pop(_id(stop))

    def add(self, stop: Incoming) -> Incoming:
        """Register a stop that is not a copy, and return it with its pair. A stop without an id has no copy."""
        if not stop.id:
            return stop
        self._pairs.pop(_id(stop), None)
        while self._pairs and (len(self._pairs) >= COPIES_KEPT or self._is_over(next(iter(self._pairs.values())))):
            del self._pairs[next(iter(self._pairs))]
        self._pairs[_id(stop)] = pair = StopPair(
            _at_port(stop), COPY_WITHIN_S if stop.mark is None else MARKED_COPY_WITHIN_S
        )
        return stop._replace(pair=pair)

    def answered(self, stop: Incoming, content: msgspec.Struct) -> Incoming | None:
        """Store the reply to a stop, and return the copy if it waits for the reply.

        If the stop was refused because the service was busy, a later copy is carried out.
        """
        pair = stop.pair
        if pair is None:
            return None
        pair.answer, pair.answered_at = content, self._clock()
        busy = isinstance(content, ErrorReply) and content.code == RefusalCode.BUSY
        if busy and self._pairs.get(_id(stop)) is pair:
            del self._pairs[_id(stop)]
        copy, pair.copy = pair.copy, None
        return copy

    def _is_over(self, pair: StopPair) -> bool:
        return self._clock() - pair.answered_at > pair.copy_within


def _id(stop: Incoming) -> _Id:
    return stop.key, stop.id, stop.payload


def _at_port(stop: Incoming) -> bool:
    return stop.query is None


THREADS = 32
"""Number of threads. Other clients are delayed only if this number of clients do not read their replies."""
CLOSE_WITHIN = 2.0
"""Maximum time for sending the last replies [s]."""


class Replies:
    """Sender of replies, which sends the replies to each client in order.

    A reply that a client does not read is stored until the transport closes the client's session.
    """

    def __init__(self, robot: str) -> None:
        self._robot = robot
        self.copies = Copies()
        self._changed = threading.Condition()
        # The queues are not limited. Dropping a query would not help: it sends a final message to the client, which may
        # block as long as a reply.
        self._queues: dict[str, deque[tuple[Incoming, msgspec.Struct]]] = {}
        self._idle: deque[str] = deque()
        """Names of queues from which no reply is being sent at the moment, in the order of their turns."""
        self._closed = False
        self._threads = [threading.Thread(target=self._run, name="replies", daemon=True) for _ in range(THREADS)]
        for thread in self._threads:
            thread.start()

    @property
    def waiting(self) -> int:
        """Number of replies that have not been sent yet."""
        with self._changed:
            return sum(map(len, self._queues.values()))

    def send(self, incoming: Incoming, content: msgspec.Struct) -> None:
        """Enqueue the reply to a message, but not to its copies. A put gets no reply.

        This method may be called from any thread.
        """
        if incoming.at_door is not None:
            incoming.at_door(content)
        if incoming.query is None:
            return
        # There is one queue per kind of message and user, because a user who does not read one reply will not read the
        # next replies either. Queries about a role have a common queue for all users.
        asker = f"{incoming.kind}/{incoming.user}"
        with self._changed:
            if asker not in self._queues:
                self._queues[asker] = deque()
                self._idle.append(asker)
                self._changed.notify()
            self._queues[asker].append((incoming, content))

    def send_now(self, incoming: Incoming, content: msgspec.Struct) -> None:
        """Send the reply to a message from the calling thread. This may block until the client reads the reply."""
        if incoming.at_door is not None:
            incoming.at_door(content)
        if incoming.query is not None:
            with contextlib.suppress(zenoh.ZError):  # the client has disconnected
                self._answer(incoming, incoming.query, content)

    def answer(self, incoming: Incoming, content: msgspec.Struct) -> None:
        """Answer a message, the equal messages that were merged into it, and the copies of all of these."""
        for each in (incoming, *incoming.alike):
            self.send(each, content)
            if (copy := self.copies.answered(each, content)) is not None:
                self.send(copy, content)

    def without_copies(self, incoming: Incoming) -> Incoming | None:
        """Remove copies of earlier stops from a stop and the equal stops merged into it; return None if none is left.

        The removed copies are answered with the reply to their first copy. The returned stop has the number of the
        newest stop that is left.
        """
        fresh = []
        for each in (incoming, *incoming.alike):
            if (pair := self.copies.first(each)) is None:
                fresh.append(self.copies.add(each))
            elif pair.answer is None:
                pair.copy = each
            else:
                self.send(each, pair.answer)
        if not fresh:
            return None
        return fresh[0]._replace(number=fresh[-1].number, alike=tuple(fresh[1:]))

    def close(self) -> None:
        """Send the replies that are waiting, but give up after CLOSE_WITHIN."""
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
                incoming, content = self._queues[asker].popleft()
            self.send_now(incoming._replace(at_door=None), content)
            del incoming, content  # deleting the last reference to the query completes the query
            with self._changed:
                if self._queues[asker]:
                    self._idle.append(asker)
                    self._changed.notify()
                else:
                    del self._queues[asker]

    def _answer(self, incoming: Incoming, query: zenoh.Query, content: msgspec.Struct) -> None:
        try:
            encoding = boundary.encoding(incoming.encoding)
        except RefusedError:
            encoding = boundary.JSON
        payload = boundary.encode(content, encoding)
        with query:  # complete the query, because otherwise the client waits for further replies until its time-out
            if isinstance(content, ErrorReply):
                query.reply_err(payload, encoding=encoding)
            else:
                of_robot = incoming.kind in ("info", "poses")  # the key of such a query may contain wildcards
                key = zenoh_session.key(self._robot, incoming.kind) if of_robot else incoming.key
                query.reply(key, payload, encoding=encoding)


REFUSALS_OF_USER, REFUSALS_OF_USER_PER_SECOND = 10, 0.2
"""Number of refusals of one user that are announced to all clients in a burst, and afterwards per second.

The sender of a refused message receives an error reply in any case. More announcements would displace other events from
the history.
"""
REFUSALS_OF_ALL, REFUSALS_OF_ALL_PER_SECOND = 50, 0.4
"""Number of refusals of all users that are announced to all clients in a burst, and afterwards per second."""


class Refusals:
    """Sender of refusals, as an error reply and as an announcement to all clients, because a put has no reply."""

    def __init__(self, link: PacketLink, replies: Replies) -> None:
        self._link = link
        self._replies = replies
        self._paces = (
            Pace(REFUSALS_OF_USER, REFUSALS_OF_USER_PER_SECOND),
            Pace(REFUSALS_OF_ALL, REFUSALS_OF_ALL_PER_SECOND),
        )
        """Rate limits of the announcements for each user, and for all users together."""
        self._unkept: deque[tuple[str, ErrorReply]] = deque(maxlen=REFUSALS_OF_ALL)
        self._budget = Budget(MAX_REFUSED, MAX_REFUSED)

    def not_kept(self, incoming: Incoming, error: ErrorReply) -> None:
        """Refuse a message that the inbox has not accepted. `announce_unkept` announces the refusal later.

        This method may be called from any thread. If the refusals that wait to be sent occupy too much memory, this
        refusal is sent from the calling thread of Zenoh. Nothing more is then received from a sender that does not read
        its replies.
        """
        self._unkept.append((incoming.user, error))
        hold = self._budget.hold(incoming.user, incoming.held)
        if hold is None:
            self._replies.send_now(incoming, error)
        else:
            self._replies.send(incoming._replace(hold=hold), error)

    def announce_unkept(self) -> None:
        """Announce the refusals of messages that the inbox has not accepted."""
        while self._unkept:
            user, why = self._unkept.popleft()
            self.warn_everyone(why.message, user if is_name(user) else "", why.code)

    def refuse(self, incoming: Incoming, refusal: RefusedError) -> None:
        """Refuse a message, and announce the refusal to all clients."""
        text = quoted(str(refusal))
        self._replies.answer(incoming, ErrorReply(refusal.code, text))
        self.warn_everyone(text, incoming.user if is_name(incoming.user) else "", refusal.code)

    def warn_everyone(self, text: str, user: str = "", code: RefusalCode = RefusalCode.INTERNAL) -> None:
        """Ask the loop to announce a refusal, at a limited rate."""
        now, (of_user, of_all) = time.monotonic(), self._paces
        if not (of_user.wait(user, now) or of_all.wait("", now)):
            of_user.count(user, now)
            of_all.count("", now)
            notice = Notice("refused", "warning", text, user=user, code=code, event_code=EventCode.REFUSED)
            self._link.send(message(Announcement(notice)))
