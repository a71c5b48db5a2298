"""Goals as clients send them, each kind with its checks. SI units and radians."""

from __future__ import annotations

import itertools
import math
from typing import Annotated, Literal

from msgspec import Meta, Struct

from trirail.wire.sizes import MAX_NAME, MAX_POINTS
from trirail.wire.text import ID_RULE, is_id, quoted

SHORTEST_PIECE = 1e-4
"""Least time between two points of a trajectory [s]: below, its derivatives lose their digits."""

Identifier = Annotated[str, Meta(min_length=1, max_length=MAX_NAME)]
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


def check_fields(message: Struct) -> None:
    """Refuse ids that cannot be shown, and numbers that are not finite, also in messages that were never decoded."""
    for name in message.__struct_fields__:
        value = getattr(message, name)
        if name == "id" and isinstance(value, str) and not is_id(value):
            raise ValueError(f"id {quoted(value)!r} cannot be shown: {ID_RULE} are taken")
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, float) and not math.isfinite(number):
                raise ValueError(f"{name} is {number}: it must be a finite number")


class OwnLimits(Struct, frozen=True, forbid_unknown_fields=True):
    """A goal's own limits for x, y [m] and phi [rad], in place of the platform's; none may be above them."""

    velocity: OwnTriple | None = None
    """[m/s, m/s, rad/s]."""
    acceleration: OwnTriple | None = None
    """[m/s², m/s², rad/s²]."""
    jerk: OwnTriple | None = None
    """[m/s³, m/s³, rad/s³]."""

    def __post_init__(self) -> None:
        check_fields(self)


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
        check_fields(self)


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
        check_fields(self)


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
        check_fields(self)


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
        check_fields(self)


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
        check_fields(self)


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
        check_fields(self)


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
        check_fields(self)


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
        check_fields(self)
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
