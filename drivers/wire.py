"""A CAN bus as the cycle uses it: it never waits and never raises, and keeps the first fault."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Protocol

import can

from drivers.interface import DriveFault

MOST_FRAMES = 1000
"""Frames taken in by one `receive` at most, so that a chattering bus cannot hold it."""
BUS_OFF = 0x040
"""Error class of a SocketCAN error frame: the controller has left the bus (linux/can/error.h)."""

Handler = Callable[[bytearray, float], None]
"""Takes a frame's data and the time; struct.error if the length is wrong."""


class Listener(Protocol):
    """Whose frame it is."""

    def tell(self, cause: str, code: int, text: str) -> None:
        """Keep what is wrong with it."""


class Wire:
    """The bus, who hears which frame, and the first fault since the last reset.

    `stop` is called in the moment when a fault is latched.
    """

    def __init__(self, bus: can.BusABC, stop: Callable[[], None]) -> None:
        self.bus = bus
        self.fault: DriveFault | None = None
        self._stop = stop
        self._handlers: dict[int, tuple[Listener, Handler]] = {}

    def listen(self, can_id: int, listener: Listener, handler: Handler) -> None:
        """Let a handler have the data frames of an 11-bit identifier."""
        self._handlers[can_id] = listener, handler

    def fail(self, fault: DriveFault) -> None:
        """Latch the first fault."""
        if self.fault is None:
            self.fault = fault
            self._stop()

    def send(self, message: can.Message) -> bool:
        """Send a frame at once; return whether the bus took it."""
        try:
            self.bus.send(message, timeout=0)
        except (can.CanError, OSError) as error:
            self.fail(DriveFault("", "bus", 0, f"CAN bus: cannot send: {error}"))
            return False
        return True

    def receive(self, now: float) -> None:
        """Take in every frame that has arrived."""
        try:
            for _ in range(MOST_FRAMES):
                message = self.bus.recv(0)
                if message is None:
                    return
                self.take(message, now)
        except (can.CanError, OSError) as error:
            self.fail(DriveFault("", "bus", 0, f"CAN bus: cannot receive: {error}"))

    def take(self, message: can.Message, now: float) -> None:
        """Give one frame to who listens to it."""
        if message.is_error_frame:
            if message.arbitration_id & BUS_OFF:
                self.fail(DriveFault("", "bus", 0, "CAN bus: the controller went bus-off"))
            return
        if message.is_extended_id or message.is_remote_frame or message.arbitration_id not in self._handlers:
            return
        listener, handler = self._handlers[message.arbitration_id]
        try:
            handler(message.data, now)
        except struct.error:
            listener.tell("frame", 0, f"frame {message.arbitration_id:03X} has wrong length {len(message.data)}")
