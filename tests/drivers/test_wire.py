"""The bus as the cycle uses it: it never waits, never raises, and keeps the first fault.

All of it is tried both ways that frames can go: by python-can, and on the bus's own socket.
"""

from __future__ import annotations

import contextlib
import itertools
import select
import socket
import struct
from collections.abc import Iterator

import can
import carriers
import pytest
from carriers import FarEnd
from hypothesis import example, given
from hypothesis import strategies as st
from trirail_drivers.bus import wire as wires
from trirail_drivers.bus.can_frame import ERROR, EXTENDED, REMOTE
from trirail_drivers.bus.frames import Frame
from trirail_drivers.bus.reopening import AbsentBus, Reopening
from trirail_drivers.bus.unixbus import UnixBus
from trirail_drivers.bus.wire import Wire
from trirail_drivers.interface import DriveFault
from trirail_drivers.timing import BusTiming, frame_bits


class Listener:
    def __init__(self) -> None:
        self.heard: list[tuple[bytes, float]] = []
        self.told: list[tuple[str, int, str]] = []

    def take(self, data: bytearray, now: float) -> None:
        struct.Struct("<i").unpack(data)
        self.heard.append((bytes(data), now))

    def note_fault(self, cause: str, code: int, text: str) -> None:
        self.told.append((cause, code, text))


class Rig:
    """A wire over a bus, and its far end."""

    def __init__(self, bus: UnixBus, far: FarEnd) -> None:
        self.bus, self.far, self.stops = bus, far, 0
        self.wire = Wire(bus, BusTiming(1_000_000), self.stop)
        self.listener = Listener()
        self.wire.listen(0x281, self.listener, self.listener.take)

    def stop(self) -> None:
        self.stops += 1

    def fill(self) -> None:
        """Leave no room for another frame."""
        assert self.bus.carrier is not None
        with contextlib.suppress(BlockingIOError):
            while True:
                self.bus.carrier.send(Frame(0x7FF).packed, socket.MSG_DONTWAIT)

    def drain(self) -> None:
        """Take away all frames that have been sent."""
        while select.select([self.far.socket], [], [], 0.0)[0]:
            self.far.receive()

    def cycle(self, *, full: bool = False) -> None:
        self.wire.begin(0.0)
        self.fill() if full else self.drain()
        self.wire.send(Frame(0x080))


def full(frame: Frame) -> None:
    raise can.CanOperationError("Transmit buffer full")


@contextlib.contextmanager
def rigged(way: str) -> Iterator[Rig]:
    """A rig whose frames go one way of carriers.WAYS."""
    with pytest.MonkeyPatch.context() as patch, carriers.bus("unix") as (bus, far):
        patch.setattr(wires, "frame_io", carriers.WAYS[way])
        assert isinstance(bus, UnixBus)
        assert bus.carrier is not None
        bus.carrier.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1)  # as little as there is
        yield Rig(bus, far)


@pytest.fixture(params=carriers.WAYS)
def way(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def rig(way: str) -> Iterator[Rig]:
    with rigged(way) as made:
        yield made


@pytest.mark.parametrize("way", carriers.WAYS)
def test_a_queue_that_is_full_in_three_cycles_in_a_row_is_a_fault(way: str) -> None:
    for full in itertools.product((False, True), repeat=6):
        with rigged(way) as rig:
            row = 0
            for now in full:
                rig.cycle(full=now)
                row = row + 1 if now else 0
                if row == 3:
                    assert rig.wire.fault is not None
                    assert rig.wire.fault[:3] == ("", "bus", 0)
                    assert rig.stops == 1
                    break
                assert rig.wire.fault is None
            else:
                assert len(rig.wire.warnings()) == any(full)


def test_a_queue_that_was_full_before_the_first_cycle_counts_as_one_cycle(rig: Rig) -> None:
    rig.fill()
    rig.wire.send(Frame(0x080))
    rig.cycle(full=True)
    assert rig.wire.fault is None
    rig.cycle(full=True)
    assert rig.wire.fault is not None


@given(
    cycles=st.lists(st.sampled_from(["accepted", "refused", "accepted, refused", "idle"]), max_size=12),
    way=st.sampled_from([*carriers.WAYS]),
)
@example(cycles=["accepted"] * 2 + ["refused", "accepted"], way="socket")
def test_a_reopened_bus_works_again_after_three_cycles_in_a_row_without_a_refused_frame(
    cycles: list[str], way: str
) -> None:
    """Although no frame arrives. A cycle in which no frame is sent proves nothing."""
    with rigged(way) as first, rigged(way) as second:
        opened = [second.bus, first.bus]
        reopening = Reopening("can0", opened.pop, lambda work: work())
        wire = Wire(AbsentBus("can0"), BusTiming(1_000_000), first.stop, reopening)
        for number, rig in enumerate((first, second)):
            wire.lose("it is unplugged")
            wire.begin(10.0 * number)
            wire.begin(10.0 * number)
            assert wire.bus is rig.bus
            row = 0
            for cycle in (*cycles, *["accepted"] * 3):
                rig.drain()
                if "accepted" in cycle:
                    assert wire.send(Frame(0x080))
                if "refused" in cycle:
                    rig.fill()
                    assert not wire.send(Frame(0x080))
                row = 0 if "refused" in cycle else row + (cycle == "accepted")
                wire.begin(10.0 * number)
                assert (wire.down == "") == (row == 3)
                if row == 3:
                    break
            assert wire.warnings()[-1] == "CAN bus can0 is up again"


def test_frames_are_taken_in_up_to_a_number_and_then_the_cycle_goes_on(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(wires, "MAX_FRAMES", 10)
    for _ in range(15):
        rig.far.send(0x281, bytes(4))
    rig.wire.receive(1.0)
    assert len(rig.listener.heard) == 10
    rig.wire.receive(2.0)
    assert [now for _, now in rig.listener.heard] == [1.0] * 10 + [2.0] * 5


@pytest.mark.parametrize("length", range(9))
def test_traffic_counts_each_frame_with_its_worst_stuffing(rig: Rig, length: int) -> None:
    rig.wire.send(Frame(0x123, bytes(length)))
    assert rig.wire.traffic == 1000 * frame_bits(length)
    rig.far.send(0x456, bytes(length))
    rig.wire.receive(0.0)
    assert rig.wire.traffic == 2000 * frame_bits(length)


def test_only_data_frames_of_the_identifier_are_heard(rig: Rig) -> None:
    rig.far.send(0x281 | EXTENDED, bytes(4))
    rig.far.send(0x281 | REMOTE)
    rig.far.send(0x282, bytes(4))
    rig.far.send(0x281, b"\1\2\3\4")
    rig.wire.receive(7.0)
    assert rig.listener.heard == [(b"\1\2\3\4", 7.0)]
    assert rig.listener.told == []


@pytest.mark.parametrize("stopping", [0, 1, 20])
def test_a_bus_whose_queue_was_full_carries_what_stops_the_drives_and_is_given_up_after_that(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, stopping: int
) -> None:
    """The adapter may be there. python-can's error for a full queue often has no number that would tell."""
    wire = Wire(
        rig.bus, BusTiming(1_000_000), rig.stop, Reopening("can0", lambda: AbsentBus("can0"), lambda work: None)
    )
    with monkeypatch.context() as patch:
        patch.setattr(wire._frames, "send", full)
        for _ in range(wires.UNSENT_CYCLES):
            wire.begin(0.0, stopping=True)
            assert not wire.send(Frame(0x080))
    assert wire.down
    for _ in range(stopping):
        wire.begin(0.0, stopping=True)
        assert wire.send(Frame(0x080))
        assert rig.far.receive()[0] == 0x080
    wire.begin(0.0)
    assert not wire.send(Frame(0x080))
    assert isinstance(wire.bus, AbsentBus)


def test_a_listener_that_is_forgotten_hears_no_frame(rig: Rig) -> None:
    other = Listener()
    rig.wire.listen(0x282, other, other.take)
    rig.wire.forget(rig.listener)
    for identifier in (0x281, 0x282):
        rig.far.send(identifier, b"\1\2\3\4")
    rig.wire.receive(7.0)
    assert rig.listener.heard == []
    assert other.heard == [(b"\1\2\3\4", 7.0)]


def test_a_frame_of_wrong_length_is_told_to_whose_it_is(rig: Rig) -> None:
    rig.far.send(0x281, bytes(5))
    rig.wire.receive(0.0)
    assert rig.listener.told == [("frame", 0, "frame 281 has wrong length 5")]
    assert rig.wire.fault is None


def test_a_bus_that_is_gone_is_a_fault(rig: Rig) -> None:
    rig.far.socket.close()
    rig.wire.receive(0.0)
    assert rig.wire.fault is not None
    assert rig.wire.fault[:3] == ("", "bus", 0)
    assert rig.stops == 1
    assert not rig.wire.send(Frame(0x080))


def test_the_first_fault_stays_until_a_reset(rig: Rig) -> None:
    first, second = DriveFault("A", "silent", 0, "first"), DriveFault("B", "emcy", 1, "second")
    rig.wire.fail(first)
    rig.wire.fail(second)
    assert (rig.wire.fault, rig.stops) == (first, 1)
    rig.wire.reset()
    rig.wire.fail(second)
    assert (rig.wire.fault, rig.stops) == (second, 2)


def test_a_warning_is_told_once_until_a_reset(rig: Rig) -> None:
    for told in (("it is so",), ()):
        rig.wire.warn("it is so")
        rig.wire.warn("it is so")
        assert rig.wire.warnings() == told
    rig.wire.reset()
    rig.wire.warn("it is so")
    assert rig.wire.warnings() == ("it is so",)


@pytest.mark.parametrize(
    ("can_id", "data", "fault", "warned"),
    [(0x40, bytes(8), True, 0), (0x04, b"\0\x20" + bytes(6), False, 1), (0x02, b"\5" + bytes(7), False, 0)],
    ids=["bus-off", "error-passive", "arbitration lost"],
)
def test_error_frames_are_faults_or_warnings(rig: Rig, can_id: int, data: bytes, fault: bool, warned: int) -> None:
    rig.far.send(can_id | ERROR, data)
    rig.wire.receive(0.0)
    assert (rig.wire.fault is not None) == fault
    if rig.wire.fault is not None:
        assert rig.wire.fault[:3] == ("", "bus", 0)
    assert len(rig.wire.warnings()) == warned
