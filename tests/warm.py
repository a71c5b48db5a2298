"""Services forked from a warm process: what every start imports and loads is there once for all tests of a session.

`start` is `python -m trirail …` by a fork: a second and a half of processor time less. It leaves out the start of
interpreters; tests of that, and of what is imported from where, start them. The other side is warm_parent.py.
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
from pathlib import Path
from typing import IO


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


def start(*arguments: str, output: IO[bytes]) -> WarmProcess:
    """Run `trirail` with arguments, in this folder and environment."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    request = {"arguments": arguments, "folder": os.getcwd(), "environment": dict(os.environ)}
    with theirs:
        socket.send_fds(_parent(), [json.dumps(request).encode()], [theirs.fileno(), output.fileno()])
    return WarmProcess(ours)


@functools.cache
def _parent() -> socket.socket:
    """Start the warm process; it ends with this one, and ends what it has forked."""
    from trirail.processes.interpreter import ONE_THREAD, python

    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with theirs:
        command = python(str(Path(__file__).with_name("warm_parent.py")), str(theirs.fileno()))
        process = subprocess.Popen(command, pass_fds=[theirs.fileno()], env=os.environ | ONE_THREAD)

    def end() -> None:
        ours.close()
        process.wait()

    atexit.register(end)
    return ours
