"""The gateway's process: Zenoh on one side, the loop on the other. It checks and translates; it decides nothing."""

from __future__ import annotations

import math
import os
import select
import signal
import time
import uuid
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import zenoh
from zenoh.ext import CacheConfig, MissDetectionConfig, RepliesConfig, declare_advanced_publisher

from service import __version__, session
from service.config import Config, geometry
from service.links import Closed, Link
from service.messages import MAX_MESSAGE, CommandReply, ErrorReply, Goal, GoalReply, Info, Override, Stop
from service.packets import (
    Accepted,
    Answer,
    CommandRequest,
    Confirmed,
    GoalRequest,
    Happened,
    Kind,
    Refused,
    RefusedRequest,
    Request,
    Situation,
    Welcome,
    decode_answer,
    message,
)
from service.provenance import versions
from service.records import unpack
from service.state import StateMaker

COMMANDS = ("enable", "disable", "stop", "quick_stop", "reset", "home", "pause", "resume", "override")
UNREAD = 65_536
"""Messages from Zenoh that may wait to be read; beyond that the oldest get no answer."""
BACKLOG = 20_000
"""Goals that may wait for those before them; beyond that they are refused."""
AHEAD = 2
"""Goals that the loop has at once, so that it has the next one when it is done with the last. The others wait here:
a command overtakes them, and what waits when the robot is told to stop does not begin any more."""
STOPPING = ("stop", "disable", "quick_stop")
EVENTS_KEPT = 1000
REPLY_WITHIN = 15.0
"""A command that the loop has not carried out by then is answered with an error [s]."""
_PAST = RepliesConfig(
    priority=zenoh.Priority.BACKGROUND, congestion_control=zenoh.CongestionControl.BLOCK, express=False
)
REFUSALS_PER_SECOND = 10
"""Unreadable goals that are told to everyone; the others only get their error reply."""


class Incoming(NamedTuple):
    """A query or a put, as Zenoh handed it over."""

    key: str
    payload: bytes
    encoding: str
    query: zenoh.Query | None


class _Waiting(NamedTuple):
    incoming: Incoming
    deadline: float


class Gateway:
    """Takes requests from Zenoh, passes them to the loop, and answers and publishes what the loop says."""

    def __init__(self, config: Config, link: Link, opened: zenoh.Session) -> None:
        self._robot = config.robot.name
        homing = [drive.homing.timeout for drive in config.drives.each if drive.homing is not None]
        self._home_within = REPLY_WITHIN + sum(homing)
        self._link = link
        self._session = opened
        self._info = _info(config)
        self._states = StateMaker(config)
        self._state_every = 1.0 / config.telemetry.state_hz
        self._state_due = 0.0
        self._goals = msgspec.json.Decoder(Goal), msgspec.msgpack.Decoder(Goal)
        self._incoming: deque[Incoming] = deque(maxlen=UNREAD)
        self._backlog: deque[tuple[Incoming, GoalRequest]] = deque()
        self._ahead: set[int] = set()
        self._wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._waiting: dict[int, _Waiting] = {}
        self._tickets = 0
        self._refusals = 0
        self._refusals_since = 0.0
        self._ending = False
        self._state = opened.declare_publisher(
            self._key("state"),
            encoding=session.JSON,
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.DATA_HIGH,
        )
        self._records = opened.declare_publisher(
            self._key("records"),
            encoding=session.BINARY,
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.DATA_LOW,
        )
        self._event = declare_advanced_publisher(
            opened,
            self._key("event"),
            encoding=session.JSON,
            # The past goes out in one burst, whole, in a queue of its own: who is slow to take it delays nothing else.
            cache=CacheConfig(max_samples=EVENTS_KEPT, replies_config=_PAST),
            sample_miss_detection=MissDetectionConfig(heartbeat=None, sporadic_heartbeat=0.5),
            publisher_detection=True,
        )

    def serve(self, ready: Callable[[], None]) -> None:
        """Serve until told to end or the loop has gone; `ready` is called once the loop has said welcome."""
        poll = select.poll()
        poll.register(self._link.fileno(), select.POLLIN)
        poll.register(self._wake, select.POLLIN)
        try:
            while not self._ending:
                poll.poll(1000)
                self._drain()
                while (packet := self._link.receive()) is not None:
                    content = memoryview(packet)[1:]
                    if packet[0] == Kind.RECORDS:
                        self._publish(content)
                        continue
                    answer = decode_answer(content)
                    if isinstance(answer, Welcome):
                        self._declare()
                        ready()
                    self._take(answer)
                self._give_up_late()
        except Closed:
            return
        finally:
            for incoming in [
                *(waiting.incoming for waiting in self._waiting.values()),
                *(goal[0] for goal in self._backlog),
            ]:
                self._reply(incoming, ErrorReply("ended", "the service has ended"))

    def end(self) -> None:
        """End soon; safe from a signal handler."""
        self._ending = True
        os.eventfd_write(self._wake, 1)

    # ------------------------------------------------------------------ Zenoh to loop

    def _declare(self) -> None:
        # Called as messages arrive, by one thread: else a stop could overtake the goals that were put before it.
        on_query = zenoh.handlers.Callback(self._on_query, indirect=False)
        on_sample = zenoh.handlers.Callback(self._on_sample, indirect=False)
        declare = self._session.declare_queryable
        self._declared = [
            declare(self._key("goal", "*"), on_query),
            declare(self._key("cmd", "*", "*"), on_query),
            declare(self._key("info"), on_query),
            self._session.declare_subscriber(self._key("goal", "*"), on_sample),
            self._session.liveliness().declare_token(self._key("alive")),
        ]

    def _on_query(self, query: zenoh.Query) -> None:
        payload = query.payload.to_bytes() if query.payload is not None else b""
        encoding = str(query.encoding) if query.encoding is not None else ""
        self._incoming.append(Incoming(str(query.key_expr), payload, encoding, query))
        os.eventfd_write(self._wake, 1)

    def _on_sample(self, sample: zenoh.Sample) -> None:
        incoming = Incoming(str(sample.key_expr), sample.payload.to_bytes(), str(sample.encoding), None)
        self._incoming.append(incoming)
        os.eventfd_write(self._wake, 1)

    def _drain(self) -> None:
        try:
            os.eventfd_read(self._wake)
        except BlockingIOError:
            return
        while self._incoming:
            incoming = self._incoming.popleft()
            kind, *rest = incoming.key.split("/")[2:]
            if "*" in incoming.key:
                self._refuse(incoming, "", ErrorReply("wildcard", f"{incoming.key}: name one robot and one user"))
            elif kind == "info":
                self._reply(incoming, self._info)
            elif kind == "goal":
                self._goal(incoming, *rest)
            else:
                self._command(incoming, *rest)

    def _goal(self, incoming: Incoming, user: str) -> None:
        if len(incoming.payload) > MAX_MESSAGE:
            problem = f"the goal has {len(incoming.payload)} bytes: at most {MAX_MESSAGE} are taken"
            self._refuse(incoming, user, ErrorReply("too_large", problem))
            return
        packed = incoming.encoding.startswith(session.MSGPACK)
        try:
            goal = self._goals[packed].decode(incoming.payload)
        except (msgspec.DecodeError, UnicodeDecodeError) as error:
            self._refuse(incoming, user, ErrorReply("malformed", f"not a goal: {_plain(error)}"))
            return
        if len(self._backlog) >= BACKLOG:
            self._refuse(incoming, user, ErrorReply("busy", f"{BACKLOG} goals are waiting already: send fewer"))
            return
        goal_id = goal.id or uuid.uuid4().hex[:12]
        self._tickets += 1
        request = GoalRequest(self._tickets, user, goal_id, goal, time.monotonic_ns())
        self._backlog.append((incoming, request))
        self._send_goals()

    def _send_goals(self) -> None:
        """Pass on as many goals as the loop is to have."""
        while self._backlog and len(self._ahead) < AHEAD:
            incoming, request = self._backlog[0]
            if not self._link.send(message(request)):
                return
            self._backlog.popleft()
            self._ahead.add(request.ticket)
            self._waiting[request.ticket] = _Waiting(incoming, time.monotonic() + REPLY_WITHIN)

    def _command(self, incoming: Incoming, user: str, name: str) -> None:
        if name not in COMMANDS:
            problem = f"{name}: no such command; there are {', '.join(COMMANDS)}"
            self._refuse(incoming, user, ErrorReply("unknown_command", problem))
        elif name == "override":
            try:
                share = msgspec.json.decode(incoming.payload, type=Override).percent / 100.0
            except (msgspec.DecodeError, UnicodeDecodeError) as error:
                problem = f'override takes {{"percent": 0 to 200}}: {_plain(error)}'
                self._refuse(incoming, user, ErrorReply("malformed", problem))
                return
            self._forward(incoming, lambda ticket: CommandRequest(ticket, user, name, share))
        elif incoming.payload in (b"", b"{}", b"null"):
            self._forward(incoming, lambda ticket: CommandRequest(ticket, user, name))
            if name in STOPPING:
                replace, reason = msgspec.structs.replace, f"{name} by {user}"
                self._backlog = deque((waiting, replace(goal, withdrawn=reason)) for waiting, goal in self._backlog)
        elif name == "stop":
            try:
                goal = msgspec.json.decode(incoming.payload, type=Stop).goal
            except (msgspec.DecodeError, UnicodeDecodeError) as error:
                self._refuse(incoming, user, ErrorReply("malformed", f'stop takes {{"goal": id}}: {_plain(error)}'))
                return
            if not self._withdraw(incoming, goal, f"{name} by {user}"):
                self._forward(incoming, lambda ticket: CommandRequest(ticket, user, name, goal=goal))
        else:
            self._refuse(incoming, user, ErrorReply("malformed", f"{name} takes no content"))

    def _withdraw(self, incoming: Incoming, goal_id: str, reason: str) -> bool:
        """Stop a goal that waits here, before the loop has it; whether there is one."""
        for number, (waiting, request) in enumerate(self._backlog):
            if request.id == goal_id:
                self._backlog[number] = waiting, msgspec.structs.replace(request, withdrawn=reason)
                self._reply(incoming, CommandReply("stop", self._states.newest().mode))
                return True
        return False

    def _forward(self, incoming: Incoming, make: Callable[[int], Request]) -> None:
        self._tickets += 1
        if self._link.send(message(make(self._tickets))):
            within = self._home_within if incoming.key.endswith("/home") else REPLY_WITHIN
            self._waiting[self._tickets] = _Waiting(incoming, time.monotonic() + within)
        else:
            self._reply(incoming, ErrorReply("busy", "too many requests at once: send it again"))

    def _refuse(self, incoming: Incoming, user: str, error: ErrorReply) -> None:
        """Answer what cannot be read; tell everyone too, since a put has no answer."""
        self._reply(incoming, error)
        now = time.monotonic()
        if now - self._refusals_since >= 1.0:
            self._refusals, self._refusals_since = 0, now
        self._refusals += 1
        if self._refusals <= REFUSALS_PER_SECOND:
            self._link.send(message(RefusedRequest(user[:64], error.message[:512])))

    # ------------------------------------------------------------------ loop to Zenoh

    def _take(self, answer: Answer) -> None:
        match answer:
            case Happened(event):
                self._event.put(msgspec.json.encode(event))
            case Situation() | Welcome():
                self._states.update(answer)
            case Accepted(ticket, goal_id, duration, slowed, stops_first, queued):
                expected = duration if math.isfinite(duration) else None
                self._answer(ticket, GoalReply(goal_id, expected, slowed, stops_first, queued))
            case Confirmed(ticket, name, mode):
                self._answer(ticket, CommandReply(name, mode))
            case Refused(ticket, code, text, slider, value, limit):
                self._answer(ticket, ErrorReply(code, text, slider, value, limit))

    def _publish(self, batch: memoryview) -> None:
        """Take in a batch of records and pass it on; publish the newest state when it is time."""
        self._records.put(bytes(batch))
        self._states.records(unpack(batch))
        now = time.monotonic()
        if now >= self._state_due:
            self._state_due = max(self._state_due + self._state_every, now)
            self._state.put(msgspec.json.encode(self._states.newest()))

    def _answer(self, ticket: int, content: msgspec.Struct) -> None:
        waiting = self._waiting.pop(ticket, None)
        if waiting is not None:
            self._reply(waiting.incoming, content)
        if ticket in self._ahead:
            self._ahead.discard(ticket)
            self._send_goals()

    def _give_up_late(self) -> None:
        now = time.monotonic()
        for ticket in [ticket for ticket, waiting in self._waiting.items() if waiting.deadline < now]:
            self._answer(ticket, ErrorReply("timeout", "not carried out in time"))

    def _reply(self, incoming: Incoming, content: msgspec.Struct) -> None:
        query = incoming.query
        if query is None:
            return
        encoding = session.MSGPACK if incoming.encoding.startswith(session.MSGPACK) else session.JSON
        payload = session.encode(content, encoding)
        with query:  # dropped afterwards: else the caller waits for more until its time-out
            if isinstance(content, ErrorReply):
                query.reply_err(payload, encoding=encoding)
            else:
                query.reply(incoming.key, payload, encoding=encoding)

    def _key(self, *parts: str) -> str:
        return session.key(self._robot, *parts)


def _plain(error: Exception) -> str:
    return str(error).replace("`", "").replace(" - at $.", ": ").replace(" - at $", "")


def _info(config: Config) -> Info:
    live = config.telemetry.live_port
    legs: list[dict[str, Any]] = []
    for name, leg in zip("ABC", geometry(config.geometry).legs, strict=True):
        legs.append({"name": name} | {field: getattr(leg, field) for field in leg.__slots__})
    return Info(
        robot=config.robot.name,
        version=__version__,
        geometry=tuple(legs),
        limits=msgspec.to_builtins(config.limits),
        rate_hz=config.loop.rate_hz,
        state_hz=config.telemetry.state_hz,
        recordings=str(Path(config.telemetry.directory).resolve()),
        live=f"rerun+http://127.0.0.1:{live}/proxy" if live else "",
        versions=versions(),
    )


def main(config: Config, link: Link, ready: Callable[[object], None]) -> int:
    """Run the gateway's process; `ready` is called once it can be reached."""
    with session.open_service(config.robot.name, config.zenoh.listen) as opened:
        gateway = Gateway(config, link, opened)
        signal.signal(signal.SIGTERM, lambda _signal, _frame: gateway.end())
        gateway.serve(lambda: ready({}))
    return 0
