"""Frames to and from a bus in the cycle, without waiting: on its socket where it has one, else by python-can.

python-can opens and configures the bus, and whatever it knows of interfaces holds. Where the bus is a socket of
`struct can_frame`, which is SocketCAN and the bus between processes, packed frames pass it at a fifth of the price.
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
from can.interfaces.udp_multicast import UdpMulticastBus

from trirail_drivers.bus.can_frame import CAN_FRAME, DATA_AT, HEAD, REMOTE, STANDARD_BITS
from trirail_drivers.bus.capture import Capture, CapturedBus
from trirail_drivers.bus.frames import Frame, can_id
from trirail_drivers.bus.packed_frames import BusAccess, PackedFrames
from trirail_drivers.bus.unixbus import UnixBus

MOST_NOTHINGS = 64
"""Times in a row at most that an interface is read on though it has given no frame: more than a cycle's answers."""

TIME: Final = Struct("@ll")
"""Linux' `struct timespec`: seconds, nanoseconds; and `struct timeval`: seconds, microseconds."""
TIME_SPACE: Final = socket.CMSG_SPACE(TIME.size)
SO_TIMESTAMPNS: Final = 35
"""Socket option of asm-generic/socket.h, which Python does not name: the time of arrival with each packet."""

Received = tuple[int, bytearray]
"""Identifier with the flags of `struct can_frame`, and data; a remote frame has none."""


class FrameIO(Protocol):
    """A bus as the cycle uses it. What goes wrong is raised as can.CanError or OSError."""

    def send(self, frame: Frame) -> None:
        """Send a frame at once, or raise."""

    def receive(self, timeout: float = 0.0) -> Received | None:
        """The next frame that has arrived, or arrives within `timeout` [s]; None where there is none left."""

    def hear(self, identifiers: Collection[int]) -> None:
        """Only data frames of these 11-bit identifiers are needed, and what the controller reports."""


def frame_io(bus: can.BusABC) -> FrameIO:
    """Frames to and from a bus, the cheapest way that it has."""
    inner, capture = (bus.inner, bus.capture) if isinstance(bus, CapturedBus) else (bus, None)
    if isinstance(inner, UnixBus) and inner.carrier is not None:
        return SocketFrames(inner.carrier, capture)
    if isinstance(inner, SocketcanBus) and inner.channel and inner.protocol is can.CanProtocol.CAN_20:
        # What is captured is everything that passes; else the kernel keeps out what nobody listens to.
        return SocketFrames(inner.socket, capture, filtered=None if capture else inner)
    return PythonCanFrames(bus, heard_by_itself=isinstance(inner, UdpMulticastBus))


class SocketFrames:
    """Frames on a socket that carries `struct can_frame`, one a packet."""

    def __init__(
        self, carrier: socket.socket, capture: Capture | None = None, filtered: SocketcanBus | None = None
    ) -> None:
        """`filtered` is the bus of the socket where that has the kernel's filters of identifiers."""
        self._socket = carrier
        self._capture = capture
        self._filtered = filtered
        self._packet = bytearray(CAN_FRAME.size)
        self._handed_in: deque[Received] = deque()
        self._error = 0
        self._poll = select.poll()
        self._poll.register(carrier, select.POLLIN)
        if capture is not None:
            carrier.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)

    def send(self, frame: Frame) -> None:
        """Send a frame at once, or raise."""
        self._socket.send(frame.packed, socket.MSG_DONTWAIT)
        if self._capture is not None:
            self._capture.note(frame.packed, time.time())

    def receive(self, timeout: float = 0.0) -> Received | None:
        """The next frame that has arrived, or arrives within `timeout` [s]; None where there is none left."""
        if self._handed_in:
            return self._handed_in.popleft()
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
        except ConnectionError:  # it has died, with frames that it had not read
            size = 0
        if size != CAN_FRAME.size:
            raise can.CanOperationError("the listening end is gone")
        identifier, length = HEAD.unpack_from(packet)
        return identifier, packet[DATA_AT : DATA_AT + (0 if identifier & REMOTE else length)]

    def hear(self, identifiers: Collection[int]) -> None:
        """Have the kernel drop all other frames; error frames have a filter of their own, which stays open."""
        if self._filtered is not None:
            self._filtered.set_filters(
                [{"can_id": identifier, "can_mask": STANDARD_BITS, "extended": False} for identifier in identifiers]
            )

    @property
    def captured(self) -> bool:
        """Whether every frame is to be noted with its time."""
        return self._capture is not None

    @property
    def access(self) -> BusAccess:
        """The socket."""
        return BusAccess(self._socket.fileno())

    def hand_in(self, arrived: PackedFrames, number: int, error: int) -> None:
        """So many frames that somebody else took from the socket, and the error that he met after them (errno.h)."""
        self._handed_in.extend(arrived.unpacked(number))
        self._error = error

    def _receive_timed(self, capture: Capture) -> int:
        """Receive into the packet, and note it with the time at which the kernel had it."""
        size, ancillary, _, _ = self._socket.recvmsg_into([self._packet], TIME_SPACE, socket.MSG_DONTWAIT)
        arrived = time.time()
        for level, kind, data in ancillary:
            if (level, kind) == (socket.SOL_SOCKET, SO_TIMESTAMPNS):
                seconds, nanoseconds = TIME.unpack(data)
                arrived = seconds + nanoseconds * 1e-9
        if size == CAN_FRAME.size:
            capture.note(self._packet, arrived)
        return size


class PythonCanFrames:
    """Frames by python-can's own send and receive, for whatever interface.

    None from python-can is no sign that nothing is left: its slcan gives one for each acknowledgement. So it is read
    until its descriptor is empty; where it has none, once more for each frame sent, which may have been acknowledged.

    What this end has sent itself is no frame that has arrived: gs_usb marks it, a multicast group just brings it back.
    """

    def __init__(self, bus: can.BusABC, *, heard_by_itself: bool = False) -> None:
        """`heard_by_itself`: the bus brings back, unmarked and in order, what is sent on it."""
        self._bus = bus
        self._own: deque[tuple[int, bytes]] | None = deque(maxlen=MOST_NOTHINGS) if heard_by_itself else None
        # SocketCAN's mark is on whatever comes from this machine, be it another program's.
        self._marks_own = not isinstance(bus, SocketcanBus)
        self._poll: select.poll | None = None
        self._unanswered = 0
        """Frames sent that the interface may still answer with nothing."""
        with contextlib.suppress(NotImplementedError, can.CanOperationError):
            descriptor = bus.fileno()
            self._poll = select.poll()
            self._poll.register(descriptor, select.POLLIN)

    def send(self, frame: Frame) -> None:
        """Send a frame at once, or raise."""
        message = frame.message()
        self._bus.send(message, timeout=0)
        self._unanswered = min(self._unanswered + 1, MOST_NOTHINGS)
        if self._own is not None:
            self._own.append((can_id(message), bytes(message.data)))

    def receive(self, timeout: float = 0.0) -> Received | None:
        """The next frame that has arrived, or arrives within `timeout` [s]; None where there is none left."""
        for _ in range(MOST_NOTHINGS + 1):
            message = self._bus.recv(timeout)
            if message is None:
                if not self._may_have_more():
                    break
            elif not self._is_own(message):
                return can_id(message), message.data
            timeout = 0.0
        return None

    def _is_own(self, message: can.Message) -> bool:
        """Whether this end has sent it; those sent before it that have not come back are lost."""
        if self._own is None:
            return self._marks_own and not message.is_rx
        sent = can_id(message), bytes(message.data)
        if sent not in self._own:
            return False
        while self._own.popleft() != sent:
            pass
        return True

    def hear(self, identifiers: Collection[int]) -> None:
        """Do nothing: filters are each interface's own affair."""

    def _may_have_more(self) -> bool:
        if self._poll is not None:
            return any(events & select.POLLIN for _, events in self._poll.poll(0))
        if self._unanswered == 0:
            return False
        self._unanswered -= 1
        return True
