"""A CAN bus as the cycle uses it: it never waits and never raises, and keeps the first fault."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Protocol

import can

from trirail_drivers import canerrors
from trirail_drivers.frames import frame_bits
from trirail_drivers.interface import DriveFault

MOST_FRAMES = 1000
"""Frames taken in by one `receive` at most, so that a chattering bus cannot hold it."""
UNSENT_CYCLES = 3
"""So many cycles in a row with a full transmit queue are a fault."""

_BITS = tuple(frame_bits(n) for n in range(9))

Handler = Callable[[bytearray, float], None]
"""Takes a frame's data and the time; struct.error if the length is wrong."""


class Listener(Protocol):
    """Whose frame it is."""

    def tell(self, cause: str, code: int, text: str) -> None:
        """Keep what is wrong with it."""


class Wire:
    """The bus, who hears which frame, the first fault since the last reset, and what else people should know.

    `stop` is called in the moment when a fault is latched.
    """

    def __init__(self, bus: can.BusABC, stop: Callable[[], None]) -> None:
        self.bus = bus
        self.traffic = 0
        """Bits of all frames sent and received so far, each with worst-case stuffing."""
        self.fault: DriveFault | None = None
        self._stop = stop
        self._handlers: dict[int, tuple[Listener, Handler]] = {}
        self._warnings: list[str] = []
        self._warned: set[str] = set()
        self._unsent = False
        self._unsent_cycles = 0

    def listen(self, can_id: int, listener: Listener, handler: Handler) -> None:
        """Let a handler have the data frames of an 11-bit identifier."""
        self._handlers[can_id] = listener, handler

    def begin(self) -> None:
        """Note that a cycle begins."""
        self._unsent_cycles = self._unsent_cycles + 1 if self._unsent else 0
        self._unsent = False

    def fail(self, fault: DriveFault) -> None:
        """Latch the first fault."""
        if self.fault is None:
            self.fault = fault
            self._stop()

    def warn(self, text: str) -> None:
        """Tell something once, until faults are reset."""
        if text not in self._warned:
            self._warned.add(text)
            self._warnings.append(text)

    def warnings(self) -> tuple[str, ...]:
        """Hand over what is to be told."""
        told = tuple(self._warnings)
        self._warnings.clear()
        return told

    def reset(self) -> None:
        """Forget the fault and what has been told."""
        self.fault = None
        self._warned.clear()

    def send(self, message: can.Message) -> bool:
        """Send a frame at once; return whether the bus took it.

        One that a full queue does not take is left out and, for a few cycles, no fault.
        """
        try:
            self.bus.send(message, timeout=0)
            self.traffic += _BITS[min(len(message.data), 8)]
        except (can.CanError, OSError) as error:
            text = f"CAN bus: cannot send: {canerrors.cannot_send(error)}"
            self._unsent = True
            if canerrors.queue_is_full(error) and self._unsent_cycles < UNSENT_CYCLES - 1:
                self.warn(text)
            else:
                self.fail(DriveFault("", "bus", 0, text))
            return False
        return True

    def receive(self, now: float) -> None:
        """Take in every frame that has arrived."""
        try:
            for _ in range(MOST_FRAMES):
                message = self.bus.recv(0)
                if message is None:
                    return
                self.traffic += _BITS[min(len(message.data), 8)]
                self.take(message, now)
        except (can.CanError, OSError) as error:
            self.fail(DriveFault("", "bus", 0, f"CAN bus: cannot receive: {error}"))

    def take(self, message: can.Message, now: float) -> None:
        """Give one frame to who listens to it."""
        if message.is_error_frame:
            self._take_error(canerrors.report(message))
            return
        if message.is_extended_id or message.is_remote_frame or message.arbitration_id not in self._handlers:
            return
        listener, handler = self._handlers[message.arbitration_id]
        try:
            handler(message.data, now)
        except struct.error:
            listener.tell("frame", 0, f"frame {message.arbitration_id:03X} has wrong length {len(message.data)}")

    def _take_error(self, report: canerrors.Report) -> None:
        if report.gravity is canerrors.Gravity.FAULT:
            self.fail(DriveFault("", "bus", 0, f"CAN bus: {report.text}"))
        elif report.gravity is canerrors.Gravity.WARNING:
            self.warn(f"CAN bus: {report.text}")
