"""Simulated drives for one master in another process, on a bus between processes: trirail_drivers.bus.unixbus.

One call waits for a frame or the time, and python-can has no part: at 1 kHz seven frames pass in every millisecond.
"""

from __future__ import annotations

import contextlib
import socket
import time
from collections.abc import Callable, Collection
from pathlib import Path

from trirail_drivers import config
from trirail_drivers.bus.can_frame import CAN_FRAME
from trirail_drivers.bus.frame_io import SO_TIMESTAMPNS, TIME, TIME_SPACE
from trirail_drivers.bus.unixbus import widen
from trirail_drivers.connection.opening import simulated_drives
from trirail_drivers.protocols import PROTOCOLS
from trirail_drivers.simulated.exchange import SimulatedExchange

WAIT = 0.01
"""How often the drives' timers are looked at that no frame of theirs has looked at [s]."""


def serve(
    path: Path,
    section: config.Can,
    drives: config.Drives,
    ready: Callable[[], None],
    connected: Callable[[], None],
) -> None:
    """Serve the drives of a configuration to the first who connects to the socket at `path`, until it has gone.

    The path is there once it can be connected to. `ready` is called just before, `connected` when somebody has.
    """
    devices, faults = simulated_drives(section, drives)
    states = frozenset[int]().union(*(PROTOCOLS[drives.protocol].states(each.node) for each in devices))
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listening:
        unready = path.with_name(f"{path.name}.new")
        listening.bind(str(unready))
        listening.listen()
        ready()
        unready.rename(path)
        accepted, _ = listening.accept()
    with accepted:
        master = _Master(accepted, states)
        connected()
        with contextlib.suppress(ConnectionError):
            master.exchange(SimulatedExchange(devices, master.clock, faults, master.emit))


class _Master:
    """The other end of the bus. A stall of this process is none of the drives: they live by the arrival of frames.

    What waits is brought to them as of when it came. What they say of their states in that time only the newest of is
    said, once nothing waits any more: else a position of before the stall would pass for one of now.
    """

    def __init__(self, connection: socket.socket, states: Collection[int]) -> None:
        """`states` are the identifiers of frames that a newer one of the same makes worthless."""
        self._socket = connection
        self._states = states
        self._held: dict[int, bytes] = {}
        self._now = time.monotonic()
        widen(connection)
        connection.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        # The kernel's own timeout of a receive: no call beside that.
        seconds, rest = divmod(WAIT, 1.0)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, TIME.pack(int(seconds), round(rest * 1e6)))

    def clock(self) -> float:
        """The time as the drives have it [s]: when what they are brought arrived, by the monotonic clock."""
        return self._now

    def emit(self, identifier: int, data: bytes) -> None:
        """Send a drive's frame."""
        frame = CAN_FRAME.pack(identifier, len(data), data)
        if identifier in self._states:
            self._held[identifier] = frame
        else:
            self._send(frame)

    def exchange(self, drives: SimulatedExchange) -> None:
        """Bring frames and the time to the drives until the master has gone."""
        packet = bytearray(CAN_FRAME.size)
        receive, buffers, unpack = self._socket.recvmsg_into, [packet], CAN_FRAME.unpack
        due = self._now
        while True:
            try:
                size, stamped, _, _ = receive(buffers, TIME_SPACE, socket.MSG_DONTWAIT if self._held else 0)
            except BlockingIOError:  # nothing is left, or has come for so long
                self._send_held()
                now = time.monotonic()
            else:
                if size != CAN_FRAME.size:
                    return
                seconds, nanoseconds = TIME.unpack(stamped[0][2])
                waited = time.time() - seconds - nanoseconds * 1e-9
                now = max(self._now, time.monotonic() - max(0.0, waited))
                identifier, length, data = unpack(packet)
                self._now = now
                drives.receive(identifier, data[:length], now)
            if now >= due:
                due = now + WAIT
                self._now = now
                drives.poll(now)

    def _send_held(self) -> None:
        for frame in self._held.values():
            self._send(frame)
        self._held.clear()

    def _send(self, frame: bytes) -> None:
        with contextlib.suppress(BlockingIOError):  # a master that does not read loses frames
            self._socket.send(frame, socket.MSG_DONTWAIT)
