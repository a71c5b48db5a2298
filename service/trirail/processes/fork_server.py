"""Fork server, which imports the shared modules of the service's processes once and forks all of these processes.

The supervisor forks the fork server before the supervisor starts a thread. Shared modules are therefore in memory only
once. Over a SEQPACKET socket, the fork server receives requests (`Fork`, with a descriptor for the child's messages).
The fork server reports each start (`ChildStart`, with a pidfd) and each end (`ChildEnd`) of a child.

The fork server must have only one thread, because fork(2) copies only the calling thread. Zenoh and Rerun start
threads, and are therefore imported only by the children that need them. The fork server itself compiles nothing. A
special child compiles the functions that are not in the cache.
"""

from __future__ import annotations

import gc
import os
import select
import signal
import socket
import sys
import traceback
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Final, NamedTuple, NoReturn

import msgspec
from msgspec import structs

from trirail.processes import compiling
from trirail.processes.child_process import Child, run
from trirail.processes.heartbeats import Heartbeats
from trirail.processes.order import Order
from trirail.processes.realtime import die_with_parent, name_process
from trirail.wire.decoding import decoded, prepare

MATHEMATICS = ("loop", "drives", "planner")
"""Processes that need the compiled modules. The other processes do not wait until these modules are imported."""
WITH_PARENT: Final = {"loop": signal.SIGTERM, "drives": signal.SIGTERM, "planner": signal.SIGKILL}
"""Signal that the kernel sends to each child when the fork server ends.

Gateway and recorder receive no signal. They end by themselves after the loop, once the loop's last messages have been
published and written to disk.
"""
SUPERVISOR_SIGNALS: Final = (
    signal.SIGINT,
    signal.SIGQUIT,
    signal.SIGHUP,
    signal.SIGTSTP,
    signal.SIGTTIN,
    signal.SIGTTOU,
    signal.SIGABRT,
)
"""Signals for the supervisor alone. Its children ignore them, and notice the end of the supervisor by themselves.

A terminal sends all but the last to all of its processes: on Ctrl-C, Ctrl-\\ and Ctrl-Z, when it is closed, and when a
process in the background uses it. systemd sends SIGINT to all processes of a service to end it, also when the
supervisor has died, and SIGABRT when the supervisor no longer feeds the watchdog.
"""
RERUN_ENVIRONMENT: Final = {"MIMALLOC_ARENA_EAGER_COMMIT": "0"}
"""Environment for Rerun: its allocator reserves no memory in advance."""
MAX_PACKET_BYTES = 4096
"""Maximum size of a packet on the control socket [bytes]."""


class Fork(msgspec.Struct, frozen=True):
    """Request to fork the child `name`. `number` is unique; `record` and `again` are the same as in Order."""

    number: int
    name: str
    record: str | None = None
    again: bool = False


class ChildStart(msgspec.Struct, frozen=True, tag=True):
    """Report that the child of request `number` has started as process `pid`. The packet also transfers its pidfd."""

    number: int
    pid: int


class ChildEnd(msgspec.Struct, frozen=True, tag=True):
    """Report that the child of request `number` has ended.

    `code` is the exit code of the child, or the negative number of the signal that killed it.
    """

    number: int
    code: int
    reason: str = ""
    """Reason for people, if the child could not be forked."""


prepare(Fork)


class _Request(NamedTuple):
    fork: Fork
    pipe: int
    """Descriptor for the child's messages."""


class ForkServer:
    """Server that forks children on request until the supervisor disconnects."""

    def __init__(self, inherited: Inheritance) -> None:
        self._inherited = inherited
        self._control = inherited.control
        self._requests: list[_Request] = []
        """Requests whose children have not been forked yet."""
        self._children: dict[int, int] = {}
        """Number of the request of each child, by the pidfd of the child."""
        self._compiler: tuple[int, _Request] | None = None
        """Pidfd of the child that compiles, and the request that needs the compilation; None if no child compiles."""
        self._cache_works = True
        """False if compiled code cannot be cached. Each child must then compile the functions for itself."""
        self._poll = select.poll()
        self._poll.register(self._control, select.POLLIN)

    def serve(self, work: Callable[[Child], int]) -> None:
        """Serve requests until the supervisor disconnects. `work` is run in each child, and returns the exit code."""
        while True:
            for descriptor, _ in self._poll.poll():
                if descriptor != self._control.fileno():
                    self._reap(descriptor)
                elif not self._receive():
                    return
            for request in filter(self._can_be_met, list(self._requests)):
                if (forked := self._fork(request, work, WITH_PARENT.get(request.fork.name))) is not None:
                    pidfd, pid = forked
                    self._children[pidfd] = request.fork.number
                    self._send(ChildStart(request.fork.number, pid), pidfd)
                    self._done(request)

    def _receive(self) -> bool:
        """Receive a request. Return False if the supervisor has disconnected."""
        try:
            packet, descriptors, _, _ = socket.recv_fds(self._control, MAX_PACKET_BYTES, 1)
        except ConnectionError:
            return False
        if packet:
            self._requests.append(_Request(decoded(packet, Fork), *descriptors))
        return bool(packet)

    def _can_be_met(self, request: _Request) -> bool:
        """Return True if the child can be forked now. Otherwise, start the compilation, for which it must wait."""
        if request.fork.name not in MATHEMATICS or not self._cache_works:
            return True
        if self._compiler is None and not compiling.load():
            if (forked := self._fork(request, _compile, signal.SIGKILL)) is not None:
                self._compiler = forked[0], request
            return False
        return self._compiler is None

    def _done(self, request: _Request) -> None:
        self._requests.remove(request)
        os.close(request.pipe)

    def _fork(
        self, request: _Request, work: Callable[[Child], int], with_parent: signal.Signals | None
    ) -> tuple[int, int] | None:
        """Fork a child; return its pidfd and its process id. If that fails, report the end of the child; return None.

        If `with_parent` is given, the kernel sends this signal to the child when the fork server ends.
        """
        parent = os.getpid()
        gc.freeze()  # otherwise, a child's garbage collector would write to shared memory pages, and thereby copy them
        try:
            pid = os.fork()
        except OSError as error:
            self._on_failure(request, error)
            return None
        if pid == 0:
            if with_parent is not None:
                die_with_parent(with_parent)
            if os.getppid() != parent:
                os._exit(0)
            self._become(request, work)
        try:
            pidfd = os.pidfd_open(pid)
        except OSError as error:
            os.kill(pid, signal.SIGKILL)
            os.waitpid(pid, 0)
            self._on_failure(request, error)
            return None
        self._poll.register(pidfd, select.POLLIN)
        return pidfd, pid

    def _on_failure(self, request: _Request, error: OSError) -> None:
        """Report that a child could not be forked. The supervisor may request it again."""
        self._done(request)  # closes the pipe, which a child that has ended has closed too
        self._send(ChildEnd(request.fork.number, os.EX_OSERR, f"the system starts no process: {error.strerror}"))

    def _become(self, request: _Request, work: Callable[[Child], int]) -> NoReturn:
        """Run the child's work in the forked process, after closing the descriptors of the other children."""
        code = 1
        try:
            name = request.fork.name
            name_process(name if work is not _compile else "compiler")
            self._control.close()
            others = [waiting.pipe for waiting in self._requests if waiting is not request]
            for descriptor in (*self._children, *others, *([] if name == "loop" else self._inherited.sockets)):
                os.close(descriptor)
            gc.enable()
            signal.pthread_sigmask(signal.SIG_SETMASK, [])
            _, order, runtime, heartbeats, sockets = self._inherited
            order = structs.replace(order, record=request.fork.record, again=request.fork.again)
            code = work(Child(name, order, runtime, heartbeats, sockets, request.pipe))
        except BaseException:  # noqa: BLE001 - the child must never return into the parent's code
            traceback.print_exc()
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(code)

    def _reap(self, pidfd: int) -> None:
        ended = os.waitid(os.P_PIDFD, pidfd, os.WEXITED)
        code = 0 if ended is None else ended.si_status if ended.si_code == os.CLD_EXITED else -ended.si_status
        self._poll.unregister(pidfd)
        os.close(pidfd)
        if self._compiler is None or pidfd != self._compiler[0]:
            self._send(ChildEnd(self._children.pop(pidfd), code))
            return
        (_, request), self._compiler = self._compiler, None
        if code == 0:
            self._cache_works = compiling.load()
        else:
            self._send(ChildEnd(request.fork.number, code))
            self._done(request)

    def _send(self, what: ChildStart | ChildEnd, *descriptors: int) -> None:
        try:
            socket.send_fds(self._control, [msgspec.json.encode(what)], descriptors)
        except ConnectionError:
            return  # the supervisor has disconnected, which the next read from the socket will show


def _compile(child: Child) -> int:
    compiling.compile_all(child.report_compiling)
    return 0


class Inheritance(NamedTuple):
    """Objects that the fork server inherits from the supervisor."""

    control: socket.socket
    order: Order
    runtime: Path
    heartbeats: Heartbeats
    sockets: list[int]
    """Sockets on which the loop listens."""


def serve(inheritance: Inheritance, work: Callable[[Child], int] = run) -> None:
    """Run the fork server until the supervisor disconnects."""
    name_process("fork-server")
    die_with_parent(signal.SIGKILL)
    # A SIGTERM stays pending until a child unblocks it.
    for number in SUPERVISOR_SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_SETMASK, [signal.SIGTERM])
    os.environ.update(RERUN_ENVIRONMENT)
    gc.disable()
    ForkServer(inheritance).serve(work)


def fork(inheritance: Inheritance) -> int:
    """Fork the fork server; return its process id. The calling process must have a single thread."""
    supervisor = os.getpid()
    gc.collect()
    gc.freeze()  # garbage collection in either process would write to shared memory pages, and thereby copy them
    sys.stdout.flush()
    sys.stderr.flush()
    pid = os.fork()
    if pid:
        return pid
    code = 1
    try:
        signal.set_wakeup_fd(-1)
        _keep(inheritance.control.fileno(), inheritance.heartbeats.descriptor, *inheritance.sockets)
        if not sys.flags.safe_path:
            del sys.path[0]  # prevent imports from the current folder
        if os.getppid() == supervisor:
            serve(inheritance)
        code = 0
    except BaseException:  # noqa: BLE001 - the child must never return into the supervisor's code
        traceback.print_exc()
    finally:
        os._exit(code)


def _keep(*descriptors: int) -> None:
    """Close all descriptors except `descriptors` and the standard streams; connect standard input to /dev/null."""
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    for entry in os.listdir("/proc/self/fd"):
        if int(entry) not in (0, 1, 2, *descriptors):
            with suppress(OSError):  # the descriptor with which the folder was listed is already closed
                os.close(int(entry))
