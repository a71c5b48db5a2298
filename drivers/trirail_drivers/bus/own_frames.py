"""Recognition of the frames that an interface returns to this end, which has sent them."""

from __future__ import annotations

from collections import deque

import can
from can.interfaces.socketcan import SocketcanBus
from can.interfaces.udp_multicast import UdpMulticastBus

from trirail_drivers.bus.frames import can_id

MAX_UNRETURNED = 64
"""Maximum number of sent frames that may still come back. It must exceed the number of frames sent in a cycle."""


class OwnFrames:
    """Frames that this end has sent and that its interface may return: gs_usb marks them, a multicast group does not.

    A multicast group returns them in order.
    """

    def __init__(self, bus: can.BusABC, *, unmarked: bool | None = None) -> None:
        """`unmarked` is True if the bus returns this end's frames without a mark; by default, that is known."""
        unmarked = isinstance(bus, UdpMulticastBus) if unmarked is None else unmarked
        self._sent: deque[tuple[int, bytes]] | None = deque(maxlen=MAX_UNRETURNED) if unmarked else None
        # SocketCAN marks every frame from this machine, including those of other programs.
        self._marked = not isinstance(bus, SocketcanBus)

    def note(self, message: can.Message) -> None:
        """Record a sent frame."""
        if self._sent is not None:
            self._sent.append((can_id(message), bytes(message.data)))

    def include(self, message: can.Message) -> bool:
        """Whether this end has sent a received frame.

        Older frames of this end that have not come back by now count as lost.
        """
        if self._sent is None:
            return self._marked and not message.is_rx
        sent = can_id(message), bytes(message.data)
        if sent not in self._sent:
            return False
        while self._sent.popleft() != sent:
            pass
        return True
