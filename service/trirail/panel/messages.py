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


class _PageMessage(Struct, frozen=True, forbid_unknown_fields=True, tag_field="do"):
    """Base of the page's messages."""

    permission: ClassVar[str | None] = None
    """Required permission; None for none."""

    @property
    def required_permission(self) -> str | None:
        """Return the required permission."""
        return self.permission


class StateDrawn(_PageMessage, frozen=True, tag="seen"):
    """Notice that the page has drawn a state."""

    stamp: int
    """Stamp of that state."""


class JogHeld(_PageMessage, frozen=True, tag="hold"):
    """Notice that a jog button is held down; repeated while it is."""

    permission = GOAL

    velocity: Coordinates
    """Velocity of x, y [m/s] and phi [rad/s], in the base frame."""
    seen: int
    """Stamp of the newest state that the page has drawn: nobody may jog by an outdated picture."""
    tool: FrameName | None = None
    """Tool of [frames.tool] about which it turns; the centre if None."""


class JogReleased(_PageMessage, frozen=True, tag="release"):
    """Notice that all jog buttons have been released."""


class SendCommand(_PageMessage, frozen=True, tag="command"):
    """Request to send a command: its button was pressed or its slider moved."""

    name: Command
    """The command."""
    content: Raw = Raw()
    """Content of the command, forwarded as it is."""

    @property
    def required_permission(self) -> str:
        """Return the permission of the command itself."""
        return self.name


class TakeOver(_PageMessage, frozen=True, tag="takeover"):
    """Request to take the lease over from its holder."""

    permission = TAKEOVER


class SendGoal(_PageMessage, frozen=True, tag="goal"):
    """Request to send a goal: the button of a named pose, of a typed one, or of a step was pressed."""

    permission = GOAL

    goal: PoseGoal | NamedGoal | MoveGoal
    """Goal, forwarded as it is."""
    seen: int | None = None
    """Stamp of the newest state that the page has drawn, if the goal is relative to it."""


class CheckPose(_PageMessage, frozen=True, tag="check"):
    """Request to check whether a pose is reachable, without motion."""

    goal: PoseGoal
    """Goal that would be sent."""
    number: int
    """Number that the answer repeats."""


class CheckPath(_PageMessage, frozen=True, tag="check path"):
    """Request to check whether the path in a file can be followed, without motion."""

    name: str
    """Name of the file: .json contains JSON, any other CSV."""
    text: Content
    """Content of the file."""
    number: int
    """Number that the answer repeats."""
    stretch: bool = False
    """Whether to slow a path that is too fast."""


class Follow(_PageMessage, frozen=True, tag="follow"):
    """Request to follow the path in a file from its first point."""

    permission = GOAL

    name: str
    """Name of the file, as in CheckPath."""
    text: Content
    """Content of the file."""
    stretch: bool = False
    """Whether to slow a path that is too fast."""


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
"""Requests to the service, except held jogs."""
AnyPageMessage = StateDrawn | JogHeld | JogReleased | CheckPose | CheckPath | ServiceRequest
