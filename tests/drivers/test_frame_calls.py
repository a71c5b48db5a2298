"""Frames that compiled code moves by calling Python: the same as if Python had moved them itself."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import weakref
from collections import deque
from collections.abc import Collection

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st
from trirail_drivers.bus.can_frame import CAN_FRAME
from trirail_drivers.bus.frame_calls import FrameCalls
from trirail_drivers.bus.frame_io import Received
from trirail_drivers.bus.frames import Frame
from trirail_drivers.bus.packed_frames import PackedFrames, packed_frames

ROOM = 8
NUMBER = ctypes.c_int64
ERRORS = (can.CanOperationError("gone"), OSError(100, "down"), RuntimeError("a maker's own"), KeyboardInterrupt())


class Fake:
    """A bus that gives and refuses as it is told to."""

    def __init__(self, arriving: Collection[Received | BaseException] = (), refused: int = -1) -> None:
        self.arriving = deque(arriving)
        self.sent: list[bytes] = []
        self.refused = refused
        self.error: BaseException = ERRORS[0]

    def send(self, frame: Frame) -> None:
        if len(self.sent) == self.refused:
            self.refused = -1
            raise self.error
        self.sent.append(bytes(frame.packed))

    def receive(self, timeout: float = 0.0) -> Received | None:
        found = self.arriving.popleft() if self.arriving else None
        if isinstance(found, BaseException):
            raise found
        return found

    def set_identifiers(self, identifiers: Collection[int]) -> None:
        """Hear all."""

    def reopen(self) -> None:
        """Do nothing."""


def called(address: int, frames: PackedFrames, number: int) -> int:
    """Call as compiled code does."""
    function = ctypes.CFUNCTYPE(NUMBER, NUMBER, NUMBER)(address)
    return int(function(frames.frames.ctypes.data, number))


frames_of_any_length = st.tuples(st.integers(0, 0x7FF), st.binary(max_size=64).map(bytearray))


@given(
    arriving=st.lists(frames_of_any_length, max_size=2 * ROOM),
    handled=st.integers(0, ROOM),
    handed_in=st.integers(0, ROOM),
)
def test_what_is_handed_in_is_received_once_more_in_its_order(
    arriving: list[Received], handled: int, handed_in: int
) -> None:
    """Frames of CAN FD too, which are longer than there is room for."""
    frames, room = FrameCalls(Fake(arriving)), PackedFrames(ROOM)
    number = called(frames.access.receive, room, ROOM)
    assert number == min(len(arriving), ROOM)
    for row, (identifier, data) in zip(room.frames[:number], arriving, strict=False):
        assert row.tobytes()[: CAN_FRAME.size] == CAN_FRAME.pack(identifier, len(data), data)
    frames.put_back(room, handled, handed_in, 0)
    left = [*arriving[:number][handled:handed_in], *arriving[number:]]
    assert [frames.receive() for _ in range(len(left) + 1)] == [*left, None]


@pytest.mark.parametrize("error", ERRORS)
@pytest.mark.parametrize("before", range(ROOM))
def test_an_error_is_raised_behind_the_frames_before_it_and_once(before: int, error: BaseException) -> None:
    first: list[Received] = [(0x181 + i, bytearray([i])) for i in range(before)]
    last: Received = 0x7FF, bytearray(b"last")
    frames, room = FrameCalls(Fake([*first, error, last])), PackedFrames(ROOM)
    assert called(frames.access.receive, room, ROOM) == ~before
    frames.put_back(room, 0, before, 0)
    assert [frames.receive() for _ in range(before)] == first
    with pytest.raises(type(error)):
        frames.receive()
    assert [frames.receive(), frames.receive()] == [last, None]


@pytest.mark.parametrize("error", ERRORS)
@pytest.mark.parametrize("refused", range(5))
def test_a_refused_frame_is_refused_again_and_not_tried_twice(refused: int, error: BaseException) -> None:
    bus = Fake(refused=refused)
    bus.error = error
    frames, sent = FrameCalls(bus), packed_frames([Frame(0x200 + i, bytes([i])) for i in range(4)])
    taken = called(frames.access.send, sent, 4)
    assert taken == min(refused, 4)
    for number in range(taken, 4):
        frame = Frame.from_packed(sent.frames[number].tobytes())
        if number == refused:
            with pytest.raises(type(error)):
                frames.send(frame)
        else:
            frames.send(frame)
    assert bus.sent == [row.tobytes()[: CAN_FRAME.size] for number, row in enumerate(sent.frames) if number != refused]


class Down(Fake):
    """A bus on which everything fails."""

    def __init__(self) -> None:
        super().__init__()
        self.raised: list[weakref.ref[BaseException]] = []

    def error_now(self) -> BaseException:
        error = can.CanOperationError("down")
        self.raised.append(weakref.ref(error))
        return error

    def send(self, frame: Frame) -> None:
        raise self.error_now()

    def receive(self, timeout: float = 0.0) -> Received | None:
        raise self.error_now()


def test_no_error_is_kept_after_it_was_raised() -> None:
    """The loop runs without a garbage collector, and a bus that is down may fail in each cycle."""
    bus, frame = Down(), Frame(0x200, b"")
    frames, room = FrameCalls(bus), PackedFrames(ROOM)
    gc.disable()
    try:
        called(frames.access.receive, room, ROOM)
        with contextlib.suppress(can.CanOperationError):
            frames.receive()
        called(frames.access.send, packed_frames([frame]), 1)
        with contextlib.suppress(can.CanOperationError):
            frames.send(frame)
        assert [error() for error in bus.raised] == [None, None]
    finally:
        gc.enable()
