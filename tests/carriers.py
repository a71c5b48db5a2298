"""Buses on a socket, both ways that frames can go over them, and the far end by hand.

`over("unix", "socket")` is a FrameIO and a FarEnd; "vcan" needs the kernel's virtual bus, of which `vcan` is the name.
"""

from __future__ import annotations

import os
import socket
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final, ParamSpec

import can
import pytest
from trirail_drivers.bus.can_frame import CAN_FRAME
from trirail_drivers.bus.capture import Capture, CapturedBus
from trirail_drivers.bus.frame_io import FrameIO, PythonCanFrames, SocketFrames, frame_io
from trirail_drivers.bus.unixbus import UnixBus

P = ParamSpec("P")

NAME: Final = f"vcan{os.getpid() % 100_000}"
"""The virtual bus that tests make."""
WAYS: Final[dict[str, Callable[[can.BusABC], FrameIO]]] = {"python-can": PythonCanFrames, "socket": frame_io}
"""How frames go over a bus that is a socket: as over any of python-can's, or on the socket itself."""


def ip(*arguments: str) -> None:
    """Run `ip`."""
    subprocess.run(("ip", *arguments), capture_output=True, text=True, check=True)


def _lacking() -> str:
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError:
        return "this kernel has no SocketCAN (modprobe can_raw): make hil runs these in a machine that has"
    try:
        ip("link", "add", NAME, "type", "vcan")
    except (OSError, subprocess.CalledProcessError) as error:
        said = getattr(error, "stderr", None) or str(error)
        return f"no virtual CAN bus can be made here (root, modprobe vcan): {said.strip()}"
    ip("link", "delete", NAME)
    return ""


LACKING: Final = _lacking()
"""Why there can be no virtual CAN bus here, empty where there can."""
NEEDS_VCAN: Final = (pytest.mark.vcan, pytest.mark.skipif(bool(LACKING), reason=LACKING))
"""The marks of what needs it."""


def on_vcan(test: Callable[P, None]) -> Callable[P, None]:
    """Mark a test that needs the virtual CAN bus."""
    for mark in NEEDS_VCAN:
        test = mark(test)
    return test


@contextmanager
def vcan() -> Iterator[str]:
    """A virtual bus that is up."""
    ip("link", "add", NAME, "type", "vcan")
    try:
        ip("link", "set", NAME, "up")
        yield NAME
    finally:
        ip("link", "delete", NAME)


class FarEnd:
    """The other end of a bus: a socket of `struct can_frame`."""

    def __init__(self, carrier: socket.socket) -> None:
        self.socket = carrier
        self.socket.settimeout(60.0)

    def send(self, identifier: int, data: bytes = b"", length: int | None = None) -> None:
        """Put a frame on the bus; `identifier` with its flags."""
        self.socket.send(CAN_FRAME.pack(identifier, len(data) if length is None else length, data))

    def receive(self) -> tuple[int, int, bytes]:
        """Identifier with flags, length and data field of the next frame."""
        identifier, length, data = CAN_FRAME.unpack(self.socket.recv(CAN_FRAME.size))
        return identifier, length, data


@contextmanager
def bus(kind: str) -> Iterator[tuple[can.BusABC, FarEnd]]:
    """A bus of python-can's, "unix" or "vcan", and its far end."""
    if kind == "vcan":
        with (
            vcan() as name,
            can.Bus(interface="socketcan", channel=name, ignore_config=True) as opened,
            socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as raw,
        ):
            raw.bind((name,))
            yield opened, FarEnd(raw)
        return
    with tempfile.TemporaryDirectory() as folder, socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
        path = Path(folder) / "can"
        listener.bind(str(path))
        listener.listen()
        with UnixBus(str(path)) as opened, listener.accept()[0] as raw:
            yield opened, FarEnd(raw)


@contextmanager
def over(kind: str, way: str, capture: Capture | None = None) -> Iterator[tuple[FrameIO, FarEnd]]:
    """Frames over a bus, in one way of WAYS, and its far end."""
    with bus(kind) as (opened, far):
        captured = CapturedBus(opened, capture) if capture is not None else opened
        frames = WAYS[way](captured)
        assert isinstance(frames, SocketFrames) == (way == "socket")
        yield frames, far
        captured.shutdown()
