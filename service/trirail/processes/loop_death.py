"""What is to be said when the loop has died: it numbers the events, and there is nobody else to say how goals ended.

Gateway and recorder hear the same of the loop, so each works it out by itself and both say the same.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from trirail.wire.messages import REMEMBERED_IDS, Event, FaultDetail, Notice
from trirail.wire.packets import Answer, ControlInput, Farewell, GoalRequest, Happened, Status
from trirail.wire.vocabulary import FaultCause, Mode

FROZEN, CYCLES = 0.5, 3
"""The loop sends records every 20 ms, or in every cycle: silent for so long before its end, it was frozen [s]."""


class LoopDeath:
    """Follows what the loop says; `events` is what is missing when it has gone."""

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
        """The loop has sent something."""
        self._heard = self._clock()
        self._greeted = True

    def follow(self, said: Answer | GoalRequest) -> None:
        """Take what the loop says, or a goal that it is given."""
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
    def reason(self) -> str:
        """What has become of the loop, for people; empty where it has ended as it should, or has never turned."""
        if self._farewell or not self._greeted:
            return ""
        frozen = self._clock() - self._heard > max(FROZEN, CYCLES * self._period)
        how = "was frozen and has been killed" if frozen else "has died"
        return f"the loop {how}: the drives stop by their own watchdogs"

    def events(self, cycle: int) -> list[Event]:
        """Return what the loop would have said of its end in that cycle, the last that is known; nothing if it has."""
        reason = self.reason
        if not reason:
            return []
        missing = [Notice("fault", "error", reason, fault=FaultDetail(FaultCause.LOOP))]
        for goal_id, user in self._open.items():
            words = f"goal {goal_id} faulted: {reason}"
            missing.append(Notice("goal", "error", words, id=goal_id, outcome="faulted", reason=reason, user=user))
        missing.append(Notice("mode", "info", f"{Mode.FAULT}: {reason}", mode=Mode.FAULT))
        t, wall = cycle * self._period, time.time()
        return [what.event(self._seq + n, t, cycle, wall) for n, what in enumerate(missing, 1)]
