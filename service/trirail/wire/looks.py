"""What a client tells of an alignment or a calibration while it runs: a message for each look, without pictures."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta, Struct

from trirail.wire.event_codes import EventCode, EventText, coded
from trirail.wire.goal_kind import Coordinate, Coordinates, Identifier, check_fields
from trirail.wire.sizes import MAX_TEXT
from trirail.wire.text import ID_RULE, is_id, quoted

MOST_MARKS = 32
"""Marks of one look; with names of full length that is 6 kB."""
Pixel = Annotated[float, Meta(ge=-1e9, le=1e9)]
Share = Annotated[float, Meta(ge=-1e6, le=1e6)]
Count = Annotated[int, Meta(ge=1, le=1_000_000)]
Duration = Annotated[float, Meta(ge=0.0, le=1e6)]
LookPurpose = Literal["calibration", "alignment", "check"]
LookEnd = Literal[
    "reached",
    "corrections",
    "growing",
    "noise",
    "calibrated",
    "checked",
    "failed",
    "missing",
    "distance",
    "swapped",
    "still",
    "moves",
]
"""A trirail.alignment.procedure.AlignmentEnd; what else it can end with; a trirail.errors.AlignmentFault."""
WELL = (None, "reached", "calibrated", "checked")
"""What goes on, or has ended as it should."""


class SeenMark(Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """A mark that was found."""

    name: Identifier
    pixel: tuple[Pixel, Pixel]
    """Where: u, v in its picture; the mean where several pictures were taken."""
    to_go: tuple[Coordinate, Coordinate] | None = None
    """From there to its target, x, y in the base frame [m]; None in a calibration."""

    def __post_init__(self) -> None:
        check_fields(self)
        if not is_id(self.name):
            raise ValueError(f"mark {quoted(self.name)!r} cannot be shown: {ID_RULE} are taken")


class LookError(Struct, frozen=True, forbid_unknown_fields=True):
    """How a part lies away, as one look tells it."""

    worst: Coordinate
    """The greatest way of a mark by the motion that aligns the part [m]."""
    shift: tuple[Coordinate, Coordinate]
    """Remaining distance of the centre of the marks, x, y [m]."""
    turn: Coordinate
    """Remaining rotation of the part [rad]."""
    misfit: Coordinate
    """The greatest distance of a mark from its target that no motion takes away [m]."""
    distance: Share
    """By how much the worst distance of two marks is wrong, as a share of it."""

    def __post_init__(self) -> None:
        check_fields(self)


class AlignmentLook(Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """A look, and what follows from it: a correction, the end, or the next move of a calibration."""

    id: Identifier
    """Of the alignment; the ids of its goals begin with it."""
    purpose: LookPurpose
    number: Count
    """Of the look, from 1; with an end that came without a look, of the last one."""
    marks: Annotated[tuple[SeenMark, ...], Meta(max_length=MOST_MARKS)] = ()
    error: LookError | None = None
    """None in a calibration."""
    pose: Coordinates | None = None
    """Where the platform was measured then: x, y [m], phi [rad]."""
    correction: Coordinates | None = None
    """The motion of the marks' middle that follows: x, y [m], phi [rad]."""
    end: LookEnd | None = None
    """Why it ends with this look."""
    words: Annotated[str, Meta(max_length=MAX_TEXT)] = ""
    """With an end by an error what that says."""
    noise: Pixel | None = None
    """With the end calibrated: the standard deviation of a mark's u or v from the residuals [pixel]."""
    seconds: Duration = 0.0
    """Since the first look, on the client's clock."""

    def __post_init__(self) -> None:
        check_fields(self)


def in_words(look: AlignmentLook) -> str:
    """Return a look as a line for people."""
    said = f"{look.purpose} {look.id}, look {look.number}: {_marks(look)}"
    if look.correction is not None:
        x, y, phi = look.correction
        said += f"; corrects by x {x * 1e6:.2f} µm, y {y * 1e6:.2f} µm, φ {phi * 1e6:.1f} µrad"
    if look.noise is not None:
        said += f"; residual {look.noise:.3f} pixel"
    if look.end is not None:
        said += f"; {look.end} after {look.seconds:.2f} s"
    return said + (f": {look.words}" if look.words else "")


def look_text(look: AlignmentLook, words: str) -> EventText:
    """Return the words of a look with their code."""
    if look.end is None:
        return coded(words, EventCode.ALIGNMENT_LOOK, id=look.id, purpose=look.purpose, number=look.number)
    return coded(words, EventCode.ALIGNMENT_ENDED, id=look.id, purpose=look.purpose, end=look.end, seconds=look.seconds)


def _marks(look: AlignmentLook) -> str:
    if not look.marks:
        return "no marks"
    if look.error is None:
        return ", ".join(f"{mark.name} ({mark.pixel[0]:.2f}, {mark.pixel[1]:.2f})" for mark in look.marks)
    return f"{look.error.worst * 1e6:.2f} µm and {look.error.turn * 1e6:.1f} µrad to go"
