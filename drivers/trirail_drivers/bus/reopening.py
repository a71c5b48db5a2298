"""Reopening of a lost bus in a thread, since an adapter may take seconds to open and the cycle must not wait."""

from __future__ import annotations

import contextlib
import math
import os
import threading
import time
from collections.abc import Callable
from typing import Final

import can

RETRY_AFTER: Final = 0.5
"""Pause between two attempts [s]."""


class AbsentBus(can.BusABC):
    """Placeholder for a bus that is not open: no frame arrives, and no frame can be sent."""

    def __init__(self, name: str, reason: str = "") -> None:
        self.channel_info = name
        self.reason = reason
        """Reason why the bus is not open."""
        super().__init__(channel=name)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:  # noqa: ARG002 - never waits
        """Refuse to send a frame."""
        raise can.CanOperationError(f"{self.channel_info} is not open")

    def recv(self, timeout: float | None = None) -> None:
        """Return None after `timeout` [s], since no frame can arrive."""
        if timeout:
            time.sleep(timeout)


def start_thread(work: Callable[[], None]) -> None:
    """Run `work` in a thread that delays neither the loop nor the end of the process."""

    def run() -> None:
        with contextlib.suppress(OSError):  # else the thread runs at the real-time priority inherited from the loop
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        work()

    threading.Thread(target=run, name="bus", daemon=True).start()


class Reopening:
    """Attempts to open a bus, one at a time. Only the opening itself runs in a thread."""

    def __init__(
        self,
        name: str,
        open_bus: Callable[[], can.BusABC],
        start: Callable[[Callable[[], None]], None] = start_thread,
    ) -> None:
        """`open_bus` may block and raise. `start` starts work in another thread and does not wait for it."""
        self.name = name
        """Name of the bus for people, such as can0."""
        self._open = open_bus
        self._start = start
        self._retired: can.BusABC | None = None
        self._outcome: can.BusABC | str | None = None
        self._under_way = False
        self._due = -math.inf
        self._closed = False

    def retire(self, bus: can.BusABC) -> None:
        """Close a bus before the next attempt, since most adapters can be opened only once."""
        self._retired = bus

    def attempt(self, now: float) -> can.BusABC | str | None:
        """Return the outcome of an attempt that has ended: the opened bus, or the reason why the attempt failed.

        Each outcome is returned once. If there is none, return None, and start a new attempt if one is due.
        """
        if self._under_way:
            outcome = self._outcome
            if outcome is not None:
                self._outcome, self._under_way, self._due = None, False, now + RETRY_AFTER
            return outcome
        if now >= self._due:
            self._under_way = True
            try:
                self._start(self._attempt)
            except RuntimeError as error:  # the system's limit on threads is reached
                self._outcome = str(error)
        return None

    def close(self) -> None:
        """Close a bus that was opened but never returned. A bus that is still being opened is closed afterwards."""
        self._closed = True
        for bus in (self._retired, self._outcome):
            if isinstance(bus, can.BusABC):
                _shut_down(bus)

    def _attempt(self) -> None:
        retired, self._retired = self._retired, None
        if retired is not None:  # also in a thread, since closing an adapter may block
            _shut_down(retired)
        try:
            outcome: can.BusABC | str = self._open()
        except Exception as error:  # noqa: BLE001 - vendor libraries raise any exception
            outcome = " ".join(str(error).split()) or type(error).__name__
        self._outcome = outcome
        if self._closed and isinstance(outcome, can.BusABC):
            _shut_down(outcome)


def _shut_down(bus: can.BusABC) -> None:
    with contextlib.suppress(Exception):  # the adapter may have been removed
        bus.shutdown()
