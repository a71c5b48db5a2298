"""Simulated drives in a process of their own, as their master on the other end of the bus has them."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import can
import pytest
from rigs import alike, frame
from trirail_drivers.bus import unixbus
from trirail_drivers.bus.can_frame import CAN_FRAME, ERROR, EXTENDED, REMOTE
from trirail_drivers.bus.unixbus import UnixBus
from trirail_drivers.config import Can, Drives
from trirail_drivers.connection.serving import serve
from trirail_drivers.errors import DriveError
from trirail_drivers.odrive import cansimple
from waiting import WITHIN, wait_until

SECTION = Can("simulated")
DRIVES = Drives("cia402", *alike())
ODRIVES = Drives("odrive", *alike(20.0))
DEVICE_TYPE = bytes.fromhex("4000100000000000")
"""A request to read 1000h, and its answer."""
SERVO = bytes.fromhex("4300100092010200")


class Served:
    """Drives that are served, and what has been said of that."""

    def __init__(self, path: Path, drives: Drives = DRIVES) -> None:
        self.path = path
        self.said: list[str] = []
        self.goes_on = threading.Event()
        """Until then nothing is read once a master has come."""
        self.goes_on.set()
        self._thread = threading.Thread(
            target=serve, args=(path, SECTION, drives, lambda: self.said.append("ready"), self._connected)
        )

    def _connected(self) -> None:
        self.said.append("connected")
        self.goes_on.wait(WITHIN)

    def begin(self) -> None:
        """Serve; return when they can be connected to."""
        self._thread.start()
        wait_until(self.path.exists)

    def over(self) -> None:
        """Wait until they are served no more."""
        self._thread.join(WITHIN)
        assert not self._thread.is_alive()


@pytest.fixture
def served(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Served]:
    made = Served(tmp_path / "drives", getattr(request, "param", DRIVES))
    made.begin()
    yield made
    if made.said == ["ready"]:
        UnixBus(str(made.path)).shutdown()
    made.over()


@contextlib.contextmanager
def master(served: Served) -> Iterator[socket.socket]:
    """Their master's end, as a bare socket."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as line:
        line.connect(str(served.path))
        line.settimeout(WITHIN)
        yield line


def until(bus: can.BusABC, can_id: int) -> bytes:
    """The data of the next frame of an identifier."""
    deadline = time.monotonic() + WITHIN
    while time.monotonic() < deadline:
        message = bus.recv(WITHIN)
        if message is not None and message.arbitration_id == can_id:
            return bytes(message.data)
    raise AssertionError(f"no frame {can_id:X}")


def test_they_boot_when_their_master_comes_and_answer_him_alone(served: Served) -> None:
    assert served.said == ["ready"]
    with UnixBus(str(served.path)) as bus:
        assert [until(bus, 0x700 + node) for node in (1, 2, 3)] == [b"\0"] * 3
        bus.send(frame(0x602, DEVICE_TYPE))
        assert until(bus, 0x582) == SERVO
        assert served.said == ["ready", "connected"]
        with pytest.raises(DriveError):
            UnixBus(str(served.path))


def test_their_timers_run_without_frames(served: Served) -> None:
    """Heartbeats, each 20 ms (1017h)."""
    with UnixBus(str(served.path)) as bus:
        bus.send(frame(0x601, bytes.fromhex("2b17100014000000")))
        began = time.monotonic()
        until(bus, 0x581)
        assert [until(bus, 0x701) for _ in range(6)] == [b"\x7f"] * 6
        assert time.monotonic() - began > 5 * 0.02 - 0.01


@pytest.mark.parametrize(
    ("identifier", "data"),
    [
        (0x602 | EXTENDED, DEVICE_TYPE),
        (0x602 | ERROR, DEVICE_TYPE),
        (0x602 | REMOTE, b""),
        (0x701 | EXTENDED | REMOTE, b""),
        (0x701 | ERROR | REMOTE, b""),
        (0x000, b"\x80\x01\x00"),
    ],
)
def test_what_is_no_frame_for_a_drive_changes_nothing(served: Served, identifier: int, data: bytes) -> None:
    with master(served) as line:
        booted = [CAN_FRAME.unpack(line.recv(CAN_FRAME.size))[0] for _ in range(3)]
        assert booted == [0x701, 0x702, 0x703]
        line.send(CAN_FRAME.pack(identifier, len(data), data))
        line.send(CAN_FRAME.pack(0x602, 8, DEVICE_TYPE))
        assert CAN_FRAME.unpack(line.recv(CAN_FRAME.size)) == (0x582, 8, SERVO)


def test_a_remote_frame_is_answered(served: Served) -> None:
    """Node guarding: the state, and a bit that toggles."""
    with UnixBus(str(served.path)) as bus:
        until(bus, 0x701)
        for state in (b"\x7f", b"\xff"):
            bus.send(frame(0x701, is_remote_frame=True))
            assert until(bus, 0x701) == state


@pytest.mark.parametrize("syncs", [1, 2, 7])
def test_what_was_stalled_answers_the_newest_sync_alone_and_every_request(served: Served, syncs: int) -> None:
    served.goes_on.clear()
    with UnixBus(str(served.path)) as bus:
        for setting in ("2300180181010080", "2f00180201000000", "2300180181010000"):  # 1800h: at each SYNC
            bus.send(frame(0x601, bytes.fromhex(setting)))
        bus.send(frame(0x000, b"\x01\x00"))
        for _ in range(syncs):
            bus.send(frame(0x080))
            bus.send(frame(0x602, DEVICE_TYPE))
        served.goes_on.set()
        came = [message.arbitration_id for message in iter(lambda: bus.recv(0.5), None)]
    assert (came.count(0x582), came.count(0x181)) == (syncs, 1)
    assert came[-1] == 0x181, "behind what else was waiting"


@pytest.mark.parametrize("served", [ODRIVES], indirect=True)
def test_drives_have_moved_on_while_they_were_stalled(served: Served) -> None:
    """For 40 ms, ten time constants of their servos."""
    served.goes_on.clear()
    estimates = cansimple.identifier(1, cansimple.GET_ENCODER_ESTIMATES)
    with UnixBus(str(served.path)) as bus:
        wait_until(lambda: "connected" in served.said)  # what comes before that has no time
        for command, data in (
            (cansimple.SET_CONTROLLER_MODE, cansimple.CONTROLLER_MODE.pack(cansimple.POSITION_CONTROL, 1)),
            (cansimple.SET_AXIS_STATE, cansimple.AXIS_STATE.pack(cansimple.AxisState.CLOSED_LOOP_CONTROL)),
            (cansimple.SET_INPUT_POS, cansimple.INPUT_POS.pack(0.01, 0, 0)),
        ):
            bus.send(frame(cansimple.identifier(1, command), data))
        for _ in range(4):
            time.sleep(0.01)
            bus.send(frame(estimates, is_remote_frame=True))
        served.goes_on.set()
        first = until(bus, estimates)
    assert cansimple.ESTIMATES.unpack(first)[0] == pytest.approx(0.01, rel=0.01)


def test_a_master_that_does_not_read_loses_frames_and_no_more(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(unixbus, "SEND_BUFFER_BYTES", 1)
    with master(served) as line:
        for _ in range(500):
            line.send(CAN_FRAME.pack(0x602, 8, DEVICE_TYPE))
        answers = 0
        line.settimeout(0.5)
        with contextlib.suppress(TimeoutError):
            while line.recv(CAN_FRAME.size):
                answers += 1
        assert 0 < answers < 500
        line.send(CAN_FRAME.pack(0x602, 8, DEVICE_TYPE))
        assert CAN_FRAME.unpack(line.recv(CAN_FRAME.size)) == (0x582, 8, SERVO)


@pytest.mark.parametrize("last", [b"", b"short"], ids=["hung up", "no frame"])
def test_they_end_with_their_master(served: Served, last: bytes) -> None:
    with master(served) as line:
        if last:
            line.send(last)
            served.over()
    served.over()
