"""What goes over Zenoh: goals, replies, state, events. JSON by default; SI units and radians."""

from __future__ import annotations

import itertools
import math
from typing import Annotated, Any, Literal

import msgspec
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
Outcome = Literal["done", "rejected", "preempted", "stopped", "expired", "faulted"]
# Floors and ceilings: far beyond what a robot does, far from where numbers lose their digits.
Coordinate = Annotated[float, Meta(ge=-1e3, le=1e3)]
"""x, y or a slider's position [m], phi [rad], or their velocities."""
Acceleration = Annotated[float, Meta(ge=-1e6, le=1e6)]
OwnLimit = Annotated[float, Meta(ge=1e-4, le=1e6)]
Coordinates = tuple[Coordinate, Coordinate, Coordinate]
Speed = Annotated[float, Meta(ge=1e-3, le=1.0)]
Validity = Annotated[float, Meta(ge=1e-3, le=86_400.0)]
Moment = Annotated[float, Meta(ge=-86_400.0, le=86_400.0)]
OwnTriple = tuple[OwnLimit, OwnLimit, OwnLimit]


class OwnLimits(Struct, frozen=True, forbid_unknown_fields=True):
    """A goal's own limits for x, y [m] and phi [rad], in place of the platform's; none may be above them."""

    velocity: OwnTriple | None = None
    acceleration: OwnTriple | None = None
    jerk: OwnTriple | None = None

    def __post_init__(self) -> None:
        _check(self)


class PoseGoal(Struct, frozen=True, forbid_unknown_fields=True, tag_field="kind", tag="pose"):
    """Move the platform to a pose, straight in pose space where the start allows."""

    x: Coordinate
    y: Coordinate
    phi: Coordinate
    id: Identifier | None = None
    speed: Speed = 1.0
    """Fraction of full speed: 0.5 takes twice as long over the same path."""
    valid_for: Validity | None = None
    """The goal expires unless it starts within so many seconds."""
    limits: OwnLimits | None = None
    blend: Annotated[float, Meta(ge=0.0, le=1e3)] | None = None
    """The next pose goal waits for this one, and begins when no point of the platform is farther than that from where
    it is to be [m]; without it, the next goal preempts this one."""

    def __post_init__(self) -> None:
        _check(self)


class SlidersGoal(Struct, frozen=True, forbid_unknown_fields=True, tag_field="kind", tag="sliders"):
    """Move the sliders to positions, straight in slider space where the start allows."""

    position: Coordinates
    id: Identifier | None = None
    speed: Speed = 1.0
    valid_for: Validity | None = None

    def __post_init__(self) -> None:
        _check(self)


class VelocityGoal(Struct, frozen=True, forbid_unknown_fields=True, tag_field="kind", tag="velocity"):
    """Jog: move at a velocity [m/s, rad/s] until `timeout` passes without a fresh one of the same id."""

    x: Coordinate
    y: Coordinate
    phi: Coordinate
    id: Identifier | None = None
    timeout: Annotated[float, Meta(ge=0.01, le=10.0)] = 0.1
    valid_for: Validity | None = None

    def __post_init__(self) -> None:
        _check(self)


class TrajectoryPoint(Struct, frozen=True, forbid_unknown_fields=True):
    """Where the platform is at a time [s]: x, y [m], phi [rad]; how fast and how accelerated, where given."""

    t: Moment
    x: Coordinate
    y: Coordinate
    phi: Coordinate
    velocity: Coordinates | None = None
    acceleration: tuple[Acceleration, Acceleration, Acceleration] | None = None

    def __post_init__(self) -> None:
        _check(self)


class TrajectoryGoal(Struct, frozen=True, forbid_unknown_fields=True, tag_field="kind", tag="trajectory"):
    """Follow timed points, quintic between them, from where the robot stands."""

    points: Annotated[tuple[TrajectoryPoint, ...], Meta(min_length=2, max_length=MAX_POINTS)]
    id: Identifier | None = None
    stretch: bool = False
    """Slow a trajectory that is too fast for a slider or the platform, instead of refusing it."""
    valid_for: Validity | None = None

    def __post_init__(self) -> None:
        _check(self)
        for before, after in itertools.pairwise(self.points):
            if not after.t - before.t > 0.999 * SHORTEST_PIECE:  # not a matter of the last digit
                raise ValueError(
                    f"points: t = {after.t} follows t = {before.t}: times must rise, by {SHORTEST_PIECE:g} s at least"
                )


Goal = PoseGoal | SlidersGoal | VelocityGoal | TrajectoryGoal


class Override(Struct, frozen=True, forbid_unknown_fields=True):
    """The content of the command override: the share of full speed at which motions run."""

    percent: Annotated[float, Meta(ge=0.0, le=200.0)]

    def __post_init__(self) -> None:
        _check(self)
        if 0.0 < self.percent < LOWEST_OVERRIDE:
            raise ValueError(f"percent is {self.percent}: 0, or {LOWEST_OVERRIDE:g} to 200 are taken")


class Stop(Struct, frozen=True, forbid_unknown_fields=True):
    """The content, if any, of the command stop: which goal is to be stopped, wherever it is, and no other."""

    goal: Identifier | None = None


class NoContent(Struct, frozen=True, forbid_unknown_fields=True):
    """The content of the other commands."""


CONTENT: dict[Command, Any] = {Command.OVERRIDE: Override, Command.STOP: Stop | None}
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
    duration: float | None
    """Expected time from now to arrival [s]; None while the override is zero: then it has no expected end."""
    slowed: float = 1.0
    """How many times slower it is than was asked for, since a slider or the platform may not move so fast."""
    stops_first: bool = False
    """The robot stops on its old path first: from its present motion it could not, or would be later."""
    queued: bool = False
    """It begins when the goals before it are reached."""
    accepted: Literal[True] = True


class CommandReply(Struct, frozen=True):
    """A command was carried out."""

    command: str
    mode: str
    ok: Literal[True] = True


class ErrorReply(Struct, frozen=True, omit_defaults=True):
    """A goal or command was refused, and nothing moved because of it, or a command could not be carried out."""

    code: RefusalCode
    """Why, for programs; a client takes a code that it does not know for "other"."""
    message: str
    slider: str | None = None
    value: float | None = None
    limit: float | None = None


class Event(Struct, frozen=True, omit_defaults=True):
    """Something that happened, in order, numbered without gaps by the loop."""

    seq: int
    t: float
    """Nominal time since the loop's start [s]; the same as in records."""
    cycle: int
    time: float
    """Wall clock [s since 1970]."""
    kind: Literal["goal", "mode", "fault", "refused", "service"]
    level: Level
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
    """Who sent the goal, or what was refused."""


class Commanded(Struct, frozen=True):
    """What the robot was told: platform, then sliders."""

    pose: Triple
    """x, y [m] of the platform's centre and its angle phi [rad], in the base frame."""
    pose_velocity: Triple
    """[m/s, m/s, rad/s]."""
    pose_acceleration: Triple
    """[m/s², m/s², rad/s²]."""
    position: Triple
    """lambda_10 of the sliders A, B, C [m]."""
    velocity: Triple
    """[m/s]."""
    acceleration: Triple
    """[m/s²]."""


class Traffic(Struct, frozen=True):
    """What of a drive's cyclic frames went wrong since the service started; none of it is a fault by itself."""

    feedback_late: int
    feedback_lost: int
    setpoints_late: int
    setpoints_lost: int


class Sliders(Struct, frozen=True):
    """What the drives say, of A, B, C."""

    position: Triple
    """[m]."""
    velocity: Triple
    """[m/s]."""
    following_error: Triple
    """Setpoint less measured position [m]."""
    following_error_max: Triple
    """Greatest since the service started, while enabled [m]."""
    status: tuple[str, str, str]
    """The power state of each, by its name in CiA 402."""
    traffic: tuple[Traffic, Traffic, Traffic]


class GoalState(Struct, frozen=True):
    """The goal under way."""

    id: str
    progress: float
    """Share of its time that is over, 0 to 1."""
    remaining: float
    """Time to its end [s]."""
    target: Triple | None = None
    """The pose that it leads to; None for a jog."""


class Percentiles(Struct, frozen=True):
    """Over the service's last 60 s [µs]."""

    p50: float
    p99: float
    p999: float
    max: float


class LoopState(Struct, frozen=True):
    """How well the loop keeps its time."""

    rate_hz: int
    cycles: int
    overruns: int
    lateness_us: Percentiles
    cycle_us: Percentiles
    bus_load: float
    """Worst-case share of the bus that the cycle takes, as computed at the start."""
    bus_load_measured: float
    """Share of the bus that the frames sent and heard took in the last second, counted with worst-case stuffing."""
    lacking: tuple[str, ...]
    """What the loop runs without: real-time rights and the like, each with its remedy."""


class State(Struct, frozen=True):
    """The newest state, published at state_hz."""

    seq: int
    """The cycle of its record."""
    t: float
    """Nominal time since the loop's start [s]; the same as in records and events."""
    mode: str
    """A trirail.wire.vocabulary.Mode."""
    pose: Triple
    """Measured: x, y [m] and phi [rad] in the base frame, by the forward kinematics of the measured sliders."""
    velocity: Triple
    """Measured, as a difference over a batch of records [m/s, m/s, rad/s]."""
    acceleration: Triple
    """Measured, as a difference over a batch of records [m/s², m/s², rad/s²]."""
    commanded: Commanded
    sliders: Sliders
    goal: GoalState | None
    override: float
    """The share of full speed at which motions are to run, 0 to 2."""
    faults: tuple[str, ...]
    """Why the robot is in fault, one line each; empty otherwise."""
    loop: LoopState


class Info(Struct, frozen=True):
    """What a client needs to know the robot: answered on …/info."""

    robot: str
    version: str
    geometry: tuple[dict[str, object], ...]
    limits: object
    rate_hz: int
    state_hz: int
    recordings: str
    """The folder of the service's recordings, on its machine."""
    live: str
    """Where a Rerun viewer on the service's machine finds the live view; "" for nowhere."""
    versions: dict[str, str] = msgspec.field(default_factory=dict)
