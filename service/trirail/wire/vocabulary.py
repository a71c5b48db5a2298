"""Names of modes, causes of faults, roles and commands, which the service's processes and the clients share."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Self

from msgspec import Meta, Struct

from trirail.wire.goal_kind import Identifier, check_fields
from trirail.wire.marks import OutputName


class Mode(StrEnum):
    """Operating mode of the robot."""

    DISABLED = "disabled"
    ENABLING = "enabling"
    HOMING = "homing"
    HOLDING = "holding"
    MOVING = "moving"
    STOPPING = "stopping"
    FAULT = "fault"


MODES = tuple(Mode)
"""Modes; a record contains the index of a mode in this tuple."""


class FaultCause(StrEnum):
    """Cause of a fault that the service detects. DriveFault contains the causes that drives report."""

    FOLLOWING_ERROR = "following_error"
    """The following error of a slider exceeds [limits.slider] following_error."""
    LIMIT = "limit"
    """The last gate, which checks every setpoint before it is written to the drives, refused a setpoint."""
    ENABLE = "enable"
    """The drives were not enabled in time."""
    PLACE = "place"
    """The slider positions do not correspond to any pose, or correspond to a pose at which the robot must not be."""
    QUICK_STOP = "quick_stop"
    """A user sent quick_stop, or the controlled stop at the end of the service took too long."""
    LOOP = "loop"
    """The loop has died or hung."""
    INTERNAL = "internal"
    """An internal error of the program."""


LeasePolicy = Literal["optional", "required"]
"""Rule for a free lease: if "required", no user can move the robot; if "optional", every user can move the robot."""


class Role(StrEnum):
    """Role of a user. Each role has all permissions of the roles before it."""

    VIEWER = "viewer"
    OPERATOR = "operator"
    MAINTAINER = "maintainer"

    def includes(self, other: Role) -> bool:
        """Return True if this role has all permissions of another role."""
        roles = tuple(Role)
        return roles.index(self) >= roles.index(other)


class CommandContent(Struct, frozen=True, forbid_unknown_fields=True):
    """Content of a command."""

    words: ClassVar[str] = "no content"
    """Description of the expected content, for people."""
    optional: ClassVar[bool] = True
    """Whether the command may be sent without content, so that all fields have their default values."""


LOWEST_OVERRIDE = 1.0
"""Lowest override other than 0 [%]. At override 0, the robot does not move."""


class Override(CommandContent, frozen=True):
    """Content of the command override."""

    words = '{"percent": 0, or 1 to 200}'
    optional = False

    percent: Annotated[float, Meta(ge=0.0, le=200.0)]
    """Speed override, 0 or 1 to 200 [%]. At 0, the robot does not move. All limits apply at every override."""

    def __post_init__(self) -> None:
        check_fields(self)
        if 0.0 < self.percent < LOWEST_OVERRIDE:
            raise ValueError(
                f"percent: {self.percent} is below the lowest override; send 0, or {LOWEST_OVERRIDE:g} to 200"
            )


class Stop(CommandContent, frozen=True):
    """Optional content of the command stop, which restricts the command to one goal, running or queued."""

    words = 'nothing, or {"goal": id}'

    goal: Identifier | None = None
    """Id of the goal to stop. Without an id, the robot and all goals stop."""


SHORTEST_LEASE, LONGEST_LEASE = 0.1, 10.0
"""Minimum and maximum of a lease's time-out [s]."""
LeaseTimeout = Annotated[float, Meta(ge=SHORTEST_LEASE, le=LONGEST_LEASE)]


class AcquireLease(CommandContent, frozen=True):
    """Optional content of the command acquire. To renew the lease, send the command again within `timeout`."""

    words = 'nothing, or {"id": id, "timeout": seconds, "force": true}'

    id: Identifier | None = None
    """Id of the lease. Use a new id for every lease, and the same id in all renewals of a lease, so that a late renewal
    cannot revive a lease that has ended. Without an id, each message is a new request."""
    timeout: LeaseTimeout = 1.0
    """Time without a renewal after which the lease ends and the robot makes a controlled stop [s]."""
    force: bool = False
    """Whether to take the lease over from its holder. A takeover requires the role of the key `takeover` in [control].
    """

    def __post_init__(self) -> None:
        check_fields(self)


class ReleaseLease(CommandContent, frozen=True):
    """Optional content of the command release."""

    words = 'nothing, or {"id": id}'

    id: Identifier | None = None
    """Id of the lease, as in the command acquire. The default is the user's present lease."""


class SetOutput(CommandContent, frozen=True):
    """Content of the command set_output: an output and its new value."""

    words = '{"output": name, "value": true or false}'
    optional = False

    output: OutputName
    """Name of an output of the configuration."""
    value: bool
    """New value of the output."""


class NoContent(CommandContent, frozen=True):
    """Empty content, for commands without content."""


class _CommandRow(NamedTuple):
    """Row in the table of commands below."""

    name: str
    help: str
    role: Role
    content: type[CommandContent] = NoContent
    stops: bool = False
    ignores_lease: bool = False
    starts: bool = False


class Command(StrEnum):
    """Table of all commands, with their names on the wire, help texts and properties.

    The gateway, the access rules, the schemas, the clients and the command line are derived from this table. The
    effects of the commands are in trirail.control.commands.EFFECTS.
    """

    help: str
    """Effect of the command in one line, for people."""
    role: Role
    """Lowest role that may send the command."""
    content: type[CommandContent]
    """Type of the command's content."""
    stops: bool
    """Whether the command stops the robot. Such a command overtakes all waiting messages, and goals that were sent
    before the command do not start."""
    ignores_lease: bool
    """Whether every user may send the command while another user holds the lease."""
    starts: bool
    """Whether the command starts motion or is a step towards it. It is refused if a later stop has overtaken it."""

    ENABLE = _CommandRow("enable", "Enable the drives and hold the position.", Role.OPERATOR, starts=True)
    DISABLE = _CommandRow("disable", "Stop, then disable the drives.", Role.OPERATOR, stops=True, ignores_lease=True)
    STOP = _CommandRow("stop", "Stop the robot within its limits.", Role.VIEWER, Stop, stops=True, ignores_lease=True)
    QUICK_STOP = _CommandRow(
        "quick_stop",
        "Stop every drive by its own ramp; the robot is then in fault.",
        Role.OPERATOR,
        stops=True,
        ignores_lease=True,
    )
    RESET = _CommandRow(
        "reset", "Clear a fault whose cause is removed; the drives stay disabled.", Role.MAINTAINER, starts=True
    )
    HOME = _CommandRow(
        "home",
        "Home the sliders without absolute encoders.",
        Role.MAINTAINER,
        starts=True,
    )
    PAUSE = _CommandRow("pause", "Stop on the path and keep the goal.", Role.OPERATOR, stops=True)
    RESUME = _CommandRow("resume", "Continue a paused goal.", Role.OPERATOR, starts=True)
    OVERRIDE = _CommandRow(
        "override",
        "Set the speed override (0, or 1 to 200 %).",
        Role.OPERATOR,
        Override,
    )
    SET_OUTPUT = _CommandRow("set_output", "Set a digital output of a drive.", Role.OPERATOR, SetOutput)
    ACQUIRE = _CommandRow(
        "acquire",
        "Acquire or renew the lease: only its holder can move the robot; every user can stop and disable it.",
        Role.OPERATOR,
        AcquireLease,
        ignores_lease=True,
    )
    RELEASE = _CommandRow(
        "release",
        "Release the lease; the holder's motion stops.",
        Role.OPERATOR,
        ReleaseLease,
        ignores_lease=True,
    )

    def __new__(
        cls,
        name: str,
        help: str = "",  # noqa: A002 - the field's name
        role: Role = Role.MAINTAINER,
        content: type[CommandContent] = NoContent,
        stops: bool = False,
        ignores_lease: bool = False,
        starts: bool = False,
    ) -> Self:
        """Create a member from its row. A call with only a name, such as Command("stop"), looks the member up."""
        member = str.__new__(cls, name)
        member._value_ = name
        member.help, member.role, member.content = help, role, content
        member.stops, member.ignores_lease, member.starts = stops, ignores_lease, starts
        return member

    @property
    def accepts(self) -> Any:
        """Type with which the content of the command is decoded."""
        return self.content | None if self.content.optional else self.content
