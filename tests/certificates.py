"""A robot on TLS with users of every kind, each with real certificates, for tests."""

from __future__ import annotations

import contextlib
import socket
from datetime import UTC, datetime, timedelta
from pathlib import Path

import msgspec
from control_rig import CONFIG
from ports import free_port
from trirail.cli.key_folder import AUTHORITY_KEY, KeyFolder
from trirail.config import Config, Tls, Zenoh
from trirail.wire.certificates import Pair, authority, issue
from trirail.wire.stop_protocol import stop_address
from trirail.wire.vocabulary import Role

ROLES = {"eva": Role.VIEWER, "ann": Role.OPERATOR, "max": Role.MAINTAINER}


def tls_config(folder: Path) -> Config:
    """Make every certificate below a folder; return the configuration of their robot."""
    keys = KeyFolder(folder / "keys")
    keys.create("demo", ["127.0.0.1", "localhost"], 100.0)
    for name in (*ROLES, "una", "gone"):
        keys.add(name, 100.0)
    gone = {path.name: path.read_bytes() for path in user(folder, "gone").iterdir()}
    keys.revoke("gone")
    for name, content in gone.items():  # what was lost, in other hands
        _file(user(folder, "gone") / name, content)
    by = Pair((keys.folder / "ca.pem").read_bytes(), (keys.folder / AUTHORITY_KEY).read_bytes())
    put(folder, "nobody", by, issue(by, "", 100.0))
    put(folder, "late", by, issue(by, "ann", 1.0, now=datetime.now(UTC) - timedelta(days=2)))
    put(folder, "early", by, issue(by, "ann", 9.0, now=datetime.now(UTC) + timedelta(days=2)))
    put(folder, "foreign", by, issue(authority("demo"), "ann", 100.0))
    users = ROLES | {"gone": Role.OPERATOR}
    zenoh = Zenoh(listen=(f"tls/127.0.0.1:{service_port()}",), tls=Tls(str(keys.folder)), users=users)
    return msgspec.structs.replace(CONFIG, zenoh=zenoh)


def service_port() -> int:
    """Return a port of the loopback that nobody listens on, nor on the one that takes stops."""
    while True:
        port = free_port()
        door = stop_address(f"tcp/127.0.0.1:{port}")
        with socket.socket() as probe, contextlib.suppress(OSError):
            probe.bind(door.where if door is not None else ("127.0.0.1", port))
            return port


def user(folder: Path, name: str) -> Path:
    """Where a user's credentials are."""
    return folder / "keys" / "users" / name


def put(folder: Path, name: str, by: Pair, own: Pair) -> None:
    """Write credentials as a user who trusts this authority has them."""
    for file, content in (("ca.pem", by.certificate), ("cert.pem", own.certificate), ("key.pem", own.key)):
        _file(user(folder, name) / file, content)


def _file(path: Path, content: bytes) -> None:
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(content)
    path.chmod(0o600)
