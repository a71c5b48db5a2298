"""Events that report the death of the loop. Normally, the loop itself issues all events.

Gateway and recorder receive the same messages from the loop. Each of them can therefore derive the missing events.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from trirail.wire.event_codes import EventCode, EventText, coded
from trirail.wire.messages import REMEMBERED_IDS, Event, FaultDetail, Notice
from trirail.wire.packets import Answer, ControlInput, EventReport, GoalRequest, Status
from trirail.wire.vocabulary import FaultCause, Mode

FROZEN, CYCLES = 0.5, 3
"""Duration of silence before the loop's end that shows that the loop was frozen [s, cycles].

The larger of the two durations applies. A running loop sends records every 20 ms, or every cycle if that is longer.
"""


class LoopDeath:
    """Observer of the loop's messages, which derives the missing events if the loop dies.

    `last_cycle` returns the last cycle if the loop has ended normally, otherwise None.
    """

    def __init__(
        self, period: float, last_cycle: Callable[[], int | None], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._period = period
        self._last_cycle = last_cycle
        self._clock = clock
        self._heard = clock()
        self._seq = 0
        self._open: dict[str, str | None] = {}
        self._ended: dict[str, None] = {}
        self._greeted = False

    def record_activity(self) -> None:
        """Record that a message from the loop has arrived."""
        self._heard = self._clock()
        self._greeted = True

    def follow(self, message: Answer | GoalRequest) -> None:
        """Track goals and events, given a message from the loop or a goal that was sent to the loop."""
        match message:
            case ControlInput(given=GoalRequest() as request) | (GoalRequest() as request):
                self._record_begin(request.id, request.user)
            case Status(goal=str(goal_id)):
                self._record_begin(goal_id, None)
            case EventReport(event):
                self._seq = event.seq
                if event.outcome is not None and event.id is not None:
                    self._record_end(event.id)

    def is_open(self, goal_id: str) -> bool:
        """Return True if a goal with this id has begun and has not ended."""
        return goal_id in self._open

    def _record_begin(self, goal_id: str, user: str | None) -> None:
        if goal_id not in self._ended:  # the loop itself reports that it refuses an id that was used before
            self._open.setdefault(goal_id, user)

    def _record_end(self, goal_id: str) -> None:
        self._open.pop(goal_id, None)
        self._ended[goal_id] = None
        if len(self._ended) > REMEMBERED_IDS:
            del self._ended[next(iter(self._ended))]

    @property
    def reason(self) -> EventText | None:
        """Text for people with the cause of the loop's end; None if the loop ended normally or never ran."""
        if not self._greeted or self._last_cycle() is not None:
            return None
        frozen = self._clock() - self._heard > max(FROZEN, CYCLES * self._period)
        how = "was frozen and has been killed" if frozen else "has died"
        code = EventCode.LOOP_FROZEN if frozen else EventCode.LOOP_DIED
        return coded(f"the loop {how}: the drives stop by their own watchdogs", code)

    def events(self, cycle: int) -> list[Event]:
        """Return events that report the loop's death and the faulted goals; empty if the loop ended normally.

        `cycle` is the last known cycle, which determines the time of the events.
        """
        reason = self.reason
        if reason is None:
            return []
        missing = [Notice("fault", "error", reason.text, fault=FaultDetail(FaultCause.LOOP), **reason.fields)]
        for goal_id, user in self._open.items():
            words = f"goal {goal_id} faulted: {reason}"
            ended = {"outcome": "faulted", "reason": reason.text, **reason.fields}
            missing.append(Notice("goal", "error", words, id=goal_id, user=user, **ended))
        missing.append(Notice("mode", "info", f"{Mode.FAULT}: {reason}", mode=Mode.FAULT, **reason.fields))
        return self._events(missing, cycle)

    def missing_cycles(self, cycle: int) -> list[Event]:
        """Return an event that reports the cycles between the last known cycle, `cycle`, and the loop's normal end.

        The list is empty if there are none, or if no cycle is known.
        """
        last = self._last_cycle() or cycle
        if last <= cycle or not cycle:
            return []
        words = f"missing data: the last {last - cycle} cycles (recorder too slow)"
        text = coded(words, EventCode.RECORDING_INCOMPLETE, lost=0, skipped=0, absent=last - cycle)
        return self._events([Notice("service", "warning", text.text, **text.fields)], last + 1)

    def _events(self, notices: list[Notice], cycle: int) -> list[Event]:
        t, wall = cycle * self._period, time.time()
        return [what.event(self._seq + n, t, cycle, wall) for n, what in enumerate(notices, 1)]
