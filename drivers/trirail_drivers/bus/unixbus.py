"""Emulated CAN bus between processes of one machine, for kernels without SocketCAN."""

from __future__ import annotations

import contextlib
import select
import socket
import time
from collections import deque
from pathlib import Path

import can

from trirail_drivers.bus.can_frame import CANFD_FRAME, FRAME_SIZES
from trirail_drivers.bus.frames import fd_message, is_fd, packed, unpacked
from trirail_drivers.errors import BusAbsentError, BusError

SEND_BUFFER_BYTES = 1 << 22
"""Requested size of a socket's send buffer [bytes]; the kernel's limit may be lower."""


class UnixBus(can.BusABC):
    """One end of a bus over an AF_UNIX SOCK_SEQPACKET socket at the path `channel`.

    One end listens, and any number of other ends connect. The listening end relays each frame that it receives to all
    peers except the sender. A peer that does not read loses frames, like a CAN controller with a full buffer. Each
    packet is a `struct can_frame` or a `struct canfd_frame`. Every end receives both; this emulated bus has no bit
    rates, and an end does not detect that another end uses another format.
    """

    def __init__(self, channel: str, listen: bool = False, fd: bool = False, **kwargs: object) -> None:
        """If `fd`, this end sends every data frame as a CAN FD frame with bit rate switch."""
        self._can_protocol = can.CanProtocol.CAN_FD if fd else can.CanProtocol.CAN_20
        self.channel_info = f"unix {channel}"
        self._path = Path(channel)
        self._peers: dict[int, socket.socket] = {}
        self._listener: socket.socket | None = None
        self._arrived: deque[can.Message] = deque()
        self._epoll = select.epoll()
        try:
            if listen:
                self._listener = self._listen()
                self._epoll.register(self._listener, select.EPOLLIN)
            else:
                self._add(_connect(self._path))
        except OSError as error:
            self._epoll.close()
            kind = BusError if listen else BusAbsentError
            raise kind(_remedy(self._path, listen)) from error
        super().__init__(channel, **kwargs)  # type: ignore[arg-type]

    def send(self, msg: can.Message, timeout: float | None = None) -> None:  # noqa: ARG002 - never waits
        """Send a frame to the peers. Raises can.CanOperationError if the listening end is gone or too slow."""
        if is_fd(self):
            msg = fd_message(msg)
        elif msg.is_fd:
            raise can.CanOperationError(f"{self.channel_info}: CAN FD frames cannot be sent; use classical CAN frames")
        packet = packed(msg)
        if self._listener is None:
            try:
                next(iter(self._peers.values())).send(packet)
            except (StopIteration, OSError) as error:
                raise can.CanOperationError(f"{self.channel_info}: cannot send: {error!r}") from error
        else:
            self._relay(packet)

    @property
    def carrier(self) -> socket.socket | None:
        """Socket of a connected end; None for the listening end and after the connection has been lost."""
        return next(iter(self._peers.values()), None) if self._listener is None else None

    def fileno(self) -> int:
        """Return a file descriptor that is readable when a frame or a new peer may have arrived."""
        return self._epoll.fileno()

    def shutdown(self) -> None:
        """Leave the bus. If the listening end leaves, the bus is closed for all peers."""
        if self._is_shutdown:
            return
        super().shutdown()
        for peer in self._peers.values():
            peer.close()
        if self._listener is not None:
            self._listener.close()
            self._path.unlink(missing_ok=True)
        self._epoll.close()

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if not self._arrived:
            for descriptor, _ in self._epoll.poll(timeout):
                peer = self._peers.get(descriptor)
                if peer is not None:
                    self._read_frame(peer)
                elif self._listener is not None:
                    self._add(self._listener.accept()[0])
        return (self._arrived.popleft() if self._arrived else None), False

    def _listen(self) -> socket.socket:
        with contextlib.suppress(OSError):
            _connect(self._path).close()
            raise BusError(
                f"{self.channel_info}: another process already listens on this socket; stop that process or use "
                "another path"
            )
        if self._path.is_socket():
            self._path.unlink()  # left behind by a process that died
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK)
        try:
            listener.bind(str(self._path))
            listener.listen()
        except OSError:
            listener.close()
            raise
        return listener

    def _add(self, peer: socket.socket) -> None:
        peer.setblocking(False)
        self._peers[peer.fileno()] = peer
        self._epoll.register(peer, select.EPOLLIN)

    def _read_frame(self, peer: socket.socket) -> None:
        """Read one frame or the end of file from a peer."""
        try:
            packet = peer.recv(CANFD_FRAME.size)
        except ConnectionError:
            packet = b""
        if len(packet) not in FRAME_SIZES:
            self._epoll.unregister(peer)
            del self._peers[peer.fileno()]
            peer.close()
            if self._listener is None:
                raise can.CanOperationError(f"{self.channel_info}: the listening end has closed the connection")
            return
        self._relay(packet, peer)
        self._arrived.append(unpacked(packet, time.time()))

    def _relay(self, packet: bytes, sender: socket.socket | None = None) -> None:
        if self._listener is None:
            return
        for peer in self._peers.values():
            if peer is not sender:
                with contextlib.suppress(OSError):  # full, or closed, which the next read notices
                    peer.send(packet)


def widen_send_buffer(peer: socket.socket) -> None:
    """Enlarge the send buffer, within the system's limit, so that no frame is lost if the peer reads late."""
    peer.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)


def _connect(path: Path) -> socket.socket:
    peer = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    widen_send_buffer(peer)
    try:
        peer.connect(str(path))
    except OSError:
        peer.close()
        raise
    return peer


def _remedy(path: Path, listen: bool) -> str:
    if listen:
        return (
            f"unix {path}: cannot listen there; check that the folder is writable and the path shorter than 108 bytes"
        )
    return f"unix {path}: no process listens there; start tools/virtual_drives.py --interface unix --channel {path}"
