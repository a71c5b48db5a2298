"""Which goal is planned next, which ones wait, and which must not begin any more."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable

from service.course import Course
from service.desk import Desk
from service.errors import RefusedError
from service.messages import Outcome, PoseGoal
from service.packets import GoalRequest
from service.pilot import Pilot


class Dispatch:
    """Takes goals in their order to the pilot, and to the desk what becomes of them."""

    def __init__(self, desk: Desk, pilot: Pilot, course: Course, queue: int, period: float) -> None:
        self._desk = desk
        self._pilot = pilot
        self._course = course
        self._queue = queue
        self._period = period
        self._waiting: deque[tuple[GoalRequest, int]] = deque()
        self._planned: GoalRequest | None = None

    @property
    def ready(self) -> bool:
        """Whether another goal can be taken: none waits for another one to be planned."""
        return not self._waiting

    def take(self, request: GoalRequest, now_ns: int) -> None:
        """Take a goal at a time of the monotonic clock; it waits until those before it are planned."""
        self._waiting.append((request, now_ns))

    def think(self, cycle: int, admit: Callable[[], bool]) -> GoalRequest | None:
        """Begin with the next goal if none is being planned, and take one step; return a goal that begins.

        `admit` raises RefusedError where the robot takes no goal, and says whether it is moving to one.
        """
        if not self._pilot.busy and self._waiting:
            request, now_ns = self._waiting.popleft()
            self._planned = request
            try:
                self._consider(request, now_ns, admit)
            except RefusedError as refusal:
                self._desk.refuse(request, refusal)
        try:
            taken = self._pilot.think()
        except RefusedError as refusal:
            if self._planned is not None:
                self._desk.refuse(self._planned, refusal)
            return None
        if taken is None or self._planned is None:
            return None
        valid = self._planned.goal.valid_for
        self._desk.begin(self._planned, taken, cycle + valid / self._period if valid is not None else math.inf)
        return self._planned

    def withdraw(self, outcome: Outcome, reason: str) -> None:
        """End what has been sent but not begun."""
        requests = [request for request, _ in self._waiting]
        if self._pilot.busy and self._planned is not None:
            requests.insert(0, self._planned)
        self._pilot.give_up()
        self._waiting.clear()
        for request in requests:
            self._desk.withdraw(request, outcome, reason)

    def stop_alone(self, goal_id: str, reason: str) -> bool:
        """Stop a goal that has not begun; whether that was all. Raises RefusedError if it is not under way at all."""
        if self._desk.goal is not None and self._desk.goal.id == goal_id:
            return False
        for number, goal in enumerate(self._desk.goals):
            if goal.id == goal_id:
                self._drop(number, goal_id, "stopped", reason)
                return True
        if self._pilot.busy and self._planned is not None and self._planned.id == goal_id:
            self._pilot.give_up()
            self._desk.withdraw(self._planned, "stopped", reason)
            return True
        raise RefusedError("no_goal", f"goal {goal_id!r} is not under way: it has ended, or never was")

    def expire(self, cycle: int) -> None:
        """Let go of waiting goals that can no more begin in time, and of those behind them."""
        for number, goal in enumerate(self._desk.goals):
            if number and cycle > goal.expires:
                self._drop(number, goal.id, "expired", "it has not begun in time")
                return

    def _consider(self, request: GoalRequest, now_ns: int, admit: Callable[[], bool]) -> None:
        """Begin to plan a goal, or refuse it."""
        desk, goal = self._desk, request.goal
        desk.check_id(request)
        if request.withdrawn is not None:
            desk.withdraw(request, "stopped", request.withdrawn)
            return
        moving = admit()
        if goal.valid_for is not None and now_ns - request.received_ns > goal.valid_for * 1e9:
            raise RefusedError("expired", f"the goal came too late: it was valid for {goal.valid_for:g} s")
        blend = desk.goals[-1].blend if moving and desk.goals and isinstance(goal, PoseGoal) else None
        if blend is not None and len(desk.goals) > self._queue:
            text = f"{self._queue} goals are waiting already (motion.queue): send it when one has ended"
            raise RefusedError("queue_full", text, value=len(desk.goals), limit=self._queue)
        self._pilot.plan(goal, blend)

    def _drop(self, number: int, goal_id: str, outcome: Outcome, reason: str) -> None:
        """End a goal that waits, and those behind it."""
        self._desk.end("stopped", f"goal {goal_id} before it {outcome}", but=number + 1)
        self._desk.end(outcome, reason, but=number)
        self._course.runs[-1].drop(number - 1)
        self._pilot.run_at(self._pilot.override)
