"""Bus on which no other program may be the master of the drives."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Final

import can

from trirail_drivers.bus.own_frames import OwnFrames
from trirail_drivers.driver.conversations import Wait, receive, run_concurrently
from trirail_drivers.errors import DriveError
from trirail_drivers.interface import Clock

LISTEN_TIME_S: Final = 0.5
"""Shortest time spent listening for another master before the first frame is sent [s]."""

Recognition = Callable[[can.Message], str]
"""Function that returns what another master does with a received frame, or "" if the frame is from no master."""


class ExclusiveBus(can.BusABC):
    """Bus that raises DriveError if another master sends a frame. Closing it does not close the inner bus."""

    def __init__(self, bus: can.BusABC, recognise: Recognition) -> None:
        self.inner = bus
        self._own = OwnFrames(bus)
        self._recognise = recognise
        self._can_protocol = bus.protocol
        super().__init__(channel=bus.channel_info)
        self.channel_info = bus.channel_info

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send a frame."""
        self.inner.send(msg, timeout)
        self._own.note(msg)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """Receive a frame. Raises DriveError if another master sent it."""
        frame = self.inner.recv(timeout)
        if frame is None or frame.is_error_frame or frame.is_extended_id or self._own.include(frame):
            return frame
        if text := self._recognise(frame):
            raise DriveError(
                f"another master is on the bus and {text} (identifier {frame.arbitration_id:03X}); "
                "stop the service (trirail run) or the other program"
            )
        return frame


@contextmanager
def watched_bus(bus: can.BusABC, clock: Clock, recognise: Recognition, seconds: float = 0.0) -> Iterator[ExclusiveBus]:
    """Listen for another master without sending a frame, and yield a bus that continues to watch for one.

    It listens for LISTEN_TIME_S, and at least for `seconds`. Raises DriveError if another master sends a frame, and
    BusError if the bus is lost.
    """

    async def listen() -> None:
        await Wait(lambda _: False, clock() + max(LISTEN_TIME_S, seconds))

    with ExclusiveBus(bus, recognise) as watched:
        for end in run_concurrently(watched, clock, [listen()], lambda: "listening for another master"):
            if end is not None:
                raise end
        yield watched


def check_unused(bus: can.BusABC, clock: Clock, recognise: Recognition, seconds: float = 0.0) -> None:
    """Raise DriveError if another master sends a frame before the drives are set up, and BusError if the bus is lost.

    Frames received before the check are dropped, since they may be from this program, or from a service that has been
    stopped in the meantime.
    """
    # The machine's clock ends this on a busy bus, since the clock of simulated drives does not advance here.
    end = time.monotonic() + LISTEN_TIME_S
    while time.monotonic() < end and receive(bus, 0.0) is not None:
        pass
    with watched_bus(bus, clock, recognise, seconds):
        pass
