"""Base class of all kinds of goals, and the fields that several kinds share."""

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
# These bounds exceed every robot's range, and are far below magnitudes at which doubles lose precision.
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
"""Point in the platform's frame, relative to the platform's centre [m], or the name of a point in [frames.tool]."""


def check_fields(message: Struct) -> None:
    """Raise ValueError for an unprintable id or a number that is not finite, even if the message was never decoded."""
    for name in message.__struct_fields__:
        value = getattr(message, name)
        if name == "id" and isinstance(value, str) and not is_id(value):
            raise ValueError(f"id {quoted(value)!r} is not printable; use {ID_RULE}")
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, float) and not math.isfinite(number):
                raise ValueError(f"{name}: {number} is not a finite number")


class OwnLimits(Struct, frozen=True, forbid_unknown_fields=True):
    """Limits of a single goal for x, y [m] and phi [rad]; they may not exceed the platform's limits."""

    velocity: OwnTriple | None = None
    """[m/s, m/s, rad/s]."""
    acceleration: OwnTriple | None = None
    """[m/s², m/s², rad/s²]."""
    jerk: OwnTriple | None = None
    """[m/s³, m/s³, rad/s³]."""

    def __post_init__(self) -> None:
        check_fields(self)


# Fields that several kinds share. The schemas, the command line and the table of service/talking.md use these
# descriptions.
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
    """Return the description of a goal kind's field. Raises LookupError if the type of the field has none."""
    for field in structs.fields(kind):
        for meta in getattr(field.type, "__metadata__", ()):
            if field.name == name and isinstance(meta, Meta) and meta.description is not None:
                return meta.description
    raise LookupError(f"{kind.__name__}.{name} has no description in its type")


class GoalKind(Struct, frozen=True, forbid_unknown_fields=True, tag_field="kind"):
    """Properties of any goal; a kind overrides their defaults with a field or a class constant."""

    follows: ClassVar[bool] = False
    """Whether the goal waits for a preceding goal that has a `blend`, instead of preempting it."""
    renewed: ClassVar[bool] = False
    """Whether the goal lasts only while goals with the same kind, id and user renew it, each within its `timeout`."""
    frequent: ClassVar[bool] = False
    """Whether renewals are frequent. The newest renewal then replaces one that still waits, and a refused renewal does
    not end the goal and is reported only once."""
    waits_at_end: ClassVar[bool] = False
    """Whether the goal stays active at the end of its path for as long as it is renewed."""
    timed: ClassVar[bool] = False
    """Whether the goal refers to a `time` [s]: wall-clock time when the goal arrives, loop time when it is planned."""
    greatest_rate: ClassVar[float] = math.inf
    """Maximum rate of the motion at any override; 1 for goals with their own timing."""

    def __post_init__(self) -> None:
        check_fields(self)

    @property
    def id(self) -> str | None:
        """Id that the client gave to the goal."""
        return None

    @property
    def valid_for(self) -> float | None:
        """Time within which the goal must start [s]."""
        return None

    @property
    def blend(self) -> float | None:
        """Distance from the end at which the next goal may start [m]; None if the next goal preempts this one."""
        return None

    @property
    def marks(self) -> tuple[Mark, ...]:
        """Places on the goal's path at which outputs switch."""
        return ()

    @property
    def stop_at(self) -> StopAt | None:
        """Edge of an input at which the goal ends."""
        return None

    @property
    def settle(self) -> bool:
        """Whether the goal is done only when the measured position has settled."""
        return not self.renewed

    @property
    def lengthy(self) -> bool:
        """Whether planning the goal takes so long that other users' goals are planned first."""
        return False

    @property
    def timeout(self) -> float:
        """Time after which the goal ends unless it is renewed [s]."""
        return math.inf

    @property
    def time(self) -> float | None:
        """Time to which the goal refers [s]; None for the time of its arrival."""
        return None

    @property
    def target(self) -> Triple | None:
        """Pose of the moving target; None if the goal does not follow a target."""
        return None

    def at(self, time: float) -> Self:
        """Return a copy with another time [s]. Raises NotImplementedError if the kind is not timed."""
        raise NotImplementedError(f"{type(self).__name__} has no time to replace by {time} s")

    def check_beginning(self) -> None:
        """Raise RefusedError if the message can renew a goal of this kind but not start one."""


def import_all(package: ModuleType) -> None:
    """Import every module of a package."""
    for module in pkgutil.iter_modules(package.__path__, f"{package.__name__}."):
        importlib.import_module(module.name)
