"""Names and credentials with which a client connects, from arguments or else from environment variables."""

from __future__ import annotations

import getpass
import os
import re
from pathlib import Path

from trirail.errors import RefusalCode, RefusedError
from trirail.wire.credentials import Credentials, credentials_for
from trirail.wire.endpoints import DEFAULT_LOCATOR
from trirail.wire.sizes import MAX_NAME
from trirail.wire.text import check_name, quoted


def identity(
    robot: str | None, connect: str | None, user: str | None, tls: Path | str | None
) -> tuple[str, str, str, Credentials | None]:
    """Return the robot's name, the locator, the user's name and the credentials of a client.

    Arguments that are None are replaced by TRIRAIL_ROBOT, TRIRAIL_CONNECT and the login name. Raises RefusedError if a
    name is invalid or is not the certificate's name, and ServiceError for invalid credentials.
    """
    if robot is None:
        robot = os.environ.get("TRIRAIL_ROBOT") or "demo"
    if connect is None:
        connect = os.environ.get("TRIRAIL_CONNECT") or DEFAULT_LOCATOR
    check_name(robot, "robot")
    credentials = credentials_for(robot, connect, tls)
    known_as = credentials.name if credentials is not None else ""
    name = check_name((known_as or _user()) if user is None else user, "user")
    if credentials is not None and known_as != name:
        whose = f"in the name of {quoted(known_as)}" if known_as else "without a common name"
        problem = f"the certificate in {credentials.folder} is {whose}: it cannot be used to send as {name}"
        raise RefusedError(RefusalCode.NOT_ALLOWED, problem)
    return robot, connect, name, credentials


def _user() -> str:
    try:
        name = getpass.getuser()
    except (KeyError, OSError):
        return "anonymous"
    return re.sub(r"[^A-Za-z0-9_-]", "-", name)[:MAX_NAME] or "anonymous"
