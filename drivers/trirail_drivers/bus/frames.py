"""CAN frames of any protocol, in the Linux layout: struct can_frame of linux/can.h.

A frame does not know whether its bus is a CAN FD bus: the bus sends every data frame in its own format.
"""

from __future__ import annotations

from struct import Struct
from typing import Protocol

import can

from trirail_drivers.bus import canerrors
from trirail_drivers.bus.can_frame import (
    BIT_RATE_SWITCH,
    CAN_FRAME,
    CANFD_FRAME,
    DATA_AT,
    ERROR,
    ERROR_STATE,
    EXTENDED,
    EXTENDED_BITS,
    FD_FLAGS_AT,
    FD_FORMAT,
    HEADER,
    LENGTH_AT,
    REMOTE,
    STANDARD_BITS,
)
from trirail_drivers.errors import BusError


class Frame:
    """Frame to send, with an 11-bit identifier. A frame that is sent every cycle is reused and filled with new data."""

    __slots__ = ("packed",)

    def __init__(self, identifier: int, data: bytes = b"", *, remote: bool = False) -> None:
        self.packed = bytearray(CAN_FRAME.pack(identifier | REMOTE * remote, len(data), data))
        """`struct can_frame`."""

    @classmethod
    def from_packed(cls, packed: bytes) -> Frame:
        """Return the frame in a `struct can_frame`, or in a `struct canfd_frame` with at most 8 data bytes."""
        frame = cls.__new__(cls)
        frame.packed = bytearray(packed[: CAN_FRAME.size])
        return frame

    @property
    def length(self) -> int:
        """Number of data bytes."""
        return self.packed[LENGTH_AT]

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
    """Return a python-can message as `struct can_frame`, or a message of CAN FD as `struct canfd_frame`."""
    identifier, data = can_id(message), bytes(message.data)
    if not message.is_fd:
        return CAN_FRAME.pack(identifier, message.dlc, data)
    flags = FD_FORMAT | BIT_RATE_SWITCH * message.bitrate_switch | ERROR_STATE * message.error_state_indicator
    return CANFD_FRAME.pack(identifier, len(data), flags, data)


def fd_packed(packed: bytes | bytearray) -> bytes:
    """Return a `struct can_frame` as the frame that a CAN FD bus sends.

    A data frame becomes a `struct canfd_frame` with bit rate switch. CAN FD has no remote frames; these and error
    frames do not change.
    """
    identifier, length, data = CAN_FRAME.unpack(packed)
    if identifier & (REMOTE | ERROR):
        return bytes(packed)
    return CANFD_FRAME.pack(identifier, length, FD_FORMAT | BIT_RATE_SWITCH, data)


def fd_message(message: can.Message) -> can.Message:
    """Return the message that a CAN FD bus sends for a message with at most 8 data bytes; see `fd_packed`."""
    return message if message.is_fd else unpacked(fd_packed(packed(message)), message.timestamp)


def unpacked(packed: bytes, timestamp: float = 0.0) -> can.Message:
    """Return a `struct can_frame` or `struct canfd_frame` as a python-can message.

    `timestamp` is in seconds since 1970.
    """
    identifier, length = HEADER.unpack_from(packed)
    data, fd = packed[DATA_AT:], len(packed) == CANFD_FRAME.size
    flags = packed[FD_FLAGS_AT] if fd else 0
    return can.Message(
        is_fd=fd,
        bitrate_switch=bool(flags & BIT_RATE_SWITCH),
        error_state_indicator=bool(flags & ERROR_STATE),
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

    @property
    def protocol(self) -> can.CanProtocol:
        """Whether the bus is a bus of classical CAN or of CAN FD."""

    def send(self, msg: can.Message) -> None:
        """Send a frame."""


def is_fd(bus: FrameSender) -> bool:
    """Whether a bus sends every data frame as a CAN FD frame with bit rate switch."""
    return bus.protocol is can.CanProtocol.CAN_FD


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
