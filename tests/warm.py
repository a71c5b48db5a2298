"""Programs forked from a warm process: what every start imports and loads is there once for all tests of a session.

`start` is `python -m trirail …` by a fork, `trirail` the same to its end: of a service a second and a half of processor
time less, of another command a quarter. Services of trirail.client.own_service start so as well. It leaves out the
start of interpreters; tests of that, and of what is imported from where, start them. The other side is warm_parent.py.
"""

from __future__ import annotations

import atexit
import functools
import json
import os
import select
import signal
import socket
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import IO, Final

import pytest
from trirail.client import own_service

RUNS_WITHIN: Final = 120.0
"""A command ends within so many seconds."""


class WarmProcess:
    """A forked program: what Popen is for one's own child."""

    def __init__(self, voice: socket.socket) -> None:
        self._voice: socket.socket | None = voice
        self.pid = int(voice.recv(32))
        self.returncode: int | None = None

    def poll(self) -> int | None:
        """Return its exit code, or None while there is none; until then its process id is nobody else's."""
        if self._voice is not None and select.select([self._voice], [], [], 0.0)[0]:
            self.returncode = int(self._voice.recv(32))
            self._voice.close()
            self._voice = None
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """Wait for its end; raises subprocess.TimeoutExpired where it has not ended by then."""
        if self._voice is not None and not select.select([self._voice], [], [], timeout)[0]:
            raise subprocess.TimeoutExpired("trirail", timeout or 0.0)
        self.poll()
        assert self.returncode is not None
        return self.returncode

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)

    def terminate(self) -> None:
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)


def start(
    *arguments: str, output: IO[bytes], errors: IO[bytes] | None = None, environment: Mapping[str, str] | None = None
) -> WarmProcess:
    """Run `trirail` with arguments, in this folder; errors go to the output as well where nothing else is said."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    request = {"arguments": arguments, "folder": os.getcwd(), "environment": dict(environment or os.environ)}
    with theirs:
        descriptors = [theirs.fileno(), output.fileno(), (errors or output).fileno()]
        socket.send_fds(_parent(), [json.dumps(request).encode()], descriptors)
    return WarmProcess(ours)


def trirail(*arguments: object, locator: str = "") -> subprocess.CompletedProcess[str]:
    """Run a command of `trirail` to its end, at a service."""
    environment = os.environ | ({"TRIRAIL_CONNECT": locator} if locator else {})
    command = list(map(str, arguments))
    with tempfile.TemporaryFile() as output, tempfile.TemporaryFile() as errors:
        process = start(*command, output=output, errors=errors, environment=environment)
        try:
            code = process.wait(RUNS_WITHIN)
        finally:
            process.kill()
        said = [(file.seek(0), file.read().decode())[1] for file in (output, errors)]
    return subprocess.CompletedProcess(command, code, *said)


def _popen(
    command: Sequence[str], stdout: IO[bytes], stderr: IO[bytes], start_new_session: bool, env: Mapping[str, str]
) -> WarmProcess:
    """Start what own_service does."""
    assert stderr is stdout
    return start(*command[command.index("run") :], output=stdout, environment=env)


def pytest_configure(config: pytest.Config) -> None:
    """Stand between own_service and the interpreters that it starts."""
    patches = pytest.MonkeyPatch()
    stand_in = SimpleNamespace(Popen=_popen, TimeoutExpired=subprocess.TimeoutExpired)
    patches.setattr(own_service, "subprocess", stand_in)
    config.add_cleanup(patches.undo)


@functools.cache
def _parent() -> socket.socket:
    """Start the warm process; it ends with this one, and ends what it has forked."""
    from trirail.processes.operating_system import ONE_THREAD, python

    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with theirs:
        command = python(str(Path(__file__).with_name("warm_parent.py")), str(theirs.fileno()))
        process = subprocess.Popen(command, pass_fds=[theirs.fileno()], env=os.environ | ONE_THREAD)

    def end() -> None:
        ours.close()
        process.wait()

    atexit.register(end)
    return ours
