"""Base class of all goal kinds, and the types of fields that several goal kinds share."""

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
from trirail.wire.text import check_id

Identifier = Annotated[str, Meta(min_length=1, max_length=MAX_NAME)]
# These bounds exceed the range of every robot, but are far below the magnitudes at which doubles lose precision.
Coordinate = Annotated[float, Meta(ge=-1e3, le=1e3)]
"""x, y or the position of a slider [m], phi [rad], or the velocity of one of these [m/s, rad/s]."""
Acceleration = Annotated[float, Meta(ge=-1e6, le=1e6)]
OwnLimit = Annotated[float, Meta(ge=1e-4, le=1e6)]
Coordinates = tuple[Coordinate, Coordinate, Coordinate]
Moment = Annotated[float, Meta(ge=-86_400.0, le=86_400.0)]
Clock = Annotated[float, Meta(ge=-1e11, le=1e11)]
OwnTriple = tuple[OwnLimit, OwnLimit, OwnLimit]
FrameName = Annotated[str, Meta(pattern=rf"^[A-Za-z0-9_-]{{1,{MAX_NAME}}}$(?!\n)")]
PoseName = Annotated[str, Meta(pattern=rf"^[A-Za-z0-9_-]{{1,{MAX_NAME}}}$(?!\n)")]
Tool = tuple[Coordinate, Coordinate] | FrameName
"""Point in the platform's frame, relative to the platform's centre [m], or the name of a point in [frames.tool]."""


def check_fields(message: Struct) -> None:
    """Raise ValueError if the id is invalid or if a number is not finite.

    Messages call this function when they are created, so that the checks also apply to messages that were not decoded.
    """
    for name in message.__struct_fields__:
        value = getattr(message, name)
        if name == "id" and isinstance(value, str):
            check_id(value, "id")
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, float) and not math.isfinite(number):
                raise ValueError(f"{name}: {number} is not a finite number")


class OwnLimits(Struct, frozen=True, forbid_unknown_fields=True):
    """Limits of a single goal for x, y [m] and phi [rad]; they may not exceed the platform's limits."""

    velocity: OwnTriple | None = None
    """Maximum velocity [m/s, m/s, rad/s]."""
    acceleration: OwnTriple | None = None
    """Maximum acceleration [m/s², m/s², rad/s²]."""
    jerk: OwnTriple | None = None
    """Maximum jerk [m/s³, m/s³, rad/s³]."""

    def __post_init__(self) -> None:
        check_fields(self)


# Types of fields that several goal kinds share. The schemas, the help of the command line and the table in
# service/talking.md contain these descriptions.
OwnId = Annotated[
    Identifier | None,
    Meta(description="your name for the goal, used once; made by the service if absent"),
]
ValidFor = Annotated[
    Annotated[float, Meta(ge=1e-3, le=86_400.0)] | None,
    Meta(description="longest time from arrival to start [s]; afterwards the goal expires"),
]
MIN_SPEED = 1e-3
"""Smallest fraction of full speed that a goal may have."""
Speed = Annotated[
    float,
    Meta(ge=MIN_SPEED, le=1.0, description="share of full speed"),
]
GoalLimits = Annotated[
    OwnLimits | None,
    Meta(description="own velocity, acceleration, jerk (not while braking)"),
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
    """Base class of goals. A goal kind overrides the default of a property with a field or a class constant."""

    follows: ClassVar[bool] = False
    """Whether the goal waits for a preceding goal that has a `blend`, instead of preempting it."""
    renewed: ClassVar[bool] = False
    """Whether the goal lasts only while goals with the same kind, id and user renew it, each within its `timeout`. The
    newest renewal replaces earlier renewals that still wait."""
    frequent: ClassVar[bool] = False
    """Whether renewals are frequent. A refused renewal then does not end the goal, and only the first refusal is
    reported."""
    waits_at_end: ClassVar[bool] = False
    """Whether the goal stays active at the end of its path for as long as it is renewed."""
    timed: ClassVar[bool] = False
    """Whether the goal refers to a `time` [s]. The client gives wall-clock time; the planner receives loop time."""

    def __post_init__(self) -> None:
        check_fields(self)

    @property
    def id(self) -> str | None:
        """Id that the client chose for the goal; None if the client chose none."""
        return None

    @property
    def valid_for(self) -> float | None:
        """Time after its arrival within which the goal must start [s]; None if there is no such time."""
        return None

    @property
    def blend(self) -> float | None:
        """Distance from the end of the path at which the next goal may start [m]; None if the next goal preempts it."""
        return None

    @property
    def marks(self) -> tuple[Mark, ...]:
        """Places on the goal's path at which outputs switch."""
        return ()

    @property
    def stop_at(self) -> StopAt | None:
        """Edge of an input at which the goal ends; None if there is no such edge."""
        return None

    @property
    def limits(self) -> OwnLimits | None:
        """Limits of this goal alone."""
        return None

    @property
    def greatest_rate(self) -> float:
        """Maximum rate of the motion at any override. It is 1 for goals with their own timing, limits or pulses: at a
        higher rate, the goal would exceed its limits, and pulses would merge.
        """
        pulses = any(mark.pulse_width is not None for mark in self.marks)
        return 1.0 if self.limits is not None or pulses else math.inf

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
        """Time to which the goal refers [s]; None means the time of the goal's arrival."""
        return None

    @property
    def target(self) -> Triple | None:
        """Pose of the moving target; None if the goal does not follow a target."""
        return None

    def at(self, time: float) -> Self:
        """Return a copy with another `time` [s]. Raises NotImplementedError if the goal kind is not timed."""
        raise NotImplementedError(f"{type(self).__name__} has no time to replace by {time} s")

    def check_beginning(self) -> None:
        """Raise RefusedError if this goal can renew a goal with the same id, but cannot start a new motion."""


def import_all(package: ModuleType) -> None:
    """Import every module of a package."""
    for module in pkgutil.iter_modules(package.__path__, f"{package.__name__}."):
        importlib.import_module(module.name)
