"""The gateway's process: Zenoh on one side, the loop on the other. It checks and translates; it decides nothing."""

from __future__ import annotations

import contextlib
import math
import select
import signal
import sys
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from functools import partial

import msgspec
import zenoh

from trirail.config import Config
from trirail.errors import RefusalCode, RefusedError
from trirail.processes.heartbeats import BEAT_EVERY
from trirail.processes.inbox import Inbox
from trirail.processes.incoming import Incoming
from trirail.processes.loop_death import LoopDeath
from trirail.processes.monitoring import Meter
from trirail.processes.poses import Poses
from trirail.processes.publications import Publications, StateMaker, info
from trirail.processes.realtime import give_back
from trirail.processes.replies import Refusals, Replies
from trirail.processes.requests import CommandReader, Looks, Requests
from trirail.processes.session_guard import Guard
from trirail.processes.zenoh_links import Crowding, RouterLinks
from trirail.wire import boundary, zenoh_session
from trirail.wire.goals import Goal
from trirail.wire.links import Closed, PacketLink
from trirail.wire.messages import CommandReply, ErrorReply, Event, GoalReply, RoleReply
from trirail.wire.packets import (
    Accepted,
    Answer,
    Confirmed,
    Happened,
    Kind,
    PoseChanged,
    Refused,
    Remark,
    Status,
    Welcome,
    decode_answer,
    message,
)
from trirail.wire.records import unpack
from trirail.wire.state import summary_of
from trirail.wire.text import quoted
from trirail.wire.vocabulary import Mode

SWITCH_EVERY = 0.0005
"""After so long a thread lets another have the interpreter, which Zenoh's threads need to hand a message over [s]."""
AT_ONCE = 256
"""Messages from Zenoh that are read before the loop is listened to again."""
SUMMARY_EVERY = 1.0
"""How often the summary is published [s]."""


class Gateway:
    """Takes requests from Zenoh, passes them to the loop, and answers and publishes what the loop says."""

    def __init__(
        self,
        config: Config,
        link: PacketLink,
        beat: Callable[[], None],
        session: zenoh.Session,
        guard: Guard,
        log: Callable[[Event], None] = lambda _: None,
        measured: Callable[[msgspec.Struct], None] = lambda _: None,
        hurrying: Callable[[], AbstractContextManager[None]] = nullcontext,
    ) -> None:
        self._log = log
        self._robot = config.robot.name
        self._link = link
        self._beat = beat
        self._guard = guard
        self._loop_death = LoopDeath(config.period)
        self._info = info(config)
        self._states = StateMaker(config)
        self._meter = Meter(measured) if config.telemetry.metrics_port else None
        self._state_every = 1.0 / config.telemetry.state_hz
        self._state_due = self._summary_due = self._heard = 0.0
        self._replies = Replies(self._robot)
        self._refusals = Refusals(link, self._replies)
        self._inbox = Inbox(session, self._robot, self._refusals.too_much)
        self._poses = Poses(config, self._replies.send, self._refusals.refuse, self._send_to_loop, self._inbox.wake)
        self._looks = Looks(self._robot, lambda looked: link.send(message(looked)))
        self._requests = Requests(config, link, guard, self._replies, self._loop_death, hurrying)
        self._commands = CommandReader(
            self._robot, self._requests, self._replies, self._states, self._inbox, self._refusals.refuse
        )
        connect = config.zenoh.connect
        self._routers = RouterLinks(connect, partial(guard.linked, session), guard.why_not_linked, self._send_to_loop)
        known = {*guard.users, config.zenoh.router or ""}
        self._crowding = Crowding(
            partial(guard.links, session), guard.disconnect, known, zenoh_session.SESSIONS, self._send_to_loop
        )
        self._ending = False
        self._publications = Publications(session, self._robot)

    def serve(self, ready: Callable[[], None]) -> None:
        """Serve until told to end or the loop has gone; `ready` is called once the loop has said welcome."""
        door = self._guard.stop_door(self._inbox.stop_at_door)
        poll = select.poll()
        poll.register(self._link.fileno(), select.POLLIN)
        poll.register(self._inbox.fileno(), select.POLLIN)
        try:
            while not self._ending:
                self._beat()
                poll.poll(math.ceil(min(BEAT_EVERY, self._inbox.due()) * 1e3))
                for incoming in self._inbox.next_messages(AT_ONCE):
                    self._beat()
                    self._handle(incoming)
                while (packet := self._link.receive()) is not None:
                    self._beat()
                    self._loop_death.heard()
                    self._hear(packet, ready)
                self._requests.send_goals()  # those for which there was no room
                self._poses.settle()
                self._poses.poll()
                self._routers.poll()
                self._crowding.poll()
                self._requests.give_up_late()
                self._summarize()
                self._refusals.tell_of_overruns()
        except Closed:
            self._hear_the_rest(ready)
            self._tell_of_its_end()
        finally:
            with contextlib.suppress(Closed):
                self._poses.close()
            self._routers.close()
            for incoming in self._requests:
                self._replies.answer(incoming, ErrorReply(RefusalCode.ENDED, "the service has ended"))
            door.close()
            self._replies.close()

    def warnings(self) -> tuple[str, ...]:
        """Return what people should know of how the service is run, one line each."""
        return (*self._guard.warnings(), *self._poses.warnings(), *self._routers.warnings(), *self._crowding.warnings())

    def end(self) -> None:
        """End soon; safe from a signal handler."""
        self._ending = True
        self._inbox.wake()

    # ------------------------------------------------------------------ Zenoh to loop

    def _handle(self, incoming: Incoming) -> None:
        """Take a message; whatever is wrong with it is answered, and told to everyone, since a put has no answer."""
        try:
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
                self._poses.edit(incoming)
            elif incoming.kind == "alignment":
                self._replies.send(incoming, self._looks.forward(incoming))
            else:
                self._commands.read(incoming)
        except RefusedError as refusal:
            self._refusals.refuse(incoming, refusal)
        except Closed:
            raise
        except Exception as error:  # noqa: BLE001 - a message that is read wrongly must not end the gateway
            self._refusals.refuse(
                incoming, RefusedError(RefusalCode.INTERNAL, f"internal error, please report it: {error!r}")
            )

    def _goal(self, incoming: Incoming) -> None:
        (user,) = boundary.names(incoming.key, self._key("goal"), ("user",))
        sent: Goal = incoming.content(Goal, "not a goal")
        self._requests.goal(incoming, user, self._poses.of_name(sent))

    def _send_to_loop(self, what: PoseChanged | Remark) -> None:
        self._link.send(message(what))

    # ------------------------------------------------------------------ loop to Zenoh

    def _hear(self, packet: bytes, ready: Callable[[], None]) -> None:
        content = memoryview(packet)[1:]
        try:
            if packet[0] == Kind.RECORDS:
                self._publish(content)
                return
            answer = decode_answer(content)
            self._on_answer(answer)
        except Closed:
            raise
        except Exception as error:  # noqa: BLE001 - it would come again after every restart
            self._refusals.warn_everyone(
                quoted(f"the gateway could not read what the loop said, please report it: {error!r}")
            )
            return
        if isinstance(answer, Welcome):
            self._info = msgspec.structs.replace(self._info, missing_protections=answer.missing_protections)
            self._inbox.declare()
            ready()

    def _on_answer(self, answer: Answer) -> None:
        self._loop_death.follow(answer)
        match answer:
            case Happened(event):
                self._happened(event)
            case Status() | Welcome():
                self._states.update(answer)
            case Accepted(ticket, goal_id, duration, slowed, stops_first, queued, lag):
                expected = duration if math.isfinite(duration) else None
                self._requests.answer(ticket, GoalReply(goal_id, expected, slowed, stops_first, queued, lag))
            case Confirmed(ticket, name, mode, cycle):
                self._commands.confirmed(ticket)
                self._requests.answer(ticket, CommandReply(name, mode, cycle))
            case Refused(ticket, code, text, slider, value, limit):
                error = ErrorReply(code, text, slider, value, limit)
                self._requests.answer(ticket, self._commands.refused(ticket, error))

    def _publish(self, batch: memoryview) -> None:
        """Take in a batch of records and pass it on; publish the newest state when it is time."""
        rows = unpack(batch)
        self._publications.records(bytes(batch))
        self._states.records(rows)
        self._poses.measure(rows[-1])
        if self._meter is not None:
            self._meter.records(rows)
            self._meter.publish(self._states.newest, self._crowding.use, self._crowding.warnings())
        now = self._heard = time.monotonic()
        if now >= self._state_due:
            self._state_due = max(self._state_due + self._state_every, now)
            self._publications.state(self._states.newest(self.warnings()))

    def _summarize(self) -> None:
        """Publish the summary when it is time, also while the loop says nothing: then it tells since when."""
        now = time.monotonic()
        if now >= self._summary_due and self._states.cycle:
            self._summary_due = now + SUMMARY_EVERY
            self._publications.summary(summary_of(self._states.newest(), now - self._heard, self._info.version))

    def _happened(self, event: Event) -> None:
        """Tell everyone of an event, and the service's log; what others have sent under a new holder does not begin."""
        if event.kind == "lease":
            self._requests.backlog.withdraw_others(event.user, event.message)
        self._publications.event(event)
        self._log(event)
        if self._meter is not None:
            self._meter.event(event)

    def _hear_the_rest(self, ready: Callable[[], None]) -> None:
        """Hear what the loop said before it ended: that may be its farewell."""
        with contextlib.suppress(Closed):
            while (packet := self._link.receive()) is not None:
                self._loop_death.heard()
                with contextlib.suppress(Closed):  # it takes nothing any more
                    self._hear(packet, ready)

    def _tell_of_its_end(self) -> None:
        """The loop has gone: where it has died, tell everyone in its place."""
        for event in self._loop_death.events(self._states.cycle):
            self._happened(event)
        if (reason := self._loop_death.reason) and self._states.cycle:
            state = msgspec.structs.replace(self._states.newest(), mode=Mode.FAULT, goal=None, faults=(reason,))
            self._publications.state(state)

    def _key(self, *parts: str) -> str:
        return zenoh_session.key(self._robot, *parts)


def main(
    config: Config,
    link: PacketLink,
    beat: Callable[[], None],
    ready: Callable[[object], None],
    log: Callable[[Event], None],
    measured: Callable[[msgspec.Struct], None],
    hurrying: Callable[[], AbstractContextManager[None]],
) -> int:
    """Run the gateway's process.

    `ready` is called once it can be reached, `log` with each event, `measured` each second if there are metrics;
    what is sent to the loop `hurrying` is taken in the cycle in which it comes.
    """
    sys.setswitchinterval(SWITCH_EVERY)
    guard = Guard(config)
    with guard.open() as session:
        gateway = Gateway(config, link, beat, session, guard, log, measured, hurrying)
        signal.signal(signal.SIGTERM, lambda _signal, _frame: gateway.end())

        def is_ready() -> None:
            ready({"warnings": gateway.warnings()})
            give_back()

        gateway.serve(is_ready)
    return 0
