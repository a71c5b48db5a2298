"""Simulated drives for one master in another process, connected by a bus between processes (bus.unixbus).

A single system call waits for a frame or the timer. python-can is not used because it is too slow for the seven frames
per millisecond of a cycle of 1 kHz.
"""

from __future__ import annotations

import contextlib
import socket
import time
from collections.abc import Callable, Collection
from pathlib import Path

from trirail_drivers import config
from trirail_drivers.bus.can_frame import CAN_FRAME, CANFD_FRAME, DATA_AT, FRAME_SIZES, HEADER
from trirail_drivers.bus.frame_io import SO_TIMESTAMPNS, TIMESPEC, TIMESPEC_SPACE
from trirail_drivers.bus.frames import fd_packed
from trirail_drivers.bus.unixbus import widen_send_buffer
from trirail_drivers.connection.opening import simulated_drives
from trirail_drivers.protocols import PROTOCOLS
from trirail_drivers.simulated.exchange import SimulatedExchange

POLL_PERIOD_S = 0.01
"""Period at which the drives' timers are polled while no frame arrives [s]."""


def serve(
    path: Path,
    section: config.Can,
    drives: config.Drives,
    ready: Callable[[], None],
    connected: Callable[[], None],
) -> None:
    """Serve the drives of a configuration to the first client of the socket at `path`, until the client disconnects.

    The path appears once the socket accepts connections. `ready` is called just before the path appears, `connected`
    when the client has connected.
    """
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listening:
        unready = path.with_name(f"{path.name}.new")
        listening.bind(str(unready))
        listening.listen()
        ready()
        unready.rename(path)
        accepted, _ = listening.accept()
    with accepted:
        exchange(accepted, section, drives, connected)


def exchange(
    connection: socket.socket, section: config.Can, drives: config.Drives, connected: Callable[[], None]
) -> None:
    """Connect the drives of a configuration to a master over a socket, which may also be a SocketCAN socket.

    `connected` is called when frames can be received. Return when the other end has disconnected.
    """
    devices, faults = simulated_drives(section, drives)
    states = frozenset[int]().union(*(PROTOCOLS[drives.protocol].states(each.node) for each in devices))
    master = _Master(connection, states, fd=section.fd)
    connected()
    with contextlib.suppress(ConnectionError):
        master.exchange(SimulatedExchange(devices, master.clock, faults, master.emit))


class _Master:
    """Connection to the master. The arriving frames set the time of the drives, so that a stall of this process does
    not affect the drives.

    After a stall, the waiting frames are handled with their arrival times. Of the state frames with which the drives
    answer, only the newest is sent, at the end: otherwise the master would take an old position for a current one.
    """

    def __init__(self, connection: socket.socket, states: Collection[int], *, fd: bool) -> None:
        """`states` contains the identifiers of frames that a newer frame with the same identifier replaces.

        If `fd`, the drives send CAN FD frames.
        """
        self._fd = fd
        self._socket = connection
        self._states = states
        self._held: dict[int, bytes] = {}
        self._now = time.monotonic()
        widen_send_buffer(connection)
        connection.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        # The kernel's receive time-out saves a separate call to poll.
        seconds, rest = divmod(POLL_PERIOD_S, 1.0)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, TIMESPEC.pack(int(seconds), round(rest * 1e6)))

    def clock(self) -> float:
        """Return the drives' time [s], which is the arrival time of the frame being handled, on the monotonic clock."""
        return self._now

    def emit(self, identifier: int, data: bytes) -> None:
        """Send a drive's frame; a state frame is sent only after the waiting frames of the master."""
        frame = CAN_FRAME.pack(identifier, len(data), data)
        if self._fd:
            frame = fd_packed(frame)
        if identifier in self._states:
            self._held[identifier] = frame
        else:
            self._send(frame)

    def exchange(self, drives: SimulatedExchange) -> None:
        """Pass frames and time to the drives until the master disconnects."""
        packet = bytearray(CANFD_FRAME.size)
        receive, buffers, unpack = self._socket.recvmsg_into, [packet], HEADER.unpack_from
        due = self._now
        while True:
            try:
                size, stamped, _, _ = receive(buffers, TIMESPEC_SPACE, socket.MSG_DONTWAIT if self._held else 0)
            except BlockingIOError:  # no frame is left, or none arrived within the time-out
                self._send_held()
                now = time.monotonic()
            else:
                if size not in FRAME_SIZES:
                    return
                seconds, nanoseconds = TIMESPEC.unpack(stamped[0][2])
                waited = time.time() - seconds - nanoseconds * 1e-9
                now = max(self._now, time.monotonic() - max(0.0, waited))
                identifier, length = unpack(packet)
                self._now = now
                drives.receive(identifier, bytes(packet[DATA_AT : DATA_AT + length]), now)
            if now >= due:
                due = now + POLL_PERIOD_S
                self._now = now
                drives.poll(now)

    def _send_held(self) -> None:
        for frame in self._held.values():
            self._send(frame)
        self._held.clear()

    def _send(self, frame: bytes) -> None:
        with contextlib.suppress(BlockingIOError):  # a master that does not read loses frames
            self._socket.send(frame, socket.MSG_DONTWAIT)
