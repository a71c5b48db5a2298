"""Planner in the calling process, for replays, tests and tools, which answers after a fixed number of cycles."""

from __future__ import annotations

from collections import deque

from trirail.config import Config
from trirail.motion.motion_planner import MotionPlanner
from trirail.wire.plan_packets import PlanAnswer, PlanRequest


class LocalPlanner:
    """Planner that implements trirail.control.plan_requests.PlannerPort by a direct call."""

    def __init__(self, config: Config, delay: int = 1) -> None:
        self.delay = delay
        """Cycles from the request to the answer."""
        self._planner = MotionPlanner(config)
        self._answers: deque[tuple[int, PlanAnswer]] = deque()
        self._turns = 0

    def request_plan(self, request: PlanRequest) -> None:
        """Compute the plan now, and answer later."""
        self._answers.append((self._turns + self.delay, self._planner.plan(request)))

    def answers(self) -> list[PlanAnswer]:
        """Return the answers that are due; call once in each cycle."""
        self._turns += 1
        due = []
        while self._answers and self._answers[0][0] <= self._turns:
            due.append(self._answers.popleft()[1])
        return due
