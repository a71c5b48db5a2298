"""Foreign drives that take their time: to boot, to answer, to show what was written, to lose their power."""

from __future__ import annotations

import heapq
from collections.abc import Callable
from dataclasses import dataclass
from itertools import count
from typing import Any, Final

import can
from drivers.foreign import DISABLED, ENABLED, ForeignDrive, Habits, Truth, Wires
from rigs import Clock

Delay = Callable[[], float]
"""Draws how long something takes [s]."""
_channels = count()


def at_once() -> float:
    """No delay."""
    return 0.0


@dataclass
class Slowness:
    """How long a drive takes to do what [s]."""

    answer: Delay = at_once
    """To answer an SDO request."""
    effect: Delay = at_once
    """To have, and to show, what was written."""
    brake: float = 0.0
    """To lose its power when told to."""
    boots: float = 0.0
    """Until its boot-up message; before that it hears nothing."""
    shows: int | None = None
    """6061h shows this mode until it has had power for `mode_takes`."""
    mode_takes: float = 0.0
    ignores: int = 0
    """A mode that it does not take up, though it says so."""


class SlowDrive(ForeignDrive):
    """Does later what a foreign drive does at once."""

    def __init__(self, *arguments: Any, slowness: Slowness, **options: Any) -> None:
        self.slowness = slowness
        self._due: list[tuple[float, int, Callable[[], None]]] = []
        self._order = count()
        self._enabled_at: float | None = None
        super().__init__(*arguments, **options)
        self.booted = not slowness.boots
        if slowness.boots:
            self.boots_in(slowness.boots)
        answer: Callable[[bytes], None] = self.local.sdo.send_response
        store = self.local.set_data

        def answered(data: bytes) -> None:
            content = bytes(data)
            self._later(self.slowness.answer(), lambda: answer(content))

        def stored(index: int, subindex: int, data: bytes, check_writable: bool = False) -> None:
            held = self.local.data_store.setdefault(index, {})
            old = held.get(subindex)
            store(index, subindex, data, check_writable)  # refused at once, if at all
            seconds = self.slowness.effect()
            if not seconds:
                return
            new = held.pop(subindex)
            if old is not None:
                held[subindex] = old
            self._later(seconds, lambda: self._shows(index, subindex, new))

        vars(self.local.sdo).update(send_response=answered)
        vars(self.local).update(set_data=stored)

    @property
    def due(self) -> float:
        """When it does something next [s]."""
        return self._due[0][0] if self._due else float("inf")

    def _later(self, seconds: float, action: Callable[[], None]) -> None:
        if seconds:
            heapq.heappush(self._due, (self.clock() + seconds, next(self._order), action))
        else:
            action()

    def boots_in(self, seconds: float) -> None:
        """Boot after so long."""

        def boot() -> None:
            self.booted = True
            self.boot()

        self._later(seconds, boot)

    def _shows(self, index: int, subindex: int, data: bytes) -> None:
        self.local.data_store.setdefault(index, {})[subindex] = data
        self._valid.clear()
        self._mapped_now.clear()
        if index == 0x6060:
            self.mode = int.from_bytes(data, "little", signed=True)

    def _written(self, index: int, subindex: int, od: Any, data: bytes, **more: Any) -> None:
        mode = self.mode
        super()._written(index, subindex, od, data, **more)
        if index == 0x6060 and (self.slowness.effect is not at_once or self.mode == self.slowness.ignores):
            self.mode = mode

    def control(self, word: int) -> None:
        if self.state == ENABLED and not word & 0x02 and self.slowness.brake:
            self._later(self.slowness.brake, self._release)
        else:
            super().control(word)

    def _release(self) -> None:
        self.state, self.cyclic = DISABLED, False

    def _take(self, message: can.Message) -> None:
        if self.booted:
            super()._take(message)

    def _feedback(self) -> None:
        super()._feedback()
        if self.state != ENABLED:
            self._enabled_at = None
        elif self._enabled_at is None:
            self._enabled_at = self.clock()
        shows = self.slowness.shows
        if shows is not None and not self._has_had_power():
            self.put(0x6061, shows)

    def _has_had_power(self) -> bool:
        return self._enabled_at is not None and self.clock() >= self._enabled_at + self.slowness.mode_takes

    def _time(self) -> None:
        while self._due and self._due[0][0] <= self.clock():
            heapq.heappop(self._due)[2]()
        super()._time()


class SlowWires(Wires):
    """A bus on which time passes to the next moment at which something happens."""

    @property
    def slow(self) -> list[SlowDrive]:
        """Its nodes."""
        return [node for node in self.nodes if isinstance(node, SlowDrive)]

    def recv(self, timeout: float | None = None) -> can.Message | None:
        self.pump()
        end = self.turn.now + (timeout or 0.0)
        while (message := self.inner.recv(0)) is None and self.turn.now < end:
            self.turn.now = min(end, *(node.due for node in self.slow))
            self.pump()
        return message


STARTS: Final = (0.01, -0.02, 0.03)


def three_slow(
    name: str, truth: Truth, slow: Callable[[int], Slowness], habits: Habits | None = None
) -> tuple[SlowWires, Clock]:
    """Three drives of one make, the nodes 1, 2, 3, each with its slowness."""
    clock = Clock()
    channel = f"slow-{next(_channels)}"
    wires = SlowWires(channel, clock)
    for node, start in zip((1, 2, 3), STARTS, strict=True):
        bus = can.Bus(channel, interface="virtual")
        wires.nodes.append(SlowDrive(name, node, bus, clock, truth, start, habits, slowness=slow(node)))
    return wires, clock
