"""What the page says to its server. What the server says is State, Event and the like, each beside what it `tell`s."""

from __future__ import annotations

from msgspec import Struct

from trirail.wire.goals import Coordinates
from trirail.wire.vocabulary import Command


class Seen(Struct, frozen=True, forbid_unknown_fields=True, tag_field="do", tag="seen"):
    """The page has drawn a state."""

    stamp: int
    """That state's."""


class Hold(Struct, frozen=True, forbid_unknown_fields=True, tag_field="do", tag="hold"):
    """A jog button is held down, now."""

    velocity: Coordinates
    """Of x, y [m/s] and phi [rad/s], in the base frame."""
    seen: int
    """The stamp of the newest state that the page has drawn: who sees an old picture must not move the robot."""


class Release(Struct, frozen=True, forbid_unknown_fields=True, tag_field="do", tag="release"):
    """No jog button is held down any more."""


class Tell(Struct, frozen=True, forbid_unknown_fields=True, tag_field="do", tag="command"):
    """A command's button has been pressed."""

    name: Command
    """The command, one without content."""


class SetOverride(Struct, frozen=True, forbid_unknown_fields=True, tag_field="do", tag="override"):
    """The override's slider has been moved."""

    percent: float
    """Share of full speed [%]."""


class GoTo(Struct, frozen=True, forbid_unknown_fields=True, tag_field="do", tag="goto"):
    """A named pose's button has been pressed."""

    name: str
    """The pose's."""


class GoToPose(Struct, frozen=True, forbid_unknown_fields=True, tag_field="do", tag="pose"):
    """A pose that was typed, or dragged on the drawing, is to be gone to."""

    pose: Coordinates
    """x, y [m] and phi [rad] in the base frame."""


class CheckPose(Struct, frozen=True, forbid_unknown_fields=True, tag_field="do", tag="check"):
    """Whether such a pose can be gone to is to be said, without moving."""

    pose: Coordinates
    """Likewise."""
    number: int
    """By which the page knows the answer."""


class JogStep(Struct, frozen=True, forbid_unknown_fields=True, tag_field="do", tag="step"):
    """A jog button has been pressed where it is for steps."""

    by: Coordinates
    """Along x, y [m] and about phi [rad], in the base frame."""
    seen: int
    """As of Hold."""


class Teach(Struct, frozen=True, forbid_unknown_fields=True, tag_field="do", tag="teach"):
    """Where the robot stands is to be kept as a pose."""

    name: str
    """The pose's."""


class Forget(Struct, frozen=True, forbid_unknown_fields=True, tag_field="do", tag="forget"):
    """A taught pose is to be removed."""

    name: str
    """The pose's."""


FromPage = Seen | Hold | Release | Tell | SetOverride | GoTo | GoToPose | CheckPose | JogStep | Teach | Forget
