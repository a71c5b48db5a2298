"""Events after the death of the loop: it numbers the events, and nobody else can report how goals ended.

Gateway and recorder receive the same from the loop, so each derives them by itself, and both report the same.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from trirail.wire.event_codes import EventCode, EventText, coded
from trirail.wire.messages import REMEMBERED_IDS, Event, FaultDetail, Notice
from trirail.wire.packets import Answer, ControlInput, Farewell, GoalRequest, Happened, Status
from trirail.wire.vocabulary import FaultCause, Mode

FROZEN, CYCLES = 0.5, 3
"""Silence before the loop's end that means it was frozen [s, cycles]: it sends records every 20 ms or cycle."""


class LoopDeath:
    """Follower of the loop's messages; `events` returns those missing when it has gone."""

    def __init__(self, period: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._period = period
        self._clock = clock
        self._heard = clock()
        self._seq = 0
        self._open: dict[str, str | None] = {}
        self._ended: dict[str, None] = {}
        self._farewell = False
        self._greeted = False

    def heard(self) -> None:
        """Record that the loop has sent something."""
        self._heard = self._clock()
        self._greeted = True

    def follow(self, said: Answer | GoalRequest) -> None:
        """Process a message of the loop, or a goal that it is given."""
        match said:
            case ControlInput(given=GoalRequest() as request) | (GoalRequest() as request):
                self._begun(request.id, request.user)
            case Status(goal=str(goal_id)):
                self._begun(goal_id, None)
            case Happened(event):
                self._seq = event.seq
                if event.outcome is not None and event.id is not None:
                    self._over(event.id)
            case Farewell():
                self._farewell = True

    def _begun(self, goal_id: str, user: str | None) -> None:
        if goal_id not in self._ended:  # a used id is refused, and has its own ending
            self._open.setdefault(goal_id, user)

    def _over(self, goal_id: str) -> None:
        self._open.pop(goal_id, None)
        self._ended[goal_id] = None
        if len(self._ended) > REMEMBERED_IDS:
            del self._ended[next(iter(self._ended))]

    @property
    def reason(self) -> EventText | None:
        """Cause of the loop's end, for people; None if it has ended as it should, or has never turned."""
        if self._farewell or not self._greeted:
            return None
        frozen = self._clock() - self._heard > max(FROZEN, CYCLES * self._period)
        how = "was frozen and has been killed" if frozen else "has died"
        code = EventCode.LOOP_FROZEN if frozen else EventCode.LOOP_DIED
        return coded(f"the loop {how}: the drives stop by their own watchdogs", code)

    def events(self, cycle: int) -> list[Event]:
        """Return the loop's missing events of its end in that cycle, the last known; none if it has sent them."""
        reason = self.reason
        if reason is None:
            return []
        missing = [Notice("fault", "error", reason.text, fault=FaultDetail(FaultCause.LOOP), **reason.fields)]
        for goal_id, user in self._open.items():
            words = f"goal {goal_id} faulted: {reason}"
            ended = {"outcome": "faulted", "reason": reason.text, **reason.fields}
            missing.append(Notice("goal", "error", words, id=goal_id, user=user, **ended))
        missing.append(Notice("mode", "info", f"{Mode.FAULT}: {reason}", mode=Mode.FAULT, **reason.fields))
        t, wall = cycle * self._period, time.time()
        return [what.event(self._seq + n, t, cycle, wall) for n, what in enumerate(missing, 1)]
