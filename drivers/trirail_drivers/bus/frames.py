"""Classical CAN frames of any protocol, in the Linux layout: struct can_frame of linux/can.h."""

from __future__ import annotations

from struct import Struct
from typing import Final, Protocol

import can

from trirail_drivers.bus import canerrors
from trirail_drivers.bus.can_frame import (
    CAN_FRAME,
    DATA_AT,
    ERROR,
    EXTENDED,
    EXTENDED_BITS,
    HEADER,
    REMOTE,
    STANDARD_BITS,
)
from trirail_drivers.errors import BusError


def frame_bits(n: int) -> int:
    """Return the worst-case length [bits] of a classical frame with `n` data bytes and an 11-bit identifier.

    The frame has 8n + 44 bits, followed by 3 bits of interframe space. 34 + 8n of the bits are subject to bit stuffing,
    which in the worst case adds one bit after the first five and then one after every four (ISO 11898-1).
    """
    return 8 * n + 47 + (34 + 8 * n - 1) // 4


def bits_of(frames: int, data: int) -> float:
    """Return an upper bound [bits] for `frames` frames with `data` bytes in total.

    It exceeds the exact value by at most 1 bit per frame.
    """
    return 8 * data + 47 * frames + (33 * frames + 8 * data) / 4


BITS: Final = tuple(frame_bits(n) for n in range(9))
"""`frame_bits` for each data length."""


class Frame:
    """Frame to send, with an 11-bit identifier. A frame that is sent every cycle is reused and filled with new data."""

    __slots__ = ("bits", "packed")

    def __init__(self, identifier: int, data: bytes = b"", *, remote: bool = False) -> None:
        self.bits = BITS[len(data)]
        """Worst-case length on the bus [bits]."""
        self.packed = bytearray(CAN_FRAME.pack(identifier | REMOTE * remote, len(data), data))
        """`struct can_frame`."""

    @classmethod
    def from_packed(cls, packed: bytes) -> Frame:
        """Return the frame in a `struct can_frame`."""
        frame = cls.__new__(cls)
        frame.bits, frame.packed = BITS[HEADER.unpack_from(packed)[1]], bytearray(packed)
        return frame

    def fill(self, layout: Struct, *values: int) -> None:
        """Replace the data by data of the same length. Raises struct.error if a value does not fit into the layout."""
        layout.pack_into(self.packed, DATA_AT, *values)

    def message(self) -> can.Message:
        """Return the frame as a python-can message."""
        return unpacked(bytes(self.packed))


def can_id(message: can.Message) -> int:
    """Return the identifier with flags of a python-can message, as in `struct can_frame`."""
    flags = EXTENDED * message.is_extended_id | REMOTE * message.is_remote_frame | ERROR * message.is_error_frame
    return message.arbitration_id | flags


def packed(message: can.Message) -> bytes:
    """Return a python-can message as `struct can_frame`."""
    return CAN_FRAME.pack(can_id(message), message.dlc, bytes(message.data))


def unpacked(packed: bytes, timestamp: float = 0.0) -> can.Message:
    """Return a `struct can_frame` as a python-can message; `timestamp` in seconds since 1970."""
    identifier, length, data = CAN_FRAME.unpack(packed)
    return can.Message(
        timestamp=timestamp,
        arbitration_id=identifier & (EXTENDED_BITS if identifier & EXTENDED else STANDARD_BITS),
        is_extended_id=bool(identifier & EXTENDED),
        is_remote_frame=bool(identifier & REMOTE),
        is_error_frame=bool(identifier & ERROR),
        dlc=length,
        data=None if identifier & REMOTE else data[:length],
    )


class FrameSender(Protocol):
    """Sender of set-up frames: a bus, or the cycle's access to a bus."""

    @property
    def channel_info(self) -> str:
        """Name of the bus, for people."""

    def send(self, msg: can.Message) -> None:
        """Send a frame."""


def send_in_setup(bus: FrameSender, frame: Frame) -> None:
    """Send a frame before the cycle runs. Raises BusError if the bus refuses it.

    A full queue is ignored: it occurs while all drives are off and no node acknowledges frames, and the missing answer
    is reported later.
    """
    try:
        bus.send(frame.message())
    except (can.CanError, OSError) as error:
        if canerrors.queue_is_full(error):
            return
        raise BusError(f"cannot send on {bus.channel_info}: {error}; check that the interface is up") from error
