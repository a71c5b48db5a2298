"""Time to send and receive one cycle's frames, by python-can's SocketCAN and, like the drivers, directly on its socket.

A cycle sends SYNC and three setpoints, finds the bus empty, receives three positions, and finds the bus empty again.
The bus is a virtual CAN bus of the kernel if possible, otherwise python-can's SocketCAN code on a pair of unix sockets.
"""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from typing import Any

import can
import numpy as np
from can.interfaces.socketcan import SocketcanBus
from trirail_drivers.bus.frame_io import FrameIO, PythonCanFrames, SocketFrames
from trirail_drivers.bus.frames import Frame
from trirail_drivers.cia402 import canopen_frames as layout
from trirail_drivers.interface import NAMES

AIM = 10.0
"""Maximum time for one cycle's frames [µs]."""
NODES = range(1, 1 + len(NAMES))


class Loopback(SocketcanBus):
    """python-can's SocketCAN bus on any socket that carries `struct can_frame`."""

    def __init__(self, carrier: socket.socket) -> None:
        self.socket = carrier
        self.channel = self.channel_info = "loopback"
        self._bcm_sockets = {}
        self._is_filtered = False
        self.socket.setsockopt(socket.SOL_SOCKET, 35, 1)  # SO_TIMESTAMPNS, as for every SocketCAN bus
        can.BusABC.__init__(self, channel=self.channel)

    def _apply_filters(self, filters: can.typechecking.CanFilters | None) -> None:
        """Do nothing, since only the kernel's CAN sockets can filter identifiers."""


class Listener:
    """Decoder of positions, which does the same work as a drive's axis."""

    def __init__(self) -> None:
        self.heard = 0

    def decode(self, data: bytearray) -> None:
        """Decode a position."""
        layout.POSITION.unpack(data)
        self.heard += 1


def measure(cycles: int) -> dict[str, Any]:
    """Return the time for one cycle's frames with each method [µs], and the ratio of the two times."""
    with _bus() as (kind, bus, far):
        # Only the transfer of frames is compared: both methods process the contents in the same way.
        ways: dict[str, FrameIO] = {"python_can": PythonCanFrames(bus), "socket": SocketFrames(bus.socket)}
        times: dict[str, list[float]] = {name: [] for name in ways}
        sync, setpoints = Frame(layout.SYNC), [Frame(layout.RPDO2 + node, bytes(8)) for node in NODES]
        positions = [Frame(layout.TPDO2 + node, bytes(4)).packed for node in NODES]
        for _ in range(cycles):
            for name, frames in ways.items():
                times[name].append(_cycle(frames, sync, setpoints, positions, far))
    spreads = {name: _spread(np.array(each) * 1e6) for name, each in times.items()}
    return {
        "bus": kind,
        "cycles": cycles,
        **{f"{name}_us": spread for name, spread in spreads.items()},
        "ratio": spreads["python_can"]["p50"] / spreads["socket"]["p50"],
        "aim_us": AIM,
    }


def _cycle(
    frames: FrameIO, sync: Frame, setpoints: list[Frame], positions: list[bytearray], far: socket.socket
) -> float:
    began = time.perf_counter()
    while frames.receive() is not None:
        pass
    frames.send(sync)
    duration = time.perf_counter() - began
    for position in positions:
        far.send(position)
    listener = Listener()
    began = time.perf_counter()
    while (received := frames.receive()) is not None:
        listener.decode(received[1])
    for frame in setpoints:
        frame.fill(layout.SETPOINT, 123_456, -7890)
        frames.send(frame)
    duration += time.perf_counter() - began
    if listener.heard != len(positions):
        raise SystemExit(f"{listener.heard} of {len(positions)} frames came")
    for _ in range(1 + len(setpoints)):
        far.recv(16)
    return duration


def _spread(microseconds: Any) -> dict[str, float]:
    return dict(zip(("p10", "p50", "p99"), np.percentile(microseconds, (10, 50, 99)).tolist(), strict=True))


@contextlib.contextmanager
def _bus() -> Iterator[tuple[str, SocketcanBus, socket.socket]]:
    with contextlib.ExitStack() as stack:
        try:
            name, take_down = _vcan()
            stack.callback(take_down)
        except (OSError, subprocess.CalledProcessError):
            near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            stack.enter_context(far)
            yield "SocketCAN's code over unix sockets", stack.enter_context(Loopback(near)), far
            return
        bus = stack.enter_context(SocketcanBus(name))
        far = stack.enter_context(socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW))
        far.bind((name,))
        yield "SocketCAN, virtual bus", bus, far


def _vcan() -> tuple[str, Callable[[], object]]:
    """Create a virtual bus; return its name and a function that removes it."""
    socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    name = f"vcan{os.getpid() % 100_000}"

    def ip(*arguments: str) -> None:
        subprocess.run(("ip", "link", *arguments), capture_output=True, check=True)

    ip("add", name, "type", "vcan")
    ip("set", name, "up")
    return name, lambda: ip("delete", name)
