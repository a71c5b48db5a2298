"""The robot's control, one cycle at a time, without a clock, a socket or a file.

A cycle only executes: `observe` what the drives said, `solve` the sliders, `write` the setpoints behind the last gate.
Between two cycles it `conclude`s what the one before has come to, and `decide`s what the next one executes, by what is
asked for. What is to be said of it waits at the `ledger`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Literal, NamedTuple

from trirail_drivers.interface import NAMES, DriveGroup, Feedback, PowerState, Triple

from trirail import naming
from trirail.config import Config, corrected_geometry
from trirail.control import cycle
from trirail.control.commands import Commands
from trirail.control.feedback import Measured
from trirail.control.goal_queue import GoalQueue
from trirail.control.lease import LeaseArbiter
from trirail.control.ledger import Ledger
from trirail.control.modes import ModeEvent, ModeState
from trirail.control.plan_requests import PlannerPort, PlanRequests
from trirail.control.setpoints import Setpoints
from trirail.control.transitions import Transitions
from trirail.errors import RefusalCode, RefusedError
from trirail.motion.backlash_reserve import reserve_for_backlash
from trirail.motion.limits import EDGE, Bounds
from trirail.motion.runs import STILL, MotionState, Run, rest
from trirail.motion.schedule import Schedule
from trirail.motion.tool_frames import NamedFrames
from trirail.wire.messages import FaultDetail, Notice, Outcome
from trirail.wire.packets import (
    CommandRequest,
    Disturbance,
    GoalRequest,
    Looked,
    PlannerLost,
    PoseChanged,
    RefusedRequest,
    Remark,
    Request,
)
from trirail.wire.plan_packets import PlanAnswer
from trirail.wire.records import Part
from trirail.wire.vocabulary import FaultCause, Mode

Given = tuple[Request | Disturbance | PlanAnswer | PlannerLost, int]
"""What the control is given in a cycle, and when, by the monotonic clock [ns]."""


class Calm(NamedTuple):
    """What cycles come to in which nothing happens."""

    run: Run | None
    """The motion under way, if setpoints come from one."""
    follows: bool
    """Whether setpoints follow what is measured; else, without a run, they stay."""
    held: bool
    """As of trirail.control.cycle.follow."""
    stands: bool
    """As of trirail.control.cycle.observe."""
    found: int
    """What trirail.control.cycle.command has found in the newest cycle."""
    until: float
    """The last cycle before something is due."""
    settles_by: int | None
    """The cycle in which a goal ends that waits for the robot to be in position; None where none does."""


class Control:
    """Modes, motion, kinematics and limits of one robot over one set of drives."""

    def __init__(self, config: Config, drives: DriveGroup, planner: PlannerPort) -> None:
        robot = corrected_geometry(config)
        self._labels = robot.labels
        self._drives = drives
        self._period = self.period = config.period
        self.schedule = Schedule(rest(STILL), config.period)
        self._planner = PlanRequests(config, planner, self.schedule)
        self.ledger = Ledger()
        frames, queue = NamedFrames(config.frames), config.motion.queue
        self.lease = LeaseArbiter(config.control.lease, config.period)
        self.goal_queue = GoalQueue(self.ledger, self.lease, self._planner, self.schedule, frames, queue, config.period)
        legs, step_length = robot.packed(), config.limits.slider.fastest * config.period
        self._following_error_limit = config.limits.slider.following_error
        taken = reserve_for_backlash(config.correction.backlash, config.limits.slider)
        self.measured = Measured(
            legs, config.period, step_length, self._following_error_limit, config.limits.in_position, taken
        )
        bounds = Bounds(config.limits, config.period, EDGE, robot.labels)
        self.setpoints = Setpoints(legs, bounds, self.measured, step_length)
        self.modes = Transitions(
            drives, self.schedule, self._planner, self.ledger, self.goal_queue, self.measured, self.setpoints
        )
        self._commands = Commands(
            *(config, self.modes, self.lease, self.ledger),
            *(self.goal_queue, self._planner, self.measured, self.setpoints),
        )
        self._enable_cycles = round(config.watchdogs.enable_timeout / config.period)
        self._found = 0

    @property
    def cycles(self) -> int:
        """How many cycles have been run."""
        return self.modes.cycle - 1

    @property
    def state(self) -> ModeState:
        """The mode, and what is to come once the robot stands."""
        return self.modes.state

    @property
    def fault(self) -> str | None:
        """The first reason of the fault; None where there is none."""
        return self.modes.fault

    def calm(self) -> Calm | None:
        """Return what the next cycles come to if nothing happens in them; None where something is to be done."""
        mode, runs, goal, settling = self.state.mode, self.schedule.runs, self.ledger.goal, self.measured.settling
        follows = mode not in (Mode.HOLDING, Mode.MOVING, Mode.STOPPING) or not self.measured.homed
        stopped_now = mode is Mode.FAULT and self.modes.entered == self.modes.cycle
        if stopped_now or self.ledger.busy or mode in (Mode.ENABLING, Mode.HOMING):
            return None
        if len(runs) > 1 or (mode is Mode.STOPPING and not runs):
            return None
        run = runs[0] if runs and not follows else None
        found = self._found if run is not None else 0
        if found and (cycle.refusal(found) or not self._waits(run)):
            return None
        until = min(self.lease.alive_until, self.goal_queue.due(self.modes.cycle) - 1)
        if goal is not None and not goal.released:
            until = min(until, goal.alive_until)
        held = mode not in (Mode.DISABLED, Mode.FAULT)
        return Calm(run, follows, held, self._stands, found, until, settling.ends)

    def _waits(self, run: Run | None) -> bool:
        """Whether nothing more comes of a motion that has ended."""
        if run is None or not run.arrived:
            return False
        goal = self.ledger.goal
        target = goal is not None and goal.kind.waits_at_end
        return self.state.mode is Mode.MOVING and (self.measured.settling.under_way or target)

    def go_on(self, newest: int, time: float, found: int | None) -> None:
        """Take over after calm cycles: the number of the newest one, and the time of the run's law in it [s].

        `found` is what the compiled call has found in that, if something comes of it.
        """
        self.schedule.cycle += newest - self.cycles
        self.modes.cycle = newest + 1
        if self.schedule.runs:
            self.schedule.runs[0].time = time
        if found is not None:
            self.modes.cycle, self._found = newest, found
            self.conclude()

    def cycle(self, read: Callable[[], Feedback], given: Iterable[Given] = ()) -> None:
        """Decide by what is given before a cycle, and run it on what is then `read` of the drives."""
        self.decide(given)
        self.execute(read())
        self.conclude()

    def execute(self, feedback: Feedback, mark: Callable[[Part], None] = lambda _: None) -> None:
        """Run one cycle on what the drives said at its SYNC; `mark` is called at the end of each part.

        Nothing that goes wrong in it leaves the robot moving.
        """
        try:
            self.observe(feedback)
            mark(Part.MOTION)
            self.solve()
        except Exception as error:  # noqa: BLE001 - whatever is wrong with the program, the robot must stop now
            self._trip_for(error)
        mark(Part.KINEMATICS)
        self.write()
        mark(Part.WRITE)

    def _trip_for(self, error: Exception) -> None:
        self.modes.trip(f"internal error, please report it: {error!r}", FaultCause.INTERNAL)

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
        before = self.measured.feedback
        behind = self.measured.update(feedback, self._stands)
        self._tell_warnings(feedback)
        mode = self.state.mode
        if feedback.fault is not None:
            drive, cause, code, message = feedback.fault
            if mode is Mode.FAULT and feedback.fault != before.fault:
                # The first one stays, but this came of it.
                self.ledger.notices.append(Notice("fault", "error", message, fault=FaultDetail(cause, drive, code)))
            self.modes.trip(message, cause, drive, code)
        elif mode is Mode.ENABLING:
            self._power_up()
        elif mode in (Mode.HOMING, Mode.HOLDING, Mode.MOVING, Mode.STOPPING):
            if behind:
                error = self.measured.following_error[behind - 1]
                self.modes.trip(
                    f"slider {self._labels[behind - 1]}: following error {error * 1e3:.3f} mm is beyond its limit "
                    f"{self._following_error_limit * 1e3:g} mm",
                    FaultCause.FOLLOWING_ERROR,
                    NAMES[behind - 1],
                )
            elif not feedback.homing:
                self._homing_over()

    def _tell_warnings(self, feedback: Feedback) -> None:
        """Tell what people should know of the drives: they say it in one feedback only, some in the first."""
        for warning in feedback.warnings:
            self.ledger.notices.append(Notice("service", "warning", warning))

    def solve(self) -> None:
        """Move the commanded motion on by one period, solve the sliders by the paper's recursion, pass the last gate.

        All of that is one compiled call.
        """
        run = self.schedule.begin_cycle()
        if self.state.mode not in (Mode.HOLDING, Mode.MOVING, Mode.STOPPING) or not self.measured.homed:
            self._found = 0
            self._follow_measured()
            return
        self._found = self.setpoints.solve(self.schedule, run)
        if len(self.schedule.runs) > 1:
            self.setpoints.tell_progress(*self.schedule.progress)
        if refused := self.setpoints.refusal(self._found):
            self.modes.trip(refused, FaultCause.LIMIT)

    def write(self) -> None:
        """Send the setpoints."""
        self._drives.write(*self.setpoints.sent)

    # ------------------------------------------------------------------ between two cycles

    def conclude(self) -> None:
        """End goals, or the motion, by what the compiled call has found in this cycle and what was measured in it.

        Commands that are carried out are answered.
        """
        try:
            schedule, found = self.schedule, self._found
            if found and schedule.runs:
                for _ in range(schedule.end_cycle(schedule.runs[0])):
                    self.ledger.pass_on()
            self.goal_queue.expire(self.modes.cycle)
            self._judge_arrival()
            moves = self.state.mode in (Mode.MOVING, Mode.STOPPING)
            if found and moves and schedule.runs and schedule.runs[0].stands:
                self._stand(schedule.runs[0])
            self._commands.settle()
        except Exception as error:  # noqa: BLE001
            self._trip_for(error)
        self.modes.cycle += 1

    def decide(self, given: Iterable[Given]) -> None:
        """Decide what the next cycle executes.

        `handle` what is given, end a lease or a jog that nobody renews, and begin what is planned and due.
        """
        try:
            for what, now_ns in given:
                self.handle(what, now_ns)
            self._commands.end_silent_lease()
            released = self.ledger.release(self.modes.cycle) if self.state.mode is Mode.MOVING else None
            if released is not None:
                self.modes.go(ModeEvent.NOT_RENEWED, f"goal {released.id} of {released.user} is not renewed")
            beginning = self.goal_queue.think(self.modes.cycle, self._admit, self._place)
            if beginning is not None:
                self.modes.go(ModeEvent.GOAL, f"goal {beginning.id} of {beginning.user}", beginning)
        except Exception as error:  # noqa: BLE001
            self._trip_for(error)

    def handle(self, what: Request | Disturbance | PlanAnswer | PlannerLost, now_ns: int) -> None:
        """Take in what is asked for, has happened or is planned, at a time of the monotonic clock."""
        try:
            match what:
                case Disturbance():
                    self.modes.happen(ModeEvent[what.event], what.reason)
                case GoalRequest() | CommandRequest() | RefusedRequest() | PoseChanged() | Looked() | Remark():
                    self._answer(what, now_ns)
                case PlannerLost():
                    self._planner.lose(what.reason)
                case answer:
                    self._planner.hear(answer)
        except Exception as error:  # noqa: BLE001
            self._trip_for(error)

    def _answer(self, request: Request, now_ns: int) -> None:
        """Take a request: a command at once, a goal behind those before it."""
        try:
            if isinstance(request, GoalRequest):
                self.goal_queue.enqueue(request, now_ns, self.modes.cycle)
            elif isinstance(request, CommandRequest):
                self._commands.carry_out(request)
            elif isinstance(request, PoseChanged):
                self.ledger.notices.append(Notice("pose", "info", request.message, user=request.user))
            elif isinstance(request, Looked):
                look, words = request.look, request.message
                self.ledger.notices.append(Notice("alignment", request.level, words, user=request.user, alignment=look))
            elif isinstance(request, Remark):
                self.ledger.notices.append(Notice("service", request.level, request.message))
            else:
                self.ledger.notices.append(Notice("refused", "warning", request.message, user=request.user))
        except RefusedError as refusal:
            self.ledger.refuse(request, refusal)

    # ------------------------------------------------------------------ what others ask of it

    @property
    def commanded(self) -> MotionState:
        """The platform's motion commanded in this cycle."""
        return self.schedule.commanded

    @property
    def override(self) -> float:
        """The rate at which motions are to run."""
        return self._planner.override

    @property
    def target(self) -> Triple | None:
        """The pose that the running goal leads to, or that its target was last told to have; None for a jog."""
        last, goal = self.schedule.last, self.ledger.goal
        if goal is None or last is None:
            return None
        if goal.kind.renewed:
            return goal.target
        x, y, phi = last.destination(self.commanded.pose)
        return (x, y, phi)

    # ------------------------------------------------------------------ requests

    def _admit(self) -> bool:
        """Whether the robot is moving to a goal; RefusedError where it takes none."""
        self.modes.check(ModeEvent.GOAL)
        if not self.measured.homed:
            raise RefusedError(RefusalCode.NOT_HOMED, "it is not known where the sliders are: send home first")
        return self.state.mode is Mode.MOVING

    def _place(self, origin: Literal["commanded", "measured"]) -> Sequence[float]:
        """Return the pose from which a move begins: where the goals before it lead, or where the robot is.

        RefusedError while a goal waits half-way, paused or at override 0: who looks at the robot means from there.
        """
        if origin == "measured":
            return self.measured.pose
        if self.state.paused or (self.override == 0.0 and self.schedule.last is not None):
            raise RefusedError(
                RefusalCode.MOVING,
                "a goal waits half-way, and a move would count from its end: send stop first, or resume it, or move "
                "from where the robot is measured to be",
            )
        last, goal = self.schedule.last, self.ledger.goal
        if last is None or goal is None or goal.kind.renewed:
            return self.commanded.pose
        return last.end(self.commanded.pose)

    # ------------------------------------------------------------------ from state to state

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
            self.modes.go(ModeEvent.STANDSTILL, "standstill")
        elif self.state.mode is Mode.MOVING and goal is not None and goal.kind.waits_at_end:
            return  # it waits for what renews it
        elif goal is None or not goal.settles:
            self.modes.go(ModeEvent.ARRIVED, "standstill")
        elif not settling.under_way:
            settling.begin(self.modes.cycle)

    def _judge_arrival(self) -> None:
        """End the goal whose path has ended once the robot is in position, or where that has taken too long."""
        settling = self.measured.settling
        settled = settling.over(self.modes.cycle)
        if settled is None:
            return
        outcome: Outcome = "done" if settled.settle is not None else "unsettled"
        self.ledger.end(outcome, settling.said(settled, self._labels), settled=settled)
        self.modes.go(ModeEvent.ARRIVED, "standstill")

    def _power_up(self) -> None:
        """Hold with every drive that is enabled already; go on when all are, give up when it takes too long."""
        if all(state is PowerState.OPERATION_ENABLED for state in self.measured.feedback.state):
            if not self.measured.homed:
                self.modes.go(
                    ModeEvent.POWERED, "all drives are enabled; where the sliders are is not known: send home"
                )
            elif self._rest_at_setpoints():
                self.modes.go(ModeEvent.POWERED, "all drives are enabled")
        elif self.modes.cycle - self.modes.entered > self._enable_cycles:
            waiting = [
                f"{naming.drive(name, self._labels)} is {state}"
                for name, state in zip(NAMES, self.measured.feedback.state, strict=True)
                if state is not PowerState.OPERATION_ENABLED
            ]
            seconds = self._enable_cycles * self._period
            self.modes.trip(
                f"{', '.join(waiting)} {seconds:g} s after enable; operation enabled was expected", FaultCause.ENABLE
            )

    def _homing_over(self) -> None:
        """Hold where homing has ended, or was stopped."""
        if self.state.mode not in (Mode.HOMING, Mode.STOPPING) or self.schedule.runs:
            return  # no homing has been under way
        if self.measured.homed:
            try:
                self.setpoints.check_start()
            except RefusedError as refusal:
                self.modes.trip(f"all drives are homed, but {refusal}", FaultCause.PLACE)
                return
            if not self._rest_at_setpoints():
                return
        if self.state.mode is Mode.STOPPING:
            self.modes.go(ModeEvent.STANDSTILL, "standstill")
        else:
            self.modes.go(ModeEvent.HOMED, "all drives are homed")

    def _rest_at_setpoints(self) -> bool:
        """Command the pose that belongs to the setpoints, at rest; trip where there is none."""
        a, b, c = self.setpoints.rows[0]
        pose = self.measured.pose_of((a, b, c))
        if pose is None:
            self.modes.trip("the measured sliders belong to no pose", FaultCause.PLACE)
            return False
        self.schedule.commanded = rest(pose)
        return True

    def _follow_measured(self) -> None:
        """Command the pose that is measured, and the sliders to where they are."""
        held = self.state.mode not in (Mode.DISABLED, Mode.FAULT)
        stopped_now = self.state.mode is Mode.FAULT and self.modes.entered == self.modes.cycle
        self.setpoints.follow(self.schedule, held=held, stopped_now=stopped_now)
