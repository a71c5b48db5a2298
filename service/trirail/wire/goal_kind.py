"""What goals of every kind have in common: what they may ask of their kind, and the fields that several have."""

from __future__ import annotations

import importlib
import math
import pkgutil
from types import ModuleType
from typing import Annotated, ClassVar, Self

from msgspec import Meta, Struct, structs
from trirail_drivers.interface import Triple

from trirail.wire.marks import Mark, StopAt
from trirail.wire.sizes import MAX_NAME
from trirail.wire.text import ID_RULE, is_id, quoted

Identifier = Annotated[str, Meta(min_length=1, max_length=MAX_NAME)]
# Floors and ceilings: far beyond what a robot does, far from where numbers lose their digits.
Coordinate = Annotated[float, Meta(ge=-1e3, le=1e3)]
"""x, y or a slider's position [m], phi [rad], or their velocities."""
Acceleration = Annotated[float, Meta(ge=-1e6, le=1e6)]
OwnLimit = Annotated[float, Meta(ge=1e-4, le=1e6)]
Coordinates = tuple[Coordinate, Coordinate, Coordinate]
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


# Fields that goals of several kinds have. What they are for stands here alone: schemas, the command line and the table
# of service/talking.md have it from here.
OwnId = Annotated[
    Identifier | None,
    Meta(description="your name for the goal, used once; made by the service if absent"),
]
ValidFor = Annotated[
    Annotated[float, Meta(ge=1e-3, le=86_400.0)] | None,
    Meta(description="time within which the goal must start [s]; else it expires"),
]
Speed = Annotated[
    float,
    Meta(ge=1e-3, le=1.0, description="share of full speed"),
]
GoalLimits = Annotated[
    OwnLimits | None,
    Meta(description="its own velocity, acceleration, jerk, within the robot's"),
]
Blend = Annotated[
    Annotated[float, Meta(ge=0.0, le=1e3)] | None,
    Meta(description="radius in which the path joins that of the next goal [m]"),
]
ToolPoint = Annotated[
    Tool | None,
    Meta(description="point of the platform, [u, v] in its frame [m], or a name of [frames.tool]"),
]
PoseFrame = Annotated[FrameName, Meta(description="frame of the pose, of [frames.work]")]
AxesFrame = Annotated[FrameName, Meta(description="axes of the move: base, platform, or of [frames.work]")]


def field_description(kind: type[Struct], name: str) -> str:
    """Return what a field of a kind of goal is for. Raises LookupError where that does not stand in its type."""
    for field in structs.fields(kind):
        for meta in getattr(field.type, "__metadata__", ()):
            if field.name == name and isinstance(meta, Meta) and meta.description is not None:
                return meta.description
    raise LookupError(f"{kind.__name__}.{name} has no description in its type")


class GoalKind(Struct, frozen=True, forbid_unknown_fields=True, tag_field="kind"):
    """What is asked of a goal, whatever its kind: a kind says so where it is not as here, by a field or a constant."""

    follows: ClassVar[bool] = False
    """Whether it waits for a goal with a `blend` before it, instead of preempting that."""
    renewed: ClassVar[bool] = False
    """Whether it lasts only while it is renewed, by goals of its own kind, id and user, each within its `timeout`."""
    frequent: ClassVar[bool] = False
    """Whether that is so often that the newest takes the place of one that waits, and one that is refused ends nothing
    and is told of once."""
    waits_at_end: ClassVar[bool] = False
    """Whether it goes on when its path has ended, for as long as it is renewed."""
    timed: ClassVar[bool] = False
    """Whether what it says is so at a `time`: the wall clock's as it comes, the loop's where it is planned [s]."""
    greatest_rate: ClassVar[float] = math.inf
    """At which its motion runs at most, whatever the override: 1 for what has a time of its own."""

    def __post_init__(self) -> None:
        check_fields(self)

    @property
    def id(self) -> str | None:
        """The client's name for it."""
        return None

    @property
    def valid_for(self) -> float | None:
        """Within which time it has to begin [s]."""
        return None

    @property
    def blend(self) -> float | None:
        """How far from its end the next goal may begin [m]; None where that preempts it."""
        return None

    @property
    def marks(self) -> tuple[Mark, ...]:
        """Places on its path at which outputs switch."""
        return ()

    @property
    def stop_at(self) -> StopAt | None:
        """Edge of an input at which it ends."""
        return None

    @property
    def settle(self) -> bool:
        """Whether it is done only when the robot is measured to be in position."""
        return not self.renewed

    @property
    def lengthy(self) -> bool:
        """Whether goals of other users are planned before it, since its planning takes long."""
        return False

    @property
    def timeout(self) -> float:
        """After which time it ends unless it has been renewed [s]."""
        return math.inf

    @property
    def time(self) -> float | None:
        """When what it says is so [s]; None for when it comes."""
        return None

    @property
    def target(self) -> Triple | None:
        """The pose that it says a moving target has; None where it is after none."""
        return None

    def at(self, time: float) -> Self:
        """Return it with another time [s], where it is timed."""
        raise NotImplementedError(f"{type(self).__name__} has no time: {time} s is none of it")

    def check_beginning(self) -> None:
        """Raise RefusedError for what may renew such a goal, but begin none."""


def import_all(package: ModuleType) -> None:
    """Import every module of a package."""
    for module in pkgutil.iter_modules(package.__path__, f"{package.__name__}."):
        importlib.import_module(module.name)
