"""What the gateway refuses: each asker is answered, and everyone is told, but not too often."""

from __future__ import annotations

import time
from collections import Counter, deque

from trirail.errors import RefusalCode, RefusedError
from trirail.processes.incoming import Incoming
from trirail.processes.replies import Replies
from trirail.wire.links import PacketLink
from trirail.wire.messages import ErrorReply
from trirail.wire.packets import RefusedRequest, message
from trirail.wire.text import is_name, quoted

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
