"""The gateway's process: Zenoh on one side, the loop on the other. It checks and translates; it decides nothing."""

from __future__ import annotations

import contextlib
import math
import select
import signal
import sys
import time
import uuid
from collections import Counter, deque
from collections.abc import Callable
from typing import NamedTuple

import msgspec
import zenoh

from trirail.config import Config
from trirail.errors import RefusalCode, RefusedError
from trirail.processes.backlog import Backlog
from trirail.processes.guard import Guard
from trirail.processes.heartbeats import BEAT_EVERY
from trirail.processes.inbox import Inbox, Incoming
from trirail.processes.info import info
from trirail.processes.last_words import LastWords
from trirail.processes.measured import Meter
from trirail.processes.poses import Poses
from trirail.processes.publications import Publications
from trirail.processes.replies import Replies
from trirail.processes.state import StateMaker
from trirail.wire import boundary, zenoh_session
from trirail.wire.links import Closed, PacketLink
from trirail.wire.messages import (
    CONTENT,
    AcquireLease,
    CommandReply,
    ErrorReply,
    Event,
    Goal,
    GoalReply,
    NoContent,
    Override,
    ReleaseLease,
    RoleReply,
    Stop,
    TrackGoal,
)
from trirail.wire.packets import (
    Accepted,
    Answer,
    CommandRequest,
    Confirmed,
    GoalRequest,
    Happened,
    Kind,
    PoseChanged,
    Refused,
    RefusedRequest,
    Status,
    Welcome,
    decode_answer,
    message,
)
from trirail.wire.records import unpack
from trirail.wire.text import is_name, quoted
from trirail.wire.vocabulary import Command, Mode

SWITCH_EVERY = 0.0005
"""After so long a thread lets another have the interpreter, which Zenoh's threads need to hand a message over [s]."""
AT_ONCE = 256
"""Messages from Zenoh that are read before the loop is listened to again."""
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
TOO_MUCH = "too many messages at once: send fewer"
REFUSALS_PER_SECOND = 10
"""What is refused of one user that is told to everyone; the rest only gets its error reply."""
REFUSALS_OF_ALL = 50
"""Likewise, of all users."""


class _Waiting(NamedTuple):
    incoming: Incoming
    deadline: float


class Gateway:
    """Takes requests from Zenoh, passes them to the loop, and answers and publishes what the loop says."""

    def __init__(
        self,
        config: Config,
        link: PacketLink,
        beat: Callable[[], None],
        opened: zenoh.Session,
        guard: Guard,
        log: Callable[[Event], None] = lambda _: None,
        measured: Callable[[msgspec.Struct], None] = lambda _: None,
    ) -> None:
        self._log = log
        self._robot = config.robot.name
        homing = [drive.homing.timeout for drive in config.drives.each if drive.homing is not None]
        self._home_within = REPLY_WITHIN + sum(homing)
        self._link = link
        self._beat = beat
        self._guard = guard
        self._takeover = config.control.takeover
        self._last_words = LastWords(config.period)
        self._info = info(config)
        self._states = StateMaker(config)
        self._meter = Meter(measured) if config.telemetry.metrics_port else None
        self._state_every = 1.0 / config.telemetry.state_hz
        self._state_due = 0.0
        self._replies = Replies(self._robot)
        self._inbox = Inbox(opened, self._robot, self._too_much)
        self._poses = Poses(config, self._replies.send, self._refuse, self._tell_of_pose, self._inbox.wake)
        self._backlog = Backlog()
        self._ahead: dict[int, str] = {}
        """The tickets of the goals that the loop has, and whose they are."""
        self._commands: dict[int, str] = {}
        """Likewise, of the commands."""
        self._waiting: dict[int, _Waiting] = {}
        self._tickets = 0
        self._refusals: Counter[str] = Counter()
        self._refusals_since = 0.0
        self._overruns: deque[str] = deque(maxlen=REFUSALS_OF_ALL)
        self._ending = False
        self._publications = Publications(opened, self._robot)

    def serve(self, ready: Callable[[], None]) -> None:
        """Serve until told to end or the loop has gone; `ready` is called once the loop has said welcome."""
        poll = select.poll()
        poll.register(self._link.fileno(), select.POLLIN)
        poll.register(self._inbox.fileno(), select.POLLIN)
        try:
            while not self._ending:
                self._beat()
                poll.poll(math.ceil(min(BEAT_EVERY, self._inbox.due()) * 1e3))
                for incoming in self._inbox.take(AT_ONCE):
                    self._beat()
                    self._handle(incoming)
                while (packet := self._link.receive()) is not None:
                    self._beat()
                    self._last_words.heard()
                    self._hear(packet, ready)
                self._send_goals()  # those for which there was no room
                self._poses.settle()
                self._give_up_late()
                self._tell_of_overruns()
        except Closed:
            self._tell_of_its_end()
        finally:
            with contextlib.suppress(Closed):
                self._poses.close()
            for incoming in [
                *(waiting.incoming for waiting in self._waiting.values()),
                *(goal.incoming for goal in self._backlog),
            ]:
                self._replies.send(incoming, ErrorReply(RefusalCode.ENDED, "the service has ended"))
            self._replies.close()

    def warnings(self) -> tuple[str, ...]:
        """Return what people should know of how the service is run, one line each."""
        return (*self._guard.warnings(), *self._poses.warnings())

    def end(self) -> None:
        """End soon; safe from a signal handler."""
        self._ending = True
        self._inbox.wake()

    # ------------------------------------------------------------------ Zenoh to loop

    def _handle(self, incoming: Incoming) -> None:
        """Take a message; whatever is wrong with it is answered, and told to everyone, since a put has no answer."""
        try:
            boundary.check_size(incoming.size)
            if incoming.kind == "info":
                self._replies.send(incoming, self._info)
            elif incoming.kind == "role":
                (user,) = boundary.names(incoming.key, self._key("role"), ("user",))
                self._replies.send(incoming, RoleReply(user, self._guard.role(user)))
            elif incoming.kind == "goal":
                self._goal(incoming)
            elif incoming.kind == "poses":
                self._replies.send(incoming, self._poses.table())
            elif incoming.kind in ("teach", "forget"):
                self._poses.take(incoming)
            else:
                self._command(incoming)
        except RefusedError as refusal:
            self._refuse(incoming, refusal)
        except Closed:
            raise
        except Exception as error:  # noqa: BLE001 - a message that is read wrongly must not end the gateway
            self._refuse(incoming, RefusedError(RefusalCode.INTERNAL, f"internal error, please report it: {error!r}"))

    def _goal(self, incoming: Incoming) -> None:
        (user,) = boundary.names(incoming.key, self._key("goal"), ("user",))
        sent: Goal = boundary.decode(incoming.payload, Goal, "not a goal", incoming.encoding)
        goal = self._poses.of_name(sent)
        self._backlog.check_room(user, incoming.size)
        self._tickets += 1
        goal_id = goal.id or uuid.uuid4().hex[:12]
        told_of = goal.time if isinstance(goal, TrackGoal) else None
        age = time.time() - told_of if told_of is not None else 0.0
        self._backlog.add(incoming, GoalRequest(self._tickets, user, goal_id, goal, time.monotonic_ns(), age=age))
        self._send_goals()

    def _send_goals(self) -> None:
        """Pass on as many goals of each user as the loop is to have."""
        of = Counter(self._ahead.values())
        for user in self._backlog.users:
            if len(self._ahead) >= AHEAD_OF_ALL:
                return
            if of[user] < AHEAD:
                incoming, request = self._backlog.first(user)
                if not self._link.send(message(request)):
                    return
                self._backlog.take(user)
                self._ahead[request.ticket] = user
                self._last_words.take(request)
                self._waiting[request.ticket] = _Waiting(incoming, time.monotonic() + REPLY_WITHIN)

    def _command(self, incoming: Incoming) -> None:
        user, called = boundary.names(incoming.key, self._key("cmd"), ("user", "command"))
        try:
            name = Command(called)
        except ValueError as error:
            problem = f"{quoted(called)}: no such command; there are {', '.join(Command)}"
            raise RefusedError(RefusalCode.UNKNOWN_COMMAND, problem) from error
        takes = f"{name} takes {name.content}"
        content = boundary.decode(incoming.payload, CONTENT.get(name, NoContent | None), takes, incoming.encoding)
        goal = content.goal if isinstance(content, Stop) else None
        reason = f"{name} by {user}"
        if goal is not None and self._backlog.withdraw(goal, reason):  # before the loop has it
            self._replies.send(incoming, CommandReply(Command.STOP, self._states.newest().mode))
            return
        if not name.stops:
            self._check_under_way(user)
        request = self._request(user, name, content)
        if not self._link.send(message(request)):
            raise RefusedError(RefusalCode.BUSY, "too many requests at once: send it again")
        self._commands[request.ticket] = user
        within = self._home_within if name is Command.HOME else REPLY_WITHIN
        self._waiting[request.ticket] = _Waiting(incoming, time.monotonic() + within)
        if name.stops and goal is None and (name.everybodys or self._states.lease in (None, user)):
            self._backlog.withdraw_all(reason, incoming.number)

    def _check_under_way(self, user: str) -> None:
        """Raise RefusedError where the loop has as many commands of a user, or of all, as it is to have."""
        own = sum(sender == user for sender in self._commands.values())
        if own >= UNDER_WAY:
            raise RefusedError(RefusalCode.BUSY, f"{own} commands of {user} are under way already: send fewer")
        if len(self._commands) >= UNDER_WAY_OF_ALL:
            raise RefusedError(RefusalCode.BUSY, f"{len(self._commands)} commands are under way already: send fewer")

    def _request(self, user: str, name: Command, content: msgspec.Struct | None) -> CommandRequest:
        """Make of a command and what it carries what the loop takes. Raises RefusedError for what a role forbids."""
        self._tickets += 1
        match content:
            case Override(percent):
                return CommandRequest(self._tickets, user, name, percent / 100.0)
            case Stop(goal):
                return CommandRequest(self._tickets, user, name, goal=goal)
            case AcquireLease(lease, timeout, force):
                if force:
                    self._guard.check(user, self._takeover, "taking the lease over")
                return CommandRequest(self._tickets, user, name, lease=lease, timeout=timeout, force=force)
            case ReleaseLease(lease):
                return CommandRequest(self._tickets, user, name, lease=lease)
        return CommandRequest(self._tickets, user, name)

    def _too_much(self, incoming: Incoming) -> None:
        """Answer what there is no room for; called by Zenoh's threads."""
        self._overruns.append(incoming.user)
        self._replies.send(incoming, ErrorReply(RefusalCode.BUSY, TOO_MUCH))

    def _tell_of_overruns(self) -> None:
        """Tell everyone whose messages there was no room for: a put has no answer."""
        while self._overruns:
            user = self._overruns.popleft()
            self._tell(TOO_MUCH, user if is_name(user) else "")

    def _refuse(self, incoming: Incoming, refusal: RefusedError) -> None:
        """Answer what cannot be taken; tell everyone too, since a put has no answer."""
        text = quoted(str(refusal))
        self._replies.send(incoming, ErrorReply(refusal.code, text))
        self._tell(text, incoming.user if is_name(incoming.user) else "")

    def _tell_of_pose(self, changed: PoseChanged) -> None:
        self._link.send(message(changed))

    def _tell(self, text: str, user: str = "") -> None:
        """Have the loop tell everyone, but not too often."""
        now = time.monotonic()
        if now - self._refusals_since >= 1.0:
            self._refusals.clear()
            self._refusals_since = now
        if self._refusals[user] < REFUSALS_PER_SECOND and self._refusals.total() < REFUSALS_OF_ALL:
            self._refusals[user] += 1
            self._link.send(message(RefusedRequest(user, text)))

    # ------------------------------------------------------------------ loop to Zenoh

    def _hear(self, packet: bytes, ready: Callable[[], None]) -> None:
        """Take a packet of the loop's."""
        content = memoryview(packet)[1:]
        try:
            if packet[0] == Kind.RECORDS:
                self._publish(content)
                return
            answer = decode_answer(content)
            self._take(answer)
        except Closed:
            raise
        except Exception as error:  # noqa: BLE001 - it would come again after every restart
            self._tell(quoted(f"the gateway could not read what the loop said, please report it: {error!r}"))
            return
        if isinstance(answer, Welcome):
            self._info = msgspec.structs.replace(self._info, missing_protections=answer.missing_protections)
            self._inbox.declare()
            ready()

    def _take(self, answer: Answer) -> None:
        self._last_words.take(answer)
        match answer:
            case Happened(event):
                self._happened(event)
            case Status() | Welcome():
                self._states.update(answer)
            case Accepted(ticket, goal_id, duration, slowed, stops_first, queued, lag):
                expected = duration if math.isfinite(duration) else None
                self._answer(ticket, GoalReply(goal_id, expected, slowed, stops_first, queued, lag))
            case Confirmed(ticket, name, mode):
                self._answer(ticket, CommandReply(name, mode))
            case Refused(ticket, code, text, slider, value, limit):
                self._answer(ticket, ErrorReply(code, text, slider, value, limit))

    def _publish(self, batch: memoryview) -> None:
        """Take in a batch of records and pass it on; publish the newest state when it is time."""
        rows = unpack(batch)
        self._publications.records(bytes(batch))
        self._states.records(rows)
        self._poses.measure(rows[-1])
        if self._meter is not None:
            self._meter.records(rows)
            self._meter.tell(self._states.newest)
        now = time.monotonic()
        if now >= self._state_due:
            self._state_due = max(self._state_due + self._state_every, now)
            self._publications.state(self._states.newest(self.warnings()))

    def _happened(self, event: Event) -> None:
        """Tell everyone of an event, and the service's log; what others have sent under a new holder does not begin."""
        if event.kind == "lease":
            self._backlog.withdraw_others(event.user, event.message)
        self._publications.event(event)
        self._log(event)
        if self._meter is not None:
            self._meter.event(event)

    def _tell_of_its_end(self) -> None:
        """The loop has gone: where it has died, tell everyone in its place."""
        for event in self._last_words.events(self._states.cycle):
            self._happened(event)
        if (reason := self._last_words.reason) and self._states.cycle:
            state = msgspec.structs.replace(self._states.newest(), mode=Mode.FAULT, goal=None, faults=(reason,))
            self._publications.state(state)

    def _answer(self, ticket: int, content: msgspec.Struct) -> None:
        waiting = self._waiting.pop(ticket, None)
        self._commands.pop(ticket, None)
        if waiting is not None:
            self._replies.send(waiting.incoming, content)
        if self._ahead.pop(ticket, None) is not None:
            self._send_goals()

    def _give_up_late(self) -> None:
        now = time.monotonic()
        for ticket in [ticket for ticket, waiting in self._waiting.items() if waiting.deadline < now]:
            self._answer(ticket, ErrorReply(RefusalCode.TIMEOUT, "not carried out in time"))

    def _key(self, *parts: str) -> str:
        return zenoh_session.key(self._robot, *parts)


def main(
    config: Config,
    link: PacketLink,
    beat: Callable[[], None],
    ready: Callable[[object], None],
    log: Callable[[Event], None],
    measured: Callable[[msgspec.Struct], None],
) -> int:
    """Run the gateway's process.

    `ready` is called once it can be reached, `log` with each event, `measured` each second if there are metrics.
    """
    sys.setswitchinterval(SWITCH_EVERY)
    guard = Guard(config)
    with guard.open() as opened:
        gateway = Gateway(config, link, beat, opened, guard, log, measured)
        signal.signal(signal.SIGTERM, lambda _signal, _frame: gateway.end())
        gateway.serve(lambda: ready({"warnings": gateway.warnings()}))
    return 0
