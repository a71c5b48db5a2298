"""Frames on a SocketCAN interface with the kernel's timestamps, including the frames that this machine sends.

The kernel loops every sent frame back to the other sockets of the interface. Drivers of CAN controllers do so when the
controller has sent the frame, and the frame's timestamp is then the end of the frame on the bus (Linux,
Documentation/networking/can.rst, "Local Loopback of Sent Frames").
"""

from __future__ import annotations

import contextlib
import select
import socket
import time
from collections.abc import Iterator
from struct import Struct
from types import TracebackType
from typing import Final, NamedTuple

from trirail_drivers.bus.can_frame import CANFD_FRAME, DATA_AT, ERROR, FRAME_SIZES, HEADER

_SO_TIMESTAMPING: Final = 37
_SO_RCVBUFFORCE: Final = 33
"""Socket options of asm-generic/socket.h; Python has no names for them."""
_FLAGS: Final = 1 << 2 | 1 << 3 | 1 << 4 | 1 << 6
"""Hardware and software timestamps of received frames, and the report of both (linux/net_tstamp.h,
SOF_TIMESTAMPING_RX_HARDWARE, _RX_SOFTWARE, _SOFTWARE and _RAW_HARDWARE).
"""
TIMESTAMPS: Final = Struct("@6l")
"""`struct scm_timestamping` of linux/errqueue.h: timestamp of the kernel, an unused one, and that of the hardware."""
_RECEIVE_BUFFER: Final = 4 << 20
"""Receive buffer of the socket [bytes], if this process has the right to exceed the limit of the system."""
_SPACE: Final = socket.CMSG_SPACE(TIMESTAMPS.size) + socket.CMSG_SPACE(64)


class StampedFrame(NamedTuple):
    """Frame on the bus, with the time at which its last bit was sent or received."""

    identifier: int
    """Identifier with the flags of `struct can_frame`."""
    data: bytes
    t: int
    """Timestamp [ns]; the clock is that of the hardware or of the kernel."""
    is_local: bool
    """Whether a program on this machine has sent the frame."""
    is_hardware: bool
    """Whether the timestamp is from the CAN controller; otherwise it is from the kernel."""


class Loopback:
    """Socket that receives all frames of a SocketCAN interface, and never sends."""

    def __init__(self, channel: str) -> None:
        """Open the interface `channel`. Raises OSError if that is not possible."""
        self._socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW | socket.SOCK_NONBLOCK, socket.CAN_RAW)
        try:
            with contextlib.suppress(OSError):
                self._socket.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, _RECEIVE_BUFFER)
            self._socket.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPING, _FLAGS)
            self._socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FD_FRAMES, 1)
            self._socket.bind((channel,))
        except OSError:
            self._socket.close()
            raise
        self._poll = select.poll()
        self._poll.register(self._socket, select.POLLIN)

    def __enter__(self) -> Loopback:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._socket.close()

    def arrived(self) -> Iterator[StampedFrame]:
        """Yield the frames that have arrived, except error frames. Raises OSError if the interface is lost."""
        while True:
            try:
                packet, ancillary, flags, _ = self._socket.recvmsg(CANFD_FRAME.size, _SPACE)
            except BlockingIOError:
                return
            frame = parse(packet, ancillary, flags)
            if frame is not None:
                yield frame

    def listen(self, seconds: float) -> Iterator[StampedFrame]:
        """Yield all frames that arrive within `seconds` [s], except error frames."""
        deadline = time.monotonic() + seconds
        while (left := deadline - time.monotonic()) > 0.0:
            self._poll.poll(left * 1000.0)
            yield from self.arrived()


def parse(packet: bytes, ancillary: list[tuple[int, int, bytes]], flags: int) -> StampedFrame | None:
    """Return the frame in a packet with its ancillary data and flags, as recvmsg returns them.

    Return None for an error frame and for a packet without a timestamp.
    """
    if len(packet) not in FRAME_SIZES:
        return None
    identifier, length = HEADER.unpack_from(packet)
    for level, kind, content in ancillary:
        if (level, kind) != (socket.SOL_SOCKET, _SO_TIMESTAMPING) or identifier & ERROR:
            continue
        seconds, nanoseconds, _, _, hardware_s, hardware_ns = TIMESTAMPS.unpack(content)
        is_hardware = bool(hardware_s or hardware_ns)
        t = (hardware_s, hardware_ns) if is_hardware else (seconds, nanoseconds)
        # net/can/raw.c marks the frames of all programs on this machine with MSG_DONTROUTE.
        is_local = bool(flags & socket.MSG_DONTROUTE)
        data = packet[DATA_AT : DATA_AT + length]
        return StampedFrame(identifier, data, t[0] * 1_000_000_000 + t[1], is_local, is_hardware)
    return None
