"""`trirail panel`: serve the operator's page on this machine's loopback until the command ends."""

from __future__ import annotations

import contextlib
import html
import os
import re
import secrets
import signal
import stat
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from trirail_drivers import files

from trirail.cli import terminal
from trirail.cli.options import HERE, Service
from trirail.cli.robot_commands import show
from trirail.errors import ConfigError, ServiceError

RETRY_S = 1.0
"""Time between two attempts to reach a service that is not running yet [s]."""
TOKEN_BYTES = 16
TOKEN = re.compile(r"[A-Za-z0-9_-]{16,128}")
"""Pattern of a token: characters that are allowed in a URL, and enough of them that a token cannot be guessed."""


def panel(
    *,
    port: int | None = None,
    token: Path | None = None,
    open_: Annotated[bool, Parameter(name="--open", negative="", show_default=False)] = False,
    service: Service = HERE,
) -> int:
    """Serve the operator's page to browsers on this machine.

    The page shows the robot live, and can jog, stop and command it. The command waits for a service that is not running
    yet. Press Ctrl-C to end it.

    Anyone who knows the printed address can move the robot. The address changes each time, unless --port and --token
    fix it.

    Parameters
    ----------
    port
        Port on the loopback, 0 for any free port. If absent, 9880, or any free port if 9880 is in use.
    token
        File with the secret part of the address. If there is no such file, it is created and only you can read it.
    open_
        Open the page in the browser.
    """
    from trirail.client.async_client import AsyncRobot
    from trirail.panel.server import Panel
    from trirail.processes.operating_system import Signals

    signal.signal(signal.SIGTERM, signal.default_int_handler)
    secret = read_token(token) if token is not None else None
    wait_for_robot(service)
    served_robot = AsyncRobot(service.robot, service.connect, tls=service.tls)
    with Panel(served_robot, port, secret) as served, contextlib.ExitStack() as opened:
        show(
            service,
            {"url": served.url},
            f"the panel of {service.robot}, on this machine alone, until Ctrl-C: {served.url}",
        )
        if open_:
            import webbrowser

            try:
                webbrowser.open(opened.enter_context(redirect_to(served.url)))
            except OSError as error:
                terminal.print_error(f"cannot open the browser: {error}; open the printed address in it")
        with Signals() as ends:
            ends.first()
    return 0


@contextlib.contextmanager
def redirect_to(url: str) -> Iterator[str]:
    """Create a file that leads a browser to `url`, and yield the address of the file; remove the file at the end.

    Only this user can read the file, but every user of this machine can see the arguments of a browser's process. The
    token in `url` is enough to move the robot. Raises OSError.
    """
    with files.temporary_folder() as folder:
        file = folder / "panel.html"
        with open(os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w", encoding="utf-8") as made:
            made.write(f'<!doctype html><meta http-equiv="refresh" content="0; url={html.escape(url)}">\n')
        yield file.as_uri()


def wait_for_robot(service: Service) -> None:
    """Wait until the service is running."""
    is_announced = False
    while True:
        try:
            with service.open() as robot:
                robot.info()
                return
        except ServiceError as error:
            if not is_announced:
                terminal.print_error(f"{error}; waiting for the service, Ctrl-C ends")
                is_announced = True
            time.sleep(RETRY_S)


def read_token(file: Path) -> str:
    """Return the token in a file. If there is no such file, create it so that only its owner can read it.

    Raises ConfigError if others can read the file or if it does not contain a token.
    """
    try:
        files.create(file, f"{secrets.token_urlsafe(TOKEN_BYTES)}\n".encode(), 0o600)
    except FileExistsError:
        pass
    except OSError as error:
        raise ConfigError(f"{file}: {error.strerror}") from error
    try:
        mode, text = stat.S_IMODE(file.stat().st_mode), file.read_text(encoding="ascii", errors="replace").strip()
    except OSError as error:
        raise ConfigError(f"{file}: {error.strerror}") from error
    if mode & 0o077:
        raise ConfigError(f"{file}: other users can read this token (mode {mode:03o}): run chmod 600 {file}")
    if not TOKEN.fullmatch(text):
        raise ConfigError(
            f"{file}: not a valid token: expected 16 to 128 letters, digits, - or _; "
            "delete the file to create a new one"
        )
    return text
