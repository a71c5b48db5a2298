"""Simulated drives for one master in another process, on a bus between processes: trirail_drivers.bus.unixbus.

One call waits for a frame or the time, and python-can has no part: at 1 kHz seven frames pass in every millisecond.
"""

from __future__ import annotations

import contextlib
import socket
import struct
import time
from collections.abc import Callable
from pathlib import Path

from trirail_drivers import config
from trirail_drivers.bus.can_frame import CAN_FRAME
from trirail_drivers.bus.unixbus import widen
from trirail_drivers.cia402.canopen_frames import SYNC, TPDO1
from trirail_drivers.connection.opening import simulated_drives
from trirail_drivers.simulated.exchange import SimulatedExchange

WAIT = 0.01
"""How often the drives' timers are looked at that no frame of theirs has looked at [s]."""

_TIMEVAL = struct.Struct("@ll")
"""Linux' `struct timeval`: seconds, microseconds."""


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
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listening:
        unready = path.with_name(f"{path.name}.new")
        listening.bind(str(unready))
        listening.listen()
        ready()
        unready.rename(path)
        master, _ = listening.accept()
    connected()
    with master, contextlib.suppress(ConnectionError):
        widen(master)
        # The kernel's own timeout of a receive: no call beside that.
        seconds, rest = divmod(WAIT, 1.0)
        master.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, _TIMEVAL.pack(int(seconds), round(rest * 1e6)))

        answers = _Answers(master)
        _exchange(master, SimulatedExchange(devices, time.monotonic, faults, answers.emit), answers)


class _Answers:
    """Frames from the drives to the master; those that answer a SYNC wait until no other frame of his is left.

    Where this process was stalled several SYNCs wait. A real drive answers each at once; here what is due at the newest
    is all that the master hears: he would take a position of before the stall for one of now.
    """

    def __init__(self, master: socket.socket) -> None:
        self._master = master
        self._at_sync = False
        self.held: dict[int, bytes] = {}
        """Packed, by their identifiers."""

    def begin(self, identifier: int) -> None:
        """A frame of the master's is brought to the drives."""
        self._at_sync = identifier == SYNC

    def emit(self, identifier: int, data: bytes) -> None:
        """Send a frame of a drive's. Where it answers a SYNC it does so in the place of one before; no EMCY waits."""
        frame = CAN_FRAME.pack(identifier, len(data), data)
        if self._at_sync and identifier > TPDO1:
            self.held[identifier] = frame
        else:
            self._send(frame)

    def send_held(self) -> None:
        """Send what has waited."""
        for frame in self.held.values():
            self._send(frame)
        self.held.clear()

    def _send(self, frame: bytes) -> None:
        with contextlib.suppress(BlockingIOError):  # a master that does not read loses frames
            self._master.send(frame, socket.MSG_DONTWAIT)


def _exchange(master: socket.socket, drives: SimulatedExchange, answers: _Answers) -> None:
    """Bring frames and the time to the drives until the master has gone."""
    packet = bytearray(CAN_FRAME.size)
    unpack, receive, clock = CAN_FRAME.unpack, master.recv_into, time.monotonic
    due = clock()
    while True:
        try:
            size = receive(packet, 0, socket.MSG_DONTWAIT if answers.held else 0)
        except BlockingIOError:  # nothing is left, or has come for so long
            answers.send_held()
            now = clock()
        else:
            now = clock()
            if size != CAN_FRAME.size:
                return
            identifier, length, data = unpack(packet)
            answers.begin(identifier)
            drives.receive(identifier, data[:length], now)
        if now >= due:
            due = now + WAIT
            drives.poll(now)
