"""The words that processes and clients share: what the robot can be doing, and what it can be told."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Self

from msgspec import Meta, Struct

from trirail.wire.goal_kind import Identifier, check_fields
from trirail.wire.marks import OutputName


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


class CommandContent(Struct, frozen=True, forbid_unknown_fields=True):
    """What a command carries."""

    words: ClassVar[str] = "no content"
    """What it takes, for people."""
    optional: ClassVar[bool] = True
    """Whether it may come without, as if with nothing but what is absent of it."""


LOWEST_OVERRIDE = 1.0
"""Least share of full speed at which motions run, but for 0, at which they stand [%]."""


class Override(CommandContent, frozen=True):
    """The content of the command override: the share of full speed at which motions run."""

    words = '{"percent": 0, or 1 to 200}'
    optional = False

    percent: Annotated[float, Meta(ge=0.0, le=200.0)]
    """0, at which motions stand, or 1 to 200 % of full speed, within the limits."""

    def __post_init__(self) -> None:
        check_fields(self)
        if 0.0 < self.percent < LOWEST_OVERRIDE:
            raise ValueError(f"percent is {self.percent}: 0, or {LOWEST_OVERRIDE:g} to 200 are taken")


class Stop(CommandContent, frozen=True):
    """The content, if any, of the command stop: which goal is to be stopped, wherever it is, and no other."""

    words = 'nothing, or {"goal": id}'

    goal: Identifier | None = None
    """Its id; none for the robot as a whole."""


SHORTEST_LEASE, LONGEST_LEASE = 0.1, 10.0
"""Time-outs of a lease [s]."""
LeaseTimeout = Annotated[float, Meta(ge=SHORTEST_LEASE, le=LONGEST_LEASE)]


class AcquireLease(CommandContent, frozen=True):
    """The content, if any, of the command acquire. The same one again, within its timeout, is a sign of life."""

    words = 'nothing, or {"id": id, "timeout": seconds, "force": true}'

    id: Identifier | None = None
    """A new one for every lease, the same in every sign of life: a lease that has ended does not come back by one.
    Without it, each one asks anew."""
    timeout: LeaseTimeout = 1.0
    """Real time after which a lease without a sign of life ends, with a controlled stop [s]."""
    force: bool = False
    """Take it over from who holds it, by a role of [control] `takeover`."""

    def __post_init__(self) -> None:
        check_fields(self)


class ReleaseLease(CommandContent, frozen=True):
    """The content, if any, of the command release: which lease is given back."""

    words = 'nothing, or {"id": id}'

    id: Identifier | None = None
    """As in its acquire; without it the user's own, whichever that is."""


class SetOutput(CommandContent, frozen=True):
    """The content of the command set_output: an output, and its new value."""

    words = '{"output": name, "value": true or false}'
    optional = False

    output: OutputName
    """Name of an output of the configuration."""
    value: bool


class NoContent(CommandContent, frozen=True):
    """The content of the other commands."""


class _CommandRow(NamedTuple):
    """A command's row in the table below."""

    name: str
    help: str
    role: Role
    content: type[CommandContent] = NoContent
    stops: bool = False
    everybodys: bool = False


class Command(StrEnum):
    """What the robot can be told beside goals: the name on the wire, one line of help, and what follows from it.

    What it does is its row in trirail.control.commands.EFFECTS. Gateway, access rules, schemas, clients and command
    line follow from this table.
    """

    help: str
    """What it does, in one line for people."""
    role: Role
    """The least that may send it."""
    content: type[CommandContent]
    """What it carries."""
    stops: bool
    """Whether it brings motion to rest: it overtakes whatever waits, and goals sent before it do not begin."""
    everybodys: bool
    """Whether it is everybody's while somebody holds the lease; else the holder's alone."""

    ENABLE = _CommandRow("enable", "Power the drives up and hold.", Role.OPERATOR)
    DISABLE = _CommandRow("disable", "Stop and take power off the drives.", Role.OPERATOR, stops=True, everybodys=True)
    STOP = _CommandRow("stop", "Stop the robot within its limits.", Role.VIEWER, Stop, stops=True, everybodys=True)
    QUICK_STOP = _CommandRow(
        "quick_stop",
        "Stop every drive as fast as it can: in fault until a reset.",
        Role.OPERATOR,
        stops=True,
        everybodys=True,
    )
    RESET = _CommandRow("reset", "Clear a fault whose cause is gone; power stays off.", Role.MAINTAINER)
    HOME = _CommandRow(
        "home",
        "Find where sliders without absolute encoders are, slowly.",
        Role.MAINTAINER,
    )
    PAUSE = _CommandRow("pause", "Stop on the path and keep the goal.", Role.OPERATOR, stops=True)
    RESUME = _CommandRow("resume", "Go on with a paused goal.", Role.OPERATOR)
    OVERRIDE = _CommandRow(
        "override",
        "Let motions run at a share of full speed, 0 or 1 to 200 %.",
        Role.OPERATOR,
        Override,
    )
    SET_OUTPUT = _CommandRow("set_output", "Set a digital output of a drive.", Role.OPERATOR, SetOutput)
    ACQUIRE = _CommandRow(
        "acquire",
        "Take the lease, or keep it: only its holder moves the robot; everybody may stop and disable it.",
        Role.OPERATOR,
        AcquireLease,
        everybodys=True,
    )
    RELEASE = _CommandRow(
        "release",
        "Give the lease back; what its holder has under way stops.",
        Role.OPERATOR,
        ReleaseLease,
        everybodys=True,
    )

    def __new__(
        cls,
        name: str,
        help: str = "",  # noqa: A002 - the field's name
        role: Role = Role.MAINTAINER,
        content: type[CommandContent] = NoContent,
        stops: bool = False,
        everybodys: bool = False,
    ) -> Self:
        """Make a member of its row; with a name alone, as for Command("stop"), the enumeration looks it up."""
        member = str.__new__(cls, name)
        member._value_ = name
        member.help, member.role, member.content = help, role, content
        member.stops, member.everybodys = stops, everybodys
        return member

    @property
    def accepts(self) -> Any:
        """The type of what it may come with, as it is decoded."""
        return self.content | None if self.content.optional else self.content
