"""Requests of clients to the loop, each answered exactly once; alignment reports.

Goals are sent in turn, commands and checks immediately. A command that stops the robot is carried out even if it cannot
be read.
"""

from __future__ import annotations

import time
import uuid
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from typing import NamedTuple

import msgspec
from msgspec import structs

from trirail.config import Config
from trirail.errors import RefusalCode, RefusedError
from trirail.processes.inbox import Inbox
from trirail.processes.incoming import Backlog, Incoming, Pace
from trirail.processes.loop_death import LoopDeath
from trirail.processes.publications import StateMaker
from trirail.processes.replies import Replies
from trirail.processes.session_guard import Guard
from trirail.wire.goals import Goal, LoopGoal
from trirail.wire.links import PacketLink
from trirail.wire.looks import SUCCESSFUL_ENDS, AlignmentLook, alignment_event_text, in_words
from trirail.wire.messages import CommandReply, ErrorReply, Level, Notice
from trirail.wire.packets import CheckRequest, CommandRequest, GoalRequest, message
from trirail.wire.stop_protocol import STOPS
from trirail.wire.text import quoted
from trirail.wire.vocabulary import AcquireLease, Command, CommandContent, Stop

AHEAD = 3
"""Goals of one user that the loop has at a time: one being planned, the next one, and one more, which replaces the
next one if both have the same target. The others wait here: a command overtakes them, and goals that wait when the
robot is stopped do not begin any more."""
AHEAD_OF_ALL = 16
"""Goals of all users that the loop has at a time: as many as it takes in four cycles."""
UNDER_WAY = 8
"""Commands and checks of one user that the loop has at a time; more are refused, except those that stop the robot."""
UNDER_WAY_OF_ALL = 64
"""The same for all users."""
REPLY_WITHIN = 15.0
"""Longest time for the loop to carry a command out; after it an error is answered [s]."""
LOOKS, LOOKS_PER_SECOND = 50, 20.0
"""Looks of one user that pass in a burst, and then per second: three times those of an alignment without a camera."""


class _Waiting(NamedTuple):
    incoming: Incoming
    deadline: float


class Requests:
    """Goals and commands of clients in the loop, each with a ticket until it ends; passes answers to their senders."""

    def __init__(
        self,
        config: Config,
        link: PacketLink,
        guard: Guard,
        replies: Replies,
        loop_death: LoopDeath,
        hurrying: Callable[[], AbstractContextManager[None]],
    ) -> None:
        """`hurrying` makes the loop handle packets sent in it in the cycle in which they arrive."""
        homing = [drive.homing.timeout for drive in config.drives.each if drive.homing is not None]
        self._home_within = REPLY_WITHIN + sum(homing)
        self._takeover = config.control.takeover
        self._link = link
        self._hurrying = hurrying
        self._guard = guard
        self._replies = replies
        self._loop_death = loop_death
        self.backlog = Backlog()
        """Goals that the loop has not been given yet."""
        self._ahead: dict[int, str] = {}
        """Users of the goals that the loop has, by ticket."""
        self._commands: dict[int, str] = {}
        """Users of the commands and checks that the loop has, by ticket."""
        self._waiting: dict[int, _Waiting] = {}
        self._tickets = 0

    def __iter__(self) -> Iterator[Incoming]:
        """Yield the messages that are not answered yet."""
        yield from (waiting.incoming for waiting in self._waiting.values())
        yield from (goal.incoming for goal in self.backlog)

    # ------------------------------------------------------------------ goals

    def goal(self, incoming: Incoming, user: str, goal: Goal) -> None:
        """Enqueue a goal behind the user's others. Raises RefusedError if too many wait."""
        self.backlog.check_room(user, incoming.size)
        self._tickets += 1
        goal_id = goal.id or uuid.uuid4().hex[:12]
        waited = (time.monotonic_ns() - incoming.arrived_ns) * 1e-9
        age = time.time() - waited - goal.time if goal.time is not None else 0.0
        self.backlog.add(incoming, GoalRequest(self._tickets, user, goal_id, goal, incoming.arrived_ns, age=age))
        self.send_goals()

    def send_goals(self) -> None:
        """Send the loop as many goals of each user as it may have."""
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
                self._loop_death.follow(request)
                self._waiting[request.ticket] = _Waiting(incoming, time.monotonic() + REPLY_WITHIN)

    # ------------------------------------------------------------------ commands

    def command(self, incoming: Incoming, user: str, name: Command, content: CommandContent | None) -> int:
        """Send a command to the loop; return its ticket.

        Raises RefusedError if the loop has too many, or the user's role forbids it.
        """
        if not name.stops:
            self._check_under_way(user)
        if isinstance(content, AcquireLease) and content.force:
            self._guard.check(user, self._takeover, "taking the lease over")
        self._tickets += 1
        request = CommandRequest(self._tickets, user, name, content)
        with self._hurrying() if name.stops else nullcontext():
            self._send(incoming, request, self._home_within if name is Command.HOME else REPLY_WITHIN)
        return request.ticket

    def check(self, incoming: Incoming, user: str, goal: LoopGoal) -> None:
        """Have a goal planned without moving to it. Raises RefusedError if too many requests are under way."""
        self._check_under_way(user)
        self._tickets += 1
        self._send(incoming, CheckRequest(self._tickets, user, goal), REPLY_WITHIN)

    def _send(self, incoming: Incoming, request: CommandRequest | CheckRequest, within: float) -> None:
        """Send the loop a request, to be answered within a time [s]. Raises RefusedError if it takes no more."""
        if not self._link.send(message(request)):
            raise RefusedError(RefusalCode.BUSY, "too many requests at once: send it again")
        self._commands[request.ticket] = request.user
        self._waiting[request.ticket] = _Waiting(incoming, time.monotonic() + within)

    def _check_under_way(self, user: str) -> None:
        """Raise RefusedError if the loop has the most commands and checks that it may have, of a user or of all."""
        own, all_ = sum(sender == user for sender in self._commands.values()), len(self._commands)
        if own >= UNDER_WAY:
            raise RefusedError(RefusalCode.BUSY, f"{own} commands of {user} are under way already: send fewer")
        if all_ >= UNDER_WAY_OF_ALL:
            raise RefusedError(RefusalCode.BUSY, f"{all_} commands are under way already: send fewer")

    # ------------------------------------------------------------------ answers

    def answer(self, ticket: int, content: msgspec.Struct) -> None:
        """Answer the request with that ticket, and send the loop the next goal."""
        waiting = self._waiting.pop(ticket, None)
        self._commands.pop(ticket, None)
        if waiting is not None:
            self._replies.answer(waiting.incoming, content)
        if self._ahead.pop(ticket, None) is not None:
            self.send_goals()

    def give_up_late(self) -> None:
        """Answer requests that the loop has not carried out in time, with an error."""
        now = time.monotonic()
        for ticket in [ticket for ticket, waiting in self._waiting.items() if waiting.deadline < now]:
            self.answer(ticket, ErrorReply(RefusalCode.TIMEOUT, "not carried out in time"))


class CommandReader:
    """Reader of commands, which has them carried out; `refuse` answers the others."""

    def __init__(
        self,
        requests: Requests,
        replies: Replies,
        states: StateMaker,
        inbox: Inbox,
        refuse: Callable[[Incoming, RefusedError], None],
    ) -> None:
        self._requests = requests
        self._replies = replies
        self._states = states
        self._inbox = inbox
        self._refuse = refuse
        self._of_unread: set[int] = set()
        """Tickets of stops of one goal, sent behind messages not read yet: one of these may be that goal."""

    def read(self, incoming: Incoming, user: str, called: str) -> None:
        """Carry a command out, unless it is a copy of an earlier one. Raises RefusedError for an unknown one."""
        try:
            name = Command(called)
        except ValueError as error:
            problem = f"{quoted(called)}: no such command; there are {', '.join(Command)}"
            raise RefusedError(RefusalCode.UNKNOWN_COMMAND, problem) from error
        fresh = self._replies.fresh(incoming) if name in STOPS else incoming
        if fresh is None:
            return
        try:
            self._read(fresh, user, name)
        except RefusedError as refusal:
            self._refuse(fresh, refusal)

    def _read(self, incoming: Incoming, user: str, name: Command) -> None:
        try:
            content = incoming.content(name.accepts, f"{name} takes {name.content.words}")
        except RefusedError as refusal:
            if name not in STOPS:
                raise
            # A stop, however malformed, is meant as one: it is carried out as if it had no content.
            self._carry_out(incoming.unanswered(), user, name, None)
            raise RefusedError(refusal.code, f"{refusal}; the robot is told to {name} all the same") from refusal
        self._carry_out(incoming, user, name, content)

    def refused(self, ticket: int, error: ErrorReply) -> CommandReply | ErrorReply:
        """Return the answer to a command that the loop refuses.

        A goal that the loop does not know, and that is still unread, will not begin any more: the request is fulfilled.
        """
        unread = ticket in self._of_unread
        self._of_unread.discard(ticket)
        if unread and error.code == RefusalCode.NO_GOAL:
            return self._stopped()
        return error

    def _stopped(self) -> CommandReply:
        """Return the answer to a stop of a goal that never reached the loop."""
        newest = self._states.newest()
        return CommandReply(Command.STOP, newest.mode, newest.seq)

    def confirmed(self, ticket: int) -> None:
        """Record that a command has been carried out."""
        self._of_unread.discard(ticket)

    def _carry_out(self, incoming: Incoming, user: str, name: Command, content: CommandContent | None) -> None:
        goal = content.goal if isinstance(content, Stop) else None
        reason = f"{name} by {user}"
        backlog = self._requests.backlog
        if goal is not None and backlog.withdraw(goal, reason):  # before the loop has it
            self._replies.answer(incoming, self._stopped())
            return
        ticket = self._requests.command(incoming, user, name, content)
        if goal is not None and self._inbox.earlier(incoming.number):
            self._of_unread.add(ticket)
            backlog.withdraw_coming(goal, reason, incoming.number)
        if name.stops and goal is None and (name.ignores_lease or self._states.lease in (None, user)):
            backlog.withdraw_all(reason, incoming.number)


class Looks:
    """Alignment looks that clients report; `announce` has the loop make an event of each."""

    def __init__(self, announce: Callable[[Notice], bool], clock: Callable[[], float] = time.monotonic) -> None:
        self._announce = announce
        self._clock = clock
        self._pace = Pace(LOOKS, LOOKS_PER_SECOND)

    def forward(self, user: str, sent: AlignmentLook) -> AlignmentLook:
        """Forward a look, and return it. Raises RefusedError."""
        look = structs.replace(sent, words=quoted(sent.words))
        now = self._clock()
        if self._pace.wait(user, now) > 0.0:
            raise RefusedError(RefusalCode.BUSY, f"more than {LOOKS_PER_SECOND:g} looks a second: send fewer")
        self._pace.count(user, now)
        level: Level = "info" if look.end in SUCCESSFUL_ENDS else "warning"
        text = alignment_event_text(look, in_words(look))
        if not self._announce(Notice("alignment", level, text.text, user=user, alignment=look, **text.fields)):
            raise RefusedError(RefusalCode.BUSY, "the loop takes no more now: send it again")
        return look
