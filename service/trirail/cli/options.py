"""Options that several commands share: the service or robot, and the output format."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from trirail.cli import notation
from trirail.wire.decoding import converted
from trirail.wire.endpoints import DEFAULT_LOCATOR
from trirail.wire.goal_kind import GoalKind, field_description
from trirail.wire.goals import PoseGoal

if TYPE_CHECKING:
    from cyclopts.completion._engine import CompletionContext

    from trirail.client.client import Robot

Flag = Parameter(negative="", show_default=False)
"""Option that has neither a value nor a negative form."""
Json = Annotated[bool, Flag, Parameter(help="Print one JSON object instead of words.")]
ConfigFile = Annotated[Path | None, Parameter(help="Configuration file; the simulated robot if absent.")]
Wait = Annotated[bool, Flag, Parameter(help="Show the progress; exit 0 only when the robot has arrived.")]


def described(kind: type[GoalKind], field: str, as_typed: str = "") -> Parameter:
    """Return the help of an option, which is the description of its field in a kind of goal and the notation."""
    words = field_description(kind, field)
    return Parameter(help=f"{words[0].upper()}{words[1:]}{as_typed}.")


Speed = Annotated[notation.Share, described(PoseGoal, "speed", "; or as 5%")]


def robots(context: CompletionContext) -> list[str]:
    """Return the names of the robots that answer at the address on the command line, for completion by the shell."""
    from trirail.client.connection import robots_at

    return robots_at(context["connect"].value)


def poses(context: CompletionContext) -> list[str]:
    """Return the names of the poses of the robot that the command line selects."""
    with _robot(context) as robot:
        return list(robot.poses())


def taught_poses(context: CompletionContext) -> list[str]:
    """Return the names of the taught poses of that robot."""
    with _robot(context) as robot:
        return [name for name, pose in robot.poses().items() if pose.taught]


def tool_names(context: CompletionContext) -> list[str]:
    """Return the names of the tools of that robot."""
    return _frames(context, "tool")


def frame_names(context: CompletionContext) -> list[str]:
    """Return the names of the frames in which a pose may be given."""
    return ["base", *_frames(context, "work")]


def axes_names(context: CompletionContext) -> list[str]:
    """Return the names of the frames whose axes a move can follow."""
    return ["base", "platform", *_frames(context, "work")]


def _frames(context: CompletionContext, kind: Literal["tool", "work"]) -> list[str]:
    from trirail.config import FramesTable

    with _robot(context) as robot:
        return list(getattr(converted(robot.info().frames, FramesTable), kind))


def _robot(context: CompletionContext) -> Robot:
    return Service(context["connect"].value, context["tls"].value, robot=context["robot"].value).open()


@Parameter(name="*")
@dataclass(frozen=True)
class Address:
    """Address of the services, and output format."""

    connect: Annotated[str, Parameter(env_var="TRIRAIL_CONNECT")] = DEFAULT_LOCATOR
    "Zenoh locator of the service or of a router."
    tls: Path | None = None
    """Folder with ca.pem, cert.pem and key.pem, for a locator tls/HOST:PORT. If absent, that of TRIRAIL_TLS, or
    ~/.config/trirail/ROBOT."""
    json: Json = False


@Parameter(name="*")
@dataclass(frozen=True)
class Service(Address):
    """Service to connect to."""

    robot: Annotated[str, Parameter(env_var="TRIRAIL_ROBOT", completer=robots)] = "demo"
    "Name of the robot, as in its configuration."

    def open(self) -> Robot:
        """Return a session with the service. Raises ServiceError if it does not answer."""
        from trirail.client.client import Robot

        return Robot(self.robot, self.connect, tls=self.tls)


@Parameter(name="*")
@dataclass(frozen=True)
class Services(Address):
    """Services to connect to, all at one address."""

    robot: Annotated[tuple[str, ...], Parameter(env_var="TRIRAIL_ROBOT", completer=robots, negative="")] = ("demo",)
    "Name of the robot, as in its configuration; may be repeated for several robots."


HERE, ALL_HERE = Service(), Services()


@Parameter(name="*")
@dataclass(frozen=True)
class Offline:
    """Robot for commands without a service, and output format."""

    config: ConfigFile = None
    json: Annotated[bool, Flag] = False
    "Print one JSON object, in metres and radians, instead of text."


DEFAULT = Offline()
