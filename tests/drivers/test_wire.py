"""The bus as the cycle uses it: it never waits, never raises, and keeps the first fault."""

from __future__ import annotations

import errno
import struct
from collections import deque

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st
from trirail_drivers.frames import data_frame, frame_bits
from trirail_drivers.interface import DriveFault
from trirail_drivers.wire import Wire

FULL = can.CanOperationError("Transmit buffer full", errno.ENOBUFS)
ERROR_FRAME = {"is_error_frame": True, "is_extended_id": False}


class Bus:
    """Gives what is to arrive, and notes what is sent; raises where it is told to."""

    channel_info = "a bus of the test"

    def __init__(self) -> None:
        self.arriving: deque[can.Message] = deque()
        self.sent: list[can.Message] = []
        self.failing: Exception | None = None

    def send(self, message: can.Message, timeout: float | None = None) -> None:
        assert timeout == 0
        if self.failing is not None:
            raise self.failing
        self.sent.append(message)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        assert timeout == 0
        if self.failing is not None:
            raise self.failing
        return self.arriving.popleft() if self.arriving else None


class Listener:
    def __init__(self) -> None:
        self.heard: list[tuple[bytes, float]] = []
        self.told: list[tuple[str, int, str]] = []

    def take(self, data: bytearray, now: float) -> None:
        struct.Struct("<i").unpack(data)
        self.heard.append((bytes(data), now))

    def tell(self, cause: str, code: int, text: str) -> None:
        self.told.append((cause, code, text))


class Rig:
    def __init__(self) -> None:
        self.bus, self.stops = Bus(), 0
        self.wire = Wire(self.bus, self.stop)  # type: ignore[arg-type]
        self.listener = Listener()
        self.wire.listen(0x281, self.listener, self.listener.take)

    def stop(self) -> None:
        self.stops += 1

    def arrive(self, can_id: int, data: bytes = b"", **flags: bool) -> None:
        message = can.Message(arbitration_id=can_id, data=data, **{"is_extended_id": False, **flags})
        self.bus.arriving.append(message)

    def cycle(self, *, full: bool = False) -> None:
        self.wire.begin()
        self.bus.failing = FULL if full else None
        self.wire.send(data_frame(0x80, b""))


@pytest.fixture
def rig() -> Rig:
    return Rig()


@given(st.lists(st.booleans(), max_size=20))
def test_a_queue_that_is_full_in_three_cycles_in_a_row_is_a_fault(full: list[bool]) -> None:
    rig = Rig()
    row = 0
    for now in full:
        rig.cycle(full=now)
        row = row + 1 if now else 0
        if row == 3:
            assert rig.wire.fault is not None
            assert rig.wire.fault[:3] == ("", "bus", 0)
            assert rig.stops == 1
            return
        assert rig.wire.fault is None
    assert len(rig.wire.warnings()) == any(full)


def test_a_queue_that_was_full_before_the_first_cycle_counts_as_one_cycle(rig: Rig) -> None:
    rig.bus.failing = FULL
    rig.wire.send(data_frame(0x80, b""))
    rig.cycle(full=True)
    assert rig.wire.fault is None
    rig.cycle(full=True)
    assert rig.wire.fault is not None


def test_frames_are_taken_in_by_the_thousand_and_then_the_cycle_goes_on(rig: Rig) -> None:
    for _ in range(1500):
        rig.arrive(0x281, bytes(4))
    rig.wire.receive(1.0)
    assert len(rig.listener.heard) == 1000
    rig.wire.receive(2.0)
    assert [now for _, now in rig.listener.heard] == [1.0] * 1000 + [2.0] * 500


@pytest.mark.parametrize("length", range(9))
def test_traffic_counts_each_frame_with_its_worst_stuffing(rig: Rig, length: int) -> None:
    rig.wire.send(data_frame(0x123, bytes(length)))
    assert rig.wire.traffic == frame_bits(length)
    rig.arrive(0x456, bytes(length))
    rig.wire.receive(0.0)
    assert rig.wire.traffic == 2 * frame_bits(length)


def test_only_data_frames_of_the_identifier_are_heard(rig: Rig) -> None:
    rig.arrive(0x281, bytes(4), is_extended_id=True)
    rig.arrive(0x281, is_remote_frame=True)
    rig.arrive(0x282, bytes(4))
    rig.arrive(0x281, b"\1\2\3\4")
    rig.wire.receive(7.0)
    assert rig.listener.heard == [(b"\1\2\3\4", 7.0)]
    assert rig.listener.told == []


def test_a_frame_of_wrong_length_is_told_to_whose_it_is(rig: Rig) -> None:
    rig.arrive(0x281, bytes(5))
    rig.wire.receive(0.0)
    assert rig.listener.told == [("frame", 0, "frame 281 has wrong length 5")]
    assert rig.wire.fault is None


def test_a_bus_that_cannot_receive_is_a_fault(rig: Rig) -> None:
    rig.bus.failing = OSError(errno.ENETDOWN, "Network is down")
    rig.wire.receive(0.0)
    assert rig.wire.fault == DriveFault("", "bus", 0, "CAN bus: cannot receive: [Errno 100] Network is down")
    assert rig.stops == 1


def test_the_first_fault_stays_until_a_reset(rig: Rig) -> None:
    first, second = DriveFault("A", "silent", 0, "first"), DriveFault("B", "emcy", 1, "second")
    rig.wire.fail(first)
    rig.wire.fail(second)
    assert (rig.wire.fault, rig.stops) == (first, 1)
    rig.wire.reset()
    rig.wire.fail(second)
    assert (rig.wire.fault, rig.stops) == (second, 2)


def test_a_warning_is_told_once_until_a_reset(rig: Rig) -> None:
    rig.wire.warn("it is so")
    rig.wire.warn("it is so")
    assert rig.wire.warnings() == ("it is so",)
    rig.wire.warn("it is so")
    assert rig.wire.warnings() == ()
    rig.wire.reset()
    rig.wire.warn("it is so")
    assert rig.wire.warnings() == ("it is so",)


@pytest.mark.parametrize(
    ("can_id", "data", "fault", "warned"),
    [(0x40, bytes(8), True, 0), (0x04, b"\0\x20" + bytes(6), False, 1), (0x02, b"\5" + bytes(7), False, 0)],
    ids=["bus-off", "error-passive", "arbitration lost"],
)
def test_error_frames_are_faults_or_warnings(rig: Rig, can_id: int, data: bytes, fault: bool, warned: int) -> None:
    rig.arrive(can_id, data, **ERROR_FRAME)
    rig.wire.receive(0.0)
    assert (rig.wire.fault is not None) == fault
    if rig.wire.fault is not None:
        assert rig.wire.fault[:3] == ("", "bus", 0)
    assert len(rig.wire.warnings()) == warned
