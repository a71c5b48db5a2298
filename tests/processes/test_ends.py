"""Processes of a service that freeze, or that somebody ends: what clients, log, exit code and recording say of it."""

from __future__ import annotations

import contextlib
import os
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import pytest
from processes.test_service import (
    END_WITHIN,
    UP_WITHIN,
    ColdService,
    Process,
    Service,
    again,
    assert_stopped_smoothly,
    in_motion,
    planned_again,
    service,
    until,
)
from processes.test_service import told as told_by
from trirail.client import own_service
from trirail.processes.supervisor import CHILDREN_WITH_DRIVES
from trirail.telemetry.reading import read
from trirail.telemetry.recording import Recording
from trirail.wire.messages import Event
from trirail.wire.vocabulary import MODES, Mode
from waiting import WITHIN

__all__ = ["service"]

pytestmark = pytest.mark.slow


def recording(service: Service) -> Recording:
    """The session's only recording."""
    (file,) = (file for file in (service.folder / "recordings").glob("*.rrd") if not file.name.startswith("fault-"))
    return read(file)


def events(recorded: Recording) -> list[Event]:
    return [line.event for line in recorded.events if line.event is not None]


def outcomes(recorded: Recording) -> list[tuple[str | None, str | None]]:
    return [(event.id, event.outcome) for event in events(recorded) if event.outcome is not None]


def test_a_frozen_gateway_is_a_controlled_stop_and_is_replaced(tmp_path: Path) -> None:
    usual = "gateway_timeout = 0.3"  # so that the loop is the first to notice
    with Service(tmp_path, **{usual: usual}) as service:
        service.wait_up()
        frozen_and_replaced(service)


def frozen_and_replaced(service: Service) -> None:
    with service.robot() as robot:
        in_motion(robot)
        os.kill(service.child("gateway"), signal.SIGSTOP)
        service.wait_said("the gateway has died (no sign of life for 0.7 s, so it was killed)")
    with again(service) as robot:
        state = until(robot, lambda state: state.mode == "holding")
        assert 0.0 < state.pose[0] < 0.09
        assert robot.move_to(x=0.0, y=0.0, phi=0.0).wait(WITHIN).outcome == "done"
        robot.disable()
    assert service.end() == 0
    assert_stopped_smoothly(service)
    recorded = recording(service)
    assert ("long", "stopped") in outcomes(recorded)
    assert any("the gateway is frozen, without a sign of life for 0.3 s" in event.message for event in events(recorded))


def test_a_frozen_recorder_is_replaced_and_the_robot_does_not_mind(service: Service) -> None:
    with service.robot() as robot:
        in_motion(robot, speed=0.2)
        os.kill(service.child("recorder"), signal.SIGSTOP)
        service.wait_said(
            "the recorder has died (no sign of life for 5 s, so it was killed): the robot is not affected"
        )
        state = until(robot, lambda state: state.mode == "holding")
        assert state.pose[0] == pytest.approx(0.1, abs=1e-5)
        told_by(robot, lambda heard: sum(event.message.startswith("recording to") for event in heard) == 2)
        robot.move_to(x=0.0, y=0.0, phi=0.0, id="afterwards").wait(WITHIN)
    assert service.end() == 0
    newest = max((service.folder / "recordings").glob("*.rrd"), key=lambda path: path.stat().st_mtime)
    assert {("long", "done"), ("afterwards", "done")} <= set(outcomes(read(newest)))


def test_a_frozen_loop_ends_the_service_and_everyone_is_told(service: Service) -> None:
    with service.robot() as robot:
        in_motion(robot)
        told = robot.events(history=True, timeout=WITHIN)
        heard = [next(told)]
        os.kill(service.child("loop"), signal.SIGSTOP)
        for event in told:
            heard.append(event)
            if event.mode == "fault":
                break
    assert service.process.wait(END_WITHIN) == 1
    assert "the loop has died (no sign of life for 0.7 s, so it was killed): the drives stop" in service.log.read_text()
    assert "frozen" in heard[-1].message
    assert [(event.id, event.outcome) for event in heard if event.outcome] == [("long", "faulted")]
    recorded = recording(service)
    assert outcomes(recorded) == [("long", "faulted")]
    assert [event.seq for event in events(recorded)] == list(range(1, len(events(recorded)) + 1))


def test_the_state_says_that_the_loop_has_died(service: Service) -> None:
    with service.robot() as robot:
        in_motion(robot)
        states = robot.states(WITHIN)
        next(states)  # who asks only when it has died may be too late
        os.kill(service.child("loop"), signal.SIGKILL)
        died = next(state for state in states if state.mode == "fault")
    assert died.faults == ("the loop has died: the drives stop by their own watchdogs",)
    assert service.process.wait(END_WITHIN) == 1


def test_sigterm_to_the_loop_alone_is_told_as_what_it_is(service: Service) -> None:
    with service.robot() as robot:
        in_motion(robot)
        os.kill(service.child("loop"), signal.SIGTERM)
        assert service.process.wait(END_WITHIN) == 1
    said = (
        "the loop has died (another process sent it SIGTERM): the loop has stopped the robot and disabled the drives; "
        "the service ends"
    )
    assert said in service.log.read_text()
    assert_stopped_smoothly(service)
    recorded = recording(service)
    assert outcomes(recorded) == [("long", "stopped")]
    assert MODES[recorded.records["mode"][-1]] is Mode.DISABLED


def test_sigterm_to_the_gateway_alone_is_told_as_what_it_is(service: Service) -> None:
    with service.robot() as robot:
        robot.enable()
    os.kill(service.child("gateway"), signal.SIGTERM)
    service.wait_said("the gateway has died (another process sent it SIGTERM): the loop stops the robot and holds")
    with again(service) as robot:
        until(robot, lambda state: state.mode == "holding")


@pytest.mark.parametrize("name", ["supervisor", "fork-server"])
def test_a_killed_parent_leaves_nobody_and_a_complete_recording(name: str, service: Service) -> None:
    """The loop stops the robot; the recorder outlives it, to have what it said of that."""
    with service.robot() as robot:
        in_motion(robot)
        processes = service.processes()
        assert "drives" in processes
        os.kill(processes.pop(name), signal.SIGKILL)
        for process in processes.values():
            wait_gone(process)
    if name == "fork-server":
        assert service.process.wait(END_WITHIN) == 1
        assert "the process that starts the others has died (killed by SIGKILL)" in service.log.read_text()
    assert_stopped_smoothly(service)
    recorded = recording(service)
    assert outcomes(recorded) == [("long", "stopped")]
    assert MODES[recorded.records["mode"][-1]] is Mode.DISABLED


def test_a_log_that_nobody_reads_neither_keeps_a_process_from_its_restart_nor_the_robot_from_its_stop(
    tmp_path: Path,
) -> None:
    with BlockedService(tmp_path) as service:
        service.block()
        with again(service) as robot:
            robot.enable()
            os.kill(service.child("planner"), signal.SIGKILL)
            planned_again(robot)
            in_motion(robot)
            service.process.send_signal(signal.SIGTERM)
            assert service.process.wait(END_WITHIN) == 0
    assert_stopped_smoothly(service)


class BlockedService(Service):
    """One whose output goes to a pipe."""

    def start(self, path: Path, log: IO[bytes]) -> Process:
        """Start it, with the pipe."""
        self._reader, writer = os.pipe()
        with open(writer, "wb") as output:
            return super().start(path, output)

    def block(self) -> None:
        """Let it come up, and then fill the pipe, which nobody reads any more."""
        read = b""
        while b"up  robot" not in read:
            read += os.read(self._reader, 65_536)
        writer = os.open(f"/proc/self/fd/{self._reader}", os.O_WRONLY | os.O_NONBLOCK)
        with contextlib.suppress(BlockingIOError):
            while True:
                os.write(writer, bytes(65_536))
        os.close(writer)

    def __exit__(self, *of: object) -> None:
        if self.process.poll() is None:
            self.process.kill()
        super().__exit__(*of)
        os.close(self._reader)


def wait_gone(process: int) -> None:
    """Wait for the end of a process that is nobody's child here."""
    with contextlib.suppress(ProcessLookupError):
        descriptor = os.pidfd_open(process)
        ended, _, _ = select.select([descriptor], [], [], END_WITHIN)
        os.close(descriptor)
        assert ended


@pytest.fixture
def told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[socket.socket]:
    """A socket as systemd has it, for a service with a watchdog of 1 s."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        listening.bind(str(tmp_path / "notify"))
        listening.settimeout(UP_WITHIN)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        monkeypatch.setenv("WATCHDOG_USEC", "1000000")
        monkeypatch.delenv("WATCHDOG_PID", raising=False)
        yield listening


def test_the_watchdog_is_fed_while_loop_and_gateway_are_alive(told: socket.socket, tmp_path: Path) -> None:
    with Service(tmp_path) as service:
        while told.recv(100) != b"READY=1":
            pass
        for _ in range(5):
            assert told.recv(100) == b"WATCHDOG=1"
        os.kill(service.child("gateway"), signal.SIGSTOP)
        service.wait_said("the gateway has died")
        told.setblocking(False)
        with contextlib.suppress(BlockingIOError):
            while told.recv(100):  # what was sent before
                pass
        told.settimeout(UP_WITHIN)
        assert told.recv(100) == b"WATCHDOG=1"  # it is back
        assert service.end() == 0


def test_nothing_is_imported_from_the_folder_it_is_started_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "poisoned"
    folder.mkdir()
    for name in ("msgspec", "numpy", "zenoh", "rerun", "trirail", "signal"):
        (folder / f"{name}.py").write_text(f"open('{folder}/run', 'a').write('{name}')\nraise SystemExit(9)\n")
    monkeypatch.chdir(folder)
    with ColdService(tmp_path) as service:
        service.wait_up()
        assert service.end() == 0
        assert not (folder / "run").exists()


def test_the_fork_server_has_of_the_supervisors_descriptors_those_it_hands_on_alone(service: Service) -> None:
    """An end that another process holds as well is not seen to end; and a listener stays."""
    folder = f"/proc/{service.child('fork-server')}/fd"
    has = [os.readlink(f"{folder}/{number}") for number in sorted(map(int, os.listdir(folder)))]
    assert has[0] == os.devnull
    kinds = [target.partition(":")[0] if ":[" in target else target for target in has[3:]]
    ports_and_control = 4
    assert sorted(kinds) == sorted(
        ["socket"] * ports_and_control
        + ["/memfd:trirail-heartbeats (deleted)"]
        + ["anon_inode"] * len(CHILDREN_WITH_DRIVES)
    )


def test_a_private_service_ends_with_the_program_that_has_started_it_however_that_ends(tmp_path: Path) -> None:
    """A program that is killed cannot end what it has started."""
    config, locator = own_service.private(tmp_path)
    code = (
        "import os, signal, sys\n"
        "from pathlib import Path\n"
        "from trirail.client import own_service\n"
        "from trirail.client.client import Robot\n"
        f"process = own_service.start(Path({str(config)!r}), open({str(tmp_path / 'log')!r}, 'wb'))\n"
        f"with Robot('demo', {locator!r}) as robot:\n"
        "    robot.enable()\n"
        "print(process.pid, flush=True)\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, check=False)
    assert done.returncode == -signal.SIGKILL
    supervisor = Path(f"/proc/{int(done.stdout)}")
    deadline = time.monotonic() + WITHIN
    while supervisor.exists():
        assert time.monotonic() < deadline
        time.sleep(0.05)
    log = (tmp_path / "log").read_text()
    assert "the program that started this service has ended: stopping the robot and disabling the drives" in log
