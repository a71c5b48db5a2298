"""Messages from the page to its server: goals and commands in the service's format, and the page's own messages.

The server sends State, Event and other messages, each with its kind in `tell`.
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


class _PageMessage(Struct, frozen=True, forbid_unknown_fields=True, tag_field="do"):
    """Base class of the page's messages."""

    permission: ClassVar[str | None] = None
    """Permission that the message requires, or None."""

    @property
    def required_permission(self) -> str | None:
        """Return the permission that the message requires."""
        return self.permission


class StateDrawn(_PageMessage, frozen=True, tag="seen"):
    """Notice that the page has drawn a state."""

    stamp: int
    """Stamp of the drawn state."""


class JogHeld(_PageMessage, frozen=True, tag="hold"):
    """Notice that a jog button is held down. It is repeated as long as the button is held."""

    permission = GOAL

    velocity: Coordinates
    """Velocity of x, y [m/s] and phi [rad/s], in the base frame."""
    seen: int
    """Stamp of the newest state that the page has drawn, since nobody may jog while looking at an outdated picture."""
    tool: FrameName | None = None
    """Tool of [frames.tool] about which the platform turns; the platform's centre if None."""


class JogReleased(_PageMessage, frozen=True, tag="release"):
    """Notice that all jog buttons have been released."""


class SendCommand(_PageMessage, frozen=True, tag="command"):
    """The operator pressed the button or moved the slider of a command."""

    name: Command
    """The command."""
    content: Raw = Raw()
    """Content of the command, forwarded unchanged."""

    @property
    def required_permission(self) -> str:
        """Return the permission that the command itself requires."""
        return self.name


class TakeOver(_PageMessage, frozen=True, tag="takeover"):
    """Request to take over the lease from its holder."""

    permission = TAKEOVER


class SendGoal(_PageMessage, frozen=True, tag="goal"):
    """The operator pressed the button for a named pose, a typed-in pose or a step."""

    permission = GOAL

    goal: PoseGoal | NamedGoal | MoveGoal
    """Goal, forwarded unchanged."""
    seen: int | None = None
    """Stamp of the newest state that the page has drawn, if the goal is relative to it."""


class CheckPose(_PageMessage, frozen=True, tag="check"):
    """Request to check whether a pose can be reached, without moving."""

    goal: PoseGoal
    """Goal that would be sent."""
    number: int
    """Number that is repeated in the answer."""


class CheckPath(_PageMessage, frozen=True, tag="check path"):
    """Request to check whether the path in a file can be followed, without moving."""

    name: str
    """Name of the file; .json means JSON, any other suffix CSV."""
    text: Content
    """Content of the file."""
    number: int
    """Number that is repeated in the answer."""
    stretch: bool = False
    """Whether to slow down a path that is too fast."""


class Follow(_PageMessage, frozen=True, tag="follow"):
    """Request to follow the path in a file from its first point."""

    permission = GOAL

    name: str
    """Name of the file, as in CheckPath."""
    text: Content
    """Content of the file."""
    stretch: bool = False
    """Whether to slow down a path that is too fast."""


class Teach(_PageMessage, frozen=True, tag="teach"):
    """Request to save the robot's current position as a pose."""

    permission = POSES

    name: str
    """Name of the pose."""


class Forget(_PageMessage, frozen=True, tag="forget"):
    """Request to remove a taught pose."""

    permission = POSES

    name: str
    """Name of the pose."""


ServiceRequest = SendCommand | TakeOver | SendGoal | Follow | Teach | Forget
"""Requests to the service, except those of held jog buttons."""
AnyPageMessage = StateDrawn | JogHeld | JogReleased | CheckPose | CheckPath | ServiceRequest
