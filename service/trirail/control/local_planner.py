"""Planner that runs in the calling process, for replays, tests and tools. Answers have a fixed delay in cycles."""

from __future__ import annotations

from collections import deque

from trirail.config import Config
from trirail.motion.motion_planner import MotionPlanner
from trirail.wire.plan_packets import PlanAnswer, PlanRequest


class LocalPlanner:
    """Implementation of PlannerPort that plans in the same process, without a planner process."""

    def __init__(self, config: Config, delay: int = 1) -> None:
        self.delay = delay
        """Number of cycles between a request and its answer."""
        self._planner = MotionPlanner(config)
        self._answers: deque[tuple[int, PlanAnswer]] = deque()
        self._turns = 0

    def request_plan(self, request: PlanRequest) -> None:
        """Compute the plan immediately, and store the answer until it is due."""
        self._answers.append((self._turns + self.delay, self._planner.plan(request)))

    def answers(self) -> list[PlanAnswer]:
        """Return the answers that are due. Call this once per cycle."""
        self._turns += 1
        due = []
        while self._answers and self._answers[0][0] <= self._turns:
            due.append(self._answers.popleft()[1])
        return due
