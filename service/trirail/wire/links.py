"""Connections between the loop and the other processes, on which the loop never blocks.

The connections are AF_UNIX sockets of type SEQPACKET, which preserve the boundaries and the order of packets. The
kernel limits the sizes of their buffers.
"""

from __future__ import annotations

import contextlib
import os
import select
import socket
from array import array
from collections.abc import Iterator
from pathlib import Path

from trirail.wire.sizes import MAX_PACKET, MAX_SHARED

_BUFFER = 1 << 22
"""Size of the kernel's buffer for a slow peer [bytes], enough for seconds of records.

Without the right to exceed net.core.wmem_max, the process gets a smaller buffer."""
PACKETS_PER_TURN = 64
"""Maximum number of packets that are handled before other work is due."""
_DESCRIPTOR = array("i").itemsize


class LinkClosed(Exception):
    """Exception raised if the peer has closed the connection."""


class TooLarge(Exception):
    """Exception raised if a packet exceeds MAX_SHARED."""


class PacketLink:
    """One side of a connection, which never blocks while it sends or receives.

    The kernel limits the buffer of a socket to net.core.wmem_max, usually 208 kB. A packet that is larger than
    MAX_PACKET is therefore written to a file in memory, and the file's descriptor is sent.
    """

    def __init__(self, connected: socket.socket) -> None:
        connected.setblocking(False)
        for option in (socket.SO_SNDBUF, 32):  # 32 is SO_SNDBUFFORCE, with which root may exceed the system's limit
            with contextlib.suppress(PermissionError):
                connected.setsockopt(socket.SOL_SOCKET, option, _BUFFER)
        self._socket = connected
        self._arrivals = select.poll()
        self._arrivals.register(connected, select.POLLIN)

    def fileno(self) -> int:
        """Return the file descriptor, for select and poll."""
        return self._socket.fileno()

    def send(self, packet: bytes | bytearray | memoryview) -> bool:
        """Send a packet. Return False if the packet was not sent because the kernel has no space for it.

        The usual reason is a slow peer. Raises LinkClosed if the peer has closed the connection, and TooLarge if the
        packet exceeds MAX_SHARED.
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
        """Return the next packet; None if no packet has arrived.

        Raises LinkClosed if the peer has closed the connection.
        """
        # In most cycles of the loop no packet has arrived. A poll takes a third of the time of a failing recvmsg.
        if not self._arrivals.poll(0):
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

    def packets(self) -> Iterator[bytes]:
        """Yield the packets that have arrived, at most PACKETS_PER_TURN.

        Because of the limit, a peer that sends without a pause does not prevent this side from doing other work.
        Raises LinkClosed if the peer has closed the connection.
        """
        for _ in range(PACKETS_PER_TURN):
            if (packet := self.receive()) is None:
                return
            yield packet

    @property
    def ended(self) -> bool:
        """True if the peer has closed the connection. Earlier packets of the peer may still be waiting."""
        return any(events & (select.POLLHUP | select.POLLERR) for _, events in self._arrivals.poll(0))

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()


_DESCRIPTOR_SPACE = socket.CMSG_SPACE(_DESCRIPTOR)
_SHARED = b"\0"
"""Byte that is sent together with a descriptor, because an empty packet would mean the end of the connection."""


def _share(packet: bytes | bytearray | memoryview) -> int | None:
    """Return the descriptor of a new file in memory that contains a packet; None if the file cannot be created."""
    if len(packet) > MAX_SHARED:
        raise TooLarge(f"packet: {len(packet)} bytes exceed the maximum between processes, {MAX_SHARED} bytes")
    with contextlib.suppress(OSError):
        file = os.memfd_create("packet")
        if os.write(file, packet) == len(packet):
            return file
        os.close(file)
    return None


def _read_shared(descriptor: bytes) -> bytes:
    """Return the content of the file that belongs to a received descriptor, and close the file."""
    (file,) = array("i", descriptor)
    try:
        return os.pread(file, os.fstat(file).st_size, 0)  # the exact size, since a larger buffer would be cleared first
    finally:
        os.close(file)


def connect(path: Path) -> PacketLink:
    """Return a connection to the loop's port at a path. Raises OSError if no process listens at this path."""
    connecting = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        connecting.connect(str(path))
    except OSError:
        connecting.close()
        raise
    return PacketLink(connecting)


def listen(path: Path) -> socket.socket:
    """Return a listening socket for a port, to which peers can connect even before the loop runs. Raises OSError."""
    listening = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        listening.bind(str(path))
    except OSError:
        listening.close()
        raise
    listening.listen(1)
    return listening


class Port:
    """Port of the loop to which one peer at a time can connect, such as the gateway.

    The port continues to listen, so that a restarted peer can reconnect.
    """

    def __init__(self, listening: socket.socket) -> None:
        self._listening = listening
        self._listening.setblocking(False)
        self._link: PacketLink | None = None
        self._lost = False
        self.dropped = 0
        """Number of packets dropped because the peer was too slow or because they were too large."""

    @property
    def connected(self) -> bool:
        """True if a peer is connected."""
        return self._link is not None

    @property
    def no_peer_lost(self) -> bool:
        """True if no peer was lost since the last call of `clear_lost`."""
        return not self._lost

    @property
    def ended(self) -> bool:
        """True if the peer has closed the connection, but no call has noticed the closed connection yet."""
        return self._link is not None and self._link.ended

    def fileno(self) -> int:
        """Return the descriptor of the connection; -1 if no peer is connected."""
        return self._link.fileno() if self._link is not None else -1

    def accept(self) -> bool:
        """Accept a peer that wants to connect. Return True if a peer was accepted."""
        if self._link is not None:
            return False
        try:
            connected, _ = self._listening.accept()
        except OSError:  # no peer wants to connect, or no descriptor is free; the peer then continues to wait
            return False
        self._link = PacketLink(connected)
        return True

    def await_peer(self, seconds: float) -> bool:
        """Wait at most `seconds` for a peer, before the loop runs. Return True if a peer has connected."""
        select.select([self._listening], [], [], seconds)
        return self.accept()

    def send(self, packet: bytes | bytearray | memoryview) -> bool:
        """Send a packet if a peer is connected. Return True if the packet was sent.

        A packet that the connection cannot accept is dropped and counted.
        """
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
        """Return the next packet; None if no packet has arrived or no peer is connected."""
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
        """Close the connection to the peer, which then counts as lost."""
        if self._link is not None:
            self._link.close()
            self._link = None
            self._lost = True

    def close(self) -> None:
        """Close the connection to the peer, and stop listening."""
        self.hang_up()
        self._listening.close()
