"""The fork server and the processes that it has forked, from the supervisor's side.

Each reports on a pipe that it is ready, and its measurements; the pipe's end is its end.
"""

from __future__ import annotations

import os
import select
import signal
import socket
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec

from trirail.processes.child_process import COMPILING, HAPPENED, MEASURED
from trirail.processes.fork_server import LARGEST, MATHEMATICS, OF_TERMINAL, Ended, Fork, Forked, Inheritance, fork
from trirail.processes.heartbeats import Heartbeats
from trirail.processes.order import Order
from trirail.wire.decoding import converted, decoded, prepare
from trirail.wire.messages import Event

TELLS_WITHIN = 1.0
"""Longest time after the end of a child for the fork server to report how it ended [s]."""
IMPORTS_WITHIN = 6.0
"""The same while it may be importing the mathematics [s]."""
UNTOLD = os.EX_UNAVAILABLE
"""Exit code of a child whose parent, gone, frozen or busy, does not report how it ended; none has it by itself."""

prepare(Forked | Ended)


class ServerProcess:
    """Process of the fork server, as Popen is for one's own child."""

    def __init__(self, inheritance: Inheritance) -> None:
        self._pid = fork(inheritance)
        self._code: int | None = None

    def wait(self) -> int:
        """Wait for its end, and return its exit code, or the negative number of the signal that killed it."""
        if self._code is None:
            self._code = os.waitstatus_to_exitcode(os.waitpid(self._pid, 0)[1])
        return self._code

    def kill(self) -> None:
        """Kill it, unless its end has been waited for."""
        if self._code is None:
            os.kill(self._pid, signal.SIGKILL)


class ForkServerLink:
    """Link to the fork server: starts it, requests children, receives their ends; only for a process of one thread."""

    def __init__(self, order: Order, runtime: Path, heartbeats: Heartbeats, sockets: list[int]) -> None:
        self._control, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._control.setblocking(False)
        # The supervisor alone acts on what a terminal sends to all: also while the server is still importing.
        blocked = signal.pthread_sigmask(signal.SIG_BLOCK, OF_TERMINAL)
        with theirs:
            self._process = ServerProcess(Inheritance(theirs, order, runtime, heartbeats, sockets))
        signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
        self._asked: dict[int, ChildProcess] = {}
        self._numbers = 0
        self._hung_for = 0.0
        self.tells_within = IMPORTS_WITHIN
        """Longest wait for its next message; 0 after a wait in vain [s]."""
        self.gone = False
        """Whether it has ended: then SIGTERM has been sent to the loop as well."""

    def fileno(self) -> int:
        """Return the descriptor for select."""
        return self._control.fileno()

    def fork(self, child: ChildProcess, record: str | None, voice: int, *, again: bool = False) -> None:
        """Request a child that sends its messages on the descriptor `voice`."""
        self._numbers += 1
        self._asked[self._numbers] = child
        request = Fork(self._numbers, child.name, record, again)
        try:
            socket.send_fds(self._control, [msgspec.json.encode(request)], [voice])
        except OSError:
            self._lost()

    def hear(self) -> None:
        """Process its messages, or its end, if any."""
        try:
            packet, descriptors, _, _ = socket.recv_fds(self._control, LARGEST, 1)
        except BlockingIOError:
            return
        except OSError:
            packet = b""
        if not packet:
            self._lost()
            return
        said: Forked | Ended = decoded(packet, Forked | Ended)
        if isinstance(said, Forked):
            child = self._asked[said.number]
            child.forked(said.pid, *descriptors)
            if child.name in MATHEMATICS:
                self.tells_within = TELLS_WITHIN
        else:
            self._asked.pop(said.number).ended(said.code)

    def speaks(self) -> bool:
        """Wait for its next message; return False if none comes, and then do not wait again."""
        heard = bool(select.select([self], [], [], self.tells_within)[0])
        self.tells_within = self.tells_within if heard else 0.0
        return heard

    def how(self) -> str:
        """Return how it ended, for people."""
        return how_ended(self._process.wait(), self._hung_for)

    def kill(self) -> None:
        """Kill it: the loop, if there is one, stops the robot and ends."""
        self._process.kill()

    def kill_hung(self, silent: float) -> None:
        """Kill it because it has not answered for `silent` seconds."""
        self._hung_for = silent
        self.kill()

    def close(self) -> None:
        """End it: it has nothing to keep."""
        self.kill()
        self._process.wait()
        self._control.close()

    def _lost(self) -> None:
        self.gone = True
        for child in self._asked.values():
            child.orphaned()


class ChildProcess:
    """Child of the fork server, with the interface of Popen; and a pipe for its messages, whose end is its end."""

    def __init__(self, parent: ForkServerLink, name: str, record: str | None, *, again: bool = False) -> None:
        self.name = name
        self._parent = parent
        self._pidfd: int | None = None
        self._killed = False
        """Whether it has been killed."""
        self.pid: int | None = None
        """None before it has been forked."""
        self.returncode: int | None = None
        """None before its end; as Popen has it."""
        self.began = time.monotonic()
        self.compiling: list[str] = []
        self.happened: list[Event] = []
        self.measured: list[dict[str, Any]] = []
        self._begun_line = b""
        self.ready_with: dict[str, Any] | None = None
        self._hung_for = 0.0
        self.pipe, write = os.pipe()
        os.set_blocking(self.pipe, False)
        parent.fork(self, record, write, again=again)
        os.close(write)

    def forked(self, pid: int, pidfd: int) -> None:
        """Record that it has been forked."""
        self.pid, self._pidfd = pid, pidfd
        if self._killed:
            self.send_signal(signal.SIGKILL)

    def ended(self, code: int) -> None:
        """Record that it has ended."""
        self.returncode = code
        if self._pidfd is not None:
            os.close(self._pidfd)
            self._pidfd = None

    def orphaned(self) -> None:
        """Record that its parent has ended before it, so that nobody reports its end."""
        if self.pid is None and self.returncode is None:
            self.ended(UNTOLD)

    def send_signal(self, number: int) -> None:
        """Send a signal."""
        if self._pidfd is not None:
            with suppress(ProcessLookupError):
                signal.pidfd_send_signal(self._pidfd, number)

    def kill(self) -> None:
        """Kill it; one that has not been forked yet counts as ended, and is killed when it is."""
        self.send_signal(signal.SIGKILL)
        self._killed = True
        if self.pid is None:
            self.returncode = 0

    def wait(self, deadline: float) -> bool:
        """Wait for its end until a time of the monotonic clock; return False if it has not ended by then."""
        while self.returncode is None:
            watched = [] if self._parent.gone else [self._parent.fileno()]
            watched += [] if self._pidfd is None else [self._pidfd]
            ready, _, _ = select.select(watched, [], [], max(0.0, deadline - time.monotonic()))
            if not ready:
                return False
            if self._parent.fileno() in ready:
                self._parent.hear()
            elif self._parent.gone or not self._parent.speaks():
                self.ended(UNTOLD)  # it has ended, and its parent does not say how
        return True

    def listen(self) -> bool:
        """Read the child's messages; return False once it has ended."""
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
        """Kill it after `silent` seconds without a sign of life; SIGTERM would wait, if it is stopped."""
        self._hung_for = silent
        self.kill()

    @property
    def how(self) -> str:
        """Manner of its end, for people."""
        code = self.returncode
        return how_ended(code, self._hung_for) if code else "another process sent it SIGTERM"


def how_ended(code: int, hung_for: float) -> str:
    """Return how a process ended, for people.

    `code` is its exit code, as in Popen; `hung_for` the time without a sign of life for which it was killed, or 0 [s].
    """
    if hung_for and code == -signal.SIGKILL:
        return f"no sign of life for {hung_for:g} s, so it was killed"
    if code == UNTOLD:
        return "its parent does not say how"
    return f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
