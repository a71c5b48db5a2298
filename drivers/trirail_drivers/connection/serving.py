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

        def emit(identifier: int, data: bytes) -> None:
            with contextlib.suppress(BlockingIOError):  # a master that does not read loses frames
                master.send(CAN_FRAME.pack(identifier, len(data), data), socket.MSG_DONTWAIT)

        _exchange(master, SimulatedExchange(devices, time.monotonic, faults, emit))


def _exchange(master: socket.socket, drives: SimulatedExchange) -> None:
    """Bring frames and the time to the drives until the master has gone."""
    packet = bytearray(CAN_FRAME.size)
    unpack, receive, clock = CAN_FRAME.unpack, master.recv_into, time.monotonic
    due = clock()
    while True:
        try:
            size = receive(packet)
        except BlockingIOError:  # nothing has come for so long
            now = clock()
        else:
            now = clock()
            if size != CAN_FRAME.size:
                return
            identifier, length, data = unpack(packet)
            drives.receive(identifier, data[:length], now)
        if now >= due:
            due = now + WAIT
            drives.poll(now)
