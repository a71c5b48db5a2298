"""What the page says to its server. What the server says is State, Event and the like, each beside what it `tell`s."""

from __future__ import annotations

from typing import Annotated, ClassVar

from msgspec import Meta, Struct

from trirail.panel.permissions import GOAL, POSES, TAKEOVER
from trirail.wire.goal_kind import FrameName
from trirail.wire.goals import Coordinates
from trirail.wire.sizes import MAX_MESSAGE
from trirail.wire.vocabulary import Command

Content = Annotated[str, Meta(max_length=MAX_MESSAGE)]
"""A file's."""


class _Said(Struct, frozen=True, forbid_unknown_fields=True, tag_field="do"):
    """Any of these."""

    wants: ClassVar[str | None] = None
    """Which permission it takes; None where it takes none."""

    @property
    def needs(self) -> str | None:
        """Which permission this one takes."""
        return self.wants


class Seen(_Said, frozen=True, tag="seen"):
    """The page has drawn a state."""

    stamp: int
    """That state's."""


class Hold(_Said, frozen=True, tag="hold"):
    """A jog button is held down, now."""

    wants = GOAL

    velocity: Coordinates
    """Of x, y [m/s] and phi [rad/s], in the base frame."""
    seen: int
    """The stamp of the newest state that the page has drawn: who sees an old picture must not move the robot."""
    tool: FrameName | None = None
    """One of [frames.tool], about which it turns; the centre where there is none."""


class Release(_Said, frozen=True, tag="release"):
    """No jog button is held down any more."""


class Tell(_Said, frozen=True, tag="command"):
    """A command's button has been pressed."""

    name: Command
    """The command, one without content."""

    @property
    def needs(self) -> str:
        """The command's own permission."""
        return self.name


class TakeOver(_Said, frozen=True, tag="takeover"):
    """The lease is to be taken over from who holds it."""

    wants = TAKEOVER


class SetOverride(_Said, frozen=True, tag="override"):
    """The override's slider has been moved."""

    wants = Command.OVERRIDE

    percent: float
    """Share of full speed [%]."""


class GoTo(_Said, frozen=True, tag="goto"):
    """A named pose's button has been pressed."""

    wants = GOAL

    name: str
    """The pose's."""


class GoToPose(_Said, frozen=True, tag="pose"):
    """A pose that was typed, or dragged on the drawing, is to be gone to."""

    wants = GOAL

    pose: Coordinates
    """x, y [m] and phi [rad] of the tool, in the frame."""
    tool: FrameName | None = None
    """One of [frames.tool]; the centre where there is none."""
    frame: FrameName = "base"
    """Base, or one of [frames.work]."""


class CheckPose(_Said, frozen=True, tag="check"):
    """Whether such a pose can be gone to is to be said, without moving."""

    pose: Coordinates
    """Likewise."""
    number: int
    """By which the page knows the answer."""
    tool: FrameName | None = None
    """Likewise."""
    frame: FrameName = "base"
    """Likewise."""


class JogStep(_Said, frozen=True, tag="step"):
    """A jog button has been pressed where it is for steps."""

    wants = GOAL

    by: Coordinates
    """Along x, y [m] of the frame, and about phi [rad], of the tool."""
    seen: int
    """As of Hold."""
    tool: FrameName | None = None
    """As of GoToPose."""
    frame: FrameName = "base"
    """Base, platform, or one of [frames.work]."""


class CheckPath(_Said, frozen=True, tag="check path"):
    """Whether the path in a file can be followed is to be said, without moving."""

    name: str
    """The file's: .json has JSON in it, any other CSV."""
    text: Content
    """What is in it."""
    number: int
    """By which the page knows the answer."""
    stretch: bool = False
    """Whether one that is too fast is slowed."""


class Follow(_Said, frozen=True, tag="follow"):
    """Such a path is to be followed, from where it begins."""

    wants = GOAL

    name: str
    """Likewise."""
    text: Content
    """Likewise."""
    stretch: bool = False
    """Likewise."""


class Teach(_Said, frozen=True, tag="teach"):
    """Where the robot stands is to be kept as a pose."""

    wants = POSES

    name: str
    """The pose's."""


class Forget(_Said, frozen=True, tag="forget"):
    """A taught pose is to be removed."""

    wants = POSES

    name: str
    """The pose's."""


Asked = TakeOver | SetOverride | GoTo | GoToPose | JogStep | Follow | Teach | Forget
"""What is asked of the service, beside commands and held jogs."""
FromPage = Seen | Hold | Release | Tell | CheckPose | CheckPath | Asked
