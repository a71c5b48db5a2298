"""What several commands take: which service or which robot, and how to print."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from trirail.wire.zenoh_session import DEFAULT_LOCATOR

if TYPE_CHECKING:
    from cyclopts.completion._engine import CompletionContext

Flag = Parameter(negative="")
"""An option without a value, that has no opposite."""


def robots(context: CompletionContext) -> list[str]:
    """Return the names of the robots that answer where the command line says, for the shell to complete."""
    from trirail.client.connection import robots_at

    return robots_at(context["connect"].value)


@Parameter(name="*")
@dataclass(frozen=True)
class Service:
    """Which service to talk to."""

    robot: Annotated[str, Parameter(env_var="TRIRAIL_ROBOT", completer=robots)] = "demo"
    "Name of the robot, as in its configuration."
    connect: Annotated[str, Parameter(env_var="TRIRAIL_CONNECT")] = DEFAULT_LOCATOR
    "Zenoh locator of the service or of a router."
    tls: Annotated[Path | None, Parameter(env_var="TRIRAIL_TLS")] = None
    "Folder with ca.pem, cert.pem and key.pem, for a locator tls/HOST:PORT; ~/.config/trirail/<robot> if absent."
    json: Annotated[bool, Flag] = False
    "Print one JSON object instead of words."


HERE = Service()


@Parameter(name="*")
@dataclass(frozen=True)
class Offline:
    """Which robot, and how to print."""

    config: Path | None = None
    "Configuration file; the simulated robot if absent."
    json: Annotated[bool, Flag] = False
    "Print one JSON object, in metres and radians, instead of words."


DEFAULT = Offline()
