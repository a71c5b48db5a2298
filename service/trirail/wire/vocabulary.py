"""The words that processes and clients share: what the robot can be doing, and what it can be told."""

from __future__ import annotations

from enum import StrEnum
from typing import Literal, Self


class Mode(StrEnum):
    """What the robot is doing."""

    DISABLED = "disabled"
    ENABLING = "enabling"
    HOMING = "homing"
    HOLDING = "holding"
    MOVING = "moving"
    STOPPING = "stopping"
    FAULT = "fault"


MODES = tuple(Mode)
"""In the order in which records number them."""


class FaultCause(StrEnum):
    """Why the robot is in fault where no drive has told it: drives have causes of their own, see DriveFault."""

    FOLLOWING_ERROR = "following_error"
    """A slider is farther from its setpoint than [limits.slider] following_error."""
    LIMIT = "limit"
    """The last gate has refused a setpoint."""
    ENABLE = "enable"
    """The drives took too long to power up."""
    PLACE = "place"
    """Where the sliders are belongs to no pose, or is none that may be held."""
    QUICK_STOP = "quick_stop"
    """Somebody sent quick_stop."""
    LOOP = "loop"
    """The loop has died or was frozen."""
    INTERNAL = "internal"
    """An error of the program's own."""


class Command(StrEnum):
    """What the robot can be told beside goals: the name on the wire, one line of help, and what follows from it.

    Each has, held by tests: an event of trirail.control.modes under the same name (but for override, acquire
    and release, which change no mode), a rule in trirail.control.completion, content in trirail.wire.messages.CONTENT,
    a method of trirail.client.client.Robot, and a command of the command line.
    """

    help: str
    """What it does, in one line for people."""
    stops: bool
    """Whether it brings motion to rest: it overtakes whatever waits, and goals sent before it do not begin."""
    content: str
    """What it takes, in words; its type is in trirail.wire.messages.CONTENT."""
    everybodys: bool
    """Whether it is everybody's while somebody holds the lease; else the holder's alone."""

    ENABLE = "enable", "Power the drives up and hold."
    DISABLE = "disable", "Stop and take power off the drives.", True, "no content", True
    STOP = "stop", "Stop the robot within its limits.", True, 'nothing, or {"goal": id}', True
    QUICK_STOP = (
        "quick_stop",
        "Stop every drive as fast as it can; the robot is in fault until a reset.",
        True,
        "no content",
        True,
    )
    RESET = "reset", "Clear a fault whose cause is gone; the robot stays without power."
    HOME = (
        "home",
        "Find where the sliders are, where the encoders are not absolute: one drive after the other, slowly.",
    )
    PAUSE = "pause", "Stop on the path and keep the goal.", True
    RESUME = "resume", "Go on with a paused goal."
    OVERRIDE = (
        "override",
        "Let motions run at a share of full speed, 0 or 1 to 200 %, never beyond the limits.",
        False,
        '{"percent": 0, or 1 to 200}',
    )
    ACQUIRE = (
        "acquire",
        "Take the lease, or keep it: only its holder moves the robot; everybody may stop and disable it.",
        False,
        'nothing, or {"id": id, "timeout": seconds, "force": true}',
        True,
    )
    RELEASE = (
        "release",
        "Give the lease back; what its holder has under way stops.",
        False,
        'nothing, or {"id": id}',
        True,
    )

    def __new__(
        cls,
        name: str,
        help: str = "",  # noqa: A002 - the field's name
        stops: bool = False,
        content: str = "no content",
        everybodys: bool = False,
    ) -> Self:
        """Make a member of its row; with a name alone, as for Command("stop"), the enumeration looks it up."""
        member = str.__new__(cls, name)
        member._value_ = name
        member.help, member.stops, member.content, member.everybodys = help, stops, content, everybodys
        return member


LeasePolicy = Literal["optional", "required"]
"""Whether the robot can be moved while nobody holds the lease."""


class Role(StrEnum):
    """What a user is to a robot; each may what those before it may."""

    VIEWER = "viewer"
    OPERATOR = "operator"
    MAINTAINER = "maintainer"

    def includes(self, other: Role) -> bool:
        """Whether it may all that another role may."""
        roles = tuple(Role)
        return roles.index(self) >= roles.index(other)
