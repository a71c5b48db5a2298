"""Changes of the mode, with their effects on drives, motion and goals. The effects take place in the same cycle."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from trirail_drivers.interface import DriveGroup

from trirail.control.feedback import MeasuredState
from trirail.control.goal_queue import GoalQueue
from trirail.control.ledger import Ledger
from trirail.control.modes import DISABLED, HOLDING, Action, ModeEvent, ModeState, Refusal, Step, step
from trirail.control.plan_requests import PlanRequests
from trirail.control.setpoints import Setpoints
from trirail.errors import RefusedError
from trirail.motion.schedule import Schedule
from trirail.wire.event_codes import EventCode, EventText, coded
from trirail.wire.messages import FaultDetail, Notice, Outcome
from trirail.wire.packets import GoalRequest
from trirail.wire.vocabulary import Command, FaultCause, Mode

_OUTCOMES: dict[ModeEvent, Outcome] = {
    ModeEvent.STANDSTILL: "done",
    ModeEvent.ARRIVED: "done",
    ModeEvent.INPUT_EDGE: "done",
    ModeEvent.FAULT: "faulted",
}
"""Outcome of a goal that is ended by an event. For all other events the outcome is "stopped"."""
_ORDERS: dict[Action, Callable[[DriveGroup], None]] = {
    Action.POWER_UP: lambda drives: drives.enable(),
    Action.POWER_DOWN: lambda drives: drives.disable(),
    Action.QUICK_STOP: lambda drives: drives.quick_stop(),
    Action.CLEAR: lambda drives: drives.reset(),
    Action.HOME: lambda drives: drives.home(),
    Action.STOP_HOMING: lambda drives: drives.stop_homing(),
}
"""Call to the drives for each action. Actions without an entry affect only the motion."""
_KEEPS_GOALS = (
    ModeEvent.GOAL,
    ModeEvent.STANDSTILL,
    ModeEvent.ARRIVED,
    ModeEvent.POWERED,
    # HOME is excluded: homing moves the sliders, so earlier goals would not begin from their intended pose.
    *(
        ModeEvent[name.name]
        for name in Command
        if not name.stops and name.name in ModeEvent.__members__ and name is not Command.HOME
    ),
)
"""Events that do not withdraw the goals that have been received but have not begun."""


class Transitions:
    """Current mode of the robot, and the methods that change the mode.

    Between two cycles, `cycle` is the number of the next cycle.
    """

    def __init__(
        self,
        drives: DriveGroup,
        schedule: Schedule,
        planner: PlanRequests,
        ledger: Ledger,
        goal_queue: GoalQueue,
        measured: MeasuredState,
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
        """Reason for the first fault since the last reset."""
        self.entered = 0
        """Cycle in which the robot entered the current mode."""
        self.orders = 0
        """Number of commands to the drives, including those that wait."""
        self._waiting: list[Callable[[DriveGroup], None]] | None = None
        """Commands to the drives that wait until `send_commands`; None if commands are sent immediately."""

    def hold_commands(self) -> None:
        """Let commands to the drives wait until `send_commands`, because compiled code uses the drives' tables."""
        self._waiting = []

    def send_commands(self) -> None:
        """Send the waiting commands to the drives, and send further commands immediately."""
        waiting, self._waiting = self._waiting or (), None
        for command in waiting:
            command(self._drives)

    def check(self, event: ModeEvent) -> Step:
        """Return the effect that an event would have now. Raises RefusedError if the current mode does not allow it."""
        decided = step(self.state, event)
        if isinstance(decided, Refusal):
            because = f" (fault: {self.fault})" if self.fault else ""
            raise RefusedError(decided.code, f"{decided.message}{because}")
        return decided

    def apply_event(self, event: ModeEvent, reason: EventText, goal: GoalRequest | None = None) -> None:
        """Change the mode and execute the action of the transition, if the current mode allows the event.

        `goal` is the goal that the event starts, or None.
        """
        decided = step(self.state, event)
        if isinstance(decided, Refusal) or decided == Step(self.state):
            return  # repeated stops must not restart the search for a law that brakes
        self._act(decided)
        before, self.state = self.state, decided.state
        if self.state.mode is not before.mode:
            self.entered = self.cycle
            self._setpoints.allow(self.state.mode)
        if goal is not None or not self.state.has_goal or self.state.released:
            self._measured.settling.cancel()
        if not self.state.has_goal:
            self._schedule.stop_on_path()  # also while the robot brakes; otherwise the next goal could begin
            outcome = _OUTCOMES.get(event, "stopped")
            arrived = EventCode.RELEASED if before.released else EventCode.ARRIVED
            if outcome != "faulted":
                self._ledger.end_at_edge()
            self._ledger.end(outcome, coded(arrived.value, arrived) if outcome == "done" else reason)
        if self.state.mode is not before.mode:
            begun = goal.id if goal is not None else None
            words = f"{self.state.mode}: {reason}"
            self._ledger.notices.append(
                Notice("mode", "info", words, mode=self.state.mode, goal=begun, **reason.fields)
            )
        if self.state.mode in (Mode.DISABLED, Mode.FAULT) or self.state == HOLDING:
            self._schedule.replace_runs(deque())
            self._setpoints.record_progress(0.0, 0.0)
            self._planner.discard_rate_change()

    def handle_disturbance(self, event: ModeEvent, reason: EventText) -> None:
        """Handle the loss of the gateway, a series of late ticks, or the shutdown of the service, which may end with a
        quick stop.
        """
        if event is ModeEvent.QUICK_STOP:
            self.trip(reason, FaultCause.QUICK_STOP)
            return
        decided = step(self.state, event)
        changes = not isinstance(decided, Refusal) and decided.state != self.state
        # Missed ticks are reported even if the robot is already at rest with power, since a motion would have stopped.
        if changes or (event is ModeEvent.LATE and self.state.mode is Mode.HOLDING):
            self._ledger.notices.append(Notice("service", "warning", reason.text, **reason.fields))
            self.apply_event(event, reason)
        self.withdraw(event, reason)

    def trip(self, reason: EventText, cause: str, drive: str = "", code: int = 0) -> None:
        """Stop all three drives immediately and latch the reason. FaultDetail explains `cause`, `drive` and `code`."""
        if self.state.mode is Mode.FAULT:
            return
        self.fault = reason.text
        detail = FaultDetail(cause, drive, code)
        self._ledger.notices.append(Notice("fault", "error", reason.text, fault=detail, **reason.fields))
        self.apply_event(ModeEvent.FAULT, reason)
        self.withdraw(ModeEvent.FAULT, reason)

    def withdraw(self, event: ModeEvent, reason: EventText) -> None:
        """End the goals that have not begun, unless the event is one of _KEEPS_GOALS. Call this after `apply_event`."""
        if event not in _KEEPS_GOALS:
            self._goal_queue.withdraw("faulted" if event is ModeEvent.FAULT else "stopped", reason.text)

    def _act(self, decided: Step) -> None:
        if (order := _ORDERS.get(decided.action)) is not None:
            self.orders += 1
            if self._waiting is not None:
                self._waiting.append(order)
            else:
                order(self._drives)
        match decided.action:
            case Action.CLEAR:
                self.fault = None
            case Action.BRAKE:
                if not decided.state.paused:  # brake within the current path; later goals must not begin
                    self._schedule.stop_on_path()
                self._planner.brake(stops=not decided.state.paused)
            case Action.RESUME:
                self._planner.run()
