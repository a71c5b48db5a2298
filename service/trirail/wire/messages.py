"""What clients and service say to each other over Zenoh: goals, commands, replies, events. SI units and radians.

The state, and what is answered on …/info, are in trirail.wire.state. JSON by default, msgpack where the encoding
says so.
"""

from __future__ import annotations

import itertools
import math
from typing import Annotated, Any, Literal

from msgspec import Meta, Struct
from trirail_drivers.interface import Triple

from trirail.errors import RefusalCode
from trirail.wire.sizes import MAX_NAME, MAX_POINTS
from trirail.wire.text import ID_RULE, is_id, quoted
from trirail.wire.vocabulary import Command

SHORTEST_PIECE = 1e-4
"""Least time between two points of a trajectory [s]: below, its derivatives lose their digits."""
LOWEST_OVERRIDE = 1.0
"""Least share of full speed at which motions run, but for 0, at which they stand [%]."""

Identifier = Annotated[str, Meta(min_length=1, max_length=MAX_NAME)]
Level = Literal["info", "warning", "error"]
Outcome = Literal["done", "rejected", "preempted", "stopped", "expired", "faulted", "unsettled"]
# Floors and ceilings: far beyond what a robot does, far from where numbers lose their digits.
Coordinate = Annotated[float, Meta(ge=-1e3, le=1e3)]
"""x, y or a slider's position [m], phi [rad], or their velocities."""
Acceleration = Annotated[float, Meta(ge=-1e6, le=1e6)]
OwnLimit = Annotated[float, Meta(ge=1e-4, le=1e6)]
Coordinates = tuple[Coordinate, Coordinate, Coordinate]
Speed = Annotated[float, Meta(ge=1e-3, le=1.0)]
Validity = Annotated[float, Meta(ge=1e-3, le=86_400.0)]
Moment = Annotated[float, Meta(ge=-86_400.0, le=86_400.0)]
Clock = Annotated[float, Meta(ge=-1e11, le=1e11)]
OwnTriple = tuple[OwnLimit, OwnLimit, OwnLimit]
FrameName = Annotated[str, Meta(pattern=rf"^[A-Za-z0-9_-]{{1,{MAX_NAME}}}$")]
PoseName = Annotated[str, Meta(pattern=rf"^[A-Za-z0-9_-]{{1,{MAX_NAME}}}$")]
Tool = tuple[Coordinate, Coordinate] | FrameName
"""A point of the platform in its own frame, whose origin is the centre [m], or the name of one in [frames.tool]."""


class OwnLimits(Struct, frozen=True, forbid_unknown_fields=True):
    """A goal's own limits for x, y [m] and phi [rad], in place of the platform's; none may be above them."""

    velocity: OwnTriple | None = None
    """[m/s, m/s, rad/s]."""
    acceleration: OwnTriple | None = None
    """[m/s², m/s², rad/s²]."""
    jerk: OwnTriple | None = None
    """[m/s³, m/s³, rad/s³]."""

    def __post_init__(self) -> None:
        _check(self)


class PoseGoal(Struct, frozen=True, forbid_unknown_fields=True, tag_field="kind", tag="pose"):
    """Move the platform to a pose, straight in pose space where the start allows."""

    x: Coordinate
    """Of the platform's centre, or of its `tool`, in the base frame or in `frame` [m]."""
    y: Coordinate
    """Likewise [m]."""
    phi: Coordinate
    """The platform's angle in that frame, counterclockwise [rad]."""
    id: Identifier | None = None
    """A new one for every goal; the service makes one where there is none."""
    speed: Speed = 1.0
    """Fraction of full speed: 0.5 takes twice as long over the same path."""
    valid_for: Validity | None = None
    """The goal expires unless it starts within so many seconds."""
    limits: OwnLimits | None = None
    """Lower ones than the platform's, for this goal alone; with a `tool` they are the tool's."""
    blend: Annotated[float, Meta(ge=0.0, le=1e3)] | None = None
    """The next pose or move waits for this one, and begins when no point of the platform is farther than that from
    where it is to be [m]; without it, the next goal preempts this one."""
    tool: Tool | None = None
    """The point that goes where x, y say, straight and within the platform's limits; the centre where there is none."""
    frame: FrameName = "base"
    """In which x, y and phi are given: base, or a frame of [frames.work]."""

    def __post_init__(self) -> None:
        _check(self)


class MoveGoal(
    Struct, frozen=True, forbid_unknown_fields=True, tag_field="kind", tag="move", rename={"origin": "from"}
):
    """Move the platform by so much: a pose goal, relative to where its tool is."""

    x: Coordinate
    """How far its tool, or its centre, is to go along x of `frame` [m]."""
    y: Coordinate
    """Along y [m]."""
    phi: Coordinate
    """By what angle the platform is to turn about that point, counterclockwise [rad]."""
    frame: FrameName = "base"
    """Along whose axes: those of base, of the platform as it is then, or of a frame of [frames.work]."""
    tool: Tool | None = None
    """As of a pose goal."""
    origin: Literal["commanded", "measured"] = "commanded"
    """From which pose: "commanded" is where the goals before it lead, and where the robot is commanded to be without
    one or in a jog, so that moves add up whenever they come; "measured" is where it is measured to be when they have
    been planned."""
    id: Identifier | None = None
    """As of a pose goal."""
    speed: Speed = 1.0
    """As of a pose goal."""
    valid_for: Validity | None = None
    """As of a pose goal [s]."""
    limits: OwnLimits | None = None
    """As of a pose goal."""
    blend: Annotated[float, Meta(ge=0.0, le=1e3)] | None = None
    """As of a pose goal [m]."""

    def __post_init__(self) -> None:
        _check(self)


class NamedGoal(Struct, frozen=True, forbid_unknown_fields=True, tag_field="kind", tag="named"):
    """Move the platform to a pose that has a name: a pose goal, of the pose of that name when it comes in."""

    name: PoseName
    """One of those that are answered on …/poses."""
    id: Identifier | None = None
    """As of a pose goal."""
    speed: Speed = 1.0
    """As of a pose goal."""
    valid_for: Validity | None = None
    """As of a pose goal [s]."""
    limits: OwnLimits | None = None
    """As of a pose goal."""
    blend: Annotated[float, Meta(ge=0.0, le=1e3)] | None = None
    """As of a pose goal [m]."""

    def __post_init__(self) -> None:
        _check(self)


class SlidersGoal(Struct, frozen=True, forbid_unknown_fields=True, tag_field="kind", tag="sliders"):
    """Move the sliders to positions, straight in slider space where the start allows."""

    position: Coordinates
    """lambda_10 of the sliders A, B, C [m]."""
    id: Identifier | None = None
    """As of a pose goal."""
    speed: Speed = 1.0
    """As of a pose goal."""
    valid_for: Validity | None = None
    """As of a pose goal [s]."""

    def __post_init__(self) -> None:
        _check(self)


class VelocityGoal(Struct, frozen=True, forbid_unknown_fields=True, tag_field="kind", tag="velocity"):
    """Jog: move at a velocity [m/s, rad/s] until `timeout` passes without a fresh one of the same id."""

    x: Coordinate
    """Velocity of the platform's centre along x of the base frame [m/s]."""
    y: Coordinate
    """Along y [m/s]."""
    phi: Coordinate
    """Rate of the platform's angle, counterclockwise [rad/s]."""
    id: Identifier | None = None
    """The same for every renewal of one jog."""
    timeout: Annotated[float, Meta(ge=0.01, le=10.0)] = 0.1
    """Real time, at every override, after which a jog that is not renewed brakes [s]."""
    valid_for: Validity | None = None
    """As of a pose goal [s]."""

    def __post_init__(self) -> None:
        _check(self)


class TrackGoal(Struct, frozen=True, forbid_unknown_fields=True, tag_field="kind", tag="track"):
    """Follow a moving target, renewed 10 to 200 times a second, until `timeout` passes without a fresh one of its id.

    Between two messages the target is taken to go on with its velocity. What is too fast is followed as fast as the
    limits allow; where the target is out of reach the platform waits at the border. Who does not renew it in time has
    the robot brake on its path.
    """

    x: Coordinate
    """Where the target is at `time`: there the platform's centre is to be, in the base frame [m]."""
    y: Coordinate
    """Likewise [m]."""
    phi: Coordinate
    """The angle that the platform is to have then, counterclockwise [rad]."""
    velocity: Coordinates = (0.0, 0.0, 0.0)
    """Of x, y and phi then [m/s, m/s, rad/s]."""
    time: Clock | None = None
    """When that is so, by the wall clock of the service's machine [s since 1970]: clocks of two machines must agree to
    a millisecond or so. At most half a second ago or ahead; without it, when the message comes."""
    id: Identifier | None = None
    """The same for every renewal of one track."""
    timeout: Annotated[float, Meta(ge=0.01, le=1.0)] = 0.25
    """Real time, at every override, after which a track that is not renewed brakes [s]."""
    valid_for: Validity | None = None
    """As of a pose goal [s]."""

    def __post_init__(self) -> None:
        _check(self)


class TrajectoryPoint(Struct, frozen=True, forbid_unknown_fields=True):
    """Where the platform is at a time [s]: x, y [m], phi [rad]; how fast and how accelerated, where given."""

    t: Moment
    """[s]; only differences between points count."""
    x: Coordinate
    """Of the platform's centre, in the base frame [m]."""
    y: Coordinate
    """Likewise [m]."""
    phi: Coordinate
    """The platform's angle in the base frame, counterclockwise [rad]."""
    velocity: Coordinates | None = None
    """Of x, y and phi [m/s, m/s, rad/s]; where it is not given, that between the neighbours, zero at both ends."""
    acceleration: tuple[Acceleration, Acceleration, Acceleration] | None = None
    """Of x, y and phi [m/s², m/s², rad/s²]; where it is not given, as the velocity."""

    def __post_init__(self) -> None:
        _check(self)


class TrajectoryGoal(Struct, frozen=True, forbid_unknown_fields=True, tag_field="kind", tag="trajectory"):
    """Follow timed points, quintic between them, from where the robot stands."""

    points: Annotated[tuple[TrajectoryPoint, ...], Meta(min_length=2, max_length=MAX_POINTS)]
    """By rising time; the first is where the robot stands, the last at rest."""
    id: Identifier | None = None
    """As of a pose goal."""
    stretch: bool = False
    """Slow a trajectory that is too fast for a slider or the platform, instead of refusing it."""
    settle: bool = True
    """Whether it is done only when the robot is measured to be in position, as any other goal; else when its path has
    ended."""
    valid_for: Validity | None = None
    """As of a pose goal [s]."""

    def __post_init__(self) -> None:
        _check(self)
        for before, after in itertools.pairwise(self.points):
            if not after.t - before.t > 0.999 * SHORTEST_PIECE:  # not a matter of the last digit
                raise ValueError(
                    f"points: t = {after.t} follows t = {before.t}: times must rise, by {SHORTEST_PIECE:g} s at least"
                )


RenewedGoal = VelocityGoal | TrackGoal
"""What lasts only while it is renewed, by goals of its own kind, id and user."""
PlannedGoal = PoseGoal | SlidersGoal | VelocityGoal | TrackGoal | TrajectoryGoal
"""What the planner is asked for; its tools are points, its poses those of the base frame, its times the loop's."""
Goal = PlannedGoal | MoveGoal | NamedGoal


class Override(Struct, frozen=True, forbid_unknown_fields=True):
    """The content of the command override: the share of full speed at which motions run."""

    percent: Annotated[float, Meta(ge=0.0, le=200.0)]
    """0, at which motions stand, or 1 to 200 % of full speed, within the limits."""

    def __post_init__(self) -> None:
        _check(self)
        if 0.0 < self.percent < LOWEST_OVERRIDE:
            raise ValueError(f"percent is {self.percent}: 0, or {LOWEST_OVERRIDE:g} to 200 are taken")


class Stop(Struct, frozen=True, forbid_unknown_fields=True):
    """The content, if any, of the command stop: which goal is to be stopped, wherever it is, and no other."""

    goal: Identifier | None = None
    """Its id; none for the robot as a whole."""


LeaseTimeout = Annotated[float, Meta(ge=0.1, le=10.0)]


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
        _check(self)


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


def _check(message: Struct) -> None:
    """Refuse ids that cannot be shown, and numbers that are not finite, also in messages that were never decoded."""
    for name in message.__struct_fields__:
        value = getattr(message, name)
        if name == "id" and value is not None and not is_id(value):
            raise ValueError(f"id {quoted(value)!r} cannot be shown: {ID_RULE} are taken")
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, float) and not math.isfinite(number):
                raise ValueError(f"{name} is {number}: it must be a finite number")


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
