"""Frames to and from a bus: the same whether they go by python-can or on the bus's own socket."""

from __future__ import annotations

import os
import pty
import time
from collections import deque
from collections.abc import Sequence

import can
import carriers
import pytest
from carriers import over
from hypothesis import given
from hypothesis import strategies as st
from rigs import frame
from trirail_drivers.bus import own_frames
from trirail_drivers.bus.can_frame import CAN_FRAME, CAPTURED, ERROR, EXTENDED, REMOTE
from trirail_drivers.bus.capture import Capture, CapturedBus
from trirail_drivers.bus.frame_io import FrameIO, PythonCanFrames, frame_io
from trirail_drivers.bus.frames import Frame
from trirail_drivers.bus.own_frames import OwnFrames
from trirail_drivers.bus.wire import Wire
from trirail_drivers.timing import BusTiming

BUSES = [
    pytest.param(kind, way, id=f"{kind}, {way}", marks=marks)
    for kind, marks in (("unix", ()), ("vcan", carriers.NEEDS_VCAN))
    for way in carriers.WAYS
]
on_every_bus = pytest.mark.parametrize(("kind", "way"), BUSES)

WAIT = 10.0
"""Longest wait for a frame that has to come [s]."""
KINDS = (
    (0x281, b"\x01\x02\x03\x04"),
    (0x080, b""),
    (0x1ABCDEF0 | EXTENDED, bytes(range(8))),
    (0x185 | REMOTE, b""),
    (0x204 | ERROR, b"\0\x30" + bytes(6)),
    (0x7FF, b"\xff" * 8),
)
"""One frame of each kind."""


def arriving(frames: FrameIO, number: int) -> list[tuple[int, bytes]]:
    """So many frames, which are on their way, and none after them; none of them changes by the next one."""
    received = [frames.receive(WAIT) for _ in range(number)]
    assert frames.receive() is None
    return [(one[0], bytes(one[1])) for one in received if one is not None]


@on_every_bus
def test_a_frame_arrives_as_it_was_made(kind: str, way: str) -> None:
    with over(kind, way) as (frames, far):
        for identifier in (0x000, 0x080, 0x55A, 0x7FF):
            for length in range(9):
                data = bytes(range(0xF0, 0xF0 + length))
                frames.send(Frame(identifier, data))
                assert far.receive() == (identifier, length, data.ljust(8, b"\0"))
        frames.send(Frame(0x029, remote=True))
        assert far.receive() == (0x029 | REMOTE, 0, bytes(8))


@on_every_bus
def test_frames_of_every_kind_are_received_in_their_order(kind: str, way: str) -> None:
    with over(kind, way) as (frames, far):
        assert frames.receive() is None
        for identifier, data in KINDS:
            far.send(identifier, data)
        assert arriving(frames, len(KINDS)) == list(KINDS)


@on_every_bus
def test_a_remote_frame_has_no_data_whatever_its_length(kind: str, way: str) -> None:
    with over(kind, way) as (frames, far):
        far.send(0x185 | REMOTE, length=6)
        assert arriving(frames, 1) == [(0x185 | REMOTE, b"")]


@on_every_bus
def test_a_wait_for_a_frame_ends_without_one(kind: str, way: str) -> None:
    with over(kind, way) as (frames, _):
        began = time.monotonic()
        assert frames.receive(0.05) is None
        assert time.monotonic() - began >= 0.05


def test_an_end_that_dies_with_frames_unread_is_gone_and_stays_so() -> None:
    """The kernel says once that the connection was reset."""
    with over("unix", "socket") as (frames, far):
        frames.send(Frame(0x201, b"\x06\x00"))
        far.socket.close()
        for _ in range(2):
            with pytest.raises(can.CanOperationError, match="the listening end has closed the connection"):
                frames.receive()


@on_every_bus
def test_a_capture_has_every_frame_with_its_time(kind: str, way: str) -> None:
    capture = Capture()
    began = time.time()
    with over(kind, way, capture) as (frames, far):
        frames.set_identifiers([0x281])
        frames.send(Frame(0x201, b"\x06\x00"))
        far.receive()
        for identifier, data in KINDS:
            far.send(identifier, data)
        arriving(frames, len(KINDS))
    ended = time.time()
    noted = [line for chunk in capture.drain() for line in CAPTURED.iter_unpack(chunk)]
    # Linux turns stamping on a moment after it is asked to: until then a frame has the time at which it is read.
    assert all(began <= t <= ended for t, _ in noted)
    seen = [CAN_FRAME.unpack(frame) for _, frame in noted]
    assert seen == [(one, len(data), data.ljust(8, b"\0")) for one, data in ((0x201, b"\x06\x00"), *KINDS)]


def test_a_captured_frame_has_the_time_of_its_arrival() -> None:
    capture = Capture()
    with over("unix", "socket", capture) as (frames, far):
        far.send(0x281, bytes(4))
        arrived_by = time.time()
        while time.time() - arrived_by < 0.01:
            os.sched_yield()
        assert frames.receive() is not None
    ((t, _),) = (line for chunk in capture.drain() for line in CAPTURED.iter_unpack(chunk))
    assert t <= arrived_by


@pytest.mark.parametrize("way", carriers.WAYS)
def test_the_end_of_the_bus_is_an_error(way: str) -> None:
    with over("unix", way) as (frames, far):
        far.socket.close()
        with pytest.raises((can.CanError, OSError)):
            frames.receive()
        with pytest.raises((can.CanError, OSError)):
            frames.send(Frame(0x080))


class Listener:
    """Notes what it hears."""

    def __init__(self) -> None:
        self.heard: list[bytes] = []

    def take(self, data: bytearray, now: float) -> None:
        self.heard.append(bytes(data))

    def note_fault(self, cause: str, code: int, text: str) -> None:
        raise AssertionError(text)


@carriers.on_vcan
def test_the_kernel_keeps_out_what_nobody_listens_to_but_no_report_of_the_controller() -> None:
    with carriers.bus("vcan") as (bus, far):
        listener, wire = Listener(), Wire(bus, BusTiming(1_000_000), lambda: None)
        wire.listen(0x281, listener, listener.take)
        wire.listen(0x701, listener, listener.take)
        for identifier in (*range(0x800), 0x281 | EXTENDED):
            far.send(identifier, bytes(4))
        far.send(0x040 | ERROR, bytes(8))
        before = wire.traffic
        wire.receive(0.0)
        assert len(listener.heard) == 2
        assert wire.traffic - before == 2 * 95_000
        assert wire.fault is not None
        assert "bus-off" in wire.fault.message


# ---------------------------------------------------------------------- None is not "nothing left"


class Hesitant(can.BusABC):
    """An interface that gives what it is told to, None among it; without a descriptor."""

    def __init__(self, gives: Sequence[can.Message | None]) -> None:
        self.channel_info = "hesitant"
        self.gives = deque(gives)
        super().__init__(channel="hesitant")

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        pass

    def recv(self, timeout: float | None = None) -> can.Message | None:
        return self.gives.popleft() if self.gives else None


@given(st.lists(st.booleans(), max_size=40))
def test_without_a_descriptor_each_frame_sent_may_be_answered_with_nothing(order: list[bool]) -> None:
    """`order` has True for a frame, False for an acknowledgement, of which there are no more than frames sent."""
    gives = [frame(n) if one else None for n, one in enumerate(order)]
    with Hesitant(gives) as bus:
        frames = PythonCanFrames(bus)
        for _ in range(order.count(False)):
            frames.send(Frame(0x080))
        received = []
        while (one := frames.receive()) is not None:
            received.append(one[0])
    assert received == [n for n, one in enumerate(order) if one]


def test_an_interface_that_never_gives_anything_ends_a_reading() -> None:
    readable, writable = os.pipe()
    os.write(writable, b"!")  # readable, but nothing of it is a frame
    try:
        with Hesitant([]) as bus:
            bus.fileno = lambda: readable  # type: ignore[method-assign]
            assert PythonCanFrames(bus).receive() is None
    finally:
        os.close(readable)
        os.close(writable)


def test_slcans_acknowledgements_do_not_hide_the_frames_behind_them() -> None:
    pytest.importorskip("serial")
    adapter, terminal = pty.openpty()
    listener = Listener()
    try:
        with can.Bus(os.ttyname(terminal), "slcan", sleep_after_open=0.0, ignore_config=True) as bus:
            wire = Wire(bus, BusTiming(1_000_000), lambda: None)
            wire.listen(0x281, listener, listener.take)
            for cycle in range(1, 51):
                for node in (1, 2, 3):
                    wire.send(Frame(0x300 + node, bytes(8)))
                os.read(adapter, 4096)
                answer = b"\r" * 3 + b"t2814%08X\r" % cycle
                os.write(adapter, answer)
                while bus.serialPortOrig.in_waiting < len(answer):  # type: ignore[attr-defined]
                    os.sched_yield()
                wire.receive(0.0)
                assert len(listener.heard) == cycle
            assert wire.fault is None
    finally:
        os.close(adapter)
        os.close(terminal)


class EchoingBus(can.BusABC):
    """A bus that brings back what is sent on it: marked as gs_usb does it, or unmarked as a multicast group does."""

    def __init__(self, *, marked: bool) -> None:
        self.channel_info = "echoing"
        self.arrived: deque[can.Message] = deque()
        self.marked = marked
        super().__init__("echoing")

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        self.arrived.append(msg)
        msg.is_rx = not self.marked

    def recv(self, timeout: float | None = None) -> can.Message | None:
        return self.arrived.popleft() if self.arrived else None


@pytest.mark.parametrize("marked", [True, False])
def test_what_this_end_has_sent_has_not_arrived(marked: bool) -> None:
    """But what another has sent has, though it be the same frame; one of ours that is lost hides none of theirs."""
    with EchoingBus(marked=marked) as bus:
        frames = PythonCanFrames(bus, OwnFrames(bus, unmarked=not marked))
        bus.arrived.append(frame(0x181, b"\1"))
        for identifier in (0x201, 0x080, 0x202):
            frames.send(Frame(identifier))
        bus.arrived.append(frame(0x080))  # theirs
        del bus.arrived[1]  # our first one
        assert arriving(frames, 2) == [(0x181, b"\1"), (0x080, b"")]


@pytest.mark.parametrize("marked", [True, False])
def test_what_this_end_has_sent_is_captured_once(marked: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if not marked:
        monkeypatch.setattr(own_frames, "UdpMulticastBus", EchoingBus)
    capture = Capture()
    with EchoingBus(marked=marked) as bus, CapturedBus(bus, capture) as captured:
        frames = frame_io(captured)
        for identifier in (0x201, 0x080):
            frames.send(Frame(identifier))
            bus.arrived.append(frame(identifier + 1))
        arriving(frames, 2)
        bodies = [body for chunk in capture.drain() for _, body in CAPTURED.iter_unpack(chunk)]
    assert [CAN_FRAME.unpack(body)[0] for body in bodies] == [0x201, 0x080, 0x202, 0x081]
