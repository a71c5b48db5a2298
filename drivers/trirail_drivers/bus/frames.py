"""Classical CAN frames, whatever the drives speak, as Linux lays them out: struct can_frame of linux/can.h."""

from __future__ import annotations

from struct import Struct
from typing import Final

import can

from trirail_drivers.bus.can_frame import (
    CAN_FRAME,
    DATA_AT,
    ERROR,
    EXTENDED,
    EXTENDED_BITS,
    HEAD,
    REMOTE,
    STANDARD_BITS,
)
from trirail_drivers.errors import BusError


def frame_bits(n: int) -> int:
    """Bits that a classical frame of `n` data bytes and an 11-bit identifier takes at most.

    8n + 44 bits and 3 of interframe space; 34 + 8n of these are open to bit stuffing, which at worst adds one
    bit after the first five and then one after every four (ISO 11898-1).
    """
    return 8 * n + 47 + (34 + 8 * n - 1) // 4


def bits_of(frames: int, data: int) -> float:
    """Bits that so many frames with so many data bytes in all take at most, at most one more a frame: frame_bits."""
    return 8 * data + 47 * frames + (33 * frames + 8 * data) / 4


BITS: Final = tuple(frame_bits(n) for n in range(9))
"""`frame_bits` of each length."""


class Frame:
    """A frame to be sent, with an 11-bit identifier; one that is sent in every cycle is filled in anew each time."""

    __slots__ = ("bits", "packed")

    def __init__(self, identifier: int, data: bytes = b"", *, remote: bool = False) -> None:
        self.bits = BITS[len(data)]
        """What it takes of the bus at most."""
        self.packed = bytearray(CAN_FRAME.pack(identifier | REMOTE * remote, len(data), data))
        """`struct can_frame`."""

    @classmethod
    def of(cls, packed: bytes) -> Frame:
        """Return a `struct can_frame` as a frame."""
        frame = cls.__new__(cls)
        frame.bits, frame.packed = BITS[HEAD.unpack_from(packed)[1]], bytearray(packed)
        return frame

    def fill(self, layout: Struct, *values: int) -> None:
        """Give it other data, of the same length; struct.error where the layout cannot hold a value."""
        layout.pack_into(self.packed, DATA_AT, *values)

    def message(self) -> can.Message:
        """The frame as python-can has it."""
        return unpacked(bytes(self.packed))


def can_id(message: can.Message) -> int:
    """Identifier and flags of a python-can message, as `struct can_frame` has them."""
    flags = EXTENDED * message.is_extended_id | REMOTE * message.is_remote_frame | ERROR * message.is_error_frame
    return message.arbitration_id | flags


def packed(message: can.Message) -> bytes:
    """A python-can message as `struct can_frame`."""
    return CAN_FRAME.pack(can_id(message), message.dlc, bytes(message.data))


def unpacked(packed: bytes, timestamp: float = 0.0) -> can.Message:
    """A `struct can_frame` as python-can has it; its time in seconds since 1970."""
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


def send_in_setup(bus: can.BusABC, frame: Frame) -> None:
    """Send a frame before the cycle runs; BusError where the bus does not take it."""
    try:
        bus.send(frame.message())
    except (can.CanError, OSError) as error:
        raise BusError(f"cannot send on {bus.channel_info}: {error}; is the interface up?") from error
