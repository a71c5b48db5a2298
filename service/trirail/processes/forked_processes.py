"""Supervisor's view of the fork server and of the children that the fork server forks.

Each child writes its messages to a pipe, which is closed when the child ends.
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
from trirail.processes.fork_server import (
    MATHEMATICS,
    MAX_PACKET_BYTES,
    SUPERVISOR_SIGNALS,
    ChildEnd,
    ChildStart,
    Fork,
    Inheritance,
    fork,
)
from trirail.processes.heartbeats import Heartbeats
from trirail.processes.order import Order
from trirail.wire.decoding import converted, decoded, prepare
from trirail.wire.messages import Event

END_REPORT_TIMEOUT_S = 1.0
"""Maximum time to wait for the fork server's report after a child has ended [s]."""
IMPORT_TIMEOUT_S = 6.0
"""Maximum time to wait for the report while the fork server may be importing the compiled modules [s]."""
EXIT_CODE_UNKNOWN = os.EX_UNAVAILABLE
"""Exit code assumed for a child if the fork server does not report its end. No child returns this code itself."""

prepare(ChildStart | ChildEnd)


class ServerProcess:
    """Process of the fork server, with methods like those of subprocess.Popen."""

    def __init__(self, inheritance: Inheritance) -> None:
        self._pid = fork(inheritance)
        self._code: int | None = None

    def wait(self) -> int:
        """Wait for the end; return the exit code, or the negative number of the signal that killed the process."""
        if self._code is None:
            self._code = os.waitstatus_to_exitcode(os.waitpid(self._pid, 0)[1])
        return self._code

    def kill(self) -> None:
        """Kill the process, unless `wait` has returned its exit code."""
        if self._code is None:
            os.kill(self._pid, signal.SIGKILL)


class ForkServerLink:
    """Link to the fork server, which starts it, requests children and receives reports of their starts and ends.

    The process that creates the link must have a single thread, because it forks.
    """

    def __init__(self, order: Order, runtime: Path, heartbeats: Heartbeats, sockets: list[int]) -> None:
        self._control, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._control.setblocking(False)
        # Blocked during the fork, so that a terminal's signals cannot end the fork server before it ignores them.
        blocked = signal.pthread_sigmask(signal.SIG_BLOCK, SUPERVISOR_SIGNALS)
        with theirs:
            self._process = ServerProcess(Inheritance(theirs, order, runtime, heartbeats, sockets))
        signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
        self._requested: dict[int, ChildProcess] = {}
        self._numbers = 0
        self._hung_for = 0.0
        self.report_timeout = IMPORT_TIMEOUT_S
        """Maximum time to wait for the next message [s]; 0 after a wait that timed out, until a message arrives."""
        self.gone = False
        """True if the fork server has ended. The kernel has then sent SIGTERM to the loop."""

    def fileno(self) -> int:
        """Return the descriptor to pass to select."""
        return self._control.fileno()

    def fork(self, child: ChildProcess, record: str | None, voice: int, *, again: bool = False) -> None:
        """Request a child that sends its messages to the descriptor `voice`."""
        self._numbers += 1
        self._requested[self._numbers] = child
        request = Fork(self._numbers, child.name, record, again)
        try:
            socket.send_fds(self._control, [msgspec.json.encode(request)], [voice])
        except OSError:
            self._on_end()

    def receive(self) -> None:
        """Process one message of the fork server or its end, without waiting. Do nothing if nothing has arrived."""
        try:
            packet, descriptors, _, _ = socket.recv_fds(self._control, MAX_PACKET_BYTES, 1)
        except BlockingIOError:
            return
        except OSError:
            packet = b""
        if not packet:
            self._on_end()
            return
        self.report_timeout = self.report_timeout or END_REPORT_TIMEOUT_S
        message: ChildStart | ChildEnd = decoded(packet, ChildStart | ChildEnd)
        if isinstance(message, ChildStart):
            child = self._requested[message.number]
            child.forked(message.pid, *descriptors)
            if child.name in MATHEMATICS:
                self.report_timeout = END_REPORT_TIMEOUT_S
        else:
            self._requested.pop(message.number).ended(message.code, message.reason)

    def wait_for_message(self) -> bool:
        """Wait for the next message. Return False on a time-out.

        Later calls then do not wait, until a message arrives.
        """
        heard = bool(select.select([self], [], [], self.report_timeout)[0])
        self.report_timeout = self.report_timeout if heard else 0.0
        return heard

    def describe_end(self) -> str:
        """Describe how the fork server ended, for people."""
        return describe_exit(self._process.wait(), self._hung_for)

    def kill(self) -> None:
        """Kill the fork server. If the loop is running, it then stops the robot and ends."""
        self._process.kill()

    def kill_hung(self, silent: float) -> None:
        """Kill the fork server, because it has not answered for `silent` seconds."""
        self._hung_for = silent
        self.kill()

    def close(self) -> None:
        """Kill the fork server, which has no state to save."""
        self.kill()
        self._process.wait()
        self._control.close()

    def _on_end(self) -> None:
        self.gone = True
        for child in self._requested.values():
            child.orphaned()


class ChildProcess:
    """Child of the fork server, with methods like those of subprocess.Popen and a pipe for the child's messages."""

    def __init__(self, parent: ForkServerLink, name: str, record: str | None, *, again: bool = False) -> None:
        self.name = name
        self._parent = parent
        self._pidfd: int | None = None
        self._killed = False
        self.pid: int | None = None
        """Process id; None until the child is forked."""
        self.returncode: int | None = None
        """Exit code as in subprocess.Popen; None until the child has ended."""
        self.began = time.monotonic()
        self.compiling: list[str] = []
        self.events: list[Event] = []
        self.measurements: list[dict[str, Any]] = []
        self._partial_line = b""
        self.ready_message: dict[str, Any] | None = None
        self._hung_for = 0.0
        self._reason = ""
        self.pipe, write = os.pipe()
        os.set_blocking(self.pipe, False)
        parent.fork(self, record, write, again=again)
        os.close(write)

    def forked(self, pid: int, pidfd: int) -> None:
        """Record the start of the process."""
        self.pid, self._pidfd = pid, pidfd
        if self._killed:
            self.send_signal(signal.SIGKILL)

    def ended(self, code: int, reason: str = "") -> None:
        """Record the end of the process, or the reason why it could not be forked."""
        self.returncode, self._reason = code, reason
        if self._pidfd is not None:
            os.close(self._pidfd)
            self._pidfd = None

    def orphaned(self) -> None:
        """Note that the fork server has ended. A child that was not forked yet is then recorded as ended."""
        if self.pid is None and self.returncode is None:
            self.ended(EXIT_CODE_UNKNOWN)

    def send_signal(self, number: int) -> None:
        """Send a signal to the child, unless it has ended or has not been forked yet."""
        if self._pidfd is not None:
            with suppress(ProcessLookupError):
                signal.pidfd_send_signal(self._pidfd, number)

    def kill(self) -> None:
        """Kill the child. If it has not been forked yet, count it as ended, and kill it as soon as it is forked."""
        self.send_signal(signal.SIGKILL)
        self._killed = True
        if self.pid is None:
            self.returncode = 0

    def wait(self, deadline: float) -> bool:
        """Wait for the end of the child. Return False if it has not ended at `deadline`, by the monotonic clock [s]."""
        while self.returncode is None:
            watched = [] if self._parent.gone else [self._parent.fileno()]
            watched += [] if self._pidfd is None else [self._pidfd]
            ready, _, _ = select.select(watched, [], [], max(0.0, deadline - time.monotonic()))
            if not ready:
                return False
            if self._parent.fileno() in ready:
                self._parent.receive()
            elif self._parent.gone or not self._parent.wait_for_message():
                self.ended(EXIT_CODE_UNKNOWN)  # the pidfd shows the end, but the fork server does not report it
        return True

    def read_messages(self) -> bool:
        """Read the child's messages that have arrived. Return False if there are none, or if the child has ended."""
        try:
            content = os.read(self.pipe, 65_536)
        except BlockingIOError:
            return False
        *lines, self._partial_line = (self._partial_line + content).split(b"\n")
        for line in lines:
            message = msgspec.json.decode(line)
            if COMPILING in message:
                self.compiling.append(message[COMPILING])
            elif HAPPENED in message:
                self.events.append(converted(message[HAPPENED], Event))
            elif MEASURED in message:
                self.measurements.append(message[MEASURED])
            else:
                self.ready_message = message
        return bool(content)

    def kill_hung(self, silent: float) -> None:
        """Kill the child, because it has given no sign of life for `silent` seconds.

        SIGTERM would not be enough, because a stopped process does not react to it.
        """
        self._hung_for = silent
        self.kill()

    @property
    def end_description(self) -> str:
        """Description for people of how the child ended."""
        code = self.returncode
        if self._reason:
            return self._reason
        return describe_exit(code, self._hung_for) if code else "another process sent it SIGTERM"


def describe_exit(code: int, hung_for: float) -> str:
    """Describe how a process ended, for people.

    Parameters
    ----------
    code : int
        Exit code as in subprocess.Popen.
    hung_for : float
        Time without a sign of life after which the process was killed [s]; 0 if it was not killed for that reason.

    """
    if hung_for and code == -signal.SIGKILL:
        return f"no sign of life for {hung_for:g} s, so it was killed"
    if code == EXIT_CODE_UNKNOWN:
        return "exit code unknown"
    return f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
