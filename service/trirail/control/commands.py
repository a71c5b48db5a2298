"""What clients command: whether it may be now, what it does, and what has become of it."""

from __future__ import annotations

from trirail.config import Config
from trirail.control.completion import still_powered, verdict
from trirail.control.feedback import Measured
from trirail.control.goal_queue import GoalQueue
from trirail.control.lease import LeaseArbiter, LeaseChange
from trirail.control.ledger import Ledger
from trirail.control.modes import Action, ModeEvent
from trirail.control.plan_requests import PlanRequests
from trirail.control.setpoints import Setpoints
from trirail.control.transitions import Transitions
from trirail.errors import RefusalCode, RefusedError
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

    def take(self, request: CommandRequest) -> None:
        """Begin to carry out a command. Raises RefusedError where that may not be."""
        if request.name in (Command.ACQUIRE, Command.RELEASE):
            self._take_lease(request)
            return
        if not request.name.everybodys:
            self._lease.check(request.user)
        if request.name is Command.OVERRIDE:
            self._take_override(request)
            return
        event = ModeEvent[request.name.name]
        if event is ModeEvent.HOME and not self._can_home:
            raise RefusedError(RefusalCode.NOTHING_TO_HOME, "absolute encoders: there is nothing to home")
        reason = f"{request.name} by {request.user}"
        if request.goal is not None and self._goal_queue.stop_alone(request.goal, reason):
            self._ledger.undertake(request, self._modes.cycle)
            return
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
        self._ledger.undertake(request, self._modes.cycle)

    def settle(self) -> None:
        """Answer the commands that are carried out, or cannot be any more."""
        self._ledger.settle(self._verdict, self._modes.state.mode)

    def end_silent_lease(self) -> None:
        """End a lease that its holder does not renew."""
        if (over := self._lease.silent(self._modes.cycle)) is not None:
            self._change_lease(over)

    def _take_override(self, request: CommandRequest) -> None:
        """Let this motion and those to come run at another rate."""
        rate = self._planner.override = request.value if request.value is not None else 1.0
        if self._modes.state.mode is Mode.MOVING:
            self._planner.run_at(rate)
        self._ledger.tell("service", "info", f"override {rate:.0%} by {request.user}", user=request.user)
        self._ledger.undertake(request, self._modes.cycle)

    def _take_lease(self, request: CommandRequest) -> None:
        """Let a user have the lease, keep it, or give it back."""
        acquires = request.name is Command.ACQUIRE
        change = self._lease.acquire(request, self._modes.cycle) if acquires else self._lease.release(request)
        if change is not None:
            self._change_lease(change)
        self._ledger.undertake(request, self._modes.cycle)

    def _change_lease(self, change: LeaseChange) -> None:
        """Tell who holds the lease from now on; what others have under way stops, and does not begin any more."""
        user = self._lease.user
        self._ledger.tell("lease", change.level, change.message, user=user)
        if user is None or not self._ledger.is_all_of(user):
            self._modes.go(ModeEvent.STOP, change.message)
            self._modes.withdraw(ModeEvent.STOP, change.message)

    def _verdict(self, name: Command, since: int) -> str | None:
        """Say what has become of a command that came in a cycle: trirail.control.completion.verdict."""
        settled = self._modes.cycle - since >= self._settle_cycles
        return verdict(name, self._modes.state.mode, self._modes.fault, self._measured, settled=settled)
