"""The service's own log output: one line per event of the robot or the processes, as text or as JSON."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Final, Literal, TextIO

import msgspec

from trirail.wire.messages import Event, Level
from trirail.wire.text import json_printable, printable, wall_clock

Form = Literal["text", "json"]

BURST: Final = 100
"""Maximum number of lines in a burst."""
RATE: Final = 1.0
"""Lines per second after a burst, so that a flood of goals cannot fill the disk. Errors are always written."""
PRIORITIES: Final[Mapping[str, int]] = {"info": 6, "warning": 4, "error": 3}
"""Priority of each level, which journald reads at the beginning of a line: sd-daemon(3)."""


class Log:
    """Writer of lines with time and level."""

    def __init__(
        self,
        form: Form,
        out: TextIO | None = None,
        clock: Callable[[], float] = time.time,
        environment: Mapping[str, str] = os.environ,
    ) -> None:
        self._json = form == "json"
        self._out = out or sys.stdout
        self._clock = clock
        self._to_journal = "JOURNAL_STREAM" in environment
        self._newest = 0
        self._room = float(BURST)
        self._looked = clock()
        self._left_out = 0

    def log(self, words: str, level: Level = "info") -> None:
        """Write a message of the service about itself."""
        now = self._clock()
        self._write(now, level, words, {"time": now, "kind": "service", "level": level, "message": words})

    def event(self, event: Event) -> None:
        """Write an event, but only once, because a restarted gateway sends past events again."""
        if event.seq <= self._newest:
            return
        self._newest = event.seq
        if not self._has_room() and event.level != "error":
            self._left_out += 1
            return
        if self._left_out:
            number, self._left_out = self._left_out, 0
            self.log(f"{number} events came too quickly to be written here: `trirail events` has them", "warning")
            self._room -= 1.0
        self._room -= 1.0
        self._write(event.time, event.level, event.message, event)

    def _has_room(self) -> bool:
        now = self._clock()
        self._room = min(float(BURST), self._room + RATE * max(0.0, now - self._looked))
        self._looked = now
        return self._room >= 1.0

    def _write(self, moment: float, level: Level, words: str, content: object) -> None:
        if self._json:
            line = json_printable(msgspec.json.encode(content).decode())
        else:
            line = f"{wall_clock(moment)}  {level:7}  {printable(words)}"
            if self._to_journal:
                line = f"<{PRIORITIES[level]}>{line}"
        with suppress(OSError):  # a full disk or a closed pipe must not stop the robot
            self._out.write(f"{line}\n")
            self._out.flush()

    def close(self) -> None:
        """Flush the output; discard lines that cannot be written, which the interpreter would try to write at exit."""
        try:
            self._out.flush()
        except OSError:
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self._out.fileno())
            os.close(nowhere)
