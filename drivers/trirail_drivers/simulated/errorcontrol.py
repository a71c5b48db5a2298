"""Error control of a simulated device (CiA 301): heartbeats or, instead of them, node guarding and life guarding."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

from trirail_drivers.simulated.dictionary import Dictionary, ObjectEntry

_TOGGLE: Final = 0x80


class ErrorControl:
    """Supervision of this node by the master (1017h, or node guarding) and of the master by this node (1016h, or life
    guarding).
    """

    def __init__(self, objects: Dictionary, lost: Callable[[], None], changed: Callable[[], None]) -> None:
        """`lost` is called when the master is lost, `changed` when the watched node changes."""
        self._lost = lost
        self._changed = changed
        self._producer = objects.internal(0x1017, 0)
        self._consumer = objects.internal(0x1016, 1)
        self._guard_time = objects.internal(0x100C, 0)
        self._life_factor = objects.internal(0x100D, 0)
        self.restart(0.0)
        objects.on_write(0x1016, self._consumer_written)
        objects.on_write(0x1017, self._producer_written)

    def restart(self, now: float) -> None:
        """Stop all heartbeats and time-outs after a reset, until they are started again."""
        self._now = now
        self._heartbeat_due = self._consumer_due = self._guarding_due = math.inf
        self._toggle = 0

    @property
    def watched(self) -> int | None:
        """Node whose heartbeat is watched, or None."""
        node, milliseconds = divmod(self._consumer.value, 1 << 16)
        return node if node and milliseconds else None

    def on_heartbeat(self, now: float) -> None:
        """Handle a heartbeat of the watched node.

        The first heartbeat, or the first after a loss, starts the time-out.
        """
        self._consumer_due = now + (self._consumer.value & 0xFFFF) * 1e-3

    def guarded(self, state: int, now: float) -> bytes | None:
        """Return the answer to the master's guarding request, or None if this node sends heartbeats.

        CiA 301 does not allow both.
        """
        if self._producer.value:
            return None
        life_time = self._guard_time.value * self._life_factor.value * 1e-3
        self._guarding_due = now + life_time if life_time else math.inf
        answer = bytes([state | self._toggle])
        self._toggle ^= _TOGGLE
        return answer

    def poll(self, now: float) -> bool:
        """Report the loss of the master if its time-out has elapsed by `now` [s]; return whether a heartbeat is due."""
        self._now = now
        if now >= self._consumer_due or now >= self._guarding_due:
            self._consumer_due = self._guarding_due = math.inf
            self._lost()
        if now < self._heartbeat_due:
            return False
        period = self._producer.value * 1e-3
        self._heartbeat_due += period
        if self._heartbeat_due <= now:  # the next heartbeat is overdue as well, so it is skipped
            self._heartbeat_due = now + period
        return True

    def _producer_written(self, entry: ObjectEntry, _old: int) -> None:
        self._heartbeat_due = self._now if entry.value else math.inf

    def _consumer_written(self, _entry: ObjectEntry, _old: int) -> None:
        self._consumer_due = math.inf
        self._changed()
