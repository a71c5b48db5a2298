"""The robot's control, one cycle at a time, without a clock, a socket or a file.

Each `cycle`: `observe` what the drives said, `handle` what is asked for, `advance` the motion and solve the sliders,
and `write` the setpoints behind the last gate. What is to be said of it waits at the `ledger`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from typing import Literal

from trirail_drivers.interface import NAMES, DriveGroup, Feedback, PowerState, Triple

from trirail.config import Config, corrected_geometry
from trirail.control.completion import still_powered, verdict
from trirail.control.feedback import Measured
from trirail.control.goal_queue import GoalQueue
from trirail.control.lease import LeaseArbiter, LeaseChange
from trirail.control.ledger import Ledger
from trirail.control.modes import DISABLED, HOLDING, Action, ModeEvent, ModeState, Refusal, step
from trirail.control.plan_requests import PlannerPort, PlanRequests
from trirail.control.setpoints import Setpoints
from trirail.errors import RefusalCode, RefusedError
from trirail.motion.frames import NamedFrames
from trirail.motion.limits import EDGE, Bounds
from trirail.motion.runs import STILL, MotionState, Run, rest
from trirail.motion.schedule import Schedule
from trirail.motion.take_up import take_up
from trirail.wire.messages import FaultDetail, Outcome, TrackGoal
from trirail.wire.packets import (
    CommandRequest,
    Disturbance,
    GoalRequest,
    PlannerLost,
    PoseChanged,
    RefusedRequest,
    Request,
)
from trirail.wire.planning import PlanAnswer
from trirail.wire.records import Part
from trirail.wire.vocabulary import Command, FaultCause, Mode

Given = tuple[Request | Disturbance | PlanAnswer | PlannerLost, int]
"""What the control is given in a cycle, and when, by the monotonic clock [ns]."""

SETTLE = 0.1
"""How long the drives may take to leave their fault state after a reset [s]."""

_OUTCOMES: dict[ModeEvent, Outcome] = {
    ModeEvent.STANDSTILL: "done",
    ModeEvent.ARRIVED: "done",
    ModeEvent.FAULT: "faulted",
}
"""How a goal ends on an event after which it is not under way; else it is stopped."""
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


class Control:
    """Modes, motion, kinematics and limits of one robot over one set of drives."""

    def __init__(self, config: Config, drives: DriveGroup, planner: PlannerPort) -> None:
        robot = corrected_geometry(config)
        self._drives = drives
        self._period = config.period
        self._schedule = Schedule(rest(STILL), config.period)
        self._planner = PlanRequests(config, planner, self._schedule)
        self.ledger = Ledger()
        frames, queue = NamedFrames(config.frames), config.motion.queue
        self.lease = LeaseArbiter(config.control.lease, config.period)
        self.goal_queue = GoalQueue(
            self.ledger, self.lease, self._planner, self._schedule, frames, queue, config.period
        )
        legs, step_length = robot.packed(), config.limits.slider.velocity * config.period
        self._following_error_limit = config.limits.slider.following_error
        taken = take_up(config.correction.backlash, config.limits.slider)
        self.measured = Measured(
            legs, config.period, step_length, self._following_error_limit, config.limits.in_position, taken
        )
        self.setpoints = Setpoints(legs, Bounds(config.limits, config.period, EDGE), self.measured, step_length)
        self._can_home = any(drive.homing is not None for drive in config.drives.each)
        self._enable_cycles = round(config.watchdogs.enable_timeout / config.period)
        self._settle_cycles = max(3, round(SETTLE / config.period))

        self.cycles = 0
        self.state: ModeState = DISABLED
        self.fault: str | None = None
        self._entered = 0
        self._run: Run | None = None

    def cycle(self, feedback: Feedback, given: Iterable[Given], mark: Callable[[Part], None] = lambda _: None) -> None:
        """Run one cycle: what the drives said at its SYNC, and what else is given in it; then motion and setpoints.

        `given` is read after the drives have been; `mark` is called at the end of each part. Nothing that goes wrong
        in it leaves the robot moving.
        """
        self.observe(feedback)
        try:
            for what, now_ns in given:
                match what:
                    case Disturbance():
                        self.happen(ModeEvent[what.event], what.reason)
                    case GoalRequest() | CommandRequest() | RefusedRequest() | PoseChanged():
                        self.handle(what, now_ns)
                    case PlannerLost():
                        self._planner.lose(what.reason)
                    case answer:
                        self._planner.hear(answer)
            mark(Part.MODE)
            self.advance()
            mark(Part.MOTION)
            self.solve()
        except Exception as error:  # noqa: BLE001 - whatever is wrong with the program, the robot must stop now
            self.trip(f"internal error, please report it: {error!r}", FaultCause.INTERNAL)
        mark(Part.KINEMATICS)
        self.write()
        mark(Part.WRITE)

    # ------------------------------------------------------------------ the cycle, in its order

    def start(self, feedback: Feedback) -> None:
        """Take the measured sliders for the commanded ones, before the first cycle."""
        self.measured.start(feedback)
        self.setpoints.start()
        self._follow_measured()
        self._planner.warm_up()
        self._tell_warnings(feedback)

    def observe(self, feedback: Feedback) -> None:
        """Take in what the drives said at this SYNC, and stop all three if they must not go on."""
        self.cycles += 1
        before = self.measured.feedback
        behind = self.measured.take(feedback, self._stands)
        self._tell_warnings(feedback)
        mode = self.state.mode
        if feedback.fault is not None:
            drive, cause, code, message = feedback.fault
            if mode is Mode.FAULT and feedback.fault != before.fault:
                # The first one stays, but this came of it.
                self.ledger.tell("fault", "error", message, fault=FaultDetail(cause, drive, code))
            self.trip(message, cause, drive, code)
        elif mode is Mode.ENABLING:
            self._power_up()
        elif mode in (Mode.HOMING, Mode.HOLDING, Mode.MOVING, Mode.STOPPING):
            if behind:
                error = self.measured.following_error[behind - 1]
                self.trip(
                    f"slider {NAMES[behind - 1]}: following error {error * 1e3:.3f} mm is beyond its limit "
                    f"{self._following_error_limit * 1e3:g} mm",
                    FaultCause.FOLLOWING_ERROR,
                    NAMES[behind - 1],
                )
            elif not feedback.homing:
                self._homing_over()
        self._judge_arrival()
        self.ledger.settle(self._verdict, self.state.mode)

    def _tell_warnings(self, feedback: Feedback) -> None:
        """Tell what people should know of the drives: they say it in one feedback only, some in the first."""
        for warning in feedback.warnings:
            self.ledger.tell("service", "warning", warning)

    def handle(self, request: Request, now_ns: int) -> None:
        """Take a request at a time of the monotonic clock: a command at once, a goal behind those before it."""
        try:
            if isinstance(request, GoalRequest):
                self.goal_queue.take(request, now_ns, self.cycles)
            elif isinstance(request, CommandRequest):
                self._take_command(request)
            elif isinstance(request, PoseChanged):
                self.ledger.tell("pose", "info", request.message, user=request.user)
            else:
                self.ledger.tell("refused", "warning", request.message, user=request.user)
        except RefusedError as refusal:
            self.ledger.refuse(request, refusal)

    def happen(self, event: ModeEvent, reason: str) -> None:
        """Let something happen that nobody asked for: the gateway is lost, ticks are late, the service ends."""
        decided = step(self.state, event)
        if not isinstance(decided, Refusal) and decided.state != self.state:
            self.ledger.tell("service", "warning", reason)
            self._go(event, reason)
        self._withdraw(event, reason)

    def advance(self) -> None:
        """End a lease or a jog that nobody renews, begin what is planned, and go on to the motion of this cycle."""
        if (over := self.lease.silent(self.cycles)) is not None:
            self._change_lease(over)
        released = self.ledger.release(self.cycles) if self.state.mode is Mode.MOVING else None
        if released is not None:
            self._go(ModeEvent.NOT_RENEWED, f"goal {released.id} of {released.user} is not renewed")
        beginning = self.goal_queue.think(self.cycles, self._admit, self._place)
        if beginning is not None:
            self._go(ModeEvent.GOAL, f"goal {beginning.id} of {beginning.user}", beginning)
        self._run = self._schedule.begin_cycle()

    def solve(self) -> None:
        """Move the commanded motion on by one period, solve the sliders by the paper's recursion, pass the last gate.

        All of that is one compiled call; what it finds beside ends goals, a motion, or the robot's moving at all.
        """
        if self.state.mode not in (Mode.HOLDING, Mode.MOVING, Mode.STOPPING) or not self.measured.homed:
            self._follow_measured()
            return
        schedule, run = self._schedule, self._run
        single = schedule.single
        found = self.setpoints.solve(schedule, run)
        if found and run is not None:
            for _ in range(schedule.end_cycle(run)):
                self.ledger.pass_on()
        self.goal_queue.expire(self.cycles)
        if not single:
            self.setpoints.tell_progress(*schedule.progress)
        if found:
            self._conclude(found)

    def _conclude(self, found: int) -> None:
        """Trip where the last gate has refused the setpoints; hold where the motion has come to rest."""
        refused = self.setpoints.refusal(found)
        schedule = self._schedule
        if refused:
            self.trip(refused, FaultCause.LIMIT)
        elif self.state.mode in (Mode.MOVING, Mode.STOPPING) and schedule.runs[0].stands:
            self._stand(schedule.runs[0])

    def write(self) -> None:
        """Send the setpoints."""
        self._drives.write(*self.setpoints.sent)

    # ------------------------------------------------------------------ what others ask of it

    @property
    def commanded(self) -> MotionState:
        """The platform's motion commanded in this cycle."""
        return self._schedule.commanded

    @property
    def override(self) -> float:
        """The rate at which motions are to run."""
        return self._planner.override

    @property
    def target(self) -> Triple | None:
        """The pose that the running goal leads to, or that its target was last told to have; None for a jog."""
        last, goal = self._schedule.last, self.ledger.goal
        if goal is None or last is None:
            return None
        if goal.renewed is not None:
            return goal.target
        x, y, phi = last.destination(self.commanded.pose)
        return (x, y, phi)

    def trip(self, reason: str, cause: str, drive: str = "", code: int = 0) -> None:
        """Stop all three drives in this cycle and latch the reason; cause, drive and code as of a FaultDetail."""
        if self.state.mode is Mode.FAULT:
            return
        self.fault = reason
        self.ledger.tell("fault", "error", reason, fault=FaultDetail(cause, drive, code))
        self._go(ModeEvent.FAULT, reason)
        self._withdraw(ModeEvent.FAULT, reason)

    # ------------------------------------------------------------------ requests

    def _admit(self) -> bool:
        """Whether the robot is moving to a goal; RefusedError where it takes none."""
        decided = step(self.state, ModeEvent.GOAL)
        if isinstance(decided, Refusal):
            raise RefusedError(decided.code, self._because(decided))
        if not self.measured.homed:
            raise RefusedError(RefusalCode.NOT_HOMED, "it is not known where the sliders are: send home first")
        return self.state.mode is Mode.MOVING

    def _place(self, origin: Literal["commanded", "measured"]) -> Sequence[float]:
        """Return the pose from which a move begins: where the goals before it lead, or where the robot is."""
        if origin == "measured":
            return self.measured.pose
        last, goal = self._schedule.last, self.ledger.goal
        if last is None or goal is None or goal.renewed is not None:
            return self.commanded.pose
        return last.end(self.commanded.pose)

    def _withdraw(self, event: ModeEvent, reason: str) -> None:
        """End what has been sent but not begun, where the robot is to stand: after the goals before it."""
        if event not in _GO_ON:
            self.goal_queue.withdraw("faulted" if event is ModeEvent.FAULT else "stopped", reason)

    def _take_command(self, request: CommandRequest) -> None:
        if request.name in (Command.ACQUIRE, Command.RELEASE):
            self._take_lease(request)
            return
        if not request.name.everybodys:
            self.lease.check(request.user)
        if request.name is Command.OVERRIDE:
            self._take_override(request)
            return
        event = ModeEvent[request.name.name]
        if event is ModeEvent.HOME and not self._can_home:
            raise RefusedError(RefusalCode.NOTHING_TO_HOME, "absolute encoders: there is nothing to home")
        if request.goal is not None and self.goal_queue.stop_alone(request.goal, f"{request.name} by {request.user}"):
            self.ledger.undertake(request, self.cycles)
            return
        decided = step(self.state, event)
        if isinstance(decided, Refusal):
            raise RefusedError(decided.code, self._because(decided))
        if event is ModeEvent.PAUSE and self.ledger.goal is not None and self.ledger.goal.renewed is not None:
            event = ModeEvent.STOP  # nobody would be at the key, nor where the target was, when it is resumed
        if decided.action is Action.POWER_UP:
            self.setpoints.check_rest()
            if self.measured.homed:
                self.setpoints.check_start()
        if decided.action is Action.CLEAR and self.measured.powered:
            raise RefusedError(RefusalCode.STOPPING, still_powered(self.measured, self.fault))
        reason = f"{request.name} by {request.user}"
        if event is ModeEvent.QUICK_STOP:
            self.trip(reason, FaultCause.QUICK_STOP)
        else:
            self._go(event, reason)
            self._withdraw(event, reason)
        self.ledger.undertake(request, self.cycles)

    def _take_override(self, request: CommandRequest) -> None:
        """Let this motion and those to come run at another rate."""
        self._planner.override = request.value if request.value is not None else 1.0
        if self.state.mode is Mode.MOVING:
            self._planner.run_at(self.override)
        self.ledger.tell("service", "info", f"override {self.override:.0%} by {request.user}", user=request.user)
        self.ledger.undertake(request, self.cycles)

    def _take_lease(self, request: CommandRequest) -> None:
        """Let a user have the lease, keep it, or give it back."""
        if request.name is Command.ACQUIRE:
            change = self.lease.acquire(request, self.cycles)
        else:
            change = self.lease.release(request)
        if change is not None:
            self._change_lease(change)
        self.ledger.undertake(request, self.cycles)

    def _change_lease(self, change: LeaseChange) -> None:
        """Tell who holds the lease from now on; what others have under way stops, and does not begin any more."""
        user = self.lease.user
        self.ledger.tell("lease", change.level, change.message, user=user)
        if user is None or not self.ledger.is_all_of(user):
            self._go(ModeEvent.STOP, change.message)
            self._withdraw(ModeEvent.STOP, change.message)

    def _because(self, refusal: Refusal) -> str:
        return f"{refusal.message} (fault: {self.fault})" if self.fault else refusal.message

    def _verdict(self, name: Command, since: int) -> str | None:
        """Say what has become of a command that came in a cycle: trirail.control.completion.verdict."""
        settled = self.cycles - since >= self._settle_cycles
        return verdict(name, self.state.mode, self.fault, self.measured, settled=settled)

    # ------------------------------------------------------------------ from state to state

    def _go(self, event: ModeEvent, reason: str, goal: GoalRequest | None = None) -> None:  # noqa: PLR0912  one branch an action
        """Step the modes and carry out the action; `goal` is the one that begins."""
        decided = step(self.state, event)
        if isinstance(decided, Refusal):
            return
        match decided.action:
            case Action.POWER_UP:
                self._drives.enable()
            case Action.POWER_DOWN:
                self._drives.disable()
            case Action.QUICK_STOP:
                self._drives.quick_stop()
            case Action.CLEAR:
                self._drives.reset()
                self.fault = None
            case Action.BRAKE if decided.state.paused:
                self._planner.run_at(0.0)
            case Action.BRAKE:
                self._brake()
            case Action.RESUME:
                self._planner.run_at(self.override)
            case Action.HOME:
                self._drives.home()
            case Action.STOP_HOMING:
                self._drives.stop_homing()
        before, self.state = self.state, decided.state
        if self.state.mode is not before.mode:
            self._entered = self.cycles
        if goal is not None or not self.state.has_goal:
            self.measured.settling.leave()
        if not self.state.has_goal:
            outcome = _OUTCOMES.get(event, "stopped")
            arrived = "released" if before.released else "arrived"
            self.ledger.end(outcome, arrived if outcome == "done" else reason)
        if self.state.mode is not before.mode:
            begun = goal.id if goal is not None else None
            self.ledger.tell("mode", "info", f"{self.state.mode}: {reason}", mode=self.state.mode, goal=begun)
        if self.state.mode in (Mode.DISABLED, Mode.FAULT) or self.state == HOLDING:
            self._schedule.take(deque())
            self.setpoints.tell_progress(0.0, 0.0)
            self._planner.leave_rate()

    def _brake(self) -> None:
        """Stop on the path of the motion under way; what was to follow it does not."""
        self._schedule.stop_on_path()
        self._planner.run_at(0.0)

    @property
    def _stands(self) -> bool:
        """Whether the robot has been commanded to stand where it does."""
        return (self.state.mode is Mode.HOLDING and self.measured.homed) or self.measured.settling.under_way

    def _stand(self, run: Run) -> None:
        """The motion has ended where it should, or its law has brought it to a standstill on the way.

        A goal whose path has ended is under way until the robot is in position.
        """
        goal, settling = self.ledger.goal, self.measured.settling
        if not run.arrived:
            self._go(ModeEvent.STANDSTILL, "standstill")
        elif self.state.mode is Mode.MOVING and goal is not None and goal.renewed is TrackGoal:
            return  # it waits for its target to move on, for as long as it is renewed
        elif goal is None or not goal.settles:
            self._go(ModeEvent.ARRIVED, "standstill")
        elif not settling.under_way:
            settling.begin(self.cycles)

    def _judge_arrival(self) -> None:
        """End the goal whose path has ended once the robot is in position, or where that has taken too long."""
        settling = self.measured.settling
        settled = settling.over(self.cycles)
        if settled is None:
            return
        outcome: Outcome = "done" if settled.settle is not None else "unsettled"
        self.ledger.end(outcome, settling.said(settled), settled=settled)
        self._go(ModeEvent.ARRIVED, "standstill")

    def _power_up(self) -> None:
        """Hold with every drive that is enabled already; go on when all are, give up when it takes too long."""
        if all(state is PowerState.OPERATION_ENABLED for state in self.measured.feedback.state):
            if not self.measured.homed:
                self._go(ModeEvent.POWERED, "all drives are enabled; where the sliders are is not known: send home")
            elif self._rest_at_setpoints():
                self._go(ModeEvent.POWERED, "all drives are enabled")
        elif self.cycles - self._entered > self._enable_cycles:
            waiting = [
                f"drive {name} is {state}"
                for name, state in zip(NAMES, self.measured.feedback.state, strict=True)
                if state is not PowerState.OPERATION_ENABLED
            ]
            seconds = self._enable_cycles * self._period
            self.trip(
                f"{', '.join(waiting)} {seconds:g} s after enable; operation enabled was expected", FaultCause.ENABLE
            )

    def _homing_over(self) -> None:
        """Hold where homing has ended, or was stopped."""
        if self.state.mode not in (Mode.HOMING, Mode.STOPPING) or self._schedule.runs:
            return  # no homing has been under way
        if self.measured.homed:
            try:
                self.setpoints.check_start()
            except RefusedError as refusal:
                self.trip(f"all drives are homed, but {refusal}", FaultCause.PLACE)
                return
            if not self._rest_at_setpoints():
                return
        if self.state.mode is Mode.STOPPING:
            self._go(ModeEvent.STANDSTILL, "standstill")
        else:
            self._go(ModeEvent.HOMED, "all drives are homed")

    def _rest_at_setpoints(self) -> bool:
        """Command the pose that belongs to the setpoints, at rest; trip where there is none."""
        a, b, c = self.setpoints.rows[0]
        pose = self.measured.pose_of((a, b, c))
        if pose is None:
            self.trip("the measured sliders belong to no pose", FaultCause.PLACE)
            return False
        self._schedule.commanded = rest(pose)
        return True

    def _follow_measured(self) -> None:
        """Command the pose that is measured, and the sliders to where they are."""
        held = self.state.mode not in (Mode.DISABLED, Mode.FAULT)
        stopped_now = self.state.mode is Mode.FAULT and self._entered == self.cycles
        self.setpoints.follow(self._schedule, held=held, stopped_now=stopped_now)
