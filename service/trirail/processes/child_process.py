"""A process of the service as the supervisor sees it: what it says on its pipe, and how it ended."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

import msgspec

from trirail.processes.interpreter import CHILD, python
from trirail.processes.process import COMPILING, HAPPENED, MEASURED
from trirail.wire.decoding import converted
from trirail.wire.messages import Event


class ChildProcess:
    """A child process, and a pipe on which it says that it is ready and whose end is its end."""

    def __init__(self, name: str, order: bytes, runtime: Path, beats: int, sockets: list[int]) -> None:
        self.name = name
        self.began = time.monotonic()
        self.compiling: list[str] = []
        self.happened: list[Event] = []
        self.measured: list[dict[str, Any]] = []
        self._begun_line = b""
        self.ready_with: dict[str, Any] | None = None
        self._hung_for = 0.0
        self.pipe, write = os.pipe()
        arguments = [name, str(runtime), str(write), str(beats), *map(str, sockets)]
        # The terminal sends it to all, and the supervisor alone acts on it: also while the child is still importing.
        blocked = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
        try:
            self.process = subprocess.Popen(
                python("-m", CHILD, *arguments), stdin=subprocess.PIPE, pass_fds=[write, beats, *sockets]
            )
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
        os.close(write)
        os.set_blocking(self.pipe, False)
        if self.process.stdin is not None:
            self.process.stdin.write(order)
            self.process.stdin.close()

    def listen(self) -> bool:
        """Read what the child says; False once it has ended."""
        try:
            content = os.read(self.pipe, 65_536)
        except BlockingIOError:
            return False
        *lines, self._begun_line = (self._begun_line + content).split(b"\n")
        for line in lines:
            said = msgspec.json.decode(line)
            if COMPILING in said:
                self.compiling.append(said[COMPILING])
            elif HAPPENED in said:
                self.happened.append(converted(said[HAPPENED], Event))
            elif MEASURED in said:
                self.measured.append(said[MEASURED])
            else:
                self.ready_with = said
        return bool(content)

    def wait(self, deadline: float) -> bool:
        """Wait for its end until a time of the monotonic clock."""
        try:
            self.process.wait(max(0.0, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            return False
        return True

    def kill_hung(self, silent: float) -> None:
        """Kill it for having given no sign of life for so long [s]; SIGTERM would wait, if it is stopped."""
        self._hung_for = silent
        self.process.kill()

    @property
    def how(self) -> str:
        """How it ended, for people."""
        code = self.process.returncode
        if self._hung_for and code == -signal.SIGKILL:
            return f"no sign of life for {self._hung_for:g} s, so it was killed"
        if code == 0:
            return "another process sent it SIGTERM"
        return f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
