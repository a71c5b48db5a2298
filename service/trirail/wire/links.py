"""Connections between the loop and the other processes; the kernel bounds their buffers, and the loop never blocks.

AF_UNIX sockets of type SEQPACKET preserve packet boundaries and order.
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
"""Bytes that the kernel may buffer for a slow peer: seconds of records, if the process may set it."""
_DESCRIPTOR = array("i").itemsize


class LinkClosed(Exception):
    """Raised when the peer has closed the connection."""


class TooLarge(Exception):
    """Raised when a packet exceeds MAX_SHARED."""


class PacketLink:
    """One side of a connection; sending and receiving never block.

    A packet above MAX_PACKET is written to a file in memory and its descriptor is sent, because the kernel limits a
    socket's buffer to net.core.wmem_max, usually 208 kB.
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
        """Return the file descriptor, for select and poll."""
        return self._socket.fileno()

    def send(self, packet: bytes | bytearray | memoryview) -> bool:
        """Send a packet; return False if the kernel's buffer is full because the peer is slow.

        Raises LinkClosed if the peer has closed the connection, TooLarge above MAX_SHARED.
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
            raise LinkClosed from error
        finally:
            if file is not None:
                os.close(file)
        return True

    def receive(self) -> bytes | None:
        """Return the next packet, or None. Raises LinkClosed if the peer has closed the connection."""
        if not self._arrivals.poll(0):  # a third of the time of a failing recvmsg, and true in most cycles of the loop
            return None
        try:
            packet, beside, *_ = self._socket.recvmsg(MAX_PACKET, _DESCRIPTOR_SPACE, socket.MSG_CMSG_CLOEXEC)
        except BlockingIOError:
            return None
        except OSError as error:
            raise LinkClosed from error
        if not packet:
            raise LinkClosed
        return _read_shared(beside[0][2]) if beside else packet

    @property
    def ended(self) -> bool:
        """Whether the peer has closed the connection; packets that it sent before may still be waiting."""
        return any(events & (select.POLLHUP | select.POLLERR) for _, events in self._arrivals.poll(0))

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()


_DESCRIPTOR_SPACE = socket.CMSG_SPACE(_DESCRIPTOR)
_SHARED = b"\0"
"""Byte sent with a descriptor, because an empty packet means the end of the connection."""


def _share(packet: bytes | bytearray | memoryview) -> int | None:
    """Return the descriptor of a file in memory that contains a packet; None if the system cannot create it."""
    if len(packet) > MAX_SHARED:
        raise TooLarge(f"packet: {len(packet)} bytes exceed the maximum between processes, {MAX_SHARED} bytes")
    with contextlib.suppress(OSError):
        file = os.memfd_create("packet")
        if os.write(file, packet) == len(packet):
            return file
        os.close(file)
    return None


def _read_shared(descriptor: bytes) -> bytes:
    """Read the file whose descriptor was received, and close the file."""
    (file,) = array("i", descriptor)
    try:
        return os.pread(file, os.fstat(file).st_size, 0)  # its exact size: a larger buffer would be cleared first
    finally:
        os.close(file)


def connect(path: Path) -> PacketLink:
    """Return a connection to a port of the loop. Raises OSError if no process listens."""
    connecting = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        connecting.connect(str(path))
    except OSError:
        connecting.close()
        raise
    return PacketLink(connecting)


def listen(path: Path) -> socket.socket:
    """Return the socket of a port; peers may connect from now on, before the loop runs."""
    listening = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    listening.bind(str(path))
    listening.listen(1)
    return listening


class Port:
    """The loop's side of connections with one kind of peer. It has at most one peer at a time.

    The port keeps listening, so that a restarted peer can reconnect.
    """

    def __init__(self, listening: socket.socket) -> None:
        self._listening = listening
        self._listening.setblocking(False)
        self._link: PacketLink | None = None
        self._lost = False
        self.dropped = 0
        """Number of packets dropped because the peer was too slow, or the packet too large."""

    @property
    def connected(self) -> bool:
        """Whether a peer is connected."""
        return self._link is not None

    @property
    def no_peer_lost(self) -> bool:
        """Whether `clear_lost` would return False."""
        return not self._lost

    @property
    def ended(self) -> bool:
        """Whether the peer has closed the connection and no call has noticed it yet."""
        return self._link is not None and self._link.ended

    def fileno(self) -> int:
        """Return the peer's descriptor; -1 without a peer."""
        return self._link.fileno() if self._link is not None else -1

    def accept(self) -> bool:
        """Accept a waiting peer; return True if one has connected."""
        if self._link is not None:
            return False
        try:
            connected, _ = self._listening.accept()
        except BlockingIOError:
            return False
        self._link = PacketLink(connected)
        return True

    def await_peer(self, seconds: float) -> bool:
        """Wait for a peer, before the loop runs; return True if one has connected."""
        select.select([self._listening], [], [], seconds)
        return self.accept()

    def send(self, packet: bytes | bytearray | memoryview) -> bool:
        """Send a packet if a peer is connected; drop and count a packet that the peer cannot accept."""
        if self._link is None:
            return False
        try:
            sent = self._link.send(packet)
        except TooLarge:
            sent = False
        except LinkClosed:
            self.hang_up()
            return False
        if not sent:
            self.dropped += 1
        return sent

    def receive(self) -> bytes | None:
        """Return the next packet; None without a packet or a peer."""
        if self._link is None:
            return None
        try:
            return self._link.receive()
        except LinkClosed:
            self.hang_up()
            return None

    def clear_lost(self) -> bool:
        """Return True if the peer was lost since the last call."""
        lost, self._lost = self._lost, False
        return lost

    def hang_up(self) -> None:
        """Drop the peer, as if it had closed the connection."""
        if self._link is not None:
            self._link.close()
            self._link = None
            self._lost = True

    def close(self) -> None:
        """Drop the peer and stop listening."""
        self.hang_up()
        self._listening.close()
