"""What clients command: whether it may be now, what it does, and what has become of it."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from trirail.config import Config
from trirail.control import completion
from trirail.control.completion import CommandProgress, Rule, still_powered
from trirail.control.feedback import Measured
from trirail.control.goal_queue import GoalQueue
from trirail.control.lease import LeaseArbiter, LeaseChange
from trirail.control.ledger import Ledger
from trirail.control.modes import Action, ModeEvent
from trirail.control.plan_requests import PlanRequests
from trirail.control.setpoints import Setpoints
from trirail.control.transitions import Transitions
from trirail.errors import RefusalCode, RefusedError
from trirail.wire.messages import Notice
from trirail.wire.packets import CommandRequest
from trirail.wire.vocabulary import Command, FaultCause, Mode

SETTLE = 0.1
"""How long the drives may take to leave their fault state after a reset [s]."""


class Commands:
    """Takes each command in the cycle in which it comes, and answers it when it is carried out."""

    def __init__(
        self,
        config: Config,
        modes: Transitions,
        lease: LeaseArbiter,
        ledger: Ledger,
        goal_queue: GoalQueue,
        planner: PlanRequests,
        measured: Measured,
        setpoints: Setpoints,
    ) -> None:
        self._modes = modes
        self._lease = lease
        self._ledger = ledger
        self._goal_queue = goal_queue
        self._planner = planner
        self._measured = measured
        self._setpoints = setpoints
        self._can_home = any(drive.homing is not None for drive in config.drives.each)
        self._settle_cycles = max(3, round(SETTLE / config.period))

    def carry_out(self, request: CommandRequest) -> None:
        """Begin to carry out a command. Raises RefusedError where that may not be."""
        if not request.name.everybodys:
            self._lease.check(request.user)
        EFFECTS[request.name].begin(self, request)
        self._ledger.undertake(request, self._modes.cycle)

    def settle(self) -> None:
        """Answer the commands that are carried out, or cannot be any more."""
        self._ledger.settle(self._verdict, self._modes.state.mode, self._modes.cycle + 1)

    def end_silent_lease(self) -> None:
        """End a lease that its holder does not renew."""
        if (over := self._lease.silent(self._modes.cycle)) is not None:
            self._change_lease(over)

    def _change_mode(self, request: CommandRequest) -> None:
        """Let the mode's event of the same name happen."""
        event, reason = ModeEvent[request.name.name], _reason(request)
        action = self._modes.check(event).action
        goal = self._ledger.goal
        if event is ModeEvent.PAUSE and goal is not None and goal.kind.renewed:
            event = ModeEvent.STOP  # nobody would be at the key, nor where the target was, when it is resumed
        if action is Action.POWER_UP:
            self._setpoints.check_rest()
            if self._measured.homed:
                self._setpoints.check_start()
        if action is Action.CLEAR and self._measured.powered:
            raise RefusedError(RefusalCode.STOPPING, still_powered(self._measured, self._modes.fault))
        if event is ModeEvent.QUICK_STOP:
            self._modes.trip(reason, FaultCause.QUICK_STOP)
        else:
            self._modes.go(event, reason)
            self._modes.withdraw(event, reason)

    def _stop(self, request: CommandRequest) -> None:
        """Stop the robot, or one goal, where that has not begun, alone."""
        goal = request.content.goal
        if goal is None or not self._goal_queue.stop_alone(goal, _reason(request)):
            self._change_mode(request)

    def _home(self, request: CommandRequest) -> None:
        if not self._can_home:
            raise RefusedError(RefusalCode.NOTHING_TO_HOME, "absolute encoders: there is nothing to home")
        self._change_mode(request)

    def _override(self, request: CommandRequest) -> None:
        """Let this motion and those to come run at another rate."""
        rate = self._planner.override = request.content.percent / 100.0
        if self._modes.state.mode is Mode.MOVING:
            self._planner.run_at(rate)
        self._ledger.notices.append(
            Notice("service", "info", f"override {rate:.0%} by {request.user}", user=request.user)
        )

    def _acquire(self, request: CommandRequest) -> None:
        """Let a user have the lease, or keep it."""
        change = self._lease.acquire(request.user, request.content, self._modes.cycle)
        if change is not None:
            self._change_lease(change)

    def _release(self, request: CommandRequest) -> None:
        self._change_lease(self._lease.release(request.user, request.content))

    def _change_lease(self, change: LeaseChange) -> None:
        """Tell who holds the lease from now on; what others have under way stops, and does not begin any more."""
        user = self._lease.user
        self._ledger.notices.append(Notice("lease", change.level, change.message, user=user))
        if user is None or not self._ledger.is_all_of(user):
            self._modes.go(ModeEvent.STOP, change.message)
            self._modes.withdraw(ModeEvent.STOP, change.message)

    def _verdict(self, name: Command, since: int) -> str | None:
        """Say what has become of a command that came in a cycle, as a Rule does."""
        settled = self._modes.cycle - since >= self._settle_cycles
        return EFFECTS[name].rule(CommandProgress(self._modes.state.mode, self._modes.fault, self._measured, settled))


class Effect(NamedTuple):
    """What a command does, and by which rule it is carried out."""

    rule: Rule
    begin: Callable[[Commands, CommandRequest], None] = Commands._change_mode


EFFECTS: dict[Command, Effect] = {
    Command.ENABLE: Effect(completion.powered_up),
    Command.DISABLE: Effect(completion.powered_down),
    Command.STOP: Effect(completion.standing, Commands._stop),
    Command.QUICK_STOP: Effect(completion.unpowered),
    Command.RESET: Effect(completion.cleared),
    Command.HOME: Effect(completion.homed, Commands._home),
    Command.PAUSE: Effect(completion.standing),
    Command.RESUME: Effect(completion.at_once),
    Command.OVERRIDE: Effect(completion.at_once, Commands._override),
    Command.ACQUIRE: Effect(completion.at_once, Commands._acquire),
    Command.RELEASE: Effect(completion.standing, Commands._release),
}
"""Every command's."""


def _reason(request: CommandRequest) -> str:
    return f"{request.name} by {request.user}"
