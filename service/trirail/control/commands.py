"""Execution of clients' commands: check whether a command is allowed, start it, and decide when it is complete."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from trirail_drivers.interface import NAMES, PowerState

from trirail.config import Config
from trirail.control.feedback import CAN_MOVE, MeasuredState
from trirail.control.goal_queue import GoalQueue
from trirail.control.lease import LeaseArbiter, LeaseChange
from trirail.control.ledger import Ledger
from trirail.control.modes import HOLDING, Action, ModeEvent
from trirail.control.outputs import Outputs
from trirail.control.plan_requests import PlanRequests
from trirail.control.setpoints import Setpoints
from trirail.control.transitions import Transitions
from trirail.errors import RefusalCode, RefusedError
from trirail.wire.event_codes import EventCode, EventText, coded
from trirail.wire.messages import Notice
from trirail.wire.packets import CommandRequest
from trirail.wire.vocabulary import Command, FaultCause, Mode

_FAULTY = (PowerState.FAULT_REACTION_ACTIVE, PowerState.FAULT)


class CommandProgress(NamedTuple):
    """Values from which a completion rule decides whether a command is complete."""

    mode: Mode
    latched: str | None
    """Reason for the latched fault; None if there is no fault."""
    measured: MeasuredState
    settled: bool
    """Whether the drives have had enough time to leave their fault state since the command arrived."""


Rule = Callable[[CommandProgress], str | None]
"""Completion rule of a command. It returns None while the command is in progress, then "" or the reason of a
failure."""


def completed_on_arrival(_: CommandProgress) -> str:
    """Return "" always: the command takes effect in the cycle in which it arrives."""
    return ""


def standing(now: CommandProgress) -> str | None:
    """Return "" once the robot is at rest."""
    return None if now.mode is Mode.STOPPING else ""


def powered_up(now: CommandProgress) -> str | None:
    """Return "" once the drives have power and the robot has left the mode ENABLING without a failure."""
    if now.mode is Mode.ENABLING:
        return None
    return (
        ""
        if now.mode not in (Mode.FAULT, Mode.DISABLED)
        else now.latched or "the robot was disabled while the drives were powering up"
    )


def powered_down(now: CommandProgress) -> str | None:
    """Return "" once the robot is at rest and no drive can move its slider any more."""
    if now.mode not in (Mode.STOPPING, Mode.DISABLED, Mode.FAULT):
        return "the robot was enabled again before all drives were without power"
    return _timed_out(now) or (None if now.mode is Mode.STOPPING or now.measured.powered else "")


def unpowered(now: CommandProgress) -> str | None:
    """Return "" once no drive can move its slider any more."""
    return _timed_out(now) or (None if now.measured.powered else "")


def homed(now: CommandProgress) -> str | None:
    """Return "" once every slider is homed."""
    if now.mode in (Mode.HOMING, Mode.STOPPING):
        return None
    if now.measured.homed and now.mode is not Mode.FAULT:
        return ""
    return now.latched or "homing was stopped before all drives were homed"


def cleared(now: CommandProgress) -> str | None:
    """Return "" once neither the robot nor a drive is in fault."""
    if now.mode is Mode.FAULT:
        return f"the cause of the fault persists: {now.latched}"
    return "" if now.settled and not any(state in _FAULTY for state in now.measured.feedback.state) else None


def _timed_out(now: CommandProgress) -> str:
    """Return the fault message of a drive that has timed out; "" if no drive has timed out."""
    fault = now.measured.feedback.fault
    return fault.message if fault is not None and fault.cause == "timeout" else ""


def powered_message(measured: MeasuredState, latched: str | None) -> str:
    """Return the refusal of a reset that is sent while drives can still move. The message names these drives."""
    return f"{powered_drives(measured)}: send reset again when the drives are at rest (fault: {latched})"


def powered_drives(measured: MeasuredState) -> str:
    """Return the names and states of the drives that can still move."""
    states = zip(NAMES, measured.feedback.state, strict=True)
    drives = ", ".join(f"drive {name} is {state}" for name, state in states if state in CAN_MOVE)
    return f"{drives} according to the last statusword"


def power_left(measured: MeasuredState) -> str:
    """Return which drives have power, or may have it because they are silent after a stop; "" if none has power."""
    fault = measured.feedback.fault
    if measured.powered:
        return powered_drives(measured)
    if fault is not None and fault.cause == "timeout" and any(measured.feedback.unready):
        return f"{fault.message}, and does not answer"
    return ""


SETTLE = 0.1
"""Time after a reset before the states of the drives are evaluated, so that the drives can leave their fault state
[s]."""


class Commands:
    """Executor of commands. A command starts in the cycle in which it arrives, and is answered when it is complete."""

    def __init__(
        self,
        config: Config,
        modes: Transitions,
        lease: LeaseArbiter,
        ledger: Ledger,
        goal_queue: GoalQueue,
        planner: PlanRequests,
        measured: MeasuredState,
        setpoints: Setpoints,
        outputs: Outputs,
    ) -> None:
        self._modes = modes
        self._lease = lease
        self._ledger = ledger
        self._goal_queue = goal_queue
        self._planner = planner
        self._measured = measured
        self._setpoints = setpoints
        self._outputs = outputs
        self._can_home = any(drive.homing is not None for drive in config.drives.each)
        self._settle_cycles = max(3, round(SETTLE / config.period))

    def carry_out(self, request: CommandRequest) -> None:
        """Start a command. Raises RefusedError if it is not allowed."""
        if not request.name.ignores_lease:
            self._lease.check(request.user)
        EFFECTS[request.name].begin(self, request)
        self._ledger.undertake(request, self._modes.cycle)

    def settle(self) -> None:
        """Answer the commands that are complete or have failed."""
        self._ledger.settle(self._verdict, self._modes.state.mode, self._modes.cycle + 1)

    def end_silent_lease(self) -> None:
        """End the lease if it was not renewed in time."""
        if (over := self._lease.expire(self._modes.cycle)) is not None:
            self._change_lease(over)

    def _change_mode(self, request: CommandRequest) -> None:
        """Apply the mode event that has the same name as the command."""
        event, reason = ModeEvent[request.name.name], _reason(request)
        if event is ModeEvent.PAUSE and self._pauses_for_good:
            event = ModeEvent.STOP
        action = self._modes.check(event).action
        if action is Action.POWER_UP and self._measured.powered:
            words = f"{powered_drives(self._measured)}: send enable again when no drive has power"
            raise RefusedError(RefusalCode.STOPPING, words)
        if action is Action.POWER_UP:
            self._setpoints.check_rest()
            if self._measured.homed:
                self._setpoints.check_start()  # the control warns once the drives have power, because of later pushes
        if action is Action.CLEAR and self._measured.powered:
            raise RefusedError(RefusalCode.STOPPING, powered_message(self._measured, self._modes.fault))
        if action is Action.CLEAR and (unready := self._measured.unready):
            raise RefusedError(RefusalCode.FAULT, f"the cause of the fault persists: {'; '.join(unready)}")
        if event is ModeEvent.QUICK_STOP:
            self._modes.trip(reason, FaultCause.QUICK_STOP)
        else:
            self._modes.apply_event(event, reason)
            self._modes.withdraw(event, reason)

    @property
    def _pauses_for_good(self) -> bool:
        """Whether a pause would leave no goal that could be resumed, so that it is a stop.

        Jogs and tracks cannot be resumed: the key of a jog has been released, the target of a track has moved on. A
        goal that has not begun does not start after a pause.
        """
        goal, waits = self._ledger.goal, self._modes.state == HOLDING and not self._goal_queue.idle
        return waits or (goal is not None and goal.kind.renewed) or self._planner.needs_old_motion

    def _stop(self, request: CommandRequest) -> None:
        """Stop the robot. If the command names a goal that has not begun, stop only that goal."""
        goal = request.content.goal
        if goal is None or not self._goal_queue.stop_alone(goal, _reason(request)):
            self._change_mode(request)

    def _home(self, request: CommandRequest) -> None:
        if not self._can_home:
            if self._measured.homed:
                raise RefusedError(RefusalCode.NOTHING_TO_HOME, "the encoders are absolute: homing is not needed")
            words = "no drive can be homed: to accept the positions as they are, restart the service"
            raise RefusedError(RefusalCode.NOTHING_TO_HOME, words)
        self._change_mode(request)

    def _override(self, request: CommandRequest) -> None:
        """Set the speed override for the current motion and all later motions."""
        rate = self._planner.override = request.content.percent / 100.0
        self._planner.update_rate()
        words = f"override set to {rate:.0%} by {request.user}"
        text = coded(words, EventCode.OVERRIDE, percent=request.content.percent, user=request.user)
        self._ledger.notices.append(Notice("service", "info", text.text, user=request.user, **text.fields))

    def _set_output(self, request: CommandRequest) -> None:
        """Set an output. The output switches together with the next setpoints."""
        name, value = request.content.output, request.content.value
        self._outputs.set(name, value, self._modes.state.mode)
        words = f"output {name} switched {'on' if value else 'off'} by {request.user}"
        text = coded(words, EventCode.OUTPUT_SET, output=name, on=float(value), user=request.user)
        self._ledger.notices.append(Notice("output", "info", text.text, user=request.user, **text.fields))

    def _acquire(self, request: CommandRequest) -> None:
        """Grant the lease to the sender of the command, or renew the sender's lease."""
        change = self._lease.acquire(request.user, request.content, self._modes.cycle)
        if change is not None:
            self._change_lease(change)

    def _release(self, request: CommandRequest) -> None:
        self._change_lease(self._lease.release(request.user, request.content))

    def _change_lease(self, change: LeaseChange) -> None:
        """Report a change of the lease. Unless the new holder owns all active goals and commands, stop the robot."""
        user = self._lease.user
        text = change.message
        self._ledger.notices.append(Notice("lease", change.level, text.text, user=user, **text.fields))
        if user is None or not self._ledger.is_all_of(user):
            self._modes.apply_event(ModeEvent.STOP, text)
            self._modes.withdraw(ModeEvent.STOP, text)

    def _verdict(self, name: Command, since: int) -> str | None:
        """Return the result of the completion rule for a command that arrived in cycle `since`."""
        settled = self._modes.cycle - since >= self._settle_cycles
        return EFFECTS[name].rule(CommandProgress(self._modes.state.mode, self._modes.fault, self._measured, settled))


class Effect(NamedTuple):
    """Method that starts a command, and rule that decides when the command is complete."""

    rule: Rule
    begin: Callable[[Commands, CommandRequest], None] = Commands._change_mode


EFFECTS: dict[Command, Effect] = {
    Command.ENABLE: Effect(powered_up),
    Command.DISABLE: Effect(powered_down),
    Command.STOP: Effect(standing, Commands._stop),
    Command.QUICK_STOP: Effect(unpowered),
    Command.RESET: Effect(cleared),
    Command.HOME: Effect(homed, Commands._home),
    Command.PAUSE: Effect(standing),
    Command.RESUME: Effect(completed_on_arrival),
    Command.OVERRIDE: Effect(completed_on_arrival, Commands._override),
    Command.SET_OUTPUT: Effect(completed_on_arrival, Commands._set_output),
    Command.ACQUIRE: Effect(completed_on_arrival, Commands._acquire),
    Command.RELEASE: Effect(standing, Commands._release),
}
"""Effect and completion rule of each command."""


def _reason(request: CommandRequest) -> EventText:
    words = f"{request.name} by {request.user}"
    return coded(words, EventCode.COMMAND, command=request.name, user=request.user)
