"""A process of the service as the supervisor sees it: what it says on its pipe, and how it ended."""

from __future__ import annotations

import os
import signal
import time
from typing import Any

import msgspec

from trirail.processes.process import COMPILING, HAPPENED, MEASURED
from trirail.processes.warm_parent import WarmParent, how_ended, hung
from trirail.wire.decoding import converted
from trirail.wire.messages import Event


class ChildProcess:
    """A child process, and a pipe on which it says that it is ready and whose end is its end."""

    def __init__(self, parent: WarmParent, name: str, record: str | None) -> None:
        self.name = name
        self.began = time.monotonic()
        self.compiling: list[str] = []
        self.happened: list[Event] = []
        self.measured: list[dict[str, Any]] = []
        self._begun_line = b""
        self.ready_with: dict[str, Any] | None = None
        self._hung_for = 0.0
        self.pipe, write = os.pipe()
        os.set_blocking(self.pipe, False)
        self.process = parent.fork(name, record, write)
        os.close(write)

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

    def kill_hung(self, silent: float) -> None:
        """Kill it for having given no sign of life for so long [s]; SIGTERM would wait, if it is stopped."""
        self._hung_for = silent
        self.process.kill()

    @property
    def how(self) -> str:
        """How it ended, for people."""
        code = self.process.returncode
        if self._hung_for and code == -signal.SIGKILL:
            return hung(self._hung_for)
        return how_ended(code) if code else "another process sent it SIGTERM"
