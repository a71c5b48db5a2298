"""Messages in which a client reports each look of an alignment or calibration, without the pictures."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta, Struct

from trirail.wire.event_codes import EventCode, EventText, coded
from trirail.wire.goal_kind import Coordinate, Coordinates, Identifier, check_fields
from trirail.wire.sizes import MAX_TEXT
from trirail.wire.text import check_id

MAX_MARKS = 32
"""Maximum number of marks in one look. With the longest names, this many marks take 6 kB."""
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
"""Reason why an alignment or calibration ended.

Most values are those of trirail.alignment.procedure.AlignmentEnd and trirail.errors.AlignmentFault."""
SUCCESSFUL_ENDS = (None, "reached", "calibrated", "checked")
"""Values of AlignmentLook.end that are not failures; None means that the alignment continues."""


class SeenMark(Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Mark that was found in a picture."""

    name: Identifier
    pixel: tuple[Pixel, Pixel]
    """Position u, v in the picture [pixel]; the mean position if several pictures were taken."""
    to_go: tuple[Coordinate, Coordinate] | None = None
    """Vector from the mark to its target, x, y in the base frame [m]; None in a calibration."""

    def __post_init__(self) -> None:
        check_fields(self)
        check_id(self.name, "mark")


class LookError(Struct, frozen=True, forbid_unknown_fields=True):
    """Deviation of a part from its target, as measured by one look."""

    worst: Coordinate
    """Greatest distance that any mark travels in the motion that aligns the part [m]."""
    shift: tuple[Coordinate, Coordinate]
    """Displacement of the marks' centre in the motion that aligns the part, x, y [m]."""
    turn: Coordinate
    """Rotation of the part in the motion that aligns the part [rad]."""
    misfit: Coordinate
    """Greatest distance of a mark from its target that would remain after the best motion [m]."""
    distance: Share
    """Greatest relative error of the distance between two marks."""

    def __post_init__(self) -> None:
        check_fields(self)


class AlignmentLook(Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Look of an alignment and its consequence: a correction, the end, or the next move of a calibration."""

    id: Identifier
    """Id of the alignment. The ids of the alignment's goals begin with this id."""
    purpose: LookPurpose
    number: Count
    """Number of the look, starting at 1; the number of the last look if the alignment ended without another look."""
    marks: Annotated[tuple[SeenMark, ...], Meta(max_length=MAX_MARKS)] = ()
    error: LookError | None = None
    """Deviation of the part; None in a calibration."""
    pose: Coordinates | None = None
    """Measured pose of the platform at the look: x, y [m], phi [rad]."""
    correction: Coordinates | None = None
    """Correction that follows the look, as a motion of the marks' centre: x, y [m], phi [rad]."""
    end: LookEnd | None = None
    """Reason why the alignment ends with this look; None if the alignment continues."""
    words: Annotated[str, Meta(max_length=MAX_TEXT)] = ""
    """Error message, if the alignment ends because of an error."""
    noise: Pixel | None = None
    """Standard deviation of u or v of a mark, from the residuals of a successful calibration [pixel]."""
    seconds: Duration = 0.0
    """Time since the first look, on the client's clock [s]."""

    def __post_init__(self) -> None:
        check_fields(self)


def in_words(look: AlignmentLook) -> str:
    """Return a one-line summary of a look, for people."""
    line = f"{look.purpose} {look.id}, look {look.number}: {_marks(look)}"
    if look.correction is not None:
        x, y, phi = look.correction
        line += f"; corrects by x {x * 1e6:.2f} µm, y {y * 1e6:.2f} µm, φ {phi * 1e6:.1f} µrad"
    if look.noise is not None:
        line += f"; residual {look.noise:.3f} pixel"
    if look.end is not None:
        line += f"; {look.end} after {look.seconds:.2f} s"
    return line + (f": {look.words}" if look.words else "")


def alignment_event_text(look: AlignmentLook, words: str) -> EventText:
    """Return the text `words` of a look with the look's event code and parameters."""
    if look.end is None:
        return coded(words, EventCode.ALIGNMENT_LOOK, id=look.id, purpose=look.purpose, number=look.number)
    return coded(words, EventCode.ALIGNMENT_ENDED, id=look.id, purpose=look.purpose, end=look.end, seconds=look.seconds)


def _marks(look: AlignmentLook) -> str:
    if not look.marks:
        return "no marks"
    if look.error is None:
        return ", ".join(f"{mark.name} ({mark.pixel[0]:.2f}, {mark.pixel[1]:.2f})" for mark in look.marks)
    return f"{look.error.worst * 1e6:.2f} µm and {look.error.turn * 1e6:.1f} µrad to go"
