"""What the loop is asked in the name of clients: goals by turns, commands at once, each answered exactly once."""

from __future__ import annotations

import time
import uuid
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from typing import NamedTuple

import msgspec

from trirail.config import Config
from trirail.errors import RefusalCode, RefusedError
from trirail.processes.backlog import Backlog
from trirail.processes.guard import Guard
from trirail.processes.incoming import Incoming
from trirail.processes.last_words import LastWords
from trirail.processes.replies import Replies
from trirail.wire.goals import Goal
from trirail.wire.links import PacketLink
from trirail.wire.messages import ErrorReply
from trirail.wire.packets import CommandRequest, GoalRequest, message
from trirail.wire.vocabulary import AcquireLease, Command, CommandContent

AHEAD = 3
"""Goals of one user that the loop has at once: one that is planned, the next one, and one more, which takes the next
one's place where both tell of the same target. The others wait here: a command overtakes them, and what waits when the
robot is told to stop does not begin any more."""
AHEAD_OF_ALL = 16
"""Goals that the loop has at once, of all users: what it takes in four cycles."""
UNDER_WAY = 8
"""Commands of one user that the loop has at once; beyond that they are refused, but for those that stop the robot."""
UNDER_WAY_OF_ALL = 64
"""Likewise, of all users."""
REPLY_WITHIN = 15.0
"""A command that the loop has not carried out by then is answered with an error [s]."""


class _Waiting(NamedTuple):
    incoming: Incoming
    deadline: float


class Requests:
    """Gives goals and commands to the loop, and its answers to those who asked. Each has a ticket, by which it ends."""

    def __init__(
        self,
        config: Config,
        link: PacketLink,
        guard: Guard,
        replies: Replies,
        last_words: LastWords,
        hurrying: Callable[[], AbstractContextManager[None]],
    ) -> None:
        """`hurrying` has the loop take what is sent in it in the cycle in which it comes."""
        homing = [drive.homing.timeout for drive in config.drives.each if drive.homing is not None]
        self._home_within = REPLY_WITHIN + sum(homing)
        self._takeover = config.control.takeover
        self._link = link
        self._hurrying = hurrying
        self._guard = guard
        self._replies = replies
        self._last_words = last_words
        self.backlog = Backlog()
        """Goals that the loop has not been given yet."""
        self._ahead: dict[int, str] = {}
        """The tickets of the goals that the loop has, and whose they are."""
        self._commands: dict[int, str] = {}
        """Likewise, of the commands."""
        self._waiting: dict[int, _Waiting] = {}
        self._tickets = 0

    def __iter__(self) -> Iterator[Incoming]:
        """What is not answered yet."""
        yield from (waiting.incoming for waiting in self._waiting.values())
        yield from (goal.incoming for goal in self.backlog)

    # ------------------------------------------------------------------ goals

    def goal(self, incoming: Incoming, user: str, goal: Goal) -> None:
        """Take a goal, which waits for the user's others. Raises RefusedError where too many do."""
        self.backlog.check_room(user, incoming.size)
        self._tickets += 1
        goal_id = goal.id or uuid.uuid4().hex[:12]
        waited = (time.monotonic_ns() - incoming.arrived_ns) * 1e-9
        age = time.time() - waited - goal.time if goal.time is not None else 0.0
        self.backlog.add(incoming, GoalRequest(self._tickets, user, goal_id, goal, incoming.arrived_ns, age=age))
        self.send_goals()

    def send_goals(self) -> None:
        """Pass on as many goals of each user as the loop is to have."""
        of = Counter(self._ahead.values())
        for user in self.backlog.users:
            if len(self._ahead) >= AHEAD_OF_ALL:
                return
            if of[user] < AHEAD:
                incoming, request = self.backlog.first(user)
                if not self._link.send(message(request)):
                    return
                self.backlog.drop_first(user)
                self._ahead[request.ticket] = user
                self._last_words.follow(request)
                self._waiting[request.ticket] = _Waiting(incoming, time.monotonic() + REPLY_WITHIN)

    # ------------------------------------------------------------------ commands

    def command(self, incoming: Incoming, user: str, name: Command, content: CommandContent | None) -> int:
        """Give a command to the loop; return its ticket.

        Raises RefusedError where it has too many, or the user's role forbids it.
        """
        if not name.stops:
            self._check_under_way(user)
        if isinstance(content, AcquireLease) and content.force:
            self._guard.check(user, self._takeover, "taking the lease over")
        self._tickets += 1
        request = CommandRequest(self._tickets, user, name, content)
        with self._hurrying() if name.stops else nullcontext():
            sent = self._link.send(message(request))
        if not sent:
            raise RefusedError(RefusalCode.BUSY, "too many requests at once: send it again")
        self._commands[request.ticket] = user
        within = self._home_within if name is Command.HOME else REPLY_WITHIN
        self._waiting[request.ticket] = _Waiting(incoming, time.monotonic() + within)
        return request.ticket

    def _check_under_way(self, user: str) -> None:
        """Raise RefusedError where the loop has as many commands of a user, or of all, as it is to have."""
        own = sum(sender == user for sender in self._commands.values())
        if own >= UNDER_WAY:
            raise RefusedError(RefusalCode.BUSY, f"{own} commands of {user} are under way already: send fewer")
        if len(self._commands) >= UNDER_WAY_OF_ALL:
            raise RefusedError(RefusalCode.BUSY, f"{len(self._commands)} commands are under way already: send fewer")

    # ------------------------------------------------------------------ answers

    def answer(self, ticket: int, content: msgspec.Struct) -> None:
        """Answer what has that ticket, and give the loop the next goal."""
        waiting = self._waiting.pop(ticket, None)
        self._commands.pop(ticket, None)
        if waiting is not None:
            self._replies.answer(waiting.incoming, content)
        if self._ahead.pop(ticket, None) is not None:
            self.send_goals()

    def give_up_late(self) -> None:
        """Answer with an error what the loop has not carried out in time."""
        now = time.monotonic()
        for ticket in [ticket for ticket, waiting in self._waiting.items() if waiting.deadline < now]:
            self.answer(ticket, ErrorReply(RefusalCode.TIMEOUT, "not carried out in time"))
