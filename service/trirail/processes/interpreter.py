"""How the service starts Python programs of its own."""

from __future__ import annotations

import contextlib
import sys
from pathlib import Path
from typing import Final

from trirail.errors import ServiceError


def python(*arguments: str) -> list[str]:
    """Return the command that runs this interpreter, with nothing of the current folder on its path.

    With `-m` and `-c`, Python else imports a file `msgspec.py` that lies there, whoever has put it there.
    """
    return [sys.executable, "-P", *arguments]


ONE_THREAD: Final = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
"""The environment in which numpy's libraries begin no threads: none is carried over a fork, and the service's matrices
are small."""
TITLE = "trirail: "
"""What `ps` and its like show of one of the service's processes, before its name."""


def processes(service: int) -> dict[str, int]:
    """Return the process ids of a service's processes by their names; `service` is the supervisor's."""
    found = {"supervisor": service}
    for pid in [grandchild for parent in _children(service) for grandchild in (parent, *_children(parent))]:
        with contextlib.suppress(OSError):
            called = Path(f"/proc/{pid}/cmdline").read_bytes().rstrip(b"\0").decode()
            if called.startswith(TITLE):
                found[called.removeprefix(TITLE)] = pid
    return found


def child(service: int, name: str) -> int:
    """Return the process id of one of a service's processes. Raises ServiceError where there is none."""
    try:
        return processes(service)[name]
    except KeyError:
        raise ServiceError(f"the service has no process {name}") from None


def title(name: str) -> str:
    """Return what one of the service's processes is called by `ps` and its like."""
    return TITLE + name


def _children(process: int) -> list[int]:
    with contextlib.suppress(OSError):
        return [int(pid) for pid in Path(f"/proc/{process}/task/{process}/children").read_text("ascii").split()]
    return []
