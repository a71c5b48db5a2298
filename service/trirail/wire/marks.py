"""Marks, which are places on a goal's path at which outputs switch, and records of the switches, in SI units."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from decimal import Decimal
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta, Struct
from trirail_drivers.interface import Triple

from trirail.wire.decoding import converted, prepare
from trirail.wire.plain_values import plain_value
from trirail.wire.sizes import MAX_NAME

Length = Annotated[float, Meta(ge=0.0, le=1e3)]
Duration = Annotated[float, Meta(ge=0.0, le=86_400.0)]
OutputName = Annotated[str, Meta(pattern=rf"^[A-Za-z][A-Za-z0-9_-]{{0,{MAX_NAME - 1}}}$(?!\n)")]
PLACE_FIELDS = ("after_start", "after_start_s", "before_target", "before_target_s", "at_path_fraction", "at", "start")
"""Fields that specify the place of a mark; each mark has exactly one of these fields."""


class Crossing(Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Place at which a path first crosses a value of one coordinate."""

    x: Annotated[float, Meta(ge=-1e3, le=1e3)] | None = None
    """Coordinate of the tool in the base frame [m]."""
    y: Annotated[float, Meta(ge=-1e3, le=1e3)] | None = None
    """Coordinate of the tool in the base frame [m]."""
    phi: Annotated[float, Meta(ge=-1e3, le=1e3)] | None = None
    """Angle of the platform [rad]."""

    def __post_init__(self) -> None:
        if sum(value is not None for value in (self.x, self.y, self.phi)) != 1:
            raise ValueError("at accepts exactly one coordinate: x, y or phi")

    @property
    def coordinate(self) -> tuple[int, float]:
        """Index of the coordinate, 0 to 2 for x, y, phi, and the value of the coordinate [m] or [rad]."""
        values = self.x, self.y, self.phi
        return next((number, value) for number, value in enumerate(values) if value is not None)


class Mark(Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Place on a goal's path at which an output switches, or a section of the path on which it switches repeatedly.

    Path lengths are measured along the path of the goal's tool. Times are those of a motion at full speed.
    """

    output: OutputName
    """Name of an output of the configuration."""
    value: bool = True
    """Value to which the output switches; with an `increment`, the value of the output during the pulses."""
    after_start: Length | None = None
    """Path length from the start of the path to the mark [m]."""
    after_start_s: Duration | None = None
    """Time from the start of the path to the mark [s]."""
    before_target: Length | None = None
    """Path length from the mark to the end of the path [m]."""
    before_target_s: Duration | None = None
    """Time from the mark to the end of the path [s]."""
    at_path_fraction: Annotated[float, Meta(ge=0.0, le=1.0)] | None = None
    """Place of the mark as a fraction of the path's length, 0 to 1."""
    at: Crossing | None = None
    """Value of one coordinate; the output switches where the path first crosses this value."""
    start: Length | None = None
    """Path length from the start of the path to the start of a section [m]."""
    end: Length | None = None
    """Path length from the start of the path to the end of a section [m]; the default is the end of the path."""
    increment: Annotated[float, Meta(ge=1e-7, le=1e3)] | None = None
    """Path length from pulse to pulse in a section [m]. Without an increment, the output has the `value` from `start`
    to `end`."""
    pulse_width: Annotated[float, Meta(ge=1e-4, le=3600.0)] | None = None
    """Duration of a pulse [s], rounded to whole cycles. Without a pulse width, the output does not switch back."""

    def __post_init__(self) -> None:
        for name in self.__struct_fields__:
            number = getattr(self, name)
            if isinstance(number, float) and not math.isfinite(number):
                raise ValueError(f"{name} is {number}: it must be a finite number")
        set_fields = [name for name in PLACE_FIELDS if getattr(self, name) is not None]
        if len(set_fields) != 1:
            has = " and ".join(set_fields) if set_fields else "none"
            raise ValueError(f"a mark of {self.output!r} has {has}: exactly one of {', '.join(PLACE_FIELDS)} is needed")
        if self.start is None and (self.end is not None or self.increment is not None):
            raise ValueError(f"a mark of {self.output!r} has an end or increment without a start")
        if self.increment is not None and self.pulse_width is None:
            raise ValueError(f"a repetition of {self.output!r} has an increment, and needs a pulse_width too")
        if self.start is not None and self.increment is None and self.pulse_width is not None:
            raise ValueError(f"a mark of {self.output!r} has a start and a pulse_width, and needs an increment too")
        if self.start is not None and self.end is not None and self.end <= self.start:
            raise ValueError(f"a repetition of {self.output!r} ends at {self.end:g} m: its end must be after its start")

    @property
    def closes(self) -> bool:
        """True if the output gets the opposite value at the end of the pulse or section, or where a stop ends it."""
        return self.pulse_width is not None or self.start is not None


MarkLike = Mark | Mapping[str, Any]
"""A mark, or a mapping from the names of a mark's fields to values."""


def marks_of(marks: Sequence[MarkLike]) -> tuple[Mark, ...]:
    """Convert mappings, with numbers of any library, to marks; marks are returned unchanged.

    Raises ValueError or TypeError if a mapping is invalid.
    """
    return tuple(mark if isinstance(mark, Mark) else converted(_plain(mark), Mark) for mark in marks)


def _plain(mark: Mapping[str, Any]) -> Any:
    return msgspec.to_builtins(dict(mark), enc_hook=plain_value, builtin_types=(Decimal,))


Marks = Annotated[
    tuple[Mark, ...],
    Meta(max_length=100, description="places on the path at which outputs switch"),
]


class StopAt(Struct, frozen=True, forbid_unknown_fields=True):
    """Edge of an input at which the robot makes a controlled stop; the goal is then done."""

    input: OutputName
    """Name of an input of the configuration."""
    edge: Literal["rising", "falling"] = "rising"
    """Direction of the edge."""


StopAtLike = StopAt | Mapping[str, Any]
"""A StopAt, or a mapping from the names of its fields to values."""


def stop_at_of(edge: StopAtLike | None) -> StopAt | None:
    """Convert a mapping to a StopAt; return None or a StopAt unchanged. Raises ValueError if the mapping is invalid."""
    return edge if edge is None or isinstance(edge, StopAt) else converted(dict(edge), StopAt)


StopAtEdge = Annotated[
    StopAt | None,
    Meta(description="edge of an input at which it ends, by a controlled stop"),
]


prepare(Mark, StopAt)


class PlacedMark(Struct, frozen=True, omit_defaults=True):
    """Mark of an accepted goal, with the place at which the output will first switch."""

    mark: int
    """Index of the mark in the goal."""
    output: str
    value: bool
    pose: Triple
    """Commanded pose of the platform at this place: x, y [m], phi [rad]."""
    path: float
    """Path length of the tool from the start of the path to this place [m]."""
    time: float
    """Time from the start of the path to this place at full speed [s]."""
    number: int = 1
    """Number of times that the output will switch to `value`."""


class Switch(Struct, frozen=True, omit_defaults=True):
    """Record of an output that has switched on the path of a goal."""

    goal: str
    """Id of the goal."""
    mark: int
    """Index of the mark in the goal."""
    output: str
    value: bool
    cycle: int
    """Cycle in which the switch is sent with the setpoints; the drives apply both at the next SYNC."""
    t: float
    """Nominal time since the start of the loop [s], as in records."""
    time: float
    """Wall-clock time at which the cycle was due [s since 1970]. The drives switch at the next SYNC, one period
    later."""
    commanded: Triple
    """Commanded pose in this cycle: x, y [m], phi [rad]."""
    measured: Triple
    """Measured pose in this cycle: x, y [m], phi [rad]."""
    closed: bool = False
    """True if the output switched back because the goal ended or stopped, False if it switched at a mark. If True, the
    poses are those of the cycle before, because the switch is reported before its cycle runs."""


def switch_rows(switches: tuple[Switch, ...]) -> list[dict[str, Any]]:
    """Return a table with one row for each switch and one value in each column, for CSV, Parquet and data frames."""
    rows = []
    for switch in switches:
        row: dict[str, Any] = {
            name: getattr(switch, name) for name in ("goal", "mark", "output", "value", "cycle", "t", "time", "closed")
        }
        for kind in ("commanded", "measured"):
            for name, value in zip(("x", "y", "phi"), getattr(switch, kind), strict=True):
                row[f"{kind}_{name}"] = value
        rows.append(row)
    return rows
