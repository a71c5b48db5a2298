"""The fork server: imports the modules that the service's processes need, once, and forks them from itself.

It is forked itself, from the supervisor before that has a thread, so that shared modules are in memory once. On its
control, a SEQPACKET socket, it receives requests to fork (`Fork`, with the descriptor for the child's messages) and
reports each fork (`Forked`, with a pidfd) and its end (`Ended`). It has no thread, so that a fork is a whole process:
Zenoh and Rerun, which have, are imported by the child that needs them. It compiles nothing: a child compiles
functions that are not cached.
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
"""Processes that need the compiled rooms or their imports; the others are forked before these are imported."""
WITH_PARENT: Final = {"loop": signal.SIGTERM, "drives": signal.SIGTERM, "planner": signal.SIGKILL}
"""Signal that ends a child when this process ends, in any way. Gateway and recorder end by themselves once the loop has
gone, so that its last messages are published and on disk; so do drives that it has, for it stops them first."""
OF_TERMINAL: Final = (signal.SIGINT, signal.SIGHUP)
"""Signals of a terminal to all of its processes: Ctrl-C, and its own end."""
AS_NEEDED: Final = {"MIMALLOC_ARENA_EAGER_COMMIT": "0"}
"""Environment in which Rerun's allocator takes memory as it is needed, and not in advance."""
LARGEST = 4096
"""Largest packet on CONTROL [bytes]."""


class Fork(msgspec.Struct, frozen=True):
    """Request to fork the child `name`; `number` is the supervisor's, and unique; see Order."""

    number: int
    name: str
    record: str | None = None
    again: bool = False


class Forked(msgspec.Struct, frozen=True, tag=True):
    """Start of the child of request `number` as process `pid`; its pidfd comes with the packet."""

    number: int
    pid: int


class Ended(msgspec.Struct, frozen=True, tag=True):
    """End of the child of request `number`: its exit code, or the negative number of the signal that killed it."""

    number: int
    code: int


prepare(Fork)


class _Request(NamedTuple):
    fork: Fork
    voice: int
    """Descriptor for the child's messages."""


class ForkServer:
    """Server that forks on request until the supervisor has gone; `work` runs a child, and returns its exit code."""

    def __init__(self, inherited: Inheritance) -> None:
        self._inherited = inherited
        self._control = inherited.control
        self._requests: list[_Request] = []
        """Requests whose child has not been forked yet."""
        self._children: dict[int, int] = {}
        """Request number of each child, by its pidfd."""
        self._compiler: tuple[int, _Request] | None = None
        """Pidfd of the compiling child, if any, and the request for which it compiles."""
        self._kept = True
        """False if compiled code cannot be cached: then each child that needs it compiles for itself."""
        self._poll = select.poll()
        self._poll.register(self._control, select.POLLIN)

    def serve(self, work: Callable[[Child], int]) -> None:
        """Serve until the supervisor has gone."""
        while True:
            for descriptor, _ in self._poll.poll():
                if descriptor != self._control.fileno():
                    self._reap(descriptor)
                elif not self._receive():
                    return
            for request in filter(self._can_be_met, list(self._requests)):
                pidfd, pid = self._fork(request, work, WITH_PARENT.get(request.fork.name))
                self._children[pidfd] = request.fork.number
                self._say(Forked(request.fork.number, pid), pidfd)
                self._done(request)

    def _receive(self) -> bool:
        """Receive a request; return False if there will be no more."""
        try:
            packet, descriptors, _, _ = socket.recv_fds(self._control, LARGEST, 1)
        except ConnectionError:
            return False
        if packet:
            self._requests.append(_Request(decoded(packet, Fork), *descriptors))
        return bool(packet)

    def _can_be_met(self, request: _Request) -> bool:
        """Return whether the child can be forked now: one that needs the compiled rooms waits for their compilation."""
        if request.fork.name not in MATHEMATICS or not self._kept:
            return True
        if self._compiler is None and not compiling.load():
            pidfd, _ = self._fork(request, _compile, signal.SIGKILL)
            self._compiler = pidfd, request
        return self._compiler is None

    def _done(self, request: _Request) -> None:
        self._requests.remove(request)
        os.close(request.voice)

    def _fork(
        self, request: _Request, work: Callable[[Child], int], with_parent: signal.Signals | None
    ) -> tuple[int, int]:
        """Return pidfd and process id of a new child; `with_parent` is sent to it at the end of this process."""
        parent = os.getpid()
        gc.freeze()  # a child's collector would touch, and so copy, memory shared with this process
        pid = os.fork()
        if pid == 0:
            if with_parent is not None:
                die_with_parent(with_parent)
            if os.getppid() != parent:
                os._exit(0)
            self._become(request, work)
        pidfd = os.pidfd_open(pid)
        self._poll.register(pidfd, select.POLLIN)
        return pidfd, pid

    def _become(self, request: _Request, work: Callable[[Child], int]) -> NoReturn:
        """Run as the child, with its own descriptors alone."""
        code = 1
        try:
            name = request.fork.name
            name_process(name if work is not _compile else "compiler")
            self._control.close()
            others = [waiting.voice for waiting in self._requests if waiting is not request]
            for descriptor in (*self._children, *others, *([] if name == "loop" else self._inherited.sockets)):
                os.close(descriptor)
            gc.enable()
            signal.pthread_sigmask(signal.SIG_SETMASK, [])
            _, order, runtime, heartbeats, sockets = self._inherited
            order = structs.replace(order, record=request.fork.record, again=request.fork.again)
            code = work(Child(name, order, runtime, heartbeats, sockets, request.voice))
        except BaseException:  # noqa: BLE001 - nothing of this process may return into that of the parent
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
            self._say(Ended(self._children.pop(pidfd), code))
            return
        (_, request), self._compiler = self._compiler, None
        if code == 0:
            self._kept = compiling.load()
        else:
            self._say(Ended(request.fork.number, code))
            self._done(request)

    def _say(self, what: Forked | Ended, *descriptors: int) -> None:
        try:
            socket.send_fds(self._control, [msgspec.json.encode(what)], descriptors)
        except ConnectionError:
            return  # the supervisor has gone, as the next read of the socket finds


def _compile(child: Child) -> int:
    compiling.compile_all(child.compiling)
    return 0


class Inheritance(NamedTuple):
    """Objects that the fork server has from the supervisor."""

    control: socket.socket
    order: Order
    runtime: Path
    heartbeats: Heartbeats
    sockets: list[int]
    """Sockets that the loop listens on."""


def serve(inheritance: Inheritance, work: Callable[[Child], int] = run) -> None:
    """Run the fork server until the supervisor has gone."""
    name_process("fork-server")
    die_with_parent(signal.SIGKILL)
    # The supervisor alone acts on what a terminal sends; SIGTERM waits for the child that unblocks it.
    for number in OF_TERMINAL:
        signal.signal(number, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_SETMASK, [signal.SIGTERM])
    os.environ.update(AS_NEEDED)
    gc.disable()
    ForkServer(inheritance).serve(work)


def fork(inheritance: Inheritance) -> int:
    """Return the process id of a new fork server. This process may have no other thread."""
    supervisor = os.getpid()
    gc.collect()
    gc.freeze()  # either's collector would touch, and so copy, shared memory
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
            del sys.path[0]  # files in the current folder must not be imported
        if os.getppid() == supervisor:
            serve(inheritance)
        code = 0
    except BaseException:  # noqa: BLE001 - nothing of this process may return into the supervisor
        traceback.print_exc()
    finally:
        os._exit(code)


def _keep(*descriptors: int) -> None:
    """Close all descriptors but these and the standard ones, of which the input is empty."""
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    for entry in os.listdir("/proc/self/fd"):
        if int(entry) not in (0, 1, 2, *descriptors):
            with suppress(OSError):  # that of the listing itself
                os.close(int(entry))
