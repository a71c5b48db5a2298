"""Commands as they come to the gateway: what stops the robot is carried out even where it cannot be read."""

from __future__ import annotations

from collections.abc import Callable

from trirail.errors import RefusalCode, RefusedError
from trirail.processes.inbox import Inbox
from trirail.processes.incoming import Incoming
from trirail.processes.replies import Replies
from trirail.processes.requests import Requests
from trirail.processes.state import StateMaker
from trirail.wire import boundary, zenoh_session
from trirail.wire.messages import CommandReply, ErrorReply
from trirail.wire.stop_door import STOPS
from trirail.wire.text import quoted
from trirail.wire.vocabulary import Command, CommandContent, Stop


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
            return CommandReply(Command.STOP, self._states.newest().mode)
        return error

    def confirmed(self, ticket: int) -> None:
        """Note that a command has been carried out."""
        self._of_unread.discard(ticket)

    def _carry_out(self, incoming: Incoming, user: str, name: Command, content: CommandContent | None) -> None:
        goal = content.goal if isinstance(content, Stop) else None
        reason = f"{name} by {user}"
        backlog = self._requests.backlog
        if goal is not None and backlog.withdraw(goal, reason):  # before the loop has it
            self._replies.answer(incoming, CommandReply(Command.STOP, self._states.newest().mode))
            return
        ticket = self._requests.command(incoming, user, name, content)
        if goal is not None and self._inbox.earlier(incoming.number):
            self._of_unread.add(ticket)
            backlog.withdraw_coming(goal, reason, incoming.number)
        if name.stops and goal is None and (name.everybodys or self._states.lease in (None, user)):
            backlog.withdraw_all(reason, incoming.number)
