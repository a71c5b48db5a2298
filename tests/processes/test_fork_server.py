"""The fork server: what a child has of it, what is compiled where, and who ends with whom."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import servers
from trirail.config import SIM, load
from trirail.processes import forked_processes
from trirail.processes.forked_processes import EXIT_CODE_UNKNOWN, ChildProcess, ForkServerLink
from trirail.processes.heartbeats import Heartbeats
from trirail.processes.order import Order
from trirail.wire import links
from waiting import WITHIN

SERVER = """
import errno, json, os, signal, sys, threading, time
from pathlib import Path
from typing import Any
from trirail.processes import compiling, fork_server

folder = Path({folder!r})
server = os.getpid()

def load():
    if (folder / "importing").exists():
        time.sleep(1.5)
    return (folder / "kept").exists()

def compile_all(begin):
    begin("first")
    begin("second")
    exec((folder / "compiler").read_text())

def target(entry):
    try:
        return os.readlink(f"/proc/self/fd/{{entry}}")
    except OSError:
        return "/proc/"  # that of the listing itself

def work(child):
    child.report_ready({{
        "named": Path("/proc/self/cmdline").read_bytes().strip(b"\\0").decode(),
        "record": child.order.record,
        "descriptors": {{entry: target(entry) for entry in os.listdir("/proc/self/fd")}},
        "threads": threading.active_count() + len(os.listdir(f"/proc/{{os.getppid()}}/task")) - 1,
        "blocked": [int(number) for number in signal.pthread_sigmask(signal.SIG_BLOCK, [])],
        "handled": signal.getsignal(signal.SIGTERM) is signal.SIG_DFL,
    }})
    while os.getppid() == server:  # gateway and recorder end by the loop alone, which there is none of
        time.sleep(0.05)
        if (folder / child.name).exists():
            exec((folder / child.name).read_text())

def failing(name):
    call = getattr(os, name)

    def failed(*arguments):
        if (folder / f"no-{{name}}").exists():
            raise BlockingIOError(errno.EAGAIN, "no more processes")
        return call(*arguments)

    setattr(os, name, failed)

failing("fork")
failing("pidfd_open")
compiling.load, compiling.compile_all = load, compile_all
"""


class Parent:
    """A fork server whose children say what they see, and do what is then written in a file of their name."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.listening = [links.listen(folder / f"port-{number}") for number in range(3)]
        self.heartbeats = Heartbeats.create()
        sockets = [listening.fileno() for listening in self.listening]
        self.children: list[ChildProcess] = []
        self.warm = ForkServerLink(Order(load(SIM), None), folder, self.heartbeats, sockets)

    @property
    def server(self) -> subprocess.Popen[bytes]:
        process: Any = self.warm._process
        assert isinstance(process, subprocess.Popen)
        return process

    def child(self, name: str, record: str | None = None) -> ChildProcess:
        self.children.append(ChildProcess(self.warm, name, record))
        return self.children[-1]

    def until_said(self, child: ChildProcess) -> dict[str, object]:
        """Wait until a child is up, and return what it said."""
        watched: list[Any] = [child.pipe, self.warm]
        deadline = time.monotonic() + WITHIN
        while child.ready_message is None or child.pid is None:
            heard, _, _ = select.select(watched, [], [], deadline - time.monotonic())
            assert heard
            self.warm.receive()
            if child.pipe in heard and not child.read_messages():
                break
        assert child.ready_message is not None
        return child.ready_message

    def until_over(self, child: ChildProcess) -> str:
        """Wait until a child has ended, and return how."""
        assert child.wait(time.monotonic() + WITHIN)
        return child.end_description


@pytest.fixture
def parent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Parent]:
    (tmp_path / "kept").touch()
    for times in ("END_REPORT_TIMEOUT_S", "IMPORT_TIMEOUT_S"):  # of a busy machine
        monkeypatch.setattr(forked_processes, times, WITHIN)
    monkeypatch.setattr(forked_processes, "ServerProcess", servers.doing(SERVER.format(folder=str(tmp_path)), tmp_path))
    made = Parent(tmp_path)
    try:
        yield made
    finally:
        made.warm.close()
        made.heartbeats.close()
        for child in made.children:
            os.close(child.pipe)
        for listening in made.listening:
            listening.close()


def test_a_child_has_its_own_descriptors_its_name_and_no_signal_blocked(parent: Parent) -> None:
    """Whoever held another's end of a pipe would keep its end from being seen."""
    children = {
        name: parent.child(name, "a.rrd" if name == "recorder" else None)
        for name in ("gateway", "recorder", "loop", "drives", "planner")
    }
    ports = {os.readlink(f"/proc/self/fd/{listening.fileno()}") for listening in parent.listening}
    shared = os.readlink(f"/proc/self/fd/{parent.heartbeats.descriptor}")
    for name, child in children.items():
        said = parent.until_said(child)
        descriptors = {str(what) for number, what in said["descriptors"].items() if int(number) > 2}  # type: ignore[attr-defined]
        own = os.readlink(f"/proc/self/fd/{child.pipe}")
        allowed = {own, shared} | (ports if name == "loop" else set())
        assert {what for what in descriptors if not what.startswith("/proc/")} == allowed
        assert said["named"] == f"trirail: {name}"
        assert said["record"] == ("a.rrd" if name == "recorder" else None)
        assert (said["threads"], said["blocked"], said["handled"]) == (1, [], True)


@pytest.mark.parametrize(
    ("does", "how"),
    [
        ("os._exit(7)", "exit code 7"),
        ("os.kill(os.getpid(), signal.SIGSEGV)", "killed by SIGSEGV"),
        ("1 / 0", "exit code 1"),
    ],
)
def test_how_a_child_ends_is_told_and_another_takes_its_place(does: str, how: str, parent: Parent) -> None:
    first = parent.child("gateway")
    parent.until_said(first)
    (parent.folder / "gateway").write_text(does)
    assert parent.until_over(first) == how
    (parent.folder / "gateway").unlink()
    second = parent.child("gateway")
    parent.until_said(second)
    assert second.pid != first.pid


@pytest.mark.parametrize("call", ["fork", "pidfd_open"])
@pytest.mark.parametrize("name", ["gateway", "loop"])
@pytest.mark.parametrize("kept", [True, False])
def test_a_child_that_cannot_be_forked_is_told_with_the_reason_and_another_can(
    call: str, name: str, kept: bool, parent: Parent
) -> None:
    """Also where what fails is the fork of the compiler."""
    if not kept:
        (parent.folder / "kept").unlink()
        (parent.folder / "compiler").write_text("(folder / 'kept').touch()")
    (parent.folder / f"no-{call}").touch()
    child = parent.child(name)
    assert parent.until_over(child) == "the system starts no process: no more processes"
    while os.read(child.pipe, 4096):  # a child may send something before it is killed; the pipe is closed afterwards
        pass
    server = parent.server.pid
    assert Path(f"/proc/{server}/task/{server}/children").read_text() == ""
    (parent.folder / f"no-{call}").unlink()
    parent.until_said(parent.child(name))


def test_a_signal_that_comes_before_a_child_handles_it_is_not_lost(parent: Parent) -> None:
    child = parent.child("gateway")
    while child.pid is None:
        select.select([parent.warm], [], [], WITHIN)
        parent.warm.receive()
    child.send_signal(signal.SIGTERM)
    assert parent.until_over(child) == "killed by SIGTERM"


def test_a_child_that_has_not_been_forked_can_be_killed(parent: Parent) -> None:
    child = parent.child("loop")
    child.kill()
    assert child.wait(time.monotonic())
    assert child.returncode == 0
    other = parent.child("gateway")
    parent.until_said(other)  # so the loop has been forked, and been killed
    assert child.pid is not None


def test_what_is_not_kept_is_compiled_by_a_child_before_who_needs_it_is_forked(parent: Parent) -> None:
    (parent.folder / "kept").unlink()
    (parent.folder / "compiler").write_text(
        "while not (folder / 'go').exists(): time.sleep(0.01)\n(folder / 'kept').touch()"
    )
    loop, planner, gateway = (parent.child(name) for name in ("loop", "planner", "gateway"))
    parent.until_said(gateway)  # who needs nothing compiled does not wait
    (parent.folder / "go").touch()
    parent.until_said(loop)
    parent.until_said(planner)
    assert (loop.compiling, planner.compiling) == (["first", "second"], [])


def test_where_nothing_can_be_kept_each_compiles_for_itself(parent: Parent) -> None:
    (parent.folder / "kept").unlink()
    (parent.folder / "compiler").write_text("")
    loop, planner = parent.child("loop"), parent.child("planner")
    assert [parent.until_said(child)["named"] for child in (loop, planner)] == ["trirail: loop", "trirail: planner"]
    assert loop.compiling + planner.compiling == ["first", "second"]  # by one compiler, and no second one


def test_a_compiler_that_dies_is_the_end_of_who_needs_it(parent: Parent) -> None:
    (parent.folder / "kept").unlink()
    (parent.folder / "compiler").write_text("os.kill(os.getpid(), signal.SIGKILL)")
    loop = parent.child("loop")
    assert parent.until_over(loop) == "killed by SIGKILL"
    assert loop.ready_message is None


@pytest.mark.parametrize("name", ["loop", "drives", "planner"])
def test_loop_drives_and_planner_end_with_their_parent(name: str, parent: Parent) -> None:
    child = parent.child(name)
    parent.until_said(child)
    assert child.pid is not None
    pidfd = os.pidfd_open(child.pid)
    parent.warm.close()
    ended, _, _ = select.select([pidfd], [], [], WITHIN)
    os.close(pidfd)
    assert ended


def test_a_dead_parent_is_told_and_so_are_its_children(parent: Parent) -> None:
    child = parent.child("planner")
    parent.until_said(child)
    (parent.folder / "planner").write_text("os.kill(os.getppid(), signal.SIGKILL)")
    assert parent.until_over(child) == "exit code unknown"
    assert parent.warm.gone
    assert parent.warm.describe_end() == "killed by SIGKILL"
    assert parent.child("gateway").returncode == EXIT_CODE_UNKNOWN


@pytest.mark.long
def test_how_a_child_ended_is_told_also_where_its_parent_is_importing(parent: Parent) -> None:
    gateway = parent.child("gateway")
    parent.until_said(gateway)
    (parent.folder / "importing").touch()
    parent.child("loop")
    (parent.folder / "gateway").write_text("os._exit(7)")
    assert parent.until_over(gateway) == "exit code 7"


def test_a_frozen_parent_is_waited_for_once(parent: Parent, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(forked_processes, "END_REPORT_TIMEOUT_S", 1.0)
    children = [parent.child(name) for name in ("planner", "gateway", "recorder")]
    for child in children:
        parent.until_said(child)
    (parent.folder / "planner").write_text("os.kill(os.getppid(), signal.SIGSTOP); os._exit(1)")
    assert parent.until_over(children[0]) == "exit code unknown"
    assert parent.warm.report_timeout == 0.0
    for child in children[1:]:
        child.kill()
        assert parent.until_over(child) == "exit code unknown"


@pytest.mark.long
def test_a_parent_that_was_late_once_is_waited_for_again(parent: Parent) -> None:
    late = "if os.fork() == 0: time.sleep({}); os.kill(server, signal.SIGCONT); os._exit(0)\n"
    late += "os.kill(server, signal.SIGSTOP); os._exit(7)"
    gateway, recorder = parent.child("gateway"), parent.child("recorder")
    for child in (gateway, recorder):
        parent.until_said(child)
    parent.warm.report_timeout = 0.1
    (parent.folder / "gateway").write_text(late.format(1.0))
    assert parent.until_over(gateway) == "exit code unknown"
    select.select([parent.warm], [], [], WITHIN)
    parent.warm.receive()  # it goes on, and says how the gateway has ended
    assert gateway.returncode == 7
    (parent.folder / "recorder").write_text(late.format(0.3))
    assert parent.until_over(recorder) == "exit code 7"
