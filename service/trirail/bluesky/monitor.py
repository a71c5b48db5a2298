"""Subscriptions of functions to the readings of a device, for bps.monitor of Bluesky."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncGenerator, Callable
from contextlib import aclosing
from typing import Any

from bluesky.protocols import Reading
from ophyd_async.core import Device

from trirail.wire.state import State

Readings = dict[str, Reading[Any]]
Monitor = Callable[[Readings], None]


class Monitored(Device):
    """Device with readings that can be monitored; implements bluesky.protocols.Subscribable."""

    def __init__(self, name: str = "") -> None:
        self._monitors: dict[Monitor, asyncio.Task[None]] = {}
        super().__init__(name)

    def subscribe_reading(self, function: Monitor) -> None:
        """Call a function in the running event loop with the readings of every state.

        If the function is slow, it gets only the newest readings. Raises ValueError if it is already subscribed.
        """
        if function in self._monitors:
            raise ValueError(f"{self.name}: {function!r} is already subscribed; call clear_sub first")
        self._monitors[function] = asyncio.get_running_loop().create_task(self._monitor(function))

    subscribe = subscribe_reading

    def clear_sub(self, function: Monitor) -> None:
        """End a subscription, from any thread. Raises KeyError if the function is not subscribed."""
        task = self._monitors.pop(function)
        with contextlib.suppress(RuntimeError):  # the event loop of the task is closed, so the task has ended
            task.get_loop().call_soon_threadsafe(task.cancel)

    async def _states(self) -> AsyncGenerator[State]:
        """Yield states as they arrive."""
        raise NotImplementedError
        yield

    def _readings(self, state: State) -> Readings:
        raise NotImplementedError

    async def _monitor(self, function: Monitor) -> None:
        try:
            async with aclosing(self._states()) as states:
                async for state in states:
                    if self._monitors.get(function) is not asyncio.current_task():
                        return
                    self._call(function, self._readings(state))
        except Exception:
            self.log.exception("the monitor of %s has ended", self.name)

    def _call(self, function: Monitor, readings: Readings) -> None:
        """Call a subscribed function. An error in the function is logged, and does not end the subscription."""
        try:
            function(readings)
        except Exception:
            self.log.exception("a monitor of %s failed", self.name)
