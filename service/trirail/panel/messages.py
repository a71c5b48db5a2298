"""Messages from the web page to its server. Goals and commands in them have the service's format.

In the other direction, the server sends State, Event and other messages, with the kind of each message in `tell`.
"""

from __future__ import annotations

import contextlib
from typing import Annotated, ClassVar

from msgspec import Meta, Raw, Struct

from trirail.panel.permissions import GOAL, POSES, TAKEOVER
from trirail.wire.decoding import INVALID, decoded, decoder, prepare
from trirail.wire.goal_kind import FrameName
from trirail.wire.goals import Coordinates, MoveGoal, NamedGoal, PoseGoal
from trirail.wire.sizes import MAX_FILE
from trirail.wire.stop_protocol import STOPS
from trirail.wire.vocabulary import Command, Override


class _PageMessage(Struct, frozen=True, forbid_unknown_fields=True, tag_field="do"):
    """Base class of the page's messages."""

    permission: ClassVar[str | None] = None
    """Permission that all messages of the class require; None if they require no permission."""

    @property
    def required_permission(self) -> str | None:
        """Permission that this message requires; None if it requires no permission."""
        return self.permission


class StateDrawn(_PageMessage, frozen=True, tag="seen"):
    """Message that the page has drawn a state."""

    stamp: int
    """Stamp of the drawn state."""


class JogHeld(_PageMessage, frozen=True, tag="hold"):
    """Message that a jog button is pressed. The page repeats the message until the button is released."""

    permission = GOAL

    velocity: Coordinates
    """Velocity of x, y [m/s] and phi [rad/s], in the base frame."""
    seen: int
    """Stamp of the newest state that the page has drawn. The server refuses the jog if this state is outdated."""
    tool: FrameName | None = None
    """Name of the tool in [frames.tool] about which the platform turns; None for the platform's centre."""


class JogReleased(_PageMessage, frozen=True, tag="release"):
    """Message that all jog buttons have been released."""


class SendCommand(_PageMessage, frozen=True, tag="command"):
    """Request to send a command, because the operator pressed the button or moved the slider of the command."""

    name: Command
    """Name of the command."""
    content: Raw = Raw()
    """Content of the command, which the server forwards unchanged."""
    seen: int = 0
    """Stamp of the newest state that the page has drawn. The server refuses the command if this state is outdated, and
    the command does more than reduce motion."""

    @property
    def only_reduces_motion(self) -> bool:
        """Whether the command only stops the robot or gives the lease back, as the override 0 does."""
        if self.name is Command.OVERRIDE:
            with contextlib.suppress(*INVALID):  # the service refuses invalid content
                override: Override = decoded(bytes(self.content), Override)
                return override.percent == 0.0
        return self.name.stops or self.name is Command.RELEASE

    @property
    def required_permission(self) -> str:
        """Permission to send the command."""
        return self.name


class TakeOver(_PageMessage, frozen=True, tag="takeover"):
    """Request to take over the lease from its holder."""

    permission = TAKEOVER

    seen: int
    """Stamp of the newest state that the page has drawn. The server refuses the request if this state is outdated."""


class SendGoal(_PageMessage, frozen=True, tag="goal"):
    """Request to send a goal, because the operator pressed the button for a named pose, a typed-in pose or a step."""

    permission = GOAL

    goal: PoseGoal | NamedGoal | MoveGoal
    """Goal, which the server forwards unchanged."""
    seen: int
    """Stamp of the newest state that the page has drawn. The server refuses the goal if this state is outdated."""


class CheckPose(_PageMessage, frozen=True, tag="check"):
    """Request to check, without moving, if a pose can be reached."""

    goal: PoseGoal
    """Goal that the page would send to move to the pose."""
    number: int
    """Number by which the page matches the answer to the request."""


class BeginUpload(_PageMessage, frozen=True, tag="upload"):
    """Announcement of a trajectory file, which replaces the tab's previous file.

    The page then sends the content as binary messages. The server acknowledges this message and each part, and the
    page sends the next part only after the acknowledgement. A stop therefore waits for at most one part.
    """

    file: int
    """Number by which the page refers to the file."""
    name: str
    """Name of the file. The suffix .json means JSON; every other suffix means CSV."""
    size: Annotated[int, Meta(ge=0, le=MAX_FILE)]
    """Size of the file [bytes]."""


class CheckPath(_PageMessage, frozen=True, tag="check path"):
    """Request to check, without moving, if the path in a file can be followed."""

    file: int
    """Number of the uploaded file."""
    number: int
    """Number by which the page matches the answer to the request."""
    stretch: bool = False
    """Whether to slow down a path that is too fast."""


class Follow(_PageMessage, frozen=True, tag="follow"):
    """Request to follow the path in a file from its first point."""

    permission = GOAL

    file: int
    """Number of the uploaded file."""
    seen: int
    """Stamp of the newest state that the page has drawn. The server refuses the path if this state is outdated."""
    stretch: bool = False
    """Whether to slow down a path that is too fast."""


class Teach(_PageMessage, frozen=True, tag="teach"):
    """Request to save the robot's measured pose under a name."""

    permission = POSES

    name: str
    """Name of the pose."""
    seen: int
    """Stamp of the newest state that the page has drawn. The server refuses the request if this state is outdated."""


class Forget(_PageMessage, frozen=True, tag="forget"):
    """Request to remove a taught pose."""

    permission = POSES

    name: str
    """Name of the pose."""
    seen: int
    """Stamp of the newest state that the page has drawn. The server refuses the request if this state is outdated."""


ServiceRequest = SendCommand | TakeOver | SendGoal | Follow | Teach | Forget
"""Requests that the server passes on to the service, except jogs."""
AnyPageMessage = StateDrawn | JogHeld | JogReleased | CheckPose | BeginUpload | CheckPath | ServiceRequest


class _NameOnly(Struct, frozen=True, tag_field="do", tag="command"):
    """Message with a command of which only the name is read."""

    name: Command


prepare(AnyPageMessage, _NameOnly)


def stop_in(text: str) -> SendCommand | None:
    """Return the stop in an invalid message, without its content. Return None if the message is not a stop."""
    with contextlib.suppress(*INVALID):
        name = decoder(_NameOnly).decode(text.encode()).name
        return SendCommand(name) if name in STOPS else None
    return None
