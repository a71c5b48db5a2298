"""A CAN bus as the cycle uses it: it never waits and never raises, and keeps the first fault."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Protocol

import can

from trirail_drivers.bus import canerrors
from trirail_drivers.bus.can_frame import ERROR, EXTENDED_BITS
from trirail_drivers.bus.frame_calls import lendable
from trirail_drivers.bus.frame_io import frame_io
from trirail_drivers.bus.frames import BITS, Frame
from trirail_drivers.bus.packed_frames import BusAccess, PackedFrames
from trirail_drivers.interface import Clock, DriveFault

MOST_FRAMES = 1000
"""Frames taken in by one `receive` at most, so that a chattering bus cannot hold it."""
UNSENT_CYCLES = 3
"""So many cycles in a row with a full transmit queue are a fault."""

Handler = Callable[[bytearray, float], None]
"""Takes a frame's data and the time; struct.error if the length is wrong."""


class Listener(Protocol):
    """Whose frame it is."""

    def note_fault(self, cause: str, code: int, text: str) -> None:
        """Keep what is wrong with it."""


class Wire:
    """The bus, who hears which frame, the first fault since the last reset, and what else people should know.

    `stop` is called in the moment when a fault is latched.
    """

    def __init__(self, bus: can.BusABC, stop: Callable[[], None]) -> None:
        self.bus = bus
        """For what is no part of the cycle: setting drives up, leaving."""
        self.traffic = 0
        """Bits of all frames sent and received so far, each with worst-case stuffing."""
        self._frames = lendable(frame_io(bus))
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
        self._frames.hear(self._handlers)

    def begin(self) -> None:
        """Note that a cycle begins."""
        self._unsent_cycles = self._unsent_cycles + 1 if self._unsent else 0
        self._unsent = False

    def fail(self, fault: DriveFault) -> None:
        """Latch the first fault."""
        if self.fault is None:
            self.fault = fault
            self._stop()

    @property
    def access(self) -> BusAccess:
        """How somebody else may move frames, beside this object."""
        return self._frames.access

    @property
    def calm(self) -> bool:
        """Whether nothing is wrong, nothing is to be told, and the bus takes what it is given."""
        return self.fault is None and not self._warnings and not self._unsent and self._unsent_cycles == 0

    def hand_in(self, arrived: PackedFrames, number: int, error: int) -> None:
        """So many frames that somebody else took and has not looked at, and the error that he met after them."""
        self._frames.hand_in(arrived, number, error)

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

    def send(self, frame: Frame) -> bool:
        """Send a frame at once; return whether the bus took it.

        One that a full queue does not take is left out and, for a few cycles, no fault.
        """
        try:
            self._frames.send(frame)
        except (can.CanError, OSError) as error:
            text = f"CAN bus: cannot send: {canerrors.cannot_send(error)}"
            self._unsent = True
            if canerrors.queue_is_full(error) and self._unsent_cycles < UNSENT_CYCLES - 1:
                self.warn(text)
            else:
                self.fail(DriveFault("", "bus", 0, text))
            return False
        self.traffic += frame.bits
        return True

    def receive(self, now: float) -> None:
        """Take in every frame that has arrived."""
        try:
            for _ in range(MOST_FRAMES):
                received = self._frames.receive()
                if received is None:
                    return
                self._dispatch(*received, now)
        except (can.CanError, OSError) as error:
            self.fail(DriveFault("", "bus", 0, f"CAN bus: cannot receive: {error}"))

    def wait(self, seconds: float, clock: Clock) -> None:
        """Wait for a frame, at most so long [s], and take it in; not for the cycle. Raises can.CanError, OSError."""
        received = self._frames.receive(seconds)
        if received is not None:
            self._dispatch(*received, clock())

    def _dispatch(self, identifier: int, data: bytearray, now: float) -> None:
        if identifier & ERROR:
            self._take_error(canerrors.report(identifier & EXTENDED_BITS, data))
            return
        self.traffic += BITS[min(len(data), 8)]
        heard = self._handlers.get(identifier)  # identifiers of 29 bits and remote frames have flags, and so no handler
        if heard is None:
            return
        listener, handler = heard
        try:
            handler(data, now)
        except struct.error:
            listener.note_fault("frame", 0, f"frame {identifier:03X} has wrong length {len(data)}")

    def _take_error(self, report: canerrors.Report) -> None:
        if report.gravity is canerrors.Gravity.FAULT:
            self.fail(DriveFault("", "bus", 0, f"CAN bus: {report.text}"))
        elif report.gravity is canerrors.Gravity.WARNING:
            self.warn(f"CAN bus: {report.text}")
