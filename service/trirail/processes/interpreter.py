"""How the service starts Python programs of its own."""

from __future__ import annotations

import sys
from pathlib import Path

from trirail.errors import ServiceError


def python(*arguments: str) -> list[str]:
    """Return the command that runs this interpreter, with nothing of the current folder on its path.

    With `-m` and `-c`, Python else imports a file `msgspec.py` that lies there, whoever has put it there.
    """
    return [sys.executable, "-P", *arguments]


CHILD = "trirail.processes.process"
"""The module that each of the service's child processes runs; its first argument is the process's name."""


def child(service: int, name: str) -> int:
    """Return the process id of one of a service's child processes. Raises ServiceError where there is none."""
    for entry in Path(f"/proc/{service}/task/{service}/children").read_text(encoding="ascii").split():
        command = Path(f"/proc/{entry}/cmdline").read_bytes().split(b"\0")
        if [CHILD.encode(), name.encode()] in [command[place : place + 2] for place in range(len(command))]:
            return int(entry)
    raise ServiceError(f"the service has no process {name}")
