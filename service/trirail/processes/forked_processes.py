"""The fork server and the processes that it has forked, as the supervisor sees them.

Each says on a pipe when it is ready and what it measures; the pipe's end is its end.
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

from trirail.processes.child_process import COMPILING, HAPPENED, MEASURED, Order
from trirail.processes.fork_server import LARGEST, MATHEMATICS, OF_TERMINAL, Ended, Fork, Forked, Inheritance, fork
from trirail.processes.heartbeats import Heartbeats
from trirail.wire.decoding import converted, decoded, prepare
from trirail.wire.messages import Event

TELLS_WITHIN = 1.0
"""So long after the end of a child the fork server may take to say how it ended [s]."""
IMPORTS_WITHIN = 6.0
"""The same while it may be importing the mathematics [s]."""
UNTOLD = os.EX_UNAVAILABLE
"""The code of a child whose parent, gone, frozen or busy, does not say how it ended; none ends with it by itself."""

prepare(Forked | Ended)


class ServerProcess:
    """The fork server's process: what Popen is for one's own child."""

    def __init__(self, inheritance: Inheritance) -> None:
        self._pid = fork(inheritance)
        self._code: int | None = None

    def wait(self) -> int:
        """Wait for its end, and return its exit code, or the negative number of the signal that killed it."""
        if self._code is None:
            self._code = os.waitstatus_to_exitcode(os.waitpid(self._pid, 0)[1])
        return self._code

    def kill(self) -> None:
        """Kill it, if nobody has waited for its end."""
        if self._code is None:
            os.kill(self._pid, signal.SIGKILL)


class ForkServerLink:
    """Starts the fork server, asks it for children, and hears how they end. Its process may have no other thread."""

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
        """How long what it has to say may take; nothing where it has been waited for in vain [s]."""
        self.gone = False
        """Whether it has ended: then the loop has been told to end as well."""

    def fileno(self) -> int:
        """For select and its like."""
        return self._control.fileno()

    def fork(self, child: ChildProcess, record: str | None, voice: int) -> None:
        """Ask for a child that speaks on the descriptor `voice`."""
        self._numbers += 1
        self._asked[self._numbers] = child
        try:
            socket.send_fds(self._control, [msgspec.json.encode(Fork(self._numbers, child.name, record))], [voice])
        except OSError:
            self._lost()

    def hear(self) -> None:
        """Take what it says, or that it has ended, if there is something."""
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
        """Wait until it says something; False where it does not, and then it is not waited for again."""
        heard = bool(select.select([self], [], [], self.tells_within)[0])
        self.tells_within = self.tells_within if heard else 0.0
        return heard

    def how(self) -> str:
        """How it ended, for people."""
        return how_ended(self._process.wait(), self._hung_for)

    def kill(self) -> None:
        """Kill it: the loop, if there is one, stops the robot and ends."""
        self._process.kill()

    def kill_hung(self, silent: float) -> None:
        """Kill it for not having answered for so long [s]."""
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
    """A child of the fork server, as Popen has one's own; and a pipe on which it speaks and whose end is its end."""

    def __init__(self, parent: ForkServerLink, name: str, record: str | None) -> None:
        self.name = name
        self._parent = parent
        self._pidfd: int | None = None
        self._killed = False
        """Whether it is not to be."""
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
        parent.fork(self, record, write)
        os.close(write)

    def forked(self, pid: int, pidfd: int) -> None:
        """It has been forked."""
        self.pid, self._pidfd = pid, pidfd
        if self._killed:
            self.send_signal(signal.SIGKILL)

    def ended(self, code: int) -> None:
        """It has ended."""
        self.returncode = code
        if self._pidfd is not None:
            os.close(self._pidfd)
            self._pidfd = None

    def orphaned(self) -> None:
        """Its parent has ended before it, and nobody will tell how it does."""
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
        """Wait for its end until a time of the monotonic clock; False where it has not ended by then."""
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
        self.kill()

    @property
    def how(self) -> str:
        """How it ended, for people."""
        code = self.returncode
        return how_ended(code, self._hung_for) if code else "another process sent it SIGTERM"


def how_ended(code: int, hung_for: float) -> str:
    """Return how a process ended, for people.

    `code` is its exit code as Popen has it; `hung_for` how long it had given no sign of life when it was killed for
    that, 0 where it was not [s].
    """
    if hung_for and code == -signal.SIGKILL:
        return f"no sign of life for {hung_for:g} s, so it was killed"
    if code == UNTOLD:
        return "its parent does not say how"
    return f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
