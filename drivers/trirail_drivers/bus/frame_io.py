"""Sending and receiving of frames in the cycle, without waiting.

The frames pass through the socket of the bus if the bus has one, otherwise through python-can.

python-can opens and configures every bus. If the bus is a socket of `struct can_frame` or `struct canfd_frame`
(SocketCAN, or the bus between processes), packed frames take a fifth of the time of python-can's messages.
"""

from __future__ import annotations

import contextlib
import os
import select
import socket
import time
from collections import deque
from collections.abc import Collection
from struct import Struct
from typing import Final, Protocol

import can
from can.interfaces.socketcan import SocketcanBus
from can.typechecking import CanFilter

from trirail_drivers.bus.can_frame import (
    CANFD_FRAME,
    DATA_AT,
    FD_FLAGS_AT,
    FD_FORMAT,
    FRAME_SIZES,
    HEADER,
    REMOTE,
    STANDARD_BITS,
)
from trirail_drivers.bus.capture import Capture, CapturedBus
from trirail_drivers.bus.frames import Frame, can_id, fd_packed, is_fd
from trirail_drivers.bus.own_frames import OwnFrames
from trirail_drivers.bus.packed_frames import BusAccess, PackedFrames
from trirail_drivers.bus.unixbus import UnixBus

MAX_EMPTY_READS = 64
"""Maximum number of consecutive reads without a frame.

It must exceed the number of acknowledgements in a cycle, since python-can's slcan returns None for each of them.
"""

TIMESPEC: Final = Struct("@ll")
"""`struct timespec` of Linux (seconds, nanoseconds) and `struct timeval` (seconds, microseconds)."""
TIMESPEC_SPACE: Final = socket.CMSG_SPACE(TIMESPEC.size)
SO_TIMESTAMPNS: Final = 35
"""Socket option of asm-generic/socket.h that adds the arrival time to each packet; Python has no name for it."""

Received = tuple[int, bytearray]
"""Identifier with the flags of `struct can_frame`, and data, which is empty for a remote frame."""


class FrameIO(Protocol):
    """Access of the cycle to a bus. Errors are raised as can.CanError or OSError."""

    def send(self, frame: Frame) -> None:
        """Send a frame without waiting, or raise."""

    def receive(self, timeout: float = 0.0) -> Received | None:
        """Return the next frame that has arrived or arrives within `timeout` [s]; otherwise None."""

    def set_identifiers(self, identifiers: Collection[int]) -> None:
        """Restrict receiving to error frames and to data frames with these 11-bit identifiers, if the bus can do so."""


def frame_io(bus: can.BusABC) -> FrameIO:
    """Return the fastest access to a bus."""
    inner, capture = (bus.inner, bus.capture) if isinstance(bus, CapturedBus) else (bus, None)
    if isinstance(inner, UnixBus) and inner.carrier is not None:
        return SocketFrames(inner.carrier, capture, fd=is_fd(inner))
    formats = can.CanProtocol.CAN_20, can.CanProtocol.CAN_FD
    if isinstance(inner, SocketcanBus) and inner.channel and inner.protocol in formats:
        # A capture needs every frame; without one, the kernel filters out frames that have no listener.
        return SocketFrames(inner.socket, capture, interface=inner, filtered=not capture, fd=is_fd(inner))
    return PythonCanFrames(bus, OwnFrames(inner))


class SocketFrames:
    """Frames on a socket that carries one `struct can_frame` or `struct canfd_frame` per packet."""

    def __init__(
        self,
        carrier: socket.socket,
        capture: Capture | None = None,
        interface: SocketcanBus | None = None,
        *,
        filtered: bool = False,
        fd: bool = False,
    ) -> None:
        """`interface` is the bus of a SocketCAN socket.

        If `filtered`, the kernel drops frames that have no listener. If `fd`, data frames are sent as CAN FD frames.
        """
        self._socket = carrier
        self._capture = capture
        self._interface = interface
        self._filtered = filtered
        self._fd = fd
        self._packet = bytearray(CANFD_FRAME.size)
        self._put_back: deque[Received] = deque()
        self._error = 0
        self._poll = select.poll()
        self._poll.register(carrier, select.POLLIN)
        if capture is not None:
            carrier.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)

    def send(self, frame: Frame) -> None:
        """Send a frame without waiting, or raise."""
        packed = fd_packed(frame.packed) if self._fd else frame.packed
        self._socket.send(packed, socket.MSG_DONTWAIT)
        if self._capture is not None:
            self._capture.note(packed, time.time())

    def receive(self, timeout: float = 0.0) -> Received | None:
        """Return the next frame that has arrived or arrives within `timeout` [s]; otherwise None."""
        if self._put_back:
            return self._put_back.popleft()
        if timeout > 0.0:
            self._poll.poll(timeout * 1000.0)
        packet = self._packet
        try:
            if self._error:
                error, self._error = self._error, 0
                raise OSError(error, os.strerror(error))
            if self._capture is None:
                size = self._socket.recv_into(packet, 0, socket.MSG_DONTWAIT)
            else:
                size = self._receive_timed(self._capture)
        except BlockingIOError:
            return None
        except ConnectionError:  # the other end died before it had read all frames
            size = 0
        if size not in FRAME_SIZES:  # 0 means end of file on a SOCK_SEQPACKET socket
            raise can.CanOperationError("the listening end has closed the connection")
        identifier, length = HEADER.unpack_from(packet)
        return identifier, packet[DATA_AT : DATA_AT + (0 if identifier & REMOTE else length)]

    def set_identifiers(self, identifiers: Collection[int]) -> None:
        """Let the kernel drop all other frames. Error frames have a separate filter, which lets them pass."""
        if self._filtered and self._interface is not None:
            filters: list[CanFilter] = [
                {"can_id": identifier, "can_mask": STANDARD_BITS, "extended": False} for identifier in identifiers
            ]
            self._interface.set_filters(filters)

    @property
    def captured(self) -> bool:
        """Whether every frame is captured with its time."""
        return self._capture is not None

    @property
    def access(self) -> BusAccess:
        """Bus access for compiled code: the socket."""
        return BusAccess(self._socket.fileno())

    def put_back(self, arrived: PackedFrames, handled: int, number: int, error: int) -> None:
        """Put frames back that compiled code has received: `number`, of which it has handled the first `handled`.

        `receive` returns the remaining frames, and then raises `error` (errno.h) unless `error` is 0.
        """
        self._put_back.extend(arrived.unpacked(handled, number))
        self._error = error

    def _receive_timed(self, capture: Capture) -> int:
        """Receive a frame into the packet buffer, and capture it with the kernel's arrival time; return its size."""
        size, ancillary, _, _ = self._socket.recvmsg_into([self._packet], TIMESPEC_SPACE, socket.MSG_DONTWAIT)
        arrived = time.time()
        for level, kind, data in ancillary:
            if (level, kind) == (socket.SOL_SOCKET, SO_TIMESTAMPNS):
                seconds, nanoseconds = TIMESPEC.unpack(data)
                arrived = seconds + nanoseconds * 1e-9
        if size in FRAME_SIZES:
            # Not every kernel sets the flag, and in a classical frame the byte is padding.
            flags = self._packet[FD_FLAGS_AT] | FD_FORMAT if size == CANFD_FRAME.size else 0
            self._packet[FD_FLAGS_AT] = flags
            capture.note(self._packet, arrived)
        return size


class PythonCanFrames:
    """Frames sent and received with python-can's own functions, for any interface.

    None from python-can does not mean that no frame is left, since its slcan returns None for each acknowledgement.
    Therefore the bus is read until its file descriptor has no more data. Without a descriptor, it is read once more for
    each sent frame that may have been acknowledged.

    Some interfaces also return the frames that this end has sent. These frames are dropped.
    """

    def __init__(self, bus: can.BusABC, own: OwnFrames | None = None) -> None:
        self._bus = bus
        self._own = OwnFrames(bus) if own is None else own
        self._poll: select.poll | None = None
        self._unanswered = 0
        """Number of sent frames for which the interface may still return None as the acknowledgement."""
        with contextlib.suppress(NotImplementedError, can.CanOperationError):
            descriptor = bus.fileno()
            self._poll = select.poll()
            self._poll.register(descriptor, select.POLLIN)

    def send(self, frame: Frame) -> None:
        """Send a frame without waiting, or raise."""
        message = frame.message()
        self._bus.send(message, timeout=0)
        self._unanswered = min(self._unanswered + 1, MAX_EMPTY_READS)
        self._own.note(message)

    def receive(self, timeout: float = 0.0) -> Received | None:
        """Return the next frame that has arrived or arrives within `timeout` [s]; otherwise None."""
        for _ in range(MAX_EMPTY_READS + 1):
            message = self._bus.recv(timeout)
            if message is None:
                if not self._may_have_more():
                    break
            elif not self._own.include(message):
                return can_id(message), message.data
            timeout = 0.0
        return None

    def set_identifiers(self, identifiers: Collection[int]) -> None:
        """Do nothing, since python-can's interfaces filter frames differently."""

    def _may_have_more(self) -> bool:
        if self._poll is not None:
            return any(events & select.POLLIN for _, events in self._poll.poll(0))
        if self._unanswered == 0:
            return False
        self._unanswered -= 1
        return True
