"""`trirail keys`: certificates that identify the robot and its users to each other, for [zenoh.tls]."""

from __future__ import annotations

import socket
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

from trirail.cli import terminal
from trirail.cli.options import Json
from trirail.wire.endpoints import is_host
from trirail.wire.text import check_name, quoted
from trirail.wire.vocabulary import Role

app = App(name="keys", help="Make, list, renew and revoke the certificates of a robot and its users, for zenoh.tls.")

Folder = Annotated[Path, Parameter(name="--folder")]
AuthorityFolder = Annotated[Folder, Parameter(help="That of the authority.")]
Days = Annotated[float, Parameter(validator=lambda _kind, days: _check_days(days))]
Addresses = Annotated[
    tuple[str, ...],
    Parameter(
        consume_multiple=True,
        negative="",
        show_default=False,
        validator=lambda _kind, addresses: _check_hosts(addresses),
    ),
]
HERE = Path("keys")
LOCAL = ("localhost", "127.0.0.1", "::1")
"""Addresses of the robot's own machine, which every robot's certificate contains."""
MIN_DAYS, MAX_DAYS = 0.01, 3650.0
"""Validity of a certificate in days. The maximum is the validity of the authority itself."""


def _check_hosts(addresses: tuple[str, ...]) -> None:
    for address in addresses:
        if not is_host(address):
            raise ValueError(
                f"{quoted(address)!r} is not a host name or IP address such as 192.0.2.7, without protocol and port"
            )


def _check_days(days: float) -> None:
    if not MIN_DAYS <= days <= MAX_DAYS:
        raise ValueError(f"use {MIN_DAYS:g} to {MAX_DAYS:g}")


@app.command
def init(
    *,
    robot: Annotated[str, Parameter(env_var="TRIRAIL_ROBOT")] = "demo",
    address: Addresses = (),
    days: Days = 365.0,
    folder: Folder = HERE,
    json: Json = False,
) -> int:
    """Make an authority of your own, and the robot's certificate.

    Parameters
    ----------
    robot
        Name of the robot, as in its configuration.
    address
        Host names and IP addresses at which clients find the robot. The addresses of this machine and its host name
        are always included.
    days
        Validity of the robot's certificate in days.
    folder
        Folder to create, beside the configuration.
    """
    from trirail.cli.key_folder import KeyFolder

    addresses = tuple(dict.fromkeys((*LOCAL, socket.gethostname(), *address)))
    made = KeyFolder(folder).create(check_name(robot, "robot"), addresses, days)
    if json:
        terminal.json({"folder": str(folder), "robot": robot, "addresses": addresses, "expires": made.expires})
        return 0
    terminal.print_line(f"{folder}: an authority, and the certificate of {robot} at {', '.join(addresses)}")
    terminal.print_line(f"valid until {made.expires:%Y-%m-%d}; keep ca-key.pem where only you can read it")
    terminal.print_line("in the robot's configuration:")
    for line in ("[zenoh]", 'listen = ["tls/0.0.0.0:7447"]', "[zenoh.tls]", f'directory = "{folder}"'):
        terminal.print_line(f"    {line}")
    return 0


@app.command
def add(
    user: str,
    /,
    *,
    role: Role,
    days: Days = 365.0,
    folder: AuthorityFolder = HERE,
    json: Json = False,
) -> int:
    """Make a user's certificate, in a folder to hand over.

    Parameters
    ----------
    user
        Name of the user, which is part of the user's goals and commands.
    role
        Role of the user: a viewer sees everything and may stop the robot, an operator may also move it, a maintainer
        may also reset and home it. The role takes effect when it is in the configuration.
    days
        Validity of the certificate in days.
    """
    from trirail.cli.key_folder import KeyFolder

    made = KeyFolder(folder).add(check_name(user, "user"), days)
    if json:
        terminal.json({"user": user, "role": role, "folder": str(made.folder), "expires": made.expires})
        return 0
    terminal.print_line(f"{made.folder}: {user}'s certificate, valid until {made.expires:%Y-%m-%d}")
    terminal.print_line("give it only to this user; on the user's machine, it belongs in ~/.config/trirail/<robot>/")
    terminal.print_line("in the robot's configuration, then restart the service while the robot is at rest:")
    for line in ("[zenoh.users]", f'{user} = "{role}"'):
        terminal.print_line(f"    {line}")
    return 0


@app.command(name="robot")
def further(
    name: str,
    /,
    *,
    address: Addresses = (),
    days: Days = 365.0,
    folder: AuthorityFolder = HERE,
    json: Json = False,
) -> int:
    """Make the certificate of a further robot of this authority, such as a robot that connects to a router.

    Parameters
    ----------
    name
        Name of the robot, as in its configuration.
    address
        Host names and IP addresses at which clients find the robot without the router, in addition to those of its own
        machine.
    days
        Validity of the certificate in days.
    """
    from trirail.cli.key_folder import KeyFolder

    addresses = tuple(dict.fromkeys((*LOCAL, *address)))
    made = KeyFolder(folder).add(check_name(name, "robot"), days, addresses)
    if json:
        terminal.json({"robot": name, "folder": str(made.folder), "addresses": addresses, "expires": made.expires})
        return 0
    until = f"{made.expires:%Y-%m-%d}"
    terminal.print_line(f"{made.folder}: the certificate of {name} at {', '.join(addresses)}, until {until}")
    terminal.print_line("copy it only to that robot's machine, and set it there as [zenoh.tls] directory")
    return 0


@app.default
@app.command(name="list")
def show(*, folder: AuthorityFolder = HERE, json: Json = False) -> int:
    """List the certificates with their expiry dates, and the revoked users; roles are in the configuration."""
    from trirail.cli.key_folder import KeyFolder
    from trirail.wire.credentials import revoked

    issued, gone = KeyFolder(folder).issued(), sorted(revoked(folder))
    if json:
        certificates = [
            {"name": each.name, "robot": each.serves, "expires": each.expires, "trouble": each.trouble()}
            for each in issued
        ]
        terminal.json({"folder": str(folder), "certificates": certificates, "revoked": gone})
        return 0
    table = terminal.table("name", "", "until", "days left", "")
    now = datetime.now(UTC)
    for each in issued:
        left = (str(max(0, (each.expires - now).days)), f"{each.expires:%Y-%m-%d}") if each.expires else ("", "")
        trouble = f"[red]{terminal.plain(each.trouble(now))}[/]"
        table.add_row(terminal.plain(each.name), "robot" if each.serves else "user", left[1], left[0], trouble)
    for name in gone:
        table.add_row(name, "revoked")
    terminal.print_table(table)
    return 0


@app.command
def renew(name: str, /, *, days: Days = 365.0, folder: AuthorityFolder = HERE, json: Json = False) -> int:
    """Make a new certificate for the key of a user, or of the robot by its name.

    A user's certificate takes effect with the user's next session. The robot's certificate takes effect with the next
    start of the service; restart the service while the robot is at rest.

    Parameters
    ----------
    name
        Name of the user or of the robot.
    days
        Validity of the certificate in days from now.
    """
    from trirail.cli.key_folder import KeyFolder

    made = KeyFolder(folder).renew(name, days)
    if json:
        terminal.json({"name": name, "folder": str(made.folder), "expires": made.expires})
        return 0
    then = "restart the service while the robot is at rest" if made.is_robot else "give its cert.pem to the user"
    terminal.print_line(f"{made.folder}: valid until {made.expires:%Y-%m-%d}; {then}")
    return 0


@app.command
def revoke(user: str, /, *, folder: Folder = HERE, json: Json = False) -> int:
    """Revoke a user's role permanently.

    The change takes effect when the service is restarted; do this while the robot is at rest.

    Parameters
    ----------
    user
        Name of the user, which is never issued again.
    folder
        Folder of the authority. Its revoked.txt must be where the robot reads it.
    """
    from trirail.cli.key_folder import KeyFolder

    keys = KeyFolder(folder)
    is_here = any(each.name == user for each in keys.issued())
    keys.revoke(check_name(user, "user"))
    if json:
        terminal.json({"user": user, "revoked": True})
        return 0
    if not is_here:
        terminal.print_line(f"{folder} has no folder of {user}: check that this is the name in the lost certificate")
    terminal.print_line(f"{user} no longer has a role wherever this {folder / 'revoked.txt'} is read")
    terminal.print_line(
        "copy it to the folder of [zenoh.tls] of every robot and router of this authority, and restart their services"
    )
    return 0
