"""Requests from clients to the loop, each of which is answered exactly once, and reports of alignments.

The gateway sends goals to the loop in the order of the users' turns, and sends commands and checks immediately. A
command that stops the robot is carried out even if its content cannot be decoded.
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
from trirail.processes.trajectory_parts import TrajectoryParts
from trirail.wire import boundary
from trirail.wire.goals import Goal, LoopGoal
from trirail.wire.links import PacketLink
from trirail.wire.looks import SUCCESSFUL_ENDS, AlignmentLook, alignment_event_text, in_words
from trirail.wire.messages import CommandReply, ErrorReply, Level, Notice
from trirail.wire.packets import CheckRequest, CommandRequest, GoalRequest, message
from trirail.wire.stop_protocol import STOPS
from trirail.wire.text import quoted
from trirail.wire.vocabulary import AcquireLease, Command, CommandContent, Stop

MAX_GOALS_OF_USER = 3
"""Maximum number of goals of one user in the loop.

One goal is being planned, one goal is next, and one more goal may replace the next goal if both have the same target.
Further goals wait in the gateway, where commands overtake them and a stop withdraws them.
"""
MAX_GOALS = 16
"""Maximum number of goals of all users in the loop, which is the number that the loop reads in four cycles."""
MAX_COMMANDS_OF_USER = 8
"""Maximum number of commands and checks of one user in the loop. Further ones are refused, except stops."""
MAX_COMMANDS = 64
"""Maximum number of commands and checks of all users in the loop. Further ones are refused, except stops."""
REPLY_TIMEOUT_S = 15.0
"""Maximum time for the loop to answer a request [s]. After that time, the sender receives an error."""
LOOK_BURST, LOOKS_PER_SECOND = 50, 20.0
"""Maximum number of alignment looks of one user that are accepted in a burst, and afterwards per second.

This is three times the rate at which an alignment without a camera sends looks.
"""


class _PendingRequest(NamedTuple):
    incoming: Incoming
    deadline: float


class Requests:
    """Forwarder of requests to the loop, and of the loop's answers to the senders of the requests.

    A ticket, which is a unique number, identifies each request. The tickets begin with the time, so that they differ
    from those of an earlier gateway. The loop may still answer its commands after a restart.
    """

    def __init__(
        self,
        config: Config,
        link: PacketLink,
        guard: Guard,
        replies: Replies,
        loop_death: LoopDeath,
        urgent_section: Callable[[], AbstractContextManager[None]],
    ) -> None:
        """Connect the parts.

        `urgent_section` returns a context. The loop handles packets sent within it in the cycle in which they arrive.
        """
        homing = [drive.homing.timeout for drive in config.drives.each if drive.homing is not None]
        self._takes = {Command.HOME: sum(homing), Command.ENABLE: config.watchdogs.enable_timeout}
        """Longest time that a command may take, besides REPLY_TIMEOUT_S [s]."""
        self._takeover = config.control.takeover
        self._link = link
        self._urgent_section = urgent_section
        self._guard = guard
        self._replies = replies
        self._loop_death = loop_death
        self.backlog = Backlog()
        """Goals that have not been sent to the loop yet."""
        self._goals: dict[int, GoalRequest] = {}
        """Goals in the loop, by ticket."""
        self._commands: dict[int, str] = {}
        """User of each command and check in the loop, by ticket."""
        self._acquires: dict[int, str] = {}
        """User of each request for the lease in the loop, by ticket."""
        self._pending: dict[int, _PendingRequest] = {}
        self._tickets = time.monotonic_ns()

    def __iter__(self) -> Iterator[Incoming]:
        """Yield the messages that have not been answered."""
        yield from (waiting.incoming for waiting in self._pending.values())
        yield from (goal.incoming for goal in self.backlog)

    # ------------------------------------------------------------------ goals

    def goal(self, incoming: Incoming, user: str, goal: Goal) -> None:
        """Enqueue a goal after the user's other goals. Raises RefusedError if too many goals are waiting."""
        self.backlog.check_room(user, incoming.size)
        self._tickets += 1
        goal_id = goal.id or uuid.uuid4().hex[:12]
        waited = (time.monotonic_ns() - incoming.arrived_ns) * 1e-9
        age = time.time() - waited - goal.time if goal.time is not None else 0.0
        self.backlog.add(incoming, GoalRequest(self._tickets, user, goal_id, goal, incoming.arrived_ns, age=age))
        self.send_goals()

    def send_goals(self) -> None:
        """Send goals to the loop, up to the limits per user and in total."""
        of = Counter(goal.user for goal in self._goals.values())
        for user in self.backlog.users:
            if len(self._goals) >= MAX_GOALS:
                return
            if of[user] < MAX_GOALS_OF_USER:
                incoming, request = self.backlog.first(user)
                if not self._link.send(message(request)):
                    return
                self.backlog.drop_first(user)
                self._goals[request.ticket] = request
                self._loop_death.follow(request)
                self._pending[request.ticket] = _PendingRequest(incoming, time.monotonic() + REPLY_TIMEOUT_S)

    def in_loop(self, goal_id: str) -> bool:
        """Return True if a goal with this id has been sent to the loop and has not ended.

        Another goal with this id may be waiting, if its sender has sent it again.
        """
        return self._loop_death.is_open(goal_id)

    # ------------------------------------------------------------------ commands

    def command(self, incoming: Incoming, user: str, name: Command, content: CommandContent | None) -> int:
        """Send a command to the loop; return the ticket of the command.

        Raises RefusedError if too many commands are in progress, or if the command takes over the lease and the role of
        the user does not allow that.
        """
        renews = isinstance(content, AcquireLease) and user not in self._acquires.values()
        if not (name.stops or renews):  # other commands must not end a lease
            self._check_command_count(user)
        if isinstance(content, AcquireLease) and content.force:
            self._guard.check(user, self._takeover, "taking over the lease")
        self._tickets += 1
        request = CommandRequest(self._tickets, user, name, content)
        with self._urgent_section() if name.stops else nullcontext():
            self._send(incoming, request, REPLY_TIMEOUT_S + self._takes.get(name, 0.0))
        if isinstance(content, AcquireLease):
            self._acquires[request.ticket] = user
        return request.ticket

    def check(self, incoming: Incoming, user: str, goal: LoopGoal) -> None:
        """Ask the loop to plan a goal without moving. Raises RefusedError if too many requests are in progress."""
        self._check_command_count(user)
        self._tickets += 1
        self._send(incoming, CheckRequest(self._tickets, user, goal), REPLY_TIMEOUT_S)

    def _send(self, incoming: Incoming, request: CommandRequest | CheckRequest, within: float) -> None:
        """Send a request to the loop, with a time-out `within` [s]. Raises RefusedError if the loop's queue is full."""
        if not self._link.send(message(request)):
            raise RefusedError(RefusalCode.BUSY, "the queue of requests to the loop is full: send the request again")
        self._commands[request.ticket] = request.user
        self._pending[request.ticket] = _PendingRequest(incoming, time.monotonic() + within)

    def _check_command_count(self, user: str) -> None:
        """Raise RefusedError if too many commands and checks are in progress, either for this user or overall."""
        own, all_ = sum(sender == user for sender in self._commands.values()), len(self._commands)
        if own >= MAX_COMMANDS_OF_USER:
            raise RefusedError(
                RefusalCode.BUSY, f"{own} commands of {user} are already in progress, which is the maximum: send fewer"
            )
        if all_ >= MAX_COMMANDS:
            raise RefusedError(
                RefusalCode.BUSY, f"{all_} commands are already in progress, which is the maximum: send fewer"
            )

    def stop(self, user: str) -> bool:
        """Stop the robot and withdraw all waiting goals, for the service itself.

        `user` is the name that the events show. Return False if the loop's queue is full.
        """
        self.backlog.withdraw_others(None, f"stop by {user}")
        self._tickets += 1
        with self._urgent_section():
            return self._link.send(message(CommandRequest(self._tickets, user, Command.STOP)))

    # ------------------------------------------------------------------ answers

    def answer(self, ticket: int, content: msgspec.Struct) -> None:
        """Answer the request with this ticket. If the request was a goal, send the next goals to the loop."""
        waiting = self._pending.pop(ticket, None)
        self._commands.pop(ticket, None)
        self._acquires.pop(ticket, None)
        if waiting is not None:
            self._replies.answer(waiting.incoming, content)
        if self._goals.pop(ticket, None) is not None:
            self.send_goals()

    def expire(self) -> None:
        """Answer requests that the loop has not answered in time with a time-out error.

        A goal that has such an answer must not begin later, so it is stopped.
        """
        now = time.monotonic()
        for ticket in [ticket for ticket, waiting in self._pending.items() if waiting.deadline < now]:
            goal = self._goals.get(ticket)
            if goal is not None and not goal.goal.renewed:
                self._tickets += 1
                with self._urgent_section():
                    self._link.send(message(CommandRequest(self._tickets, goal.user, Command.STOP, Stop(goal.id))))
            self.answer(ticket, ErrorReply(RefusalCode.TIMEOUT, "the request was not carried out in time"))


class CommandReader:
    """Decoder of commands, which passes valid commands to Requests and refuses all others."""

    def __init__(
        self,
        requests: Requests,
        replies: Replies,
        states: StateMaker,
        inbox: Inbox,
        parts: TrajectoryParts,
        refuse: Callable[[Incoming, RefusedError], None],
    ) -> None:
        self._requests = requests
        self._replies = replies
        self._states = states
        self._inbox = inbox
        self._parts = parts
        self._refuse = refuse
        self._of_unread: set[int] = set()
        """Tickets of stops that apply to a single goal, if that goal or a part of it has not been sent to the loop."""

    def read(self, incoming: Incoming, user: str, command: str) -> None:
        """Carry out a command, unless it is a copy of an earlier one. Raises RefusedError for an unknown command."""
        name = boundary.command_named(command)
        fresh = self._replies.without_copies(incoming) if name in STOPS else incoming
        if fresh is None:
            return
        try:
            self._read(fresh, user, name)
        except RefusedError as refusal:
            self._refuse(fresh, refusal)

    def _read(self, incoming: Incoming, user: str, name: Command) -> None:
        try:
            content = incoming.content(name.accepts, f"{name} accepts {name.content.words}")
        except RefusedError as refusal:
            if name not in STOPS:
                raise
            # The sender of a malformed stop wants to stop the robot. Carry the stop out as if it had no content.
            self._carry_out(incoming.unanswered(), user, name, None)
            raise RefusedError(refusal.code, f"{refusal}; {name} is carried out nevertheless") from refusal
        self._carry_out(incoming, user, name, content)

    def refused(self, ticket: int, error: ErrorReply) -> CommandReply | ErrorReply:
        """Return the reply to a command that the loop has refused.

        The loop refuses a stop of a goal that it does not know. If the goal may not have been read yet, the stop is
        confirmed nevertheless, because the goal will be withdrawn when it is read.
        """
        unread = ticket in self._of_unread
        self._of_unread.discard(ticket)
        if unread and error.code == RefusalCode.NO_GOAL:
            return self._stopped()
        return error

    def _stopped(self) -> CommandReply:
        """Return the reply to a stop of a goal that is withdrawn before the loop begins it."""
        newest = self._states.newest()
        return CommandReply(Command.STOP, newest.mode, newest.seq)

    def confirmed(self, ticket: int) -> None:
        """Record that the loop has carried out a command."""
        self._of_unread.discard(ticket)

    def _carry_out(self, incoming: Incoming, user: str, name: Command, content: CommandContent | None) -> None:
        goal = content.goal if isinstance(content, Stop) else None
        reason = f"{name} by {user}"
        backlog = self._requests.backlog
        withdrawn = goal is not None and backlog.withdraw(goal, reason)
        if goal is not None and withdrawn and not self._requests.in_loop(goal):
            self._replies.answer(incoming, self._stopped())
            return
        if name.starts:
            backlog.check_stops(incoming)
        renews = name.ignores_lease and self._states.lease == user
        if not (name.stops or renews):
            incoming.check_age()
        ticket = self._requests.command(incoming, user, name, content)
        if goal is not None and (withdrawn or self._inbox.earlier(incoming.number) or self._parts.is_incomplete(goal)):
            self._of_unread.add(ticket)
            backlog.withdraw_coming(goal, reason, incoming.number)
        if name.stops and goal is None and (name.ignores_lease or self._states.lease in (None, user)):
            backlog.withdraw_all(reason, incoming, ends_calls=name in STOPS)


class Looks:
    """Forwarder of alignment looks, which clients report and the loop publishes as events."""

    def __init__(self, announce: Callable[[Notice], bool], clock: Callable[[], float] = time.monotonic) -> None:
        self._announce = announce
        self._clock = clock
        self._pace = Pace(LOOK_BURST, LOOKS_PER_SECOND)

    def forward(self, user: str, received: AlignmentLook) -> AlignmentLook:
        """Forward a look of a user to the loop, and return it. Raises RefusedError if the user sends too many looks."""
        look = structs.replace(received, words=quoted(received.words))
        now = self._clock()
        if self._pace.wait(user, now) > 0.0:
            raise RefusedError(RefusalCode.BUSY, f"more than {LOOKS_PER_SECOND:g} looks per second: report fewer looks")
        self._pace.count(user, now)
        level: Level = "info" if look.end in SUCCESSFUL_ENDS else "warning"
        text = alignment_event_text(look, in_words(look))
        if not self._announce(Notice("alignment", level, text.text, user=user, alignment=look, **text.fields)):
            raise RefusedError(
                RefusalCode.BUSY, "the loop's message queue is full: send the observation of the marks again"
            )
        return look
