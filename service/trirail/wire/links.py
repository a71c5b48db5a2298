"""Connections between the loop and the processes beside it: bounded by the kernel, never waited for by the loop.

AF_UNIX sockets of type SEQPACKET keep packets whole and in order.
"""

from __future__ import annotations

import contextlib
import os
import select
import socket
from array import array
from pathlib import Path

from trirail.wire.sizes import MAX_PACKET, MAX_SHARED

_BUFFER = 1 << 22
"""Bytes the kernel may hold for a peer that is slow: seconds of records, where the rights allow it."""
_DESCRIPTOR = array("i").itemsize


class Closed(Exception):
    """The other side has gone."""


class TooLarge(Exception):
    """A packet that is larger than any goal or motion."""


class PacketLink:
    """One side of a connection; neither sending nor receiving ever waits.

    A packet above MAX_PACKET is a file in memory whose descriptor is sent: the kernel's limit for a socket's buffer,
    net.core.wmem_max, is 208 kB as a rule.
    """

    def __init__(self, connected: socket.socket) -> None:
        connected.setblocking(False)
        for option in (socket.SO_SNDBUF, 32):  # 32: SO_SNDBUFFORCE, beyond the system's limit, for root only
            with contextlib.suppress(PermissionError):
                connected.setsockopt(socket.SOL_SOCKET, option, _BUFFER)
        self._socket = connected
        self._arrivals = select.poll()
        self._arrivals.register(connected, select.POLLIN)

    def fileno(self) -> int:
        """For select and its like."""
        return self._socket.fileno()

    def send(self, packet: bytes | bytearray | memoryview) -> bool:
        """Send a packet; False where the peer is so far behind that the kernel takes no more.

        Raises Closed when the peer has gone, TooLarge above MAX_SHARED.
        """
        shared = len(packet) > MAX_PACKET
        file = _share(packet) if shared else None
        if shared and file is None:
            return False
        try:
            if file is None:
                self._socket.send(packet)
            else:
                socket.send_fds(self._socket, [_SHARED], [file])
        except BlockingIOError:
            return False
        except OSError as error:
            raise Closed from error
        finally:
            if file is not None:
                os.close(file)
        return True

    def receive(self) -> bytes | None:
        """Take the next packet, None if there is none. Raises Closed when the peer has gone."""
        if not self._arrivals.poll(0):  # a third of what it takes to fail at receiving: most of the loop's cycles
            return None
        try:
            packet, beside, *_ = self._socket.recvmsg(MAX_PACKET, _DESCRIPTOR_SPACE, socket.MSG_CMSG_CLOEXEC)
        except BlockingIOError:
            return None
        except OSError as error:
            raise Closed from error
        if not packet:
            raise Closed
        return _read_shared(beside[0][2]) if beside else packet

    @property
    def ended(self) -> bool:
        """Whether the peer has gone; what it has sent before may still be there."""
        return any(events & (select.POLLHUP | select.POLLERR) for _, events in self._arrivals.poll(0))

    def close(self) -> None:
        """Let the peer see the end."""
        self._socket.close()


_DESCRIPTOR_SPACE = socket.CMSG_SPACE(_DESCRIPTOR)
_SHARED = b"\0"
"""Sent beside a descriptor: a packet without any byte is the end of a connection."""


def _share(packet: bytes | bytearray | memoryview) -> int | None:
    """Return the descriptor of a file in memory with a packet in it; None where the system has no room for one."""
    if len(packet) > MAX_SHARED:
        raise TooLarge(f"a packet of {len(packet)} bytes: at most {MAX_SHARED} go between the processes")
    with contextlib.suppress(OSError):
        file = os.memfd_create("packet")
        if os.write(file, packet) == len(packet):
            return file
        os.close(file)
    return None


def _read_shared(descriptor: bytes) -> bytes:
    """Return what is in the file of a descriptor that was received, and close it."""
    (file,) = array("i", descriptor)
    try:
        return os.pread(file, os.fstat(file).st_size, 0)  # no larger: memory that is not written costs as much
    finally:
        os.close(file)


def connect(path: Path) -> PacketLink:
    """Connect to a port of the loop. Raises OSError where nobody listens."""
    connecting = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        connecting.connect(str(path))
    except OSError:
        connecting.close()
        raise
    return PacketLink(connecting)


def listen(path: Path) -> socket.socket:
    """Make the socket that a port listens on; a peer may connect from then on, before the loop turns."""
    listening = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    listening.bind(str(path))
    listening.listen(1)
    return listening


class Port:
    """The loop's side: listens, so that a restarted peer can come back; has one peer at most."""

    def __init__(self, listening: socket.socket) -> None:
        self._listening = listening
        self._listening.setblocking(False)
        self._link: PacketLink | None = None
        self._lost = False
        self.dropped = 0
        """Packets that the peer was too slow for, or that are too large."""

    @property
    def connected(self) -> bool:
        """Whether there is a peer."""
        return self._link is not None

    @property
    def calm(self) -> bool:
        """Whether no peer has gone of whom nobody has asked yet."""
        return not self._lost

    @property
    def ended(self) -> bool:
        """Whether the peer has gone, and that has not been found by receiving or sending yet."""
        return self._link is not None and self._link.ended

    def fileno(self) -> int:
        """The peer's descriptor; -1 where there is none."""
        return self._link.fileno() if self._link is not None else -1

    def accept(self) -> bool:
        """Take a peer that waits; True if one has just come."""
        if self._link is not None:
            return False
        try:
            connected, _ = self._listening.accept()
        except BlockingIOError:
            return False
        self._link = PacketLink(connected)
        return True

    def await_peer(self, seconds: float) -> bool:
        """Wait for a peer, before the loop turns; whether one has come."""
        select.select([self._listening], [], [], seconds)
        return self.accept()

    def send(self, packet: bytes | bytearray | memoryview) -> bool:
        """Send if there is a peer that keeps up; what it is too slow for, or is too large, is dropped and counted."""
        if self._link is None:
            return False
        try:
            sent = self._link.send(packet)
        except TooLarge:
            sent = False
        except Closed:
            self.hang_up()
            return False
        if not sent:
            self.dropped += 1
        return sent

    def receive(self) -> bytes | None:
        """Take the next packet; None if there is none, or no peer."""
        if self._link is None:
            return None
        try:
            return self._link.receive()
        except Closed:
            self.hang_up()
            return None

    def take_lost(self) -> bool:
        """Whether a peer has gone since this was last asked."""
        lost, self._lost = self._lost, False
        return lost

    def hang_up(self) -> None:
        """Let go of the peer, as if it had gone."""
        if self._link is not None:
            self._link.close()
            self._link = None
            self._lost = True

    def close(self) -> None:
        """Let go of the peer and of the name."""
        self.hang_up()
        self._listening.close()
