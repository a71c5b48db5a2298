"""Checks of goals without motion: a goal is planned, and the reply says whether the robot could execute the goal.

The path of a check begins at rest, by default at the end of the current motion. A check moves nothing and publishes no
event. It does not depend on the mode or on the lease. Goals take precedence over checks.
"""

from __future__ import annotations

from collections import deque

from msgspec import structs

from trirail.config import Config
from trirail.control.ledger import Ledger
from trirail.control.outputs import Outputs
from trirail.control.plan_requests import MIN_LEAD_CYCLES, PlannerPort, PlanRequests
from trirail.errors import RefusalCode, RefusedError
from trirail.motion.goal_motion import PoseSource
from trirail.motion.goal_planner import resolve_goal
from trirail.motion.motion_planner import revision
from trirail.motion.schedule import Schedule
from trirail.motion.tool_frames import NamedFrames
from trirail.wire.packets import Checked, CheckRequest, Refused
from trirail.wire.plan_packets import NotPlanned, PlanAnswer, PlanRequest

NO_MOTION = (0.0, 0.0, 0.0)


class PathChecks:
    """Queue of checks. One check at a time is sent to the planner, whenever no goal is being planned."""

    def __init__(
        self,
        config: Config,
        port: PlannerPort,
        planner: PlanRequests,
        schedule: Schedule,
        ledger: Ledger,
        frames: NamedFrames,
        outputs: Outputs,
    ) -> None:
        self._revision = revision(config)
        self._port = port
        self._planner = planner
        self._schedule = schedule
        self._ledger = ledger
        self._frames = frames
        self._outputs = outputs
        self._waiting: deque[CheckRequest] = deque()
        self._number = 0
        """Number of the last check sent to the planner. Checks have negative numbers, requests for goals positive."""
        self._asked_before: int | None = None
        """Number of goal requests sent before the pending check. If this number has increased, the planner has dropped
        the check in favour of a goal."""

    @property
    def due(self) -> bool:
        """Whether a check is waiting and can be sent to the planner now."""
        return bool(self._waiting) and not self._planner.busy and not self._under_way

    @property
    def _under_way(self) -> bool:
        return self._asked_before == self._planner.requests

    def enqueue(self, request: CheckRequest) -> None:
        """Add a check at the end of the queue."""
        self._waiting.append(request)

    def step(self, place: PoseSource) -> None:
        """Send the next check to the planner if it is due. `place` returns the pose from which the check begins."""
        while self.due:
            request = self._waiting[0]
            try:
                self._request_plan(request, place)
            except RefusedError as refusal:
                self._refuse(refusal)

    def receive(self, answer: PlanAnswer) -> None:
        """Answer the pending check if `answer` belongs to it; ignore all other answers of the planner."""
        if self._asked_before is None or answer.number != self._number:
            return
        if isinstance(answer, NotPlanned):
            self._refuse(answer.error())
            return
        request = self._dequeue()
        reply = structs.replace(answer.reply, id=request.goal.id or "")
        self._ledger.answers.append(Checked(request.ticket, reply))

    def fail(self, reason: str) -> None:
        """Refuse the pending check, because the planner will not answer."""
        if self._under_way:
            self._refuse(RefusedError(RefusalCode.PLANNER_LOST, f"{reason}: send the check again"))

    def withdraw(self, reason: str) -> None:
        """Refuse all checks, because no client is waiting for the answers any more."""
        while self._waiting:
            self._refuse(RefusedError(RefusalCode.BUSY, f"{reason}: send the check again"))

    def _request_plan(self, request: CheckRequest, place: PoseSource) -> None:
        x, y, phi = place("commanded")
        goal = resolve_goal(request.goal, self._frames, place)
        self._outputs.check_marks(goal.marks)
        if goal.stop_at is not None:
            self._outputs.check_input(goal.stop_at.input)
        self._number -= 1
        self._asked_before = self._planner.requests
        rate = min(self._planner.override, goal.greatest_rate)
        begin, cycle, version = ((x, y, phi), NO_MOTION, NO_MOTION), self._schedule.cycle, self._schedule.version
        self._port.request_plan(
            PlanRequest(self._number, version, self._revision, cycle, MIN_LEAD_CYCLES, rate, begin, (), goal)
        )

    def _refuse(self, refusal: RefusedError) -> None:
        """Answer the first check in the queue with a refusal."""
        code, text = refusal.code, str(refusal)
        self._ledger.answers.append(
            Refused(self._dequeue().ticket, code, text, refusal.slider, refusal.value, refusal.limit)
        )

    def _dequeue(self) -> CheckRequest:
        self._asked_before = None
        return self._waiting.popleft()
