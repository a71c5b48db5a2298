"""Gateway process, which checks and translates messages between Zenoh and the loop, but makes no decisions."""

from __future__ import annotations

import contextlib
import math
import select
import signal
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from typing import Any, NamedTuple

import msgspec
import zenoh

from trirail.config import Config
from trirail.errors import RefusalCode, RefusedError
from trirail.processes.certificate_expiry import CertificateExpiry
from trirail.processes.heartbeats import BEAT_EVERY
from trirail.processes.inbox import Inbox
from trirail.processes.incoming import Incoming
from trirail.processes.loop_death import LoopDeath
from trirail.processes.memory_budget import HeapTrim
from trirail.processes.monitoring import Meter
from trirail.processes.name_conflict import REFUSED, REFUSED_IF_HIGHER, NameConflict
from trirail.processes.order import Order
from trirail.processes.poses import Poses
from trirail.processes.publications import Publications, StateMaker, info
from trirail.processes.realtime import bound_heap, release_startup_memory
from trirail.processes.replies import Refusals, Replies
from trirail.processes.requests import CommandReader, Looks, Requests
from trirail.processes.session_guard import Guard
from trirail.processes.trajectory_parts import TrajectoryParts
from trirail.processes.zenoh_links import LinkMonitor, RouterLinks
from trirail.wire import boundary, zenoh_session
from trirail.wire.goals import Goal, PathGoal, TrajectoryGoal
from trirail.wire.links import LinkClosed, PacketLink
from trirail.wire.looks import AlignmentLook
from trirail.wire.messages import CommandReply, ErrorReply, Event, Notice, RoleReply
from trirail.wire.packed_trajectory import packed
from trirail.wire.packets import (
    Accepted,
    Announcement,
    Answer,
    Checked,
    CommandDone,
    EventReport,
    Kind,
    Refused,
    Status,
    Welcome,
    decode_answer,
    message,
)
from trirail.wire.records import unpack
from trirail.wire.sizes import MAX_PART
from trirail.wire.state import summary_of
from trirail.wire.text import quoted
from trirail.wire.vocabulary import Mode, NoContent, Override

SWITCH_EVERY = 0.0005
"""Interval after which a thread yields the interpreter [s], short enough for Zenoh's threads to deliver messages."""
MESSAGES_PER_TURN = 256
"""Maximum number of messages from Zenoh that are handled before the loop's messages are read again."""
NOT_CHECKED = "not a goal to check"
SUMMARY_EVERY = 1.0
"""Interval between two published summaries [s]."""


class Gateway:
    """Gateway, which forwards clients' requests to the loop, answers them, and publishes the loop's messages."""

    def __init__(
        self,
        config: Config,
        link: PacketLink,
        beat: Callable[[], None],
        session: zenoh.Session,
        guard: Guard,
        log: Callable[[Event], None] = lambda _: None,
        report_measurements: Callable[[msgspec.Struct], None] = lambda _: None,
        urgent_section: Callable[[], AbstractContextManager[None]] = nullcontext,
        last_cycle: Callable[[], int | None] = lambda: None,
        *,
        again: bool = False,
        run: str = "unnamed",
    ) -> None:
        """Create and connect the parts of the gateway. `again` is True if the service has already had a gateway, and
        `run` is the identity of this run of the service.
        """
        self._log = log
        self._robot = config.robot.name
        self._link = link
        self._beat = beat
        self._guard = guard
        self._loop_death = LoopDeath(config.period, last_cycle)
        self._info = info(config)
        self._past_events = 0
        """Number of the newest event from before this gateway was connected to the loop."""
        self._welcomed = self._declared = False
        """True once the loop has sent its welcome, and once clients are served, from the first record on."""
        self._states = StateMaker(config)
        self._meter = Meter(report_measurements) if config.telemetry.metrics_port else None
        self._state_every = 1.0 / config.telemetry.state_hz
        self._state_due = self._summary_due = self._records_at = 0.0
        self._replies = Replies(self._robot)
        self._refusals = Refusals(link, self._replies)
        keys = {kind: len(route.names) for kind, route in ROUTES.items()}
        self._inbox = Inbox(session, self._robot, keys, self._refusals.not_kept)
        self._poses = Poses(
            config, self._replies.send, self._refusals.refuse, self._announce, self._inbox.wake, again=again
        )
        self._looks = Looks(self._announce)
        self._parts = TrajectoryParts(self._refusals.refuse)
        self._requests = Requests(config, link, guard, self._replies, self._loop_death, urgent_section)
        self._commands = CommandReader(
            self._requests, self._replies, self._states, self._inbox, self._parts, self._refusals.refuse
        )
        connect = config.zenoh.connect
        linked = partial(guard.linked, session)
        self._routers = RouterLinks(connect, linked, guard.why_not_linked, self._announce)
        self._name_conflict = NameConflict(session, self._robot, run, linked, guard.open_client, self._announce)
        self._expiry = CertificateExpiry(guard.credentials, partial(self._requests.stop, self._robot), self._announce)
        known = {*guard.users, config.zenoh.router or ""}
        self._link_monitor = LinkMonitor(
            partial(guard.links, session),
            guard.disconnect,
            known,
            zenoh_session.SESSIONS,
            self._announce,
            unopened=guard.unopened,
        )
        self._heap = HeapTrim()
        self._ending = False
        self._run = run
        self._publications = Publications(session, self._robot, run)

    def serve(self, ready: Callable[[], None]) -> None:
        """Serve clients until `end` is called or the loop disconnects. Call `ready` when clients are served."""
        stop_port = self._guard.stop_port(self._inbox.stop_at_port)
        poll = select.poll()
        poll.register(self._link.fileno(), select.POLLIN)
        poll.register(self._inbox.fileno(), select.POLLIN)
        try:
            while not self._ending:
                self._beat()
                poll.poll(math.ceil(min(BEAT_EVERY, self._inbox.due()) * 1e3))
                for incoming in self._inbox.next_messages(MESSAGES_PER_TURN):
                    self._beat()
                    self._handle(incoming)
                for packet in self._link.packets():
                    self._beat()
                    self._loop_death.record_activity()
                    self._handle_packet(packet, ready)
                self._requests.send_goals()  # goals that could not be sent earlier because the socket was full
                self._poses.settle()
                self._poses.poll()
                self._routers.poll()
                self._link_monitor.poll()
                self._name_conflict.poll()
                self._expiry.poll()
                self._requests.expire()
                self._parts.poll()
                self._summarize()
                self._refusals.announce_unkept()
                self._heap.poll()
        except LinkClosed:
            self._handle_last_packets(ready)
            self._announce_loop_death()
        finally:
            with contextlib.suppress(LinkClosed):
                self._poses.close()
            self._routers.close()
            self._name_conflict.close()
            for incoming in (*self._requests, *self._parts):
                self._replies.answer(incoming, ErrorReply(RefusalCode.ENDED, "the service has ended"))
            stop_port.close()
            self._replies.close()

    def warnings(self) -> tuple[str, ...]:
        """Return the current warnings of the gateway's parts for the state, with one line per warning."""
        return (
            *self._guard.warnings(),
            *self._poses.warnings(),
            *self._routers.warnings(),
            *self._link_monitor.warnings(),
            *self._name_conflict.warnings(),
        )

    def end(self) -> None:
        """Make `serve` return. This method may be called from a signal handler."""
        self._ending = True
        self._inbox.wake()

    # ------------------------------------------------------------------ Zenoh to loop

    def _handle(self, incoming: Incoming) -> None:
        """Handle a message and answer it.

        An error is sent in the reply and is also announced to all clients, because a put has no reply.
        """
        try:
            route = ROUTES[incoming.kind]
            if (reply := route.handle(self, route.read(incoming, self._robot))) is not None:
                self._replies.send(incoming, reply)
        except RefusedError as refusal:
            self._refusals.refuse(incoming, refusal)
        except LinkClosed:
            raise
        except Exception as error:  # noqa: BLE001 - a message that is read wrongly must not end the gateway
            self._refusals.refuse(
                incoming, RefusedError(RefusalCode.INTERNAL, f"internal error, please report it: {error!r}")
            )

    def _user_role(self, message: RoutedMessage) -> RoleReply:
        (user,) = message.names
        self._requests.backlog.note_call(message.incoming)
        return RoleReply(user, self._guard.role(user))

    def _edit_poses(self, message: RoutedMessage) -> None:
        user, pose = message.names
        if (holder := self._states.lease) not in (None, user):
            raise RefusedError(RefusalCode.LEASED, f"{holder} holds the lease: other users cannot change poses")
        message.incoming.check_age()
        self._poses.edit(message.incoming, user, pose)

    def _command(self, message: RoutedMessage) -> None:
        _, command = message.names
        override = command in REFUSED_IF_HIGHER and self._name_conflict.exists
        if command in REFUSED:
            self._expiry.check(command)
        if command in REFUSED or (override and self._is_faster(message.incoming)):
            self._name_conflict.check(command)
        self._commands.read(message.incoming, *message.names)

    def _is_faster(self, override: Incoming) -> bool:
        """Return True if an override is higher than the present one. An invalid override is not."""
        try:
            content: Override = override.content(Override, "not an override")
        except RefusedError:
            return False
        return content.percent > self._states.newest().override * 100.0

    def _forward_look(self, message: RoutedMessage) -> AlignmentLook:
        (user,) = message.names
        return self._looks.forward(user, message.content)

    def _goal(self, message: RoutedMessage) -> None:
        self._name_conflict.check("a goal")
        self._expiry.check("a goal")
        incoming, (user,), sent = message
        if not isinstance(sent, TrajectoryGoal):
            self._requests.goal(incoming, user, self._poses.resolve_name(sent))
        elif (whole := self._parts.add(incoming, user, sent)) is not None:
            parts, goal = whole
            try:
                self._requests.goal(parts, user, goal)
            except RefusedError as refusal:
                self._refusals.refuse(parts, refusal)

    def _check_goal(self, message: RoutedMessage) -> None:
        incoming, (user,), sent = message
        if not isinstance(sent, TrajectoryGoal):
            self._requests.check(incoming, user, self._poses.resolve_name(sent))
        elif sent.part is None:
            self._requests.check(incoming, user, packed(sent))
        else:
            problem = (
                f"{NOT_CHECKED}: part: send a trajectory to be checked as one message of at most {MAX_PART} points"
            )
            raise RefusedError(RefusalCode.MALFORMED, problem)

    def _announce(self, notice: Notice) -> bool:
        """Ask the loop to announce a notice. Return True if the loop's socket has accepted the request."""
        return self._link.send(message(Announcement(notice)))

    # ------------------------------------------------------------------ loop to Zenoh

    def _handle_packet(self, packet: bytes, ready: Callable[[], None]) -> None:
        content = memoryview(packet)[1:]
        try:
            if packet[0] == Kind.RECORDS:
                self._publish(content)
            else:
                self._on_answer(decode_answer(content))
        except LinkClosed:
            raise
        except Exception as error:  # noqa: BLE001 - a restarted gateway would receive the same message again
            self._refusals.warn_everyone(
                quoted(f"the gateway could not read a message of the loop, please report it: {error!r}")
            )
            return
        if self._welcomed and self._states.cycle and not self._declared:
            self._declared = True
            self._inbox.declare()
            ready()

    def _on_answer(self, answer: Answer) -> None:
        self._loop_death.follow(answer)
        match answer:
            case EventReport(event):
                self._handle_event(event)
            case Status():
                self._states.update(answer)
            case Welcome():
                self._welcome(answer)
            case Accepted(ticket, reply):
                self._requests.answer(ticket, msgspec.structs.replace(reply, run=self._run))
            case Checked(ticket, reply):
                self._requests.answer(ticket, reply)
            case CommandDone(ticket, name, mode, cycle):
                self._commands.confirmed(ticket)
                self._requests.answer(ticket, CommandReply(name, mode, cycle))
            case Refused(ticket, code, text, slider, value, limit):
                error = ErrorReply(code, text, slider, value, limit)
                self._requests.answer(ticket, self._commands.refused(ticket, error))

    def _welcome(self, welcome: Welcome) -> None:
        self._states.update(welcome)
        self._info = msgspec.structs.replace(self._info, missing_protections=welcome.missing_protections)
        if not self._welcomed:
            self._welcomed, self._past_events = True, welcome.newest_event

    def _publish(self, batch: memoryview) -> None:
        """Publish a batch of records and update the state from it; publish the newest state if that is due."""
        rows = unpack(batch)
        self._publications.records(bytes(batch))
        self._states.records(rows)
        self._poses.measure(rows[-1])
        if self._meter is not None:
            self._meter.records(rows)
            self._meter.publish(lambda: self._states.newest(self.warnings()), self._link_monitor.use)
        now = self._records_at = time.monotonic()
        if now >= self._state_due and self._declared:  # a client may send a request as soon as it has a state
            self._state_due = max(self._state_due + self._state_every, now)
            self._publications.state(self._states.newest(self.warnings()))

    def _summarize(self) -> None:
        """Publish the summary if that is due.

        The summary is published even while the loop is silent, because it contains the age of the state.
        """
        now = time.monotonic()
        if now >= self._summary_due and self._declared:
            self._summary_due = now + SUMMARY_EVERY
            self._publications.summary(summary_of(self._states.newest(), now - self._records_at, self._info.version))

    def _handle_event(self, event: Event) -> None:
        """Publish and log an event. If the lease changes, withdraw the waiting goals of all users except the holder.

        A restarted gateway also receives past events, whose leases may have ended.
        """
        if event.kind == "lease" and event.seq > self._past_events:
            self._requests.backlog.withdraw_others(event.user, event.message)
        self._publications.event(event)
        self._log(event)

    def _handle_last_packets(self, ready: Callable[[], None]) -> None:
        """Handle the last messages of the loop."""
        with contextlib.suppress(LinkClosed):
            while (packet := self._link.receive()) is not None:
                self._loop_death.record_activity()
                with contextlib.suppress(LinkClosed):  # the loop no longer receives anything
                    self._handle_packet(packet, ready)

    def _announce_loop_death(self) -> None:
        """Publish the death of the loop as events and as a last state, unless the loop has ended normally."""
        for event in self._loop_death.events(self._states.cycle):
            self._handle_event(event)
        if (reason := self._loop_death.reason) and self._states.cycle:
            state = msgspec.structs.replace(self._states.newest(), mode=Mode.FAULT, goal=None, faults=(reason.text,))
            self._publications.state(state)


class RoutedMessage(NamedTuple):
    """Message with the names in its key and its decoded content."""

    incoming: Incoming
    names: Sequence[str]
    """Names in the key of the message, such as the user's."""
    content: Any
    """Decoded content, of the type that the route defines."""


class Route(NamedTuple):
    """Key that clients query, with the handler for messages on this key and the type of their content."""

    names: tuple[str, ...]
    """Meanings of the names in the key, of which the user is the first. If empty, a message's key is not checked."""
    handle: Callable[[Gateway, RoutedMessage], msgspec.Struct | None]
    """Handler of a message. It returns the reply, or None if the reply is sent later."""
    content: Any = None
    """Type of the content; None if the content is ignored, or if its type depends on a name in the key."""
    expected: str = ""
    """Beginning of the error message for content of another type."""

    def read(self, incoming: Incoming, robot: str) -> RoutedMessage:
        """Decode the key and the content of a message. Raises RefusedError if either is invalid."""
        prefix = zenoh_session.key(robot, incoming.kind)
        names = boundary.names(incoming.key, prefix, self.names) if self.names else ()
        content = incoming.content(self.content, self.expected) if self.content is not None else None
        return RoutedMessage(incoming, names, content)


ROUTES: dict[str, Route] = {
    "goal": Route(("user",), Gateway._goal, Goal, "not a goal"),
    "check": Route(("user",), Gateway._check_goal, PathGoal, NOT_CHECKED),
    "cmd": Route(("user", "command"), Gateway._command),
    "info": Route((), lambda gateway, _: gateway._info),
    "role": Route(("user",), Gateway._user_role),
    "poses": Route((), lambda gateway, _: gateway._poses.table()),
    "teach": Route(("user", "pose"), Gateway._edit_poses, NoContent | None, "teach accepts no content"),
    "forget": Route(("user", "pose"), Gateway._edit_poses, NoContent | None, "forget accepts no content"),
    "alignment": Route(("user",), Gateway._forward_look, AlignmentLook, "not a look of an alignment"),
}
"""Routes of all keys that clients query, by the kind of message."""


def main(
    order: Order,
    link: PacketLink,
    beat: Callable[[], None],
    ready: Callable[[object], None],
    log: Callable[[Event], None],
    report_measurements: Callable[[msgspec.Struct], None],
    urgent_section: Callable[[], AbstractContextManager[None]],
    last_cycle: Callable[[], int | None],
) -> int:
    """Run the gateway process; return its exit code.

    Parameters
    ----------
    ready
        Function called with the gateway's warnings when clients can reach the gateway.
    log
        Function called with each event.
    report_measurements
        Function called with the measurements once per second, if the configuration enables metrics.
    urgent_section
        Function that returns a context. The loop handles packets sent within it in the cycle in which they arrive.
    last_cycle
        Function that returns the loop's last cycle if the loop has ended normally, otherwise None.

    """
    sys.setswitchinterval(SWITCH_EVERY)
    bound_heap()
    config = order.config
    guard = Guard(config, order.admission)
    with guard.open() as session:
        gateway = Gateway(
            config,
            link,
            beat,
            session,
            guard,
            log,
            report_measurements,
            urgent_section,
            last_cycle,
            again=order.again,
            run=order.run,
        )
        signal.signal(signal.SIGTERM, lambda _signal, _frame: gateway.end())

        def is_ready() -> None:
            ready({"warnings": gateway.warnings()})
            release_startup_memory()

        gateway.serve(is_ready)
    return 0
