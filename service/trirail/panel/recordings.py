"""The service's recordings, where its folder is on the panel's machine too: a list, files to download, reports."""

from __future__ import annotations

import contextlib
import os
import re
import sqlite3
import subprocess
import sys
import threading
from http import HTTPStatus
from pathlib import Path
from typing import Any

from websockets.datastructures import Headers
from websockets.http11 import Response
from websockets.sync.server import ServerConnection

from trirail.telemetry.session_index import FILE, RecordedSession, SessionIndex, Wanted

LISTED = 100
"""Sessions, the newest."""
SHOWABLE = re.compile(r"[\w.-]+\.rrd", re.ASCII)
"""Names of recordings that a header can hold."""
REPORTED_WITHIN = 300.0
"""How long a report may take [s]."""


class Sent(Response):
    """An answer that has been sent already."""

    def serialize(self) -> bytes:
        """Return nothing: the connection is then ended."""
        return b""


class Recordings:
    """Those of one robot."""

    def __init__(self, robot: str, folder: str) -> None:
        self._robot = robot
        self._folder = Path(folder)
        self._one_report = threading.Lock()

    def listed(self) -> dict[str, Any]:
        """Return the folder, whether it is here, and its sessions, the newest first, ready to be encoded."""
        return {"folder": str(self._folder), "here": self._here, "sessions": self._sessions()[: -LISTED - 1 : -1]}

    def send_file(self, opened: ServerConnection, name: str, headers: dict[str, str]) -> Response | None:
        """Send a recording, however large, as a file to be kept; None where there is no such one."""
        if not self._here or SHOWABLE.fullmatch(name) is None:
            return None
        try:
            file = (self._folder / name).open("rb")
        except OSError:
            return None
        with file:
            size = os.fstat(file.fileno()).st_size
            own = {"Content-Type": "application/octet-stream", "Content-Length": str(size), "Connection": "close",
                   "Content-Disposition": f'attachment; filename="{name}"'}  # fmt: skip
            status = HTTPStatus.OK
            with contextlib.suppress(OSError):  # the browser has gone
                opened.socket.sendall(Response(status.value, status.phrase, Headers(own | headers)).serialize())
                if size:
                    opened.socket.sendfile(file, count=size)  # of one that is being written: so far
        return Sent(status.value, status.phrase, Headers())

    def report(self, session: str) -> str | None:
        """Return what `trirail report` says of a session, by a process of its own; None where there is no such one."""
        files = next((each.files for each in self._sessions() if each.session == session), None)
        if files is None:
            return None
        command = [sys.executable, "-m", "trirail", "report", *files]
        with self._one_report:  # beside a page that is used to move a robot
            done = subprocess.run(
                ["nice", *command], cwd=self._folder, capture_output=True, timeout=REPORTED_WITHIN, check=False,
                env=os.environ | {"COLUMNS": "120", "NO_COLOR": "1"},
            )  # fmt: skip
        return (done.stdout or done.stderr).decode(errors="replace")

    @property
    def _here(self) -> bool:
        return (self._folder / FILE).is_file()

    def _sessions(self) -> list[RecordedSession]:
        if not self._here:
            return []
        try:
            return SessionIndex(self._folder).find(Wanted(robot=self._robot))
        except (sqlite3.Error, OSError):
            return []
