"""What the loop and the processes beside it say to each other. The first byte of a packet is its kind."""

from __future__ import annotations

from enum import IntEnum
from typing import Any

from msgspec import Struct, msgpack, structs
from trirail_drivers.interface import Counts, MissingProtection, Triple

from trirail.errors import RefusalCode
from trirail.wire.decoding import converted, decoder, prepare
from trirail.wire.event_codes import EventCode, EventText, Params
from trirail.wire.goals import LoopGoal
from trirail.wire.messages import Event, GoalReply, Notice
from trirail.wire.plan_packets import PlanAnswer
from trirail.wire.sizes import MAX_PACKET
from trirail.wire.vocabulary import Command


class Kind(IntEnum):
    """What a packet carries."""

    RECORDS = 1  # packed records, as many as fit
    MESSAGE = 2  # one msgpack message of the unions below
    FRAMES = 3  # captured CAN frames


class GoalRequest(Struct, frozen=True, tag=True):
    """Gateway to loop: a goal that was decoded and found well-formed."""

    ticket: int
    """By which the gateway knows the answer."""
    user: str
    id: str
    """As it was sent, or made by the gateway."""
    goal: LoopGoal
    received_ns: int
    """When it came, by the monotonic clock."""
    withdrawn: str | None = None
    """Why it must not begin any more, for a goal that waited when the robot was told to stop."""
    age: float = 0.0
    """How old what it says was when it came, of a track's target: negative where that is ahead [s]."""


class CommandRequest(Struct, frozen=True, forbid_unknown_fields=True, tag=True):
    """Gateway to loop: a command, with what it carries."""

    ticket: int
    user: str
    name: Command
    content: Any = None
    """Of the command's own type, also where it came without."""

    def __post_init__(self) -> None:
        if self.content is None or isinstance(self.content, dict):  # as it is decoded
            structs.force_setattr(self, "content", converted(self.content or {}, self.name.content))


class Announcement(Struct, frozen=True, tag=True):
    """Gateway or recorder to loop: a notice for everyone, which the loop numbers as an event."""

    notice: Notice
    """Its kind is refused, pose, alignment or service."""


class Accepted(Struct, frozen=True, tag=True):
    """Loop to gateway: the goal is the loop's now."""

    ticket: int
    reply: GoalReply


class Confirmed(Struct, frozen=True, tag=True):
    """Loop to gateway: the command has been carried out."""

    ticket: int
    name: Command
    mode: str
    cycle: int
    """The first whose record shows it."""


class Refused(Struct, frozen=True, tag=True):
    """Loop to gateway: neither goal nor command was taken."""

    ticket: int
    code: RefusalCode
    message: str
    slider: str | None = None
    value: float | None = None
    limit: float | None = None


class Welcome(Struct, frozen=True, tag=True):
    """Loop to a peer that has just connected."""

    lacking: tuple[str, ...]
    """What the loop runs without: real-time rights and the like, each with its remedy."""
    bus_load: float
    """Worst-case share of the bus that the cycle takes; 1 is full."""
    missing_protections: tuple[MissingProtection, ...] = ()
    """What the drives do without."""


class Happened(Struct, frozen=True, tag=True):
    """Loop to both: an event."""

    event: Event


class Farewell(Struct, frozen=True, tag=True):
    """Loop to both: it has ended as it should, with drives that have no power. Without it, the loop has died."""


class Status(Struct, frozen=True, tag=True):
    """Loop to both: what records do not say and the state needs; sent when it changes."""

    goal: str | None
    """The id of the goal under way."""
    override: float
    """The rate at which motions are to run, 0 to 2."""
    fault: str | None
    """Why the robot is in fault."""
    target: Triple | None = None
    """The pose that the goal leads to, of a track that its target was last told to have; None for a jog."""
    bus_load: float = 0.0
    """Share of the bus that was in use in the last second."""
    counts: tuple[Counts, Counts, Counts] = (Counts(), Counts(), Counts())
    lease: str | None = None
    """The user who holds the lease."""
    lag: float | None = None
    """Of a track, as in trirail.wire.messages.GoalReply, when it was last renewed."""
    unrecorded: str = ""
    """Why nothing is recorded now, or no CAN frames are captured; empty while all is."""
    unready: tuple[str, ...] = ()
    """Why drives cannot be reset yet, a line for each, with the progress of their configuration."""


class Disturbance(Struct, frozen=True, tag="Mishap"):  # as recordings have it
    """Something that nobody asked for, as Control.happen takes it."""

    event: str
    """Name of the trirail.control.modes.Event."""
    reason: str
    event_code: EventCode = EventCode.OTHER
    params: Params = {}

    @property
    def text(self) -> EventText:
        """The reason with its code."""
        return EventText(self.reason, self.event_code, self.params)


class DrivesFault(Struct, frozen=True, tag=True):
    """What the drives say is wrong from this cycle on."""

    message: str | None
    """None when nothing is any more."""
    unready: tuple[str, ...] = ()
    """Names of the drives that cannot be reset yet."""


class PlannerLost(Struct, frozen=True, tag=True):
    """The planner will not answer what it was asked: it has died, or is not there."""

    reason: str


Request = GoalRequest | CommandRequest | Announcement
GivenInput = Request | Disturbance | DrivesFault | PlanAnswer | PlannerLost


class ControlInput(Struct, frozen=True, tag="Input"):  # as recordings have it
    """Loop to recorder: what the control was given in a cycle, beside the feedback that is in its record.

    Together they are all that setpoints depend on.
    """

    seq: int
    """Numbered without gaps from 1."""
    cycle: int
    now_ns: int
    """The monotonic clock then: how old a goal was."""
    given: GivenInput
    urgent: bool = False
    """Whether it was given behind the cycle's SYNC; else before it, with all that was decided then."""
    waiting: bool = False
    """Whether it was heard while the cycle's tick was waited for, behind what else was decided before it."""


class Unrecorded(Struct, frozen=True, tag=True):
    """Recorder to loop: why what it takes is in no file, sent when that changes; empty while it is."""

    why: str


RecorderSaid = Announcement | Unrecorded
Answer = Accepted | Confirmed | Refused | Welcome | Farewell | Happened | Status | ControlInput

prepare(Request, Answer, RecorderSaid, *(command.content for command in Command))
encode = msgpack.Encoder().encode
decode_request = decoder(Request, packed=True).decode
decode_answer = decoder(Answer, packed=True).decode
decode_recorder = decoder(RecorderSaid, packed=True).decode


def message(content: Request | Answer | RecorderSaid) -> bytes:
    """Pack a message."""
    return bytes((Kind.MESSAGE,)) + encode(content)


def event_packet(event: Event) -> bytes:
    """Pack an event so that it fits: it is kept, and a gateway that could not read it would meet it again."""
    packet = message(Happened(event))
    if len(packet) <= MAX_PACKET:
        return packet
    words = f"{event.message[:1000]}… ({len(event.message)} characters)"
    reason = event.reason and f"{event.reason[:1000]}…"
    name, goal, user = (text and text[:100] for text in (event.id, event.goal, event.user))
    return message(Happened(structs.replace(event, message=words, id=name, reason=reason, goal=goal, user=user)))
