"""Messages of the page to its server: goals and contents of commands in the service's format, and the page's own.

The server sends State, Event and others, each with its kind in `tell`.
"""

from __future__ import annotations

from typing import Annotated, ClassVar

from msgspec import Meta, Raw, Struct

from trirail.panel.permissions import GOAL, POSES, TAKEOVER
from trirail.wire.goal_kind import FrameName
from trirail.wire.goals import Coordinates, MoveGoal, NamedGoal, PoseGoal
from trirail.wire.sizes import MAX_FILE
from trirail.wire.vocabulary import Command

Content = Annotated[str, Meta(max_length=MAX_FILE)]
"""Content of a file."""


class _Said(Struct, frozen=True, forbid_unknown_fields=True, tag_field="do"):
    """Any message of the page."""

    wants: ClassVar[str | None] = None
    """Required permission; None for none."""

    @property
    def needs(self) -> str | None:
        """Return the required permission."""
        return self.wants


class Seen(_Said, frozen=True, tag="seen"):
    """Notice that the page has drawn a state."""

    stamp: int
    """Stamp of that state."""


class Hold(_Said, frozen=True, tag="hold"):
    """Notice that a jog button is held down now."""

    wants = GOAL

    velocity: Coordinates
    """Velocity of x, y [m/s] and phi [rad/s], in the base frame."""
    seen: int
    """Stamp of the newest state that the page has drawn: a user of an outdated picture must not move the robot."""
    tool: FrameName | None = None
    """Tool of [frames.tool] about which it turns; the centre if None."""


class Release(_Said, frozen=True, tag="release"):
    """Notice that no jog button is held down any more."""


class Tell(_Said, frozen=True, tag="command"):
    """Command whose button has been pressed or whose slider has been moved."""

    name: Command
    """The command."""
    content: Raw = Raw()
    """Content of the command, forwarded as it is."""

    @property
    def needs(self) -> str:
        """Return the permission of the command itself."""
        return self.name


class TakeOver(_Said, frozen=True, tag="takeover"):
    """Request to take the lease over from its holder."""

    wants = TAKEOVER


class SendGoal(_Said, frozen=True, tag="goal"):
    """Goal to forward: the button of a named pose, of a typed one, or of a step has been pressed."""

    wants = GOAL

    goal: PoseGoal | NamedGoal | MoveGoal
    """Goal, forwarded as it is."""
    seen: int | None = None
    """Stamp of the newest state that the page has drawn, if the goal is relative to it."""


class CheckPose(_Said, frozen=True, tag="check"):
    """Request to check whether a pose is reachable, without motion."""

    goal: PoseGoal
    """Goal that would be sent."""
    number: int
    """Number that the answer repeats."""


class CheckPath(_Said, frozen=True, tag="check path"):
    """Request to check whether the path in a file can be followed, without motion."""

    name: str
    """Name of the file: .json contains JSON, any other CSV."""
    text: Content
    """Content of the file."""
    number: int
    """Number that the answer repeats."""
    stretch: bool = False
    """Whether to slow a path that is too fast."""


class Follow(_Said, frozen=True, tag="follow"):
    """Request to follow the path in a file from its first point."""

    wants = GOAL

    name: str
    """Name of the file, as in CheckPath."""
    text: Content
    """Content of the file."""
    stretch: bool = False
    """Whether to slow a path that is too fast."""


class Teach(_Said, frozen=True, tag="teach"):
    """Request to save the robot's current position as a pose."""

    wants = POSES

    name: str
    """Name of the pose."""


class Forget(_Said, frozen=True, tag="forget"):
    """Request to remove a taught pose."""

    wants = POSES

    name: str
    """Name of the pose."""


Asked = Tell | TakeOver | SendGoal | Follow | Teach | Forget
"""Requests to the service, except held jogs."""
FromPage = Seen | Hold | Release | CheckPose | CheckPath | Asked
