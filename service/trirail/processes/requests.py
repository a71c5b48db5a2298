"""What clients ask of the loop, goals by turns and commands at once, each answered exactly once; and what they tell it.

A command that stops the robot is carried out even where it cannot be read.
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
from trirail.wire import boundary, zenoh_session
from trirail.wire.goals import Goal
from trirail.wire.links import PacketLink
from trirail.wire.looks import WELL, AlignmentLook, in_words
from trirail.wire.messages import CommandReply, ErrorReply
from trirail.wire.packets import CommandRequest, GoalRequest, Looked, message
from trirail.wire.stop_protocol import STOPS
from trirail.wire.text import quoted
from trirail.wire.vocabulary import AcquireLease, Command, CommandContent, Stop

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
LOOKS, LOOKS_PER_SECOND = 50, 20.0
"""Looks of one user that pass at once, and then a second: three times what an alignment without a camera has."""


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
        loop_death: LoopDeath,
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
        self._loop_death = loop_death
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
                self._loop_death.follow(request)
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


class CommandReader:
    """Reads commands and has them carried out; `refuse` answers those that are not."""

    def __init__(
        self,
        robot: str,
        requests: Requests,
        replies: Replies,
        states: StateMaker,
        inbox: Inbox,
        refuse: Callable[[Incoming, RefusedError], None],
    ) -> None:
        self._prefix = zenoh_session.key(robot, "cmd")
        self._requests = requests
        self._replies = replies
        self._states = states
        self._inbox = inbox
        self._refuse = refuse
        self._of_unread: set[int] = set()
        """Tickets of stops of one goal before which others had come that were not read yet: that goal for one."""

    def read(self, incoming: Incoming) -> None:
        """Have a command carried out, unless it is a copy of one that is, or was. Raises RefusedError for none."""
        user, called = boundary.names(incoming.key, self._prefix, ("user", "command"))
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
            # Whoever says stop, however badly, wants it to stop: it is carried out as if it had no content.
            self._carry_out(incoming.unanswered(), user, name, None)
            raise RefusedError(refusal.code, f"{refusal}; the robot is told to {name} all the same") from refusal
        self._carry_out(incoming, user, name, content)

    def refused(self, ticket: int, error: ErrorReply) -> CommandReply | ErrorReply:
        """Return the answer to a command that the loop refuses.

        A goal that it does not know, and that is not read yet, will not begin any more: that is what was asked for.
        """
        unread = ticket in self._of_unread
        self._of_unread.discard(ticket)
        if unread and error.code == RefusalCode.NO_GOAL:
            return self._stopped()
        return error

    def _stopped(self) -> CommandReply:
        """Return the answer to a stop of a goal that never came to the loop."""
        newest = self._states.newest()
        return CommandReply(Command.STOP, newest.mode, newest.seq)

    def confirmed(self, ticket: int) -> None:
        """Note that a command has been carried out."""
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
        if name.stops and goal is None and (name.everybodys or self._states.lease in (None, user)):
            backlog.withdraw_all(reason, incoming.number)


class Looks:
    """What clients tell of their alignments: `send` gives it to the loop, which makes an event of each look."""

    def __init__(self, robot: str, send: Callable[[Looked], bool], clock: Callable[[], float] = time.monotonic) -> None:
        self._prefix = zenoh_session.key(robot, "alignment")
        self._send = send
        self._clock = clock
        self._pace = Pace(LOOKS, LOOKS_PER_SECOND)

    def forward(self, incoming: Incoming) -> AlignmentLook:
        """Pass a look on, and return it. Raises RefusedError."""
        (user,) = boundary.names(incoming.key, self._prefix, ("user",))
        sent: AlignmentLook = incoming.content(AlignmentLook, "not a look of an alignment")
        look = structs.replace(sent, words=quoted(sent.words))
        now = self._clock()
        if self._pace.wait(user, now) > 0.0:
            raise RefusedError(RefusalCode.BUSY, f"more than {LOOKS_PER_SECOND:g} looks a second: send fewer")
        self._pace.count(user, now)
        if not self._send(Looked(user, "info" if look.end in WELL else "warning", in_words(look), look)):
            raise RefusedError(RefusalCode.BUSY, "the loop takes no more now: send it again")
        return look
