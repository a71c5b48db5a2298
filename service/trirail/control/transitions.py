"""From mode to mode: what is done to drives, motion and goals where the mode changes, in the same cycle."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from trirail_drivers.interface import DriveGroup

from trirail.control.feedback import Measured
from trirail.control.goal_queue import GoalQueue
from trirail.control.ledger import Ledger
from trirail.control.modes import DISABLED, HOLDING, Action, ModeEvent, ModeState, Refusal, Step, step
from trirail.control.plan_requests import PlanRequests
from trirail.control.setpoints import Setpoints
from trirail.errors import RefusedError
from trirail.motion.schedule import Schedule
from trirail.wire.messages import FaultDetail, Notice, Outcome
from trirail.wire.packets import GoalRequest
from trirail.wire.vocabulary import Command, Mode

_OUTCOMES: dict[ModeEvent, Outcome] = {
    ModeEvent.STANDSTILL: "done",
    ModeEvent.ARRIVED: "done",
    ModeEvent.FAULT: "faulted",
}
"""How a goal ends on an event after which it is not under way; else it is stopped."""
_ORDERS: dict[Action, Callable[[DriveGroup], None]] = {
    Action.POWER_UP: lambda drives: drives.enable(),
    Action.POWER_DOWN: lambda drives: drives.disable(),
    Action.QUICK_STOP: lambda drives: drives.quick_stop(),
    Action.CLEAR: lambda drives: drives.reset(),
    Action.HOME: lambda drives: drives.home(),
    Action.STOP_HOMING: lambda drives: drives.stop_homing(),
}
"""What of it the drives are told; all else is for the motion."""
_GO_ON = (
    ModeEvent.GOAL,
    ModeEvent.STANDSTILL,
    ModeEvent.ARRIVED,
    ModeEvent.POWERED,
    # Homing moves the sliders: what was sent before would not begin from where it was meant to.
    *(
        ModeEvent[name.name]
        for name in Command
        if not name.stops and name.name in ModeEvent.__members__ and name is not Command.HOME
    ),
)
"""Events that leave alone what has been sent but not begun."""


class Transitions:
    """The robot's mode, and since when it is in it; `cycle` is the number of that under way, or to come."""

    def __init__(
        self,
        drives: DriveGroup,
        schedule: Schedule,
        planner: PlanRequests,
        ledger: Ledger,
        goal_queue: GoalQueue,
        measured: Measured,
        setpoints: Setpoints,
    ) -> None:
        self._drives = drives
        self._schedule = schedule
        self._planner = planner
        self._ledger = ledger
        self._goal_queue = goal_queue
        self._measured = measured
        self._setpoints = setpoints
        self.cycle = 1
        self.state: ModeState = DISABLED
        self.fault: str | None = None
        """The first reason, since the last reset."""
        self.entered = 0
        """In which cycle the mode was entered."""
        self.orders = 0
        """How many orders the drives have been given."""

    def check(self, event: ModeEvent) -> Step:
        """Return what an event would do now. Raises RefusedError where it makes no sense in this mode."""
        decided = step(self.state, event)
        if isinstance(decided, Refusal):
            because = f" (fault: {self.fault})" if self.fault else ""
            raise RefusedError(decided.code, f"{decided.message}{because}")
        return decided

    def go(self, event: ModeEvent, reason: str, goal: GoalRequest | None = None) -> None:
        """Step the modes and carry out the action, where the event makes sense; `goal` is the one that begins."""
        decided = step(self.state, event)
        if isinstance(decided, Refusal):
            return
        self._act(decided)
        before, self.state = self.state, decided.state
        if self.state.mode is not before.mode:
            self.entered = self.cycle
        if goal is not None or not self.state.has_goal:
            self._measured.settling.leave()
        if not self.state.has_goal:
            self._schedule.stop_on_path()  # also where it brakes already: no goal begins on the way
            outcome = _OUTCOMES.get(event, "stopped")
            arrived = "released" if before.released else "arrived"
            self._ledger.end(outcome, arrived if outcome == "done" else reason)
        if self.state.mode is not before.mode:
            begun = goal.id if goal is not None else None
            self._ledger.notices.append(
                Notice("mode", "info", f"{self.state.mode}: {reason}", mode=self.state.mode, goal=begun)
            )
        if self.state.mode in (Mode.DISABLED, Mode.FAULT) or self.state == HOLDING:
            self._schedule.replace_runs(deque())
            self._setpoints.tell_progress(0.0, 0.0)
            self._planner.leave_rate()

    def happen(self, event: ModeEvent, reason: str) -> None:
        """Let something happen that nobody asked for: the gateway is lost, ticks are late, the service ends."""
        decided = step(self.state, event)
        if not isinstance(decided, Refusal) and decided.state != self.state:
            self._ledger.notices.append(Notice("service", "warning", reason))
            self.go(event, reason)
        self.withdraw(event, reason)

    def trip(self, reason: str, cause: str, drive: str = "", code: int = 0) -> None:
        """Stop all three drives in this cycle and latch the reason; cause, drive and code as of a FaultDetail."""
        if self.state.mode is Mode.FAULT:
            return
        self.fault = reason
        self._ledger.notices.append(Notice("fault", "error", reason, fault=FaultDetail(cause, drive, code)))
        self.go(ModeEvent.FAULT, reason)
        self.withdraw(ModeEvent.FAULT, reason)

    def withdraw(self, event: ModeEvent, reason: str) -> None:
        """End what has been sent but not begun, where the robot is to stand: after the goals before it."""
        if event not in _GO_ON:
            self._goal_queue.withdraw("faulted" if event is ModeEvent.FAULT else "stopped", reason)

    def _act(self, decided: Step) -> None:
        if (order := _ORDERS.get(decided.action)) is not None:
            self.orders += 1
            order(self._drives)
        match decided.action:
            case Action.CLEAR:
                self.fault = None
            case Action.BRAKE if decided.state.paused:
                self._planner.run_at(0.0)
            case Action.BRAKE:  # on the path of the motion under way; what was to follow it does not
                self._schedule.stop_on_path()
                self._planner.run_at(0.0)
            case Action.RESUME:
                self._planner.run_at(self._planner.override)
