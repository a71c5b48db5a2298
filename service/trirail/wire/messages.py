"""What clients and service say to each other over Zenoh beside goals: replies, events. SI units and radians.

Commands are in trirail.wire.vocabulary; the state, and what is answered on …/info, in trirail.wire.state. JSON by
default, msgpack where the encoding says so.
"""

from __future__ import annotations

import math
from typing import Literal

from msgspec import Struct, structs
from trirail_drivers.interface import Triple

from trirail.errors import RefusalCode
from trirail.wire.event_codes import EventCode, Params
from trirail.wire.looks import AlignmentLook
from trirail.wire.marks import PlacedMark, Switch

Level = Literal["info", "warning", "error"]
Outcome = Literal["done", "rejected", "preempted", "stopped", "expired", "faulted", "unsettled"]

REMEMBERED_IDS = 10_000
"""Goals whose ids may not be used again; older ones are forgotten."""


class GoalReply(Struct, frozen=True):
    """A goal was accepted; it ends in exactly one event."""

    id: str
    """The goal's own, or the one that was made for it."""
    duration: float | None
    """Expected time from now to the end of its path [s]; None while the override is zero: then it has no expected end,
    and for what was told of a target before something newer took its place.
    It is done when the robot has been in position for the dwell of [limits.in_position] after that."""
    slowed: float = 1.0
    """How many times slower it is than was asked for, since a slider or the platform may not move so fast."""
    stops_first: bool = False
    """The robot stops on its old path first: from its present motion it could not, or would be later."""
    queued: bool = False
    """It begins when the goals before it are reached."""
    lag: float | None = None
    """Of a track: how far a point of the platform was at most from where the target had it, when this was taken up
    [m]."""
    marks: tuple[PlacedMark, ...] = ()
    """Where each mark of the goal will switch first."""
    accepted: Literal[True] = True

    def with_duration(self, duration: float) -> GoalReply:
        """Return it with another duration [s], which may be infinite."""
        return structs.replace(self, duration=duration if math.isfinite(duration) else None)


class CommandReply(Struct, frozen=True):
    """A command was carried out."""

    command: str
    """Its name."""
    mode: str
    """A trirail.wire.vocabulary.Mode: the robot's, when it had been carried out."""
    seq: int
    """Of the first State that shows it."""
    ok: Literal[True] = True


class RoleReply(Struct, frozen=True):
    """What a user is to the robot, asked on …/role/<user>; answered to every certificate of the robot's authority."""

    user: str
    """The name in the key."""
    role: str | None
    """A trirail.wire.vocabulary.Role, None for who has none; where nobody is asked for a certificate, maintainer."""


class ErrorReply(Struct, frozen=True, omit_defaults=True):
    """A goal or command was refused, and nothing moved because of it, or a command could not be carried out."""

    code: RefusalCode
    """Why, for programs; a client takes a code that it does not know for "other"."""
    message: str
    """Why, for people: one line that says what would be right."""
    slider: str | None = None
    """A, B or C, where it is about one."""
    value: float | None = None
    """What was asked, in SI units, where a limit forbids it."""
    limit: float | None = None
    """What is allowed, in SI units."""


class Residual(Struct, frozen=True):
    """Where the robot was to be, less where it was measured."""

    sliders: Triple
    """Of the sliders A, B, C [m]."""
    pose: Triple
    """Of x, y [m] and phi [rad]."""


class FaultDetail(Struct, frozen=True, omit_defaults=True):
    """What a fault is about, for programs."""

    cause: str
    """A trirail.wire.vocabulary.FaultCause, or a cause of trirail_drivers.interface.DriveFault: emcy, silent, bus, …"""
    drive: str = ""
    """A, B or C, where it is about one."""
    code: int = 0
    """The drive's own: EMCY or 603Fh error code, or an ODrive's error bits; 0 where there is none."""


class Notice(Struct, frozen=True, omit_defaults=True):
    """Something to tell everyone, before it is numbered as an event."""

    kind: Literal["goal", "mode", "fault", "refused", "pose", "lease", "alignment", "output", "input", "service"]
    """What it is about: the end of a goal, a new mode, a fault, something refused, a named pose that was taught or
    removed, a new holder of the lease, a look of an alignment, outputs that have switched, the edge of an input, the
    service itself."""
    level: Level
    """How much it matters to people."""
    message: str
    """One line for people."""
    mode: str | None = None
    """The mode entered, with kind mode."""
    id: str | None = None
    """The goal's id, with kind goal: what has this field is a goal's end."""
    outcome: Outcome | None = None
    """How the goal ended, with kind goal."""
    reason: str | None = None
    """Why it ended so, with kind goal; the message has it too."""
    goal: str | None = None
    """The id of the goal that set the robot in motion, with kind mode."""
    user: str | None = None
    """Who sent the goal, or what was refused, has taught or removed the pose, or aligns; with kind lease who holds it
    from now on, None for nobody."""
    settle: float | None = None
    """With outcome done: time from the end of the path until the robot was in position, to the first cycle of the dwell
    [s]. None of a goal that was not to settle: a jog, one that was passed on the way to the next."""
    residual: Residual | None = None
    """How far it was from its target when it ended, with outcomes done and unsettled; None of a goal that was not to
    settle."""
    overshoot: Triple | None = None
    """Likewise, how far each of the sliders A, B, C was beyond its target at most since the end of the path, in the
    direction in which it was last commanded to move; of one that was not to move, to either side [m]."""
    fault: FaultDetail | None = None
    """What it is about, with kind fault."""
    alignment: AlignmentLook | None = None
    """The look, with kind alignment."""
    code: RefusalCode | None = None
    """Reason for programs, with kind refused and with a goal that was refused."""
    slider: str | None = None
    """A, B or C, with a code that is about one."""
    value: float | None = None
    """Requested value in SI units, with a code that is about a limit."""
    limit: float | None = None
    """Allowed value in SI units."""
    event_code: EventCode | None = None
    """Content of the message for programs and translations; with kind mode and at a goal's end that of the reason.
    None from a service older than these codes."""
    params: Params = {}
    """Values in the message, by the names that the event code has; SI units and radians."""
    marks: tuple[Switch, ...] = ()
    """Switches on the path of a goal, with kind output, in the order in which they happened."""

    def event(self, seq: int, t: float, cycle: int, time: float) -> Event:
        """Return it with its number and time."""
        marks = tuple(structs.replace(switch, time=time - (t - switch.t)) for switch in self.marks)
        return Event(**structs.asdict(structs.replace(self, marks=marks)), seq=seq, t=t, cycle=cycle, time=time)


class Event(Notice, frozen=True, omit_defaults=True, kw_only=True):
    """Something that happened, in order, numbered without gaps by the loop."""

    seq: int
    """Numbered from 1 since the service's start."""
    t: float
    """Nominal time since the loop's start [s]; the same as in records."""
    cycle: int
    """Its cycle, as in records."""
    time: float
    """Wall clock [s since 1970]."""
