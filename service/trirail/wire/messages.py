"""Replies and events over Zenoh, in SI units and radians.

Goals are in trirail.wire.goals, commands in trirail.wire.vocabulary, the state and the reply on …/info in
trirail.wire.state. Messages are JSON by default, or msgpack if the encoding names it.
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
"""Number of the last goals whose ids may not be used again."""


class GoalReply(Struct, frozen=True):
    """Acceptance of a goal, which ends with exactly one event; or of a check, which moves nothing and has no event."""

    id: str
    """Id of the goal, from the client or generated; of a check that of its goal, empty if absent."""
    duration: float | None
    """Expected time from now to the end of the path [s]. None if the end is unknown: at override zero, and for a target
    that a newer one has replaced. The goal is done when the robot has then been in position for the dwell of
    [limits.in_position]."""
    slowed: float = 1.0
    """Factor by which the motion is slower than requested, to keep the limits of sliders and platform."""
    stops_first: bool = False
    """Whether the robot first stops on its old path, because a direct transition is impossible or slower."""
    queued: bool = False
    """Whether the goal starts after the goals before it."""
    lag: float | None = None
    """Greatest distance of a point of the platform from its place at the target, when this was accepted [m]; only for a
    track."""
    marks: tuple[PlacedMark, ...] = ()
    """Place at which each mark of the goal will switch first."""
    accepted: Literal[True] = True

    def with_duration(self, duration: float) -> GoalReply:
        """Return a copy with another duration [s], which may be infinite."""
        return structs.replace(self, duration=duration if math.isfinite(duration) else None)


class CommandReply(Struct, frozen=True):
    """A command was carried out."""

    command: str
    """Name of the command."""
    mode: str
    """Mode of the robot after the command, a trirail.wire.vocabulary.Mode."""
    seq: int
    """Number of the first State that shows its effect."""
    ok: Literal[True] = True


class RoleReply(Struct, frozen=True):
    """Role of a user, in reply to …/role/<user>; every certificate of the robot's authority may query it."""

    user: str
    """Name in the key."""
    role: str | None
    """A trirail.wire.vocabulary.Role; None for a user without one; maintainer if the service requires no certificates.
    """


class ErrorReply(Struct, frozen=True, omit_defaults=True):
    """Refusal of a goal or command, which moved nothing, or failure of a command."""

    code: RefusalCode
    """Reason for programs; a client treats an unknown code as "other"."""
    message: str
    """Reason for people, in one line with the expected value or the next step."""
    slider: str | None = None
    """A, B or C, if the reason concerns one slider."""
    value: float | None = None
    """Requested value, if it exceeds a limit, in SI units."""
    limit: float | None = None
    """Allowed value, in SI units."""


class Residual(Struct, frozen=True):
    """Target minus measured position."""

    sliders: Triple
    """Residual of the sliders A, B, C [m]."""
    pose: Triple
    """Residual of x, y [m] and phi [rad]."""


class FaultDetail(Struct, frozen=True, omit_defaults=True):
    """Details of a fault, for programs."""

    cause: str
    """A trirail.wire.vocabulary.FaultCause, or a cause of trirail_drivers.interface.DriveFault: emcy, silent, bus, …"""
    drive: str = ""
    """A, B or C, if the fault concerns one drive."""
    code: int = 0
    """The drive's code: EMCY or 603Fh error code, or an ODrive's error bits; 0 if there is none."""


class Notice(Struct, frozen=True, omit_defaults=True):
    """Content of an event before it has a number and a time."""

    kind: Literal["goal", "mode", "fault", "refused", "pose", "lease", "alignment", "output", "input", "service"]
    """Subject: the end of a goal, a new mode, a fault, a refusal, a named pose that was taught or removed, a change of
    the lease, a look of an alignment, outputs that have switched, the edge of an input, or the service itself."""
    level: Level
    """Importance to people."""
    message: str
    """One line for people."""
    mode: str | None = None
    """Mode entered, with kind mode."""
    id: str | None = None
    """Id of the goal, with kind goal; an event with this field is the end of a goal."""
    outcome: Outcome | None = None
    """Outcome of the goal, with kind goal."""
    reason: str | None = None
    """Reason of the outcome, with kind goal; the message contains it too."""
    goal: str | None = None
    """Id of the goal that set the robot in motion, with kind mode."""
    user: str | None = None
    """User that sent the goal or the refused message, taught or removed the pose, or aligns; with kind lease the new
    holder, None if there is none."""
    settle: float | None = None
    """Time from the end of the path to the first cycle of the dwell in position, with outcome done [s]. None for a goal
    that does not settle: a jog, or a goal that was passed on the way to the next."""
    residual: Residual | None = None
    """Distance from the target at the end, with outcomes done and unsettled; None if the goal does not settle."""
    overshoot: Triple | None = None
    """Greatest distance of the sliders A, B, C beyond their targets since the end of the path, in the direction of the
    last commanded motion, or to either side for a slider that did not move [m]; None as for `residual`."""
    fault: FaultDetail | None = None
    """Details of the fault, with kind fault."""
    alignment: AlignmentLook | None = None
    """The look, with kind alignment."""
    code: RefusalCode | None = None
    """Reason for programs, with kind refused and at the end of a rejected goal."""
    slider: str | None = None
    """A, B or C, if the code concerns one slider."""
    value: float | None = None
    """Requested value in SI units, if the code concerns a limit."""
    limit: float | None = None
    """Allowed value in SI units."""
    event_code: EventCode | None = None
    """Content of the message for programs and translations; with kind mode and at the end of a goal, that of the
    reason. None from a service older than these codes."""
    params: Params = {}
    """Values in the message, by the names that the event code defines; SI units and radians."""
    marks: tuple[Switch, ...] = ()
    """Switches on the path of a goal, with kind output, in the order in which they happened."""
    planned: tuple[PlacedMark, ...] = ()
    """Marks of an accepted goal, with kind output, and the places at which they will switch first."""

    def event(self, seq: int, t: float, cycle: int, time: float, offset: float = 0.0) -> Event:
        """Return the event with its number and time; `offset` is the wall clock less the monotonic one [s]."""
        marks = tuple(
            structs.replace(each, time=time - (t - each.t) if math.isnan(each.time) else each.time + offset)
            for each in self.marks
        )
        return Event(**structs.asdict(structs.replace(self, marks=marks)), seq=seq, t=t, cycle=cycle, time=time)


class Event(Notice, frozen=True, omit_defaults=True, kw_only=True):
    """An event; the loop numbers events without gaps, in order."""

    seq: int
    """Number since the service's start, from 1."""
    t: float
    """Nominal time since the loop's start [s]; the same as in records."""
    cycle: int
    """Cycle of the event, as in records."""
    time: float
    """Wall clock [s since 1970]."""
