"""The service's own log output: one line per event of the robot or the processes, as text or as JSON."""

from __future__ import annotations

import os
import queue
import sys
import threading
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
MAX_WAITING: Final = 1000
"""Maximum number of lines that wait while the output is blocked; further lines are dropped and counted."""
FLUSH_WITHIN: Final = 1.0
"""Maximum time for writing the lines that wait when the service ends [s]."""


def unbuffered(stream: TextIO) -> Callable[[str], None]:
    """Return a function that writes to a stream without Python's buffer.

    A blocked write would hold the lock of the buffer, for which the interpreter would wait when it ends.
    """

    def write(text: str) -> None:
        content = text.encode(stream.encoding, "backslashreplace")
        while content:
            content = content[os.write(stream.fileno(), content) :]

    return write


def is_journal(descriptor: int, environment: Mapping[str, str] = os.environ) -> bool:
    """Return True if journald reads what is written to a descriptor.

    JOURNAL_STREAM names the file that journald reads. Programs that are started in a terminal of a desktop session
    inherit the variable, but write to another file: systemd.exec(5).
    """
    status = os.fstat(descriptor)
    return environment.get("JOURNAL_STREAM") == f"{status.st_dev}:{status.st_ino}"


class Log:
    """Writer of lines with time and level.

    After `start`, a thread writes the lines, so that a reader who does not read cannot block the service.

    Parameters
    ----------
    write
        Function that writes a text and may block; None for standard output.
    to_journal
        Whether journald reads the lines, each of which then begins with its priority.

    """

    def __init__(
        self,
        form: Form,
        write: Callable[[str], object] | None = None,
        clock: Callable[[], float] = time.time,
        *,
        to_journal: bool = False,
    ) -> None:
        self._json = form == "json"
        self._write = write or unbuffered(sys.stdout)
        self._clock = clock
        self._to_journal = to_journal
        self._room = float(BURST)
        self._looked = clock()
        self._left_out = 0
        self._waiting: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        self._lock = threading.Lock()
        self._dropped = 0
        """Number of lines dropped since the output was blocked. No line waits after the first dropped line."""

    def start(self) -> None:
        """Start the thread. Before, lines are written by the caller, because a process with threads must not fork."""
        self._thread = threading.Thread(target=self._run, name="log", daemon=True)
        self._thread.start()

    def log(self, words: str, level: Level = "info") -> None:
        """Write a message of the service about itself."""
        self.text(self._own_line(words, level))

    def text(self, text: str) -> None:
        """Write a text as it is."""
        if self._thread is None:
            self._write_now(text)
            return
        with self._lock:
            if self._dropped or self._waiting.qsize() >= MAX_WAITING:
                self._dropped += 1
            else:
                self._waiting.put(text)

    def event(self, event: Event) -> None:
        """Write an event, unless too many events arrive."""
        if not self._has_room() and event.level != "error":
            self._left_out += 1
            return
        if self._left_out:
            number, self._left_out = self._left_out, 0
            self.log(f"{number} events came too quickly to be written here: `trirail events` has the newest", "warning")
            self._room -= 1.0
        self._room -= 1.0
        self.text(self._line(event.time, event.level, event.message, event))

    def _has_room(self) -> bool:
        now = self._clock()
        self._room = min(float(BURST), self._room + RATE * max(0.0, now - self._looked))
        self._looked = now
        return self._room >= 1.0

    def _own_line(self, words: str, level: Level) -> str:
        now = self._clock()
        return self._line(now, level, words, {"time": now, "kind": "service", "level": level, "message": words})

    def _line(self, moment: float, level: Level, words: str, content: object) -> str:
        if self._json:
            return json_printable(msgspec.json.encode(content).decode(), sys.stdout.encoding) + "\n"
        line = f"{wall_clock(moment)}  {level:7}  {printable(words)}\n"
        return f"<{PRIORITIES[level]}>{line}" if self._to_journal else line

    def _run(self) -> None:
        """Write the lines that wait, until `close`."""
        while (text := self._waiting.get()) is not None:
            self._write_now(text)
            with self._lock:
                dropped = self._dropped if self._waiting.empty() else 0
                self._dropped -= dropped
            if dropped:
                words = f"the output was blocked: {dropped} lines of this log are missing"
                self._write_now(self._own_line(words, "warning"))

    def _write_now(self, text: str) -> None:
        with suppress(OSError):  # a full disk or a closed pipe must not stop the robot
            self._write(text)

    def close(self) -> None:
        """Write the lines that wait, as far as the output takes them within FLUSH_WITHIN."""
        if self._thread is not None:
            self._waiting.put(None)
            self._thread.join(FLUSH_WITHIN)
