"""What clients and service say to each other over Zenoh beside goals: commands, replies, events. SI units and radians.

The state, and what is answered on …/info, are in trirail.wire.state. JSON by default, msgpack where the encoding
says so.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from msgspec import Meta, Struct
from trirail_drivers.interface import Triple

from trirail.errors import RefusalCode
from trirail.wire.goal_kind import Identifier, check_fields
from trirail.wire.vocabulary import Command

LOWEST_OVERRIDE = 1.0
"""Least share of full speed at which motions run, but for 0, at which they stand [%]."""

Level = Literal["info", "warning", "error"]
Outcome = Literal["done", "rejected", "preempted", "stopped", "expired", "faulted", "unsettled"]


class Override(Struct, frozen=True, forbid_unknown_fields=True):
    """The content of the command override: the share of full speed at which motions run."""

    percent: Annotated[float, Meta(ge=0.0, le=200.0)]
    """0, at which motions stand, or 1 to 200 % of full speed, within the limits."""

    def __post_init__(self) -> None:
        check_fields(self)
        if 0.0 < self.percent < LOWEST_OVERRIDE:
            raise ValueError(f"percent is {self.percent}: 0, or {LOWEST_OVERRIDE:g} to 200 are taken")


class Stop(Struct, frozen=True, forbid_unknown_fields=True):
    """The content, if any, of the command stop: which goal is to be stopped, wherever it is, and no other."""

    goal: Identifier | None = None
    """Its id; none for the robot as a whole."""


SHORTEST_LEASE, LONGEST_LEASE = 0.1, 10.0
"""Time-outs of a lease [s]."""
LeaseTimeout = Annotated[float, Meta(ge=SHORTEST_LEASE, le=LONGEST_LEASE)]


class AcquireLease(Struct, frozen=True, forbid_unknown_fields=True):
    """The content, if any, of the command acquire. The same one again, within its timeout, is a sign of life."""

    id: Identifier | None = None
    """A new one for every lease, the same in every sign of life: a lease that has ended does not come back by one.
    Without it, each one asks anew."""
    timeout: LeaseTimeout = 1.0
    """Real time after which a lease without a sign of life ends, with a controlled stop [s]."""
    force: bool = False
    """Take it over from who holds it, by a role of [control] `takeover`."""

    def __post_init__(self) -> None:
        check_fields(self)


class ReleaseLease(Struct, frozen=True, forbid_unknown_fields=True):
    """The content, if any, of the command release: which lease is given back."""

    id: Identifier | None = None
    """As in its acquire; without it the user's own, whichever that is."""


class NoContent(Struct, frozen=True, forbid_unknown_fields=True):
    """The content of the other commands."""


CONTENT: dict[Command, Any] = {
    Command.OVERRIDE: Override,
    Command.STOP: Stop | None,
    Command.ACQUIRE: AcquireLease | None,
    Command.RELEASE: ReleaseLease | None,
}
"""What commands carry, with None where they may come without; those that are not here, NoContent | None."""


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
    accepted: Literal[True] = True


class CommandReply(Struct, frozen=True):
    """A command was carried out."""

    command: str
    """Its name."""
    mode: str
    """A trirail.wire.vocabulary.Mode: the robot's, when it had been carried out."""
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


class Event(Struct, frozen=True, omit_defaults=True):
    """Something that happened, in order, numbered without gaps by the loop."""

    seq: int
    """Numbered from 1 since the service's start."""
    t: float
    """Nominal time since the loop's start [s]; the same as in records."""
    cycle: int
    """Its cycle, as in records."""
    time: float
    """Wall clock [s since 1970]."""
    kind: Literal["goal", "mode", "fault", "refused", "pose", "lease", "service"]
    """What it is about: the end of a goal, a new mode, a fault, something refused, a named pose that was taught or
    removed, a new holder of the lease, the service itself."""
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
    """Who sent the goal, or what was refused, or has taught or removed the pose; with kind lease who holds it from now
    on, None for nobody."""
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
