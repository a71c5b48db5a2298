"""List, downloads and reports of the service's recordings, if their folder is on the panel's machine."""

from __future__ import annotations

import contextlib
import os
import stat
import subprocess
import threading
from collections.abc import Callable
from http import HTTPStatus
from pathlib import Path
from typing import Any
from urllib.parse import quote

import msgspec
from websockets.datastructures import Headers
from websockets.http11 import Response
from websockets.sync.server import ServerConnection

from trirail.errors import ServiceError
from trirail.processes.operating_system import python
from trirail.telemetry.sessions import RecordedSession
from trirail.wire.decoding import decoded, prepare

MAX_SESSIONS = 100
"""Maximum number of sessions in the list, which contains the newest sessions."""
REPORT_TIMEOUT_S = 300.0
"""Time limit for a report, and for reading the recordings for the list [s]."""


def _open_here(path: str, flags: int) -> int:
    """Open a file without blocking, and without following a symbolic link, which could lead out of the folder."""
    return os.open(path, flags | os.O_NOFOLLOW | os.O_NONBLOCK)


class AlreadySent(Response):
    """Response that has already been sent, so that the websockets library sends nothing."""

    def serialize(self) -> bytes:
        """Return no bytes; the connection then ends."""
        return b""


class _SessionList(msgspec.Struct):
    """Output of `trirail sessions --json`, without the fields that are not needed here."""

    sessions: list[RecordedSession]


prepare(_SessionList)


class Recordings:
    """Recordings of one robot.

    `folder` returns their folder, which another configuration of the service may change. `is_here` returns whether the
    service runs on this machine. The same folder on another machine may contain recordings of another robot.
    """

    def __init__(self, robot: str, folder: Callable[[], str], is_here: Callable[[], bool] = lambda: True) -> None:
        self._robot = robot
        self._find_folder = folder
        self._is_here = is_here
        self._one_report = threading.Lock()

    def listed(self) -> dict[str, Any]:
        """Return the list of sessions for the page, as values that can be encoded as JSON.

        `folder` is the folder, `here` is True if the folder on this machine contains recordings, and `sessions` are
        the sessions, newest first. `trouble` is the reason why they cannot be listed, or empty.
        """
        content: dict[str, Any] = {"folder": str(self._folder), "here": True, "sessions": [], "trouble": ""}
        try:
            content["here"] = self._here
            content["sessions"] = self._sessions()[: -MAX_SESSIONS - 1 : -1]
        except ServiceError as error:
            content["trouble"] = str(error)
        return content

    def send_file(self, opened: ServerConnection, name: str, headers: dict[str, str]) -> Response | None:
        """Send a recording of any size as a download.

        Return None, without sending anything, if the recording is not a regular file in the folder.
        """
        if not self._is_here() or "/" in name or not name.endswith(".rrd"):
            return None
        try:
            file = open(self._folder / name, "rb", opener=_open_here)  # noqa: SIM115
        except (OSError, ValueError):  # ValueError: the name contains a null character
            return None
        with file:
            if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
                return None
            size = os.fstat(file.fileno()).st_size
            own = {"Content-Type": "application/octet-stream", "Content-Length": str(size), "Connection": "close",
                   "Content-Disposition": f"attachment; filename*=UTF-8''{quote(name, safe='')}"}  # fmt: skip
            status = HTTPStatus.OK
            with contextlib.suppress(OSError):  # the browser has disconnected
                opened.socket.sendall(Response(status.value, status.phrase, Headers(own | headers)).serialize())
                if size:
                    opened.socket.sendfile(file, count=size)  # if the file is still being written, its present part
        return AlreadySent(status.value, status.phrase, Headers())

    def report(self, session: str) -> str | None:
        """Run `trirail report` for a session in a separate process; return its warnings or its error, and the report.

        Return None if the session does not exist.
        """
        try:
            files = next((each.files for each in self._sessions() if each.session == session), None)
            if files is None or not all(stat.S_ISREG((self._folder / name).lstat().st_mode) for name in files):
                return None
            with self._one_report:
                done = self._run("report", *files)
        except ServiceError as error:
            return str(error)
        return (done.stderr + done.stdout).decode(errors="replace")

    @property
    def _folder(self) -> Path:
        return Path(self._find_folder())

    @property
    def _here(self) -> bool:
        """True if the folder on this machine contains recordings. Raises ServiceError if it cannot be listed."""
        try:
            return self._is_here() and any(name.endswith(".rrd") for name in os.listdir(self._folder))
        except (FileNotFoundError, NotADirectoryError):
            return False
        except OSError as error:
            raise ServiceError(f"{self._folder}: {error.strerror}") from error

    def _sessions(self) -> list[RecordedSession]:
        """Return all sessions, the newest last. Raises ServiceError if they cannot be listed."""
        if not self._here:
            return []
        done = self._run("sessions", ".", "--robot", self._robot, "--last", "0", "--json")
        if done.returncode != 0:
            raise ServiceError(done.stderr.decode(errors="replace").strip() or f"exit code {done.returncode}")
        return decoded(done.stdout, _SessionList).sessions

    def _run(self, *command: str) -> subprocess.CompletedProcess[bytes]:
        """Run a `trirail` command in the folder.

        The command has a low priority, because the page may move a robot at the same time. Raises ServiceError if the
        command cannot be run, or does not end within REPORT_TIMEOUT_S.
        """
        try:
            return subprocess.run(
                ["nice", *python("-m", "trirail", *command)], cwd=self._folder, capture_output=True,
                timeout=REPORT_TIMEOUT_S, check=False, env=os.environ | {"COLUMNS": "120", "NO_COLOR": "1"},
            )  # fmt: skip
        except subprocess.TimeoutExpired as error:
            raise ServiceError(f"trirail {command[0]} took longer than {REPORT_TIMEOUT_S:g} s") from error
        except OSError as error:
            raise ServiceError(f"trirail {command[0]} cannot be run: {error}") from error
