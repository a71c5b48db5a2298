"""Whole services in their own processes, as a user runs them: from outside, through Zenoh, signals and files."""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import re
import resource
import selectors
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import IO, Self
from urllib.parse import urlsplit

import edsfiles
import msgspec
import numpy as np
import pytest
import zenoh
from can import CanutilsLogReader, Message
from numpy.typing import NDArray
from refusals import refused_as
from trirail.cli.remote_view import RemoteView
from trirail.client.client import Robot
from trirail.config import SIM, load
from trirail.errors import RefusalCode, RefusedError, ServiceError
from trirail.processes.operating_system import child, processes, python
from trirail.telemetry import provenance
from trirail.telemetry.reading import read
from trirail.wire.goals import OwnLimits
from trirail.wire.messages import Event, GoalReply
from trirail.wire.state import State
from trirail.wire.vocabulary import MODES, Mode
from trirail.wire.zenoh_session import open_client
from trirail_drivers.cia402 import canopen_frames
from trirail_drivers.interface import MissingProtection
from trirail_drivers.odrive import cansimple as odrive_frames
from waiting import WITHIN, wait_until
from warm import WarmProcess, start, trirail

pytestmark = pytest.mark.slow

UP_WITHIN = 100.0
END_WITHIN = WITHIN

Process = WarmProcess | subprocess.Popen[bytes]


class Service:
    """A service in its own process, on sockets and in a folder of its own."""

    def __init__(self, folder: Path, **changes: str) -> None:
        self.folder = folder
        self.locator = f"unixsock-stream/{folder}/zenoh"
        text = SIM.read_text()
        for before, after in {
            'listen = ["tcp/127.0.0.1:7447"]': f'listen = ["{self.locator}"]',
            "live_port = 9876": "live_port = 0\ncapture_can = true",
            "max_overruns = 100 ": "max_overruns = 5000 ",  # a shared machine stalls now and then, all of it or a part
            "missed_syncs = 150": "missed_syncs = 2000",
            "missed_positions = 100 ": "missed_positions = 1000 ",
            "heartbeat = 0.1": "heartbeat = 1.0\nsdo_timeout = 5.0",
            "gateway_timeout = 0.3": "gateway_timeout = 1.0",
            "\nfollowing_error = 0.004": "\nfollowing_error = 0.3",
            "\nfollowing_error = 0.005": "\nfollowing_error = 0.4",
            'directory = "recordings"': f'directory = "{folder}/recordings"',
            **changes,
        }.items():
            assert before in text, before
            text = text.replace(before, after, 1)
        path = folder / "robot.toml"
        path.write_text(text)
        self.log = folder / "service.log"
        with self.log.open("wb") as log:
            self.process = self.start(path, log)

    def start(self, path: Path, log: IO[bytes]) -> Process:
        """Start it, by a fork."""
        return start("run", str(path), output=log)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self.process.poll() is None:  # whatever has failed: it must not disturb the tests to come
            self.process.terminate()
            self.process.wait(END_WITHIN)
        sys.stdout.write(self.log.read_text()[-5000:])  # pytest prints it if the test fails

    def wait_up(self) -> None:
        """Wait until it says that it is up."""
        self.wait_said("up  robot")

    def wait_said(self, words: str) -> None:
        """Wait until its log has these words."""
        deadline = time.monotonic() + UP_WITHIN
        while words not in self.log.read_text():
            if self.process.poll() is not None or time.monotonic() > deadline:
                raise AssertionError(self.log.read_text())
            wait_readable(self.process, 0.1)

    def processes(self) -> dict[str, int]:
        """Process ids of all its processes, by their names."""
        return processes(self.process.pid)

    def child(self, name: str) -> int:
        """Process id of one of its children."""
        return child(self.process.pid, name)

    def end(self, number: int = signal.SIGTERM) -> int:
        """Send a signal and wait for the exit code."""
        self.process.send_signal(number)
        return self.process.wait(END_WITHIN)

    def robot(self) -> Robot:
        return Robot("demo", self.locator, user="ann")

    def frames(self) -> list[tuple[int, bytes]]:
        """Every frame of the session, once it is over: identifier and data, in order."""
        (log,) = (self.folder / "recordings").glob("*.log")
        return [(frame.arbitration_id, bytes(frame.data)) for frame in CanutilsLogReader(log)]


class ColdService(Service):
    """One that is started by its command, with an interpreter of its own."""

    def start(self, path: Path, log: IO[bytes]) -> Process:
        """Start it, as a user does."""
        return subprocess.Popen(python("-m", "trirail", "run", str(path)), stdout=log, stderr=log)


def wait_readable(process: Process, seconds: float) -> None:
    """Wait for a process to end, for so long at most."""
    pidfd = os.pidfd_open(process.pid)
    with selectors.DefaultSelector() as selector:
        selector.register(pidfd, selectors.EVENT_READ)
        selector.select(seconds)
    os.close(pidfd)


def until(robot: Robot, condition: Callable[[State], bool]) -> State:
    """Return the first state for which something holds."""
    deadline = time.monotonic() + WITHIN
    for state in robot.states(WITHIN):
        if condition(state):
            return state
        assert time.monotonic() < deadline, state
    raise AssertionError("the service no longer sends its state")


def told(robot: Robot, enough: Callable[[list[Event]], bool]) -> list[Event]:
    """Return the events so far, as soon as they are enough."""
    heard: list[Event] = []
    for event in robot.events(history=True, timeout=WITHIN):
        heard.append(event)
        if enough(heard):
            return heard
    raise AssertionError(heard)


LOST_AFTER_S = 0.01
"""Time between setpoints in a recording from which cycles of a period of 1 ms may be missing [s]."""
SLOWLY = 0.02
"""Of full speed: whatever is done next is done in motion, on a busy machine as well."""


def in_motion(robot: Robot, speed: float = SLOWLY) -> None:
    """Have it on the way to x = 0.1 m."""
    robot.enable()
    robot.move_to(x=0.1, y=0.02, phi=0.3, speed=speed, id="long")
    until(robot, lambda state: state.goal is not None and state.goal.progress > 0.02)


def positions(sent: list[tuple[int, bytes]], node: int) -> NDArray[np.float64]:
    """Setpoints that a drive was sent [m]."""
    counts = [
        canopen_frames.SETPOINT.unpack(data)[0]
        for identifier, data in sent
        if identifier == canopen_frames.RPDO2 + node
    ]
    return np.array(counts) / 1e7


def assert_stopped_smoothly(service: Service) -> None:
    """The setpoints on the bus end at standstill, and their differences never jump.

    If the recording lacks cycles because the recorder was too slow, differences across these are not compared.
    """
    incomplete = "(recorder too slow)" in service.log.read_text()
    (log,) = (service.folder / "recordings").glob("*.log")
    for node in (1, 2, 3):
        times, setpoints = setpoints_of(CanutilsLogReader(log), node)
        gaps = np.flatnonzero((np.diff(times) > LOST_AFTER_S) & incomplete) + 1
        for part in np.split(setpoints, gaps):
            acceleration = np.diff(part, 2) / 1e-3**2
            assert np.abs(acceleration).max(initial=0.0) < 15.0 + 0.4  # the limit, and the rounding of three counts
        assert np.ptp(setpoints[-5:]) < 2e-6  # without power the setpoint is what is measured


def setpoints_of(frames: Iterable[Message], node: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return when a drive was sent setpoints [s], and the setpoints [m]."""
    sent = [
        (frame.timestamp, canopen_frames.SETPOINT.unpack(frame.data)[0] / 1e7)
        for frame in frames
        if frame.arbitration_id == canopen_frames.RPDO2 + node
    ]
    times, setpoints = np.array(sent, np.float64).T
    return times, setpoints


def controlwords(sent: list[tuple[int, bytes]], node: int) -> list[int]:
    return [
        int.from_bytes(data[:2], "little") for identifier, data in sent if identifier == canopen_frames.RPDO1 + node
    ]


@pytest.fixture
def service(tmp_path: Path) -> Iterator[Service]:
    with Service(tmp_path) as started:
        started.wait_up()
        yield started


@pytest.fixture
def cold_service(tmp_path: Path) -> Iterator[Service]:
    with ColdService(tmp_path) as started:
        started.wait_up()
        yield started


# ---------------------------------------------------------------------- the way it is meant to be used


@pytest.mark.core
def test_a_session(cold_service: Service) -> None:
    with cold_service.robot() as robot:
        info = robot.info()
        assert info.robot == "demo"
        assert [leg["name"] for leg in info.geometry] == ["A", "B", "C"]
        assert robot.state().mode == "disabled"
        with refused_as(RefusalCode.NOT_ENABLED):
            robot.move_to(x=0.0, y=0.0, phi=0.1)
        robot.enable()
        goal = robot.move_to(x=0.02, y=-0.01, phi=0.1, id="g1")
        assert goal.wait(WITHIN).outcome == "done"
        state = until(robot, lambda state: state.mode == "holding")
        assert state.pose == pytest.approx((0.02, -0.01, 0.1), abs=1e-5)
        first = robot.move_to(x=0.1, y=0.0, phi=0.0, speed=SLOWLY)
        second = robot.move_to(x=0.0, y=0.0, phi=0.0)
        assert first.wait(WITHIN).outcome == "preempted"
        assert second.wait(WITHIN).outcome == "done"
        robot.disable()
        until(robot, lambda state: state.sliders.status == ("switch on disabled",) * 3)
        events = told(robot, lambda heard: sum(event.kind == "goal" for event in heard) == 4)
        assert [event.seq for event in events] == list(range(1, len(events) + 1))
        outcomes = [event.outcome for event in events if event.kind == "goal"]
        assert outcomes == ["rejected", "done", "preempted", "done"]
    assert cold_service.end() == 0
    sent = cold_service.frames()
    assert {identifier for identifier, _ in sent} <= {
        canopen_frames.NMT,
        canopen_frames.SYNC,
        canopen_frames.HEARTBEAT + 126,
        *(base + node for base in (0x180, 0x200, 0x280, 0x300, 0x580, 0x600, 0x700) for node in (1, 2, 3)),
    }
    for node in (1, 2, 3):
        words = controlwords(sent, node)
        assert [words.index(word) for word in (0x06, 0x07, 0x0F)] == sorted(words.index(w) for w in (0x06, 0x07, 0x0F))
        assert words[-1] & 0b1111 != 0b1111
    assert_stopped_smoothly(cold_service)


def test_a_session_with_odrives(tmp_path: Path) -> None:
    changes = {'protocol = "cia402"': 'protocol = "odrive"'}
    # The feed-forward of an ODrive reaches the 1 m/s of the configuration with at most 32 turns per metre.
    changes |= {f"node = {n}\ncounts_per_metre = 1e7": f"node = {n}\ncounts_per_metre = 25.0" for n in (1, 2, 3)}
    with Service(tmp_path, **changes) as service:
        service.wait_up()
        with service.robot() as robot:
            robot.enable()
            assert robot.move_to(x=0.02, y=-0.01, phi=0.1).wait(WITHIN).outcome == "done"
            state = until(robot, lambda state: state.mode == "holding")
            assert state.pose == pytest.approx((0.02, -0.01, 0.1), abs=1e-4)
            robot.disable()
            until(robot, lambda state: state.sliders.status == ("switch on disabled",) * 3)
        assert service.end() == 0
        sent = service.frames()
        commands = {0x00, 0x01, 0x03, 0x04, 0x05, 0x06, 0x07, 0x09, 0x0B, 0x0C}
        assert {identifier for identifier, _ in sent} == {
            node << 5 | number for node in (1, 2, 3) for number in commands
        }
        for node in (1, 2, 3):
            states = [data[0] for identifier, data in sent if identifier == node << 5 | odrive_frames.SET_AXIS_STATE]
            assert [state for state, _ in itertools.groupby(states)] == [1, 8, 1]


def test_what_a_drive_does_without_stands_in_every_place_where_one_looks(tmp_path: Path) -> None:
    """Announced at the start, listed by the doctor, in info and in status: drives B and C of a make without 1006."""
    eds = tmp_path / "without.eds"
    eds.write_text(edsfiles.eds(edsfiles.rows("elmo_gold"), lacks=[0x1006]))
    lines = f'\neds = "{eds}"\naccept_without = ["1006"]\n'
    with Service(tmp_path, **{f"[drives.{name}]\n": f"[drives.{name}]{lines}" for name in "BC"}) as service:
        service.wait_up()
        words = "its monitoring of SYNC; without: it continues without SYNC"
        said = trirail("doctor", tmp_path / "robot.toml", "--quick").stdout
        assert f"drives B, C may lack 1006, {words}" in said
        assert f"drive B, drive C: 1006, {words}" in trirail("status", locator=service.locator).stdout
        missing = json.loads(trirail("status", "--json", locator=service.locator).stdout)["missing_protections"]
        assert missing == [{"drive": name, "object": "1006", "means": words} for name in "BC"]
        with service.robot() as robot:
            told(robot, lambda heard: "drives B, C: lacks 1006" in heard[-1].message)
            assert robot.info().missing_protections == tuple(MissingProtection(**each) for each in missing)
        assert service.end() == 0


def test_the_commands(service: Service) -> None:
    def call(*arguments: object) -> subprocess.CompletedProcess[str]:
        return trirail(*arguments, locator=service.locator)

    confirmed = json.loads(call("enable", "--json").stdout)
    assert confirmed.pop("seq") <= json.loads(call("status", "--json").stdout)["seq"]
    assert confirmed == {"command": "enable", "mode": "holding", "ok": True}
    done = call("goto", 0.01, -0.02, 5, "--deg", "--wait")
    assert (done.returncode, done.stderr) == (0, "")
    assert "done" in done.stdout
    state = json.loads(call("status", "--json").stdout)
    assert state["pose"] == pytest.approx([0.01, -0.02, np.radians(5)], abs=1e-5)
    assert "holding" in call("status").stdout
    out = call("goto", 0.5, 0, 0)
    assert out.returncode == 1
    assert "platform x: position 500 mm is beyond the limit of 150 mm" in out.stderr
    assert call("reset").returncode == 1
    assert call("goto", "nan", 0, 0).returncode == 2
    assert call("goto", 1, 2).returncode == 2
    assert call("quick-stop").returncode == 0
    failed = call("enable")
    assert failed.returncode == 1
    assert "fault: quick_stop by" in failed.stderr
    assert call("reset").returncode == 0
    assert call("disable").returncode == 0
    for answer in (out, failed):
        assert len(answer.stderr.splitlines()) == 1
    assert service.end(signal.SIGINT) == 0


@pytest.mark.parametrize(
    ("payload", "code", "said"),
    [
        (b"{", "malformed", "not a goal"),
        (b'{"kind": "pose", "x": 1, "y": 2}', "malformed", "missing required field phi"),
        (b'{"kind": "pose", "x": 0, "y": 0, "phi": 0, "z": 0}', "malformed", "unknown field z"),
        (b'{"kind": "pose", "x": 0, "y": 0, "phi": NaN}', "malformed", "not a goal"),
        (b'{"kind": "pose", "x": 0, "y": 0, "phi": 1e999}', "malformed", "not a goal"),
        (b'{"kind": "pose", "x": 0, "y": 0, "phi": 0, "speed": 2}', "malformed", "<= 1.0"),
        (b'{"kind": "dance", "x": 0, "y": 0, "phi": 0}', "malformed", "dance"),
        (b'{"kind": "pose", "x": 0, "y": "0", "phi": 0}', "malformed", "got str"),
        (b"\xff\xfe", "malformed", "not a goal"),
        (b"", "malformed", "not a goal"),
        (b" " * 300_000, "too_large", "exceed the maximum of 262144"),
    ],
)
def test_bad_goals(shared: tuple[Service, Robot, zenoh.Session], payload: bytes, code: str, said: str) -> None:
    _, robot, session = shared
    before = robot.state().commanded.position
    (reply,) = session.get("trirail/demo/goal/eve", payload=payload)
    assert reply.err is not None
    error = json.loads(reply.err.payload.to_bytes())
    assert error["code"] == code
    assert said in error["message"]
    state = robot.state()
    assert state.mode == "holding"
    assert state.commanded.position == pytest.approx(before, abs=1e-12)


def test_bad_checks(shared: tuple[Service, Robot, zenoh.Session]) -> None:
    _, robot, session = shared
    points = [{"t": t, "x": 0.0, "y": 0.0, "phi": 0.0} for t in (0.0, 1.0)]
    part = json.dumps({"kind": "trajectory", "id": "t", "part": {"number": 1, "of": 2}, "points": points})
    jog = '{"kind":"velocity","x":0.01,"y":0,"phi":0,"timeout":0.1}'
    for payload, said in ((part, "one message"), (jog, "not a goal to check"), ("", "not a goal to check")):
        (reply,) = session.get("trirail/demo/check/eve", payload=payload)
        assert reply.err is not None
        error = json.loads(reply.err.payload.to_bytes())
        assert error["code"] == "malformed"
        assert said in error["message"]
    assert robot.state().mode == "holding"


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Service, Robot, zenoh.Session]]:
    """One enabled service for the tests that ask it for nothing but a no."""
    with Service(tmp_path_factory.mktemp("shared")) as service:
        service.wait_up()
        with service.robot() as robot, open_client(service.locator) as session:
            robot.enable()
            yield service, robot, session
        assert service.end() == 0


@pytest.mark.core
def test_bad_commands(shared: tuple[Service, Robot, zenoh.Session]) -> None:
    _, robot, session = shared
    (reply,) = session.get("trirail/demo/cmd/eve/dance")
    assert reply.err is not None
    assert "use one of enable" in reply.err.payload.to_string()
    (reply,) = session.get("trirail/demo/cmd/*/stop")
    assert reply.err is not None
    assert "contains a wildcard" in reply.err.payload.to_string()
    assert robot.state().mode == "holding"


def test_other_ways_to_send_a_goal(shared: tuple[Service, Robot, zenoh.Session]) -> None:
    _, robot, session = shared
    session.put("trirail/demo/goal/ann", b'{"kind": "pose", "x": 0.01, "y": 0, "phi": 0}')
    until(robot, lambda state: state.mode == "holding" and abs(state.pose[0] - 0.01) < 1e-5)
    packed = msgspec.msgpack.encode({"kind": "pose", "x": 0.0, "y": 0.0, "phi": 0.0, "id": "packed"})
    (reply,) = session.get("trirail/demo/goal/ann", payload=packed, encoding="application/msgpack")
    assert reply.ok is not None
    assert msgspec.msgpack.decode(reply.ok.payload.to_bytes(), type=GoalReply).id == "packed"
    until(robot, lambda state: state.mode == "holding" and abs(state.pose[0]) < 1e-5)


def test_a_target_is_followed_from_the_plain_wire(shared: tuple[Service, Robot, zenoh.Session]) -> None:
    """By puts, which have no answer: the state says how far it is behind, and when messages cease it is over."""
    _, robot, session = shared
    assert robot.move_to(x=0.0, y=0.0, phi=0.0).wait(WITHIN).outcome == "done"
    over = threading.Event()

    def tell() -> None:
        begins = time.time()
        while not over.wait(0.01):
            at = time.time()
            target = {"x": 0.02 * (at - begins), "y": 0, "phi": 0, "velocity": [0.02, 0, 0], "time": at}
            track = {"kind": "track", "id": "target", "timeout": 1.0, **target}
            session.put("trirail/demo/goal/ann", json.dumps(track))

    ends = (event for event in robot.events(history=True, timeout=WITHIN) if event.id == "target")
    sender = threading.Thread(target=tell)
    sender.start()
    try:
        goal = until(robot, lambda state: state.pose[0] > 0.01).goal
    finally:
        over.set()
        sender.join()
    assert goal is not None
    assert (goal.id, goal.lag is None, goal.target is None) == ("target", False, False)
    assert next(ends).outcome == "done"
    late = json.dumps({"kind": "track", "x": 0, "y": 0, "phi": 0, "time": time.time() - 2.0})
    (reply,) = session.get("trirail/demo/goal/ann", payload=late)
    assert reply.err is not None
    assert json.loads(reply.err.payload.to_string())["code"] == "wrong_time"


def test_the_client_tells_of_a_target_and_its_end_brakes(shared: tuple[Service, Robot, zenoh.Session]) -> None:
    _, robot, _ = shared
    assert robot.move_to(x=0.0, y=0.0, phi=0.0).wait(WITHIN).outcome == "done"
    with robot.track(timeout=1.0) as track:
        track.update((0.01, 0.0, 0.0))
        for state in robot.states():
            track.update((0.01, 0.0, 0.0))
            if abs(state.pose[0] - 0.01) < 1e-4 and track.lag is not None and track.lag < 1e-4:
                break
    assert track.result is not None
    assert track.result.outcome == "stopped"
    with refused_as(RefusalCode.JOG_OVER):
        track.update((0.0, 0.0, 0.0))
    until(robot, lambda state: state.mode == "holding")
    with robot.track(timeout=0.05) as silent:
        silent.update((0.0, 0.0, 0.0))
        until(robot, lambda _: silent.result is not None)
    assert silent.result is not None
    assert silent.result.outcome == "done"


@pytest.mark.core
def test_every_kind_of_goal(shared: tuple[Service, Robot, zenoh.Session], tmp_path: Path) -> None:
    service, robot, _ = shared
    assert robot.move_sliders(0.01, 0.0, -0.01).wait(WITHIN).outcome == "done"
    assert robot.move_to(x=0.0, y=0.0, phi=0.0).wait(WITHIN).outcome == "done"
    with robot.jog(x=0.002, timeout=10.0) as jog:
        until(robot, lambda state: state.pose[0] > 0.001)
    assert robot.state().pose[0] < 0.012  # it brakes where the context is left, not a time-out later
    assert jog.error is None
    assert jog.result is not None
    assert jog.result.outcome == "done"
    robot.override(10.0)
    slow = robot.move_to(x=-0.03, y=0.0, phi=0.0, speed=0.1)
    until(robot, lambda state: state.goal is not None and state.goal.progress > 0.02)
    robot.pause()
    assert until(robot, lambda state: (state.mode, state.override) == ("holding", 0.1)).goal is not None
    robot.resume()
    robot.override(100.0)
    assert slow.wait(WITHIN).outcome == "done"
    path = tmp_path / "path.csv"
    path.write_text("t,x,y,phi\n0,-0.03,0,0\n0.5,-0.01,0,0.1\n1,0,0,0\n")
    followed = trirail("follow", path, "--wait", "--json", locator=service.locator)
    assert json.loads(followed.stdout)["outcome"] == "done"
    refused = trirail("follow", path, locator=service.locator)
    assert refused.returncode == 1
    assert "the trajectory begins at x = -30 mm" in refused.stderr
    assert "--go-there" in refused.stderr
    went = trirail("follow", path, "--go-there", "--wait", "--json", locator=service.locator)
    assert json.loads(went.stdout)["outcome"] == "done"
    assert robot.follow(path, go_there=True).wait(WITHIN).outcome == "done"
    robot.override(1.0)
    with ThreadPoolExecutor(1) as beside:
        on_the_way = beside.submit(robot.follow, path, go_there=True)
        until(robot, lambda state: state.mode == "moving")
        robot.stop()
        with pytest.raises(RefusedError) as elsewhere:
            on_the_way.result(WITHIN)
        assert elsewhere.value.code is RefusalCode.WRONG_START
    robot.override(100.0)


@pytest.mark.alone
def test_a_flood_of_goals_ends_one_by_one_and_a_stop_overtakes_it(service: Service) -> None:
    """Puts, which have no answer: faster than the loop plans them; then a stop. Each has its ending, in order."""
    ids = [f"f{k}" for k in range(900)]
    heard: list[Event] = []
    with service.robot() as robot, open_client(service.locator) as user:
        robot.enable()

        def listen() -> None:
            for event in robot.events(history=True, timeout=WITHIN):
                heard.append(event)
                if event.outcome and event.id == ids[-1]:
                    return

        listening = threading.Thread(target=listen)
        listening.start()
        until(robot, lambda _: bool(heard))
        for k, name in enumerate(ids):
            goal = {"kind": "pose", "x": 0.03 * (k % 3 - 1), "y": 0.02 * (k % 2), "phi": 0.1, "id": name}
            user.put(
                "trirail/demo/goal/bob",
                json.dumps(goal),
                encoding="application/json",
                congestion_control=zenoh.CongestionControl.BLOCK,  # else Zenoh drops what a slow machine is behind with
            )
        (reply,) = user.get("trirail/demo/cmd/bob/stop", priority=zenoh.Priority.DATA)
        assert reply.ok is not None
        listening.join()
        until(robot, lambda state: state.mode == "holding")
    assert [event.seq for event in heard] == list(range(1, len(heard) + 1))
    outcomes = [(event.id, event.outcome) for event in heard if event.outcome]
    assert [name for name, _ in outcomes] == ids
    assert {outcome for _, outcome in outcomes[:-1]} <= {"done", "preempted", "stopped"}  # done: the next came late
    assert outcomes[-1][1] == "stopped"
    assert service.end() == 0, service.log.read_text()
    assert_stopped_smoothly(service)


@pytest.mark.parametrize("command", ["stop", "quick_stop", "disable", "override"])
def test_goals_that_wait_at_override_zero_keep_no_command_waiting(
    shared: tuple[Service, Robot, zenoh.Session], command: str
) -> None:
    _, robot, _ = shared
    assert robot.move_to(x=0.0, y=0.0, phi=0.0).wait(WITHIN).outcome == "done"
    robot.override(0)
    goals = [robot.move_to(x=x, y=y, phi=0.0, blend=0.05) for x, y in ((0.01, 0.0), (0.02, 0.01), (0.03, 0.0))]
    assert [goal.duration for goal in goals] == [None] * 3
    if command == "override":
        robot.override(100)
        assert [goal.wait(WITHIN).outcome for goal in goals] == ["done"] * 3
        return
    robot.command(command)
    ended = {goal.wait(WITHIN).outcome for goal in goals}
    assert ended == {"faulted" if command == "quick_stop" else "stopped"}
    if command == "quick_stop":
        robot.reset()
    robot.enable()
    robot.override(100)


def test_done_is_said_when_the_robot_is_measured_to_be_there(tmp_path: Path) -> None:
    """Servos 0.2 s behind: not before, and where that takes too long, what is left to go; a replay judges the same."""
    with Service(
        tmp_path,
        **{
            "time_constant = 0.004": "time_constant = 0.2",
            "feed_forward_gain = 0.95": "feed_forward_gain = 0.0",
            "\nfollowing_error = 0.004": "\nfollowing_error = 0.05",
            "\nfollowing_error = 0.005": "\nfollowing_error = 0.06",
            "timeout = 2.0": "timeout = 0.3",
        },
    ) as lagging:
        windows = load(tmp_path / "robot.toml").limits.in_position
        lagging.wait_up()
        with lagging.robot() as robot:
            robot.enable()
            near = robot.move_to(x=0.0003, y=-0.0002, phi=0.0).wait(WITHIN)
            assert near.outcome == "done"
            assert near.settle is not None
            assert near.settle > 0.02
            assert near.residual is not None
            assert (np.abs(near.residual.pose) <= windows.pose).all()
            assert near.overshoot == pytest.approx((0.0, 0.0, 0.0), abs=1e-6)
            until(robot, lambda state: state.settled)
            far = trirail("goto", 0.006, -0.004, 0.02, "--wait", locator=lagging.locator)
            assert far.returncode == 1
            assert "unsettled: not in position 0.3 s after the end of the path; residuals: slider A " in far.stdout
            said = json.loads(trirail("goto", 0.05, 0.0, 0.0, "--wait", "--json", locator=lagging.locator).stdout)
            assert (said["outcome"], said["settle"]) == ("unsettled", None)
            assert max(np.abs(said["residual"]["pose"]) / windows.pose) > 1.0
            assert until(robot, lambda state: state.mode == "holding").faults == ()
            until(robot, lambda state: state.settled)
            there = trirail("goto", 0.05, 0.0, 0.0, "--wait", locator=lagging.locator)
            assert (there.returncode, "done: arrived, settled after 1 ms" in there.stdout) == (0, True)
        assert lagging.end() == 0
        (file,) = (tmp_path / "recordings").glob("*.rrd")
        recording = read(file)
        (done,) = [line.event for line in recording.events if line.event is not None and line.event.id == near.id]
        last = int(np.searchsorted(recording.records["cycle"], done.cycle))
        dwell = recording.records[last + 1 - round(windows.dwell * 1000) : last + 1]
        assert (np.abs(dwell["pose"] - (0.0003, -0.0002, 0.0)) <= windows.pose).all()
        report = trirail("report", file)
        assert "unsettled" in report.stdout
        assert f"settled in {near.settle * 1e3:g} ms" in report.stdout
        assert trirail("replay", file).returncode == 0


def test_goals_wait_blend_and_are_cancelled(shared: tuple[Service, Robot, zenoh.Session]) -> None:
    service, robot, _ = shared
    robot.override(1.0)
    corner = robot.move_to(x=0.05, y=0.0, phi=0.0, blend=0.01)
    end = robot.move_to(x=0.05, y=0.05, phi=0.0)
    assert end.reply.queued
    robot.override(100.0)
    assert (corner.wait(WITHIN).outcome, end.wait(WITHIN).outcome) == ("done", "done")
    slow = robot.move_to(x=-0.05, y=0.0, phi=0.0, speed=SLOWLY)
    slow.cancel()
    assert slow.wait(WITHIN).outcome == "stopped"
    with pytest.raises(RefusedError) as refused:
        slow.cancel()
    assert refused.value.code is RefusalCode.NO_GOAL
    with pytest.raises(RefusedError) as refused:
        robot.move_to(x=0.0, y=0.0, phi=0.0, limits=OwnLimits(velocity=(1.0, 0.1, 0.1)))
    assert refused.value.code is RefusalCode.ABOVE_LIMIT
    blended = trirail("goto", 0.0, 0.0, 0.0, "--blend", 0.01, locator=service.locator)
    assert (blended.returncode, blended.stderr) == (0, "")
    waiting = trirail("goto", 0.02, 0.02, 0.0, "--wait", "--json", locator=service.locator)
    assert json.loads(waiting.stdout)["outcome"] == "done"


def test_a_view_is_drawn_from_what_the_service_publishes(shared: tuple[Service, Robot, zenoh.Session]) -> None:
    service, robot, _ = shared
    with RemoteView([robot.info()], service.locator) as view:
        (drawn,) = view.robots
        host = socket.create_connection(("127.0.0.1", urlsplit(view.url).port or 0), timeout=WITHIN)
        host.close()
        began = drawn.streams.t
        goal = robot.move_to(x=0.01, y=0.0, phi=0.0)
        assert goal.wait(WITHIN).outcome == "done"
        until(robot, lambda _: drawn.streams.t > began + 0.2)
    assert (drawn.lost, view.relay.skipped) == (0, 0)
    assert drawn._bus_load == robot.state(WITHIN).loop.bus_load == pytest.approx(0.75, abs=0.01)
    assert robot.move_to(x=0.0, y=0.0, phi=0.0).wait(WITHIN).outcome == "done"
    refused = trirail("view", "--web", locator=service.locator)
    assert refused.returncode == 1
    assert "use trirail view --records, which draws" in refused.stderr


def test_the_service_is_seen_alive(shared: tuple[Service, Robot, zenoh.Session]) -> None:
    _, _, session = shared
    assert [reply.ok is not None for reply in session.liveliness().get("trirail/demo/alive")] == [True]


def test_clients_see_who_is_connected_while_it_is(shared: tuple[Service, Robot, zenoh.Session]) -> None:
    service, robot, _ = shared
    with Robot("demo", service.locator, user="guest") as guest:
        wait_until(lambda: robot.users() == guest.users() == sorted({robot.user, "guest"}))
    wait_until(lambda: robot.users() == [robot.user])


# ---------------------------------------------------------------------- ends, asked for and not


@pytest.mark.core
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_in_motion_is_a_controlled_stop(service: Service, number: int) -> None:
    with service.robot() as robot:
        in_motion(robot)
        assert service.end(number) == 0
    sent = service.frames()
    assert_stopped_smoothly(service)
    for node in (1, 2, 3):
        assert controlwords(sent, node)[-1] & 0b10 == 0  # disable voltage
        assert positions(sent, node)[-1] != positions(sent, node)[0]
    (file,) = (service.folder / "recordings").glob("*.rrd")
    recording = read(file)  # to the very end: the recorder is given the time for what the loop said last
    assert MODES[recording.records["mode"][-1]] is Mode.DISABLED
    assert [line.event.mode for line in recording.events if line.event and line.event.mode][-1] == "disabled"
    assert "Traceback" not in service.log.read_text()


def again(service: Service) -> Robot:
    """Connect to a service whose gateway is being started again."""
    deadline = time.monotonic() + END_WITHIN
    while True:
        with contextlib.suppress(ServiceError):
            robot = service.robot()
            robot.state()
            return robot
        assert time.monotonic() < deadline


@pytest.mark.core
def test_a_killed_gateway_is_a_controlled_stop(service: Service) -> None:
    with service.robot() as robot:
        in_motion(robot)
        os.kill(service.child("gateway"), signal.SIGKILL)
    with again(service) as robot:
        assert robot.state().mode in ("stopping", "holding")
        state = until(robot, lambda state: state.mode == "holding")
        assert 0.0 < state.pose[0] < 0.09
        told(robot, lambda heard: (heard[-1].id, heard[-1].outcome) == ("long", "stopped"))
        assert robot.move_to(x=0.0, y=0.0, phi=0.0).wait(WITHIN).outcome == "done"
    assert service.end() == 0
    assert_stopped_smoothly(service)
    assert "the gateway has died (killed by SIGKILL)" in service.log.read_text()


def planned_again(robot: Robot) -> None:
    """Wait until goals are planned again, with the last one reached."""
    deadline = time.monotonic() + END_WITHIN
    while True:
        with contextlib.suppress(RefusedError):
            assert robot.move_to(x=0.0, y=0.0, phi=0.0).wait(WITHIN).outcome == "done"
            return
        assert time.monotonic() < deadline


@pytest.mark.parametrize("harm", [signal.SIGKILL, signal.SIGTERM, signal.SIGSTOP])
def test_a_planner_that_is_lost_costs_a_goal_and_no_more(service: Service, harm: signal.Signals) -> None:
    with service.robot() as robot:
        in_motion(robot, speed=0.2)
        fork_server, planner = service.child("fork-server"), service.child("planner")
        os.kill(fork_server, signal.SIGSTOP)  # else it may be back before it is missed
        os.kill(planner, harm)
        with refused_as(RefusalCode.PLANNER_LOST):
            robot.move_to(x=0.0, y=0.0, phi=0.0)
        os.kill(fork_server, signal.SIGCONT)
        robot.override(50.0)
        robot.override(100.0)
        state = until(robot, lambda state: state.mode == "holding")
        assert state.pose[0] == pytest.approx(0.1, abs=1e-5)
        planned_again(robot)
    assert service.end() == 0
    assert_stopped_smoothly(service)
    log = service.log.read_text()
    assert "the motion in progress continues, and new goals are refused; restarting it" in log
    assert "Traceback" not in log


@pytest.mark.parametrize("harm", [signal.SIGKILL, signal.SIGSTOP])
def test_a_robot_is_stopped_without_a_planner(service: Service, harm: signal.Signals) -> None:
    with service.robot() as robot:
        in_motion(robot)
        os.kill(service.child("planner"), harm)
        robot.stop()
        assert until(robot, lambda state: state.mode == "holding").pose[0] < 0.09
    assert service.end() == 0
    assert_stopped_smoothly(service)


def test_a_killed_recorder_does_not_matter(service: Service) -> None:
    with service.robot() as robot:
        in_motion(robot, speed=0.2)
        os.kill(service.child("recorder"), signal.SIGKILL)
        state = until(robot, lambda state: state.mode == "holding")
        assert state.pose[0] == pytest.approx(0.1, abs=1e-5)
        told(robot, lambda heard: sum(event.message.startswith("recording to") for event in heard) == 2)
    assert service.end() == 0
    log = service.log.read_text()
    assert "the recorder has died (killed by SIGKILL)" in log
    # Each recorder begins one file, and continues in a file -part2 if the disk does not respond for seconds. On a busy
    # machine, the supervisor may find another recorder frozen and replace it as well.
    begun = [path for path in (service.folder / "recordings").glob("*.rrd") if "-part" not in path.stem]
    assert len(begun) == 1 + log.count("the recorder has died (")


@pytest.mark.core
def test_a_fault_is_kept_apart(service: Service) -> None:
    with service.robot() as robot:
        in_motion(robot)
        robot.quick_stop()
    assert service.end() == 0
    (box,) = (service.folder / "recordings").glob("fault-*.rrd")
    kept = read(box)
    assert [line.text for line in kept.events if line.event and line.event.kind == "fault"] == ["quick_stop by ann"]
    assert kept.records["cycle"][0] == 1
    assert not kept.records["commanded_velocity"][-1].any()  # the stop is in it
    assert provenance.configuration(kept.texts) == load(service.folder / "robot.toml")


def test_a_recording_that_suffers_is_told_to_everyone(service: Service) -> None:
    with service.robot() as robot:
        in_motion(robot, speed=0.2)
        recorder = service.child("recorder")
        resource.prlimit(recorder, resource.RLIMIT_FSIZE, (50_000, 50_000))  # more than the log has, less than a second
        told(robot, lambda heard: heard[-1].level == "warning" and "cannot be written" in heard[-1].message)
        until(robot, lambda state: any("nothing is recorded" in warning for warning in state.warnings))
        assert until(robot, lambda state: state.mode == "holding").pose[0] == pytest.approx(0.1, abs=1e-5)
    service.end()
    assert "trirail: recorder: nothing is recorded: " in service.log.read_text()


@pytest.mark.alone
def test_a_recorder_that_cannot_begin_again_never_ends_the_service(service: Service) -> None:
    """Its folder has gone, so that every restart fails; when that is back, so is the recording."""
    folder, aside = service.folder / "recordings", service.folder / "aside"
    with service.robot() as robot:
        in_motion(robot, speed=0.2)
        os.kill(service.child("recorder"), signal.SIGSTOP)  # it would notice
        folder.rename(aside)
        folder.write_bytes(b"")
        os.kill(service.child("recorder"), signal.SIGKILL)
        assert until(robot, lambda state: state.mode == "holding").pose[0] == pytest.approx(0.1, abs=1e-5)
        service.wait_said("the recorder has died (exit code 78): the robot is not affected; restarting it")
        folder.unlink()
        assert robot.move_to(x=0.0, y=0.0, phi=0.0).wait(WITHIN).outcome == "done"
        said = (event.message for event in robot.events(history=True, timeout=WITHIN) if "record" in event.message)
        begun, gone, back = itertools.islice(said, 3)
    assert gone == "the recorder has died: nothing is recorded until it has restarted"
    assert begun.startswith(f"recording to {folder}/")
    assert back.startswith(f"recording to {folder}/")
    assert service.end() == 0
    (file,) = folder.glob("*.rrd")
    assert len(read(file).records) > 0


def test_a_frozen_recorder_does_not_matter(service: Service) -> None:
    with service.robot() as robot:
        in_motion(robot, speed=0.5)  # it is killed where it is frozen for longer than 5 s
        recorder = service.child("recorder")
        os.kill(recorder, signal.SIGSTOP)
        try:
            state = until(robot, lambda state: state.mode == "holding")
            assert robot.move_to(x=0.0, y=0.0, phi=0.0).wait(WITHIN).outcome == "done"
        finally:
            os.kill(recorder, signal.SIGCONT)
        assert state.pose[0] == pytest.approx(0.1, abs=1e-5)
    assert service.end() == 0
    (file,) = (service.folder / "recordings").glob("*.rrd")
    cycles = read(file).records["cycle"]
    assert np.array_equal(np.diff(cycles), np.ones(len(cycles) - 1))  # what waited for it is in the file


@pytest.mark.core
def test_killed_drives_are_a_fault_and_the_service_stays(service: Service) -> None:
    with service.robot() as robot:
        in_motion(robot)
        os.kill(service.child("drives"), signal.SIGKILL)
        state = until(robot, lambda state: state.mode == "fault")
        (fault,) = state.faults
        assert re.fullmatch(
            r"CAN bus .* is down: cannot (send|receive): .*listening end( of the bus)? has closed the connection", fault
        )
        service.wait_said(
            "the simulated drives have died (killed by SIGKILL): the robot is in fault; restart the "
            "service to restart them"
        )
        with pytest.raises(RefusedError) as refused:
            robot.reset()
        assert refused.value.code is RefusalCode.STOPPING
        stopped = trirail("stop", locator=service.locator)
        assert (stopped.returncode, stopped.stderr) == (0, "")
        assert robot.state().mode == "fault"
        assert "drives" not in service.processes()
    assert service.end() == 1  # nobody knows whether the drives have power
    assert "the service has ended, but drive A is operation enabled" in service.log.read_text()
    assert "Traceback" not in service.log.read_text()


def test_frozen_drives_are_a_fault_and_do_not_hold_up_the_end(service: Service) -> None:
    with service.robot() as robot:
        robot.enable()
        os.kill(service.child("drives"), signal.SIGSTOP)
        state = until(robot, lambda state: state.mode == "fault")
        assert re.search(r"drive [ABC]: no (heartbeat|statusword) for \d", state.faults[0])
    assert service.end() == 1  # nobody knows whether the drives have power
    assert "the service has ended, but drive A is operation enabled" in service.log.read_text()
    assert "Traceback" not in service.log.read_text()


def test_drives_that_are_told_to_end_go_on_as_long_as_the_loop_has_them(service: Service) -> None:
    with service.robot() as robot:
        in_motion(robot, speed=0.2)
        os.kill(service.child("drives"), signal.SIGTERM)
        state = until(robot, lambda state: state.mode == "holding")
        assert state.pose[0] == pytest.approx(0.1, abs=1e-5)
    assert service.end() == 0
    assert "drives have died" not in service.log.read_text()


def test_a_killed_loop_leaves_the_drives_to_their_watchdogs(tmp_path: Path) -> None:
    bus = f"{tmp_path}/bus"
    root = Path(__file__).parents[2]
    config = tmp_path / "drives.toml"
    config.write_text(
        SIM.read_text()
        .replace("rate_hz = 1000", "rate_hz = 20")  # a busy machine keeps the drives' process waiting
        .replace("missed_syncs = 150", "missed_syncs = 20")
        .replace("heartbeat = 0.1", "heartbeat = 0.5")
    )
    command = [sys.executable, str(root / "tools" / "virtual_drives.py"), str(config)]
    drives = subprocess.Popen([*command, "--interface", "unix", "--channel", bus], stdout=subprocess.PIPE)
    assert drives.stdout is not None
    try:
        while not Path(bus).exists():
            assert drives.poll() is None
            wait_readable(drives, 0.05)
        service = Service(
            tmp_path,
            **{
                'interface = "simulated"': f'interface = "unix"\nchannel = "{bus}"',
                "rate_hz = 1000": "rate_hz = 20",
                "heartbeat = 0.1": "heartbeat = 0.5\nsdo_timeout = 5.0",
            },
        )
        service.wait_up()
        with service.robot() as robot:
            in_motion(robot)
            os.kill(service.child("loop"), signal.SIGKILL)
        assert service.process.wait(END_WITHIN) == 1
        assert (
            "the loop has died (killed by SIGKILL): the drives stop by their own watchdogs" in service.log.read_text()
        )
        enabled, stopped = set[str](), set[str]()
        while len(stopped) < 3:
            line = drives.stdout.readline().decode()
            assert line
            # A drive misses SYNC, or the heartbeat if its process has to wait, and then has no fault.
            name, state = line.split(",")[0].split(" ", 1)
            if state == "operation enabled":
                enabled.add(name)
            elif state in ("fault", "switch on disabled") and name in enabled:
                stopped.add(name)
    finally:
        drives.terminate()
        drives.wait(END_WITHIN)
        drives.stdout.close()


# ---------------------------------------------------------------------- what cannot start


@pytest.mark.parametrize(
    ("before", "after", "said"),
    [
        ("rate_hz = 1000", "rate_hx = 1000", "loop.rate_hx: unknown key; did you mean rate_hz?"),
        ('interface = "simulated"', 'interface = "vcan"', 'can.interface "vcan" is unknown'),
        ("bitrate = 1_000_000", "bitrate = 500_000", "takes 126% of the bus at 500000 bit/s"),
        ('listen = ["tcp/127.0.0.1:7447"]', 'listen = ["tcp/127.0.0.1:{port}"]', "cannot listen on tcp/127.0.0.1"),
        ("live_port = 9876", "live_port = {port}", "telemetry.live_port"),
    ],
)
def test_a_start_that_fails_says_why_in_one_line(
    tmp_path: Path, before: str, after: str, said: str | tuple[str, ...]
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        text = SIM.read_text().replace('"tcp/127.0.0.1:7447"', f'"unixsock-stream/{tmp_path}/z"')
        text = text.replace("live_port = 9876", "live_port = 0") if "live_port" not in before else text
        if "listen" in before:
            before = before.replace('"tcp/127.0.0.1:7447"', f'"unixsock-stream/{tmp_path}/z"')
        path = tmp_path / "robot.toml"
        path.write_text(text.replace(before, after.format(port=port), 1))
        failed = trirail("run", path, "--record", tmp_path / "r.rrd")
    assert failed.returncode == 1
    assert len(failed.stderr.splitlines()) == 1, failed.stderr
    assert any(part in failed.stderr for part in ([said] if isinstance(said, str) else said))
    assert not (tmp_path / "r.rrd").exists()


def test_nobody_there(tmp_path: Path) -> None:
    failed = trirail("status", locator=f"unixsock-stream/{tmp_path}/none")
    assert failed.returncode == 1
    assert failed.stderr.startswith("trirail: no service at unixsock-stream/")
    assert "start trirail run or zenohd there, or name another address" in failed.stderr


@pytest.mark.alone  # the demo has a port of the machine
def test_the_demo_never_drives_another_service(tmp_path: Path) -> None:
    locator = "tcp/127.0.0.1:7447"
    other = Service(tmp_path, **{f"unixsock-stream/{tmp_path}/zenoh": locator})
    try:
        other.wait_up()
        refused = trirail("demo", "--record", tmp_path / "demo.rrd")
        assert refused.returncode == 1
        assert "cannot listen on tcp/127.0.0.1:7447" in refused.stderr
        with Robot("demo", locator) as robot:
            assert robot.state().mode == "disabled"
            assert [event.message for event in robot.events(history=True, timeout=0.5) if event.kind != "service"] == []
    finally:
        assert other.end() == 0


@pytest.mark.alone  # the demo has a port of the machine
def test_the_demo(tmp_path: Path) -> None:
    shown = trirail("demo", "--record", tmp_path / "demo.rrd")
    assert shown.returncode == 0, shown.stderr + shown.stdout
    assert "12 of 12 done" in shown.stdout
    assert (tmp_path / "demo.rrd").stat().st_size > 100_000


@pytest.mark.alone  # the demo has a port of the machine
@pytest.mark.parametrize("stage", ["uvw", "uvw-ppr", "xxy"])
def test_a_stage_is_toured_summed_up_and_replayed_as_the_papers_robot_is(stage: str, tmp_path: Path) -> None:
    file = tmp_path / "stage.rrd"
    shown = trirail("demo", stage, "--record", file)
    assert shown.returncode == 0, shown.stderr + shown.stdout
    assert "8 of 8 done" in shown.stdout
    summed = trirail("report", file).stdout
    for label in load(SIM.with_name(f"{stage}.toml")).geometry.labels:
        assert f"error of {label}" in summed
    replayed = trirail("replay", file)
    assert replayed.returncode == 0, replayed.stderr + replayed.stdout
    assert "the same to the last bit, in every cycle" in replayed.stdout
    assert trirail("export", file, "--every", "10ms", "--columns", "pose,error").returncode == 0
    assert len(file.with_suffix(".csv").read_text().splitlines()) > 100


UNUSUAL = {"RERUN": "off", "NUMBA_DISABLE_JIT": "1"}
"""What somebody's shell may have for other programs: Rerun would record nothing, and no function would be compiled."""


class UnusualService(Service):
    """A service with the environment of such a shell, whose folder has a name in another encoding."""

    def start(self, path: Path, log: IO[bytes]) -> Process:
        folder = Path(os.fsdecode(os.fsencode(path.parent) + b"/Ger\xe4te"))
        folder.mkdir()
        path = path.rename(folder / path.name)
        command = python("-m", "trirail", "run", str(path))
        return subprocess.Popen(command, stdout=log, stderr=log, env=os.environ | UNUSUAL)


def test_a_shell_made_for_other_programs_and_a_folder_in_another_encoding_change_nothing(tmp_path: Path) -> None:
    with UnusualService(tmp_path, **{'directory = "recordings"': 'directory = "recordings"'}) as service:
        service.wait_up()
        with service.robot() as robot:
            robot.command("enable")
    assert service.process.returncode == 0
    (recording,) = tmp_path.glob("Ger*/recordings/*.rrd")
    copy = shutil.copy(recording, tmp_path / "copy.rrd")  # Rerun reads no file in a folder of such a name
    assert len(read(Path(copy)).records) > 0
    assert "recording to" in service.log.read_text()
