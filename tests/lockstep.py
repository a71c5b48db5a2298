"""Buses whose two ends take turns: what the service sends waits until the test brings it to the drives.

"unix" is the bus between processes, a socket of `struct can_frame`; "captured" the same with every frame noted down;
"fd" is the same as a CAN FD bus; "virtual" is python-can's, which stands for every interface that has no such socket.
"""

from __future__ import annotations

import contextlib
import itertools
import socket
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Final, Protocol

import can
from can.interfaces.virtual import VirtualBus
from trirail_drivers.bus.can_frame import CAN_FRAME, CANFD_FRAME, STANDARD_BITS
from trirail_drivers.bus.capture import Capture, CapturedBus
from trirail_drivers.bus.frames import packed, unpacked
from trirail_drivers.bus.unixbus import UnixBus

CARRIERS: Final = ("unix", "captured", "virtual")
"""Buses of classical CAN."""
STEP_NS: Final = 200_000
"""How time passes for who waits."""
FILLER: Final = CAN_FRAME.pack(STANDARD_BITS, 0, b"")
"""What a full bus is full of: nobody hears it."""
ROOM_BYTES: Final = 1 << 17
"""Send buffer of the service's end, for 342 frames: the usual one takes 11,000, which a test would have to fill up."""
_channels = itertools.count()


class Time(Protocol):
    """What a wait goes by."""

    now_ns: int

    def pass_time(self, ns: int) -> None:
        """Let the bus' other end live for so long."""


class Waiting(can.BusABC):
    """The service's end, whose other end lives while it waits."""

    time: Time

    def recv(self, timeout: float | None = None) -> can.Message | None:
        end = self.time.now_ns + round((timeout or 0.0) * 1e9)
        while (found := super().recv(0)) is None and self.time.now_ns < end:
            self.time.pass_time(STEP_NS)
        return found


class WaitingUnix(Waiting, UnixBus):
    """Over a socket."""


class WaitingVirtual(Waiting, VirtualBus):
    """Over queues of this process."""

    broken = False
    """Whether the adapter has gone."""

    def __init__(self, channel: str) -> None:
        self.refused: dict[int, Exception] = {}
        """By identifier: the next frame that is refused, and how."""
        super().__init__(channel)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        found = super()._recv_internal(timeout)
        if self.broken and found[0] is None:
            raise can.CanOperationError("the adapter is gone")
        return found

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        if self.broken:
            raise can.CanOperationError("the adapter is gone", 19)
        if (refusal := self.refused.pop(msg.arbitration_id, None)) is not None:
            raise refusal
        super().send(msg, timeout)


class Lockstep:
    """Both ends of a bus."""

    def __init__(self, carrier: str, folder: Path, time: Time) -> None:
        self.capture = Capture()
        """What has passed a captured one."""
        self._stack = ExitStack()
        self.bus: can.BusABC
        """The service's end."""
        self.take: Callable[[], bytes | None]
        """Returns the next frame that the service has sent, None where there is none."""
        self.say: Callable[[bytes], None]
        """Sends the service a frame."""
        self.die: Callable[[], None]
        """Ends the bus for the service, for good."""
        self.leave_room: Callable[[int], None]
        """Has the bus take so many frames more, until some are taken from it."""
        self.refuse: Callable[[int, Exception], None]
        """Has the bus refuse the next frame of an identifier."""
        self._virtual(time) if carrier == "virtual" else self._socket(carrier, folder, time)
        self._stack.callback(self.bus.shutdown)

    def close(self) -> None:
        """Leave both ends."""
        self._stack.close()

    def _virtual(self, time: Time) -> None:
        channel = f"lockstep-{next(_channels)}"
        self.bus = bus = WaitingVirtual(channel)
        bus.time = time
        end = VirtualBus(channel)
        self._stack.callback(end.shutdown)
        self.take = lambda: packed(found) if (found := end.recv(0)) is not None else None
        self.say = lambda packet: end.send(unpacked(packet))
        self.die = lambda: setattr(bus, "broken", True)
        self.refuse = bus.refused.__setitem__

    def _socket(self, carrier: str, folder: Path, time: Time) -> None:
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listening:
            listening.bind(str(folder / "can"))
            listening.listen()
            bus = WaitingUnix(str(folder / "can"), fd=carrier == "fd")
            bus.time = time
            assert bus.carrier is not None
            bus.carrier.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, ROOM_BYTES)
            end, _ = listening.accept()
        end.setblocking(False)
        self._stack.callback(end.close)
        self.bus = CapturedBus(bus, self.capture) if carrier == "captured" else bus

        def take() -> bytes | None:
            with contextlib.suppress(BlockingIOError):
                while (packet := end.recv(CANFD_FRAME.size)) == FILLER:
                    pass
                return packet
            return None

        def leave_room(frames: int) -> None:
            assert bus.carrier is not None
            with contextlib.suppress(BlockingIOError):
                while True:
                    bus.carrier.send(FILLER, socket.MSG_DONTWAIT)
            for _ in range(frames):
                assert end.recv(CANFD_FRAME.size) == FILLER

        def say(packet: bytes) -> None:
            end.send(packet)

        self.take, self.say, self.die, self.leave_room = take, say, end.close, leave_room
