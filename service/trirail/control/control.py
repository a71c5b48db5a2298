"""Control of the robot, cycle by cycle. This module uses no clock, socket or file.

Each cycle has three steps: `observe` evaluates the feedback of the drives, `solve` computes the slider positions, and
`write` sends the setpoints that the last gate has accepted. Between two cycles, `conclude` evaluates the cycle that has
ended, and `decide` handles requests and chooses the motion of the next cycle. The `ledger` collects answers and
notices.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Literal, NamedTuple

from numpy.typing import NDArray
from trirail_drivers.interface import NAMES, DriveGroup, Feedback, PowerState, Triple

from trirail import naming
from trirail.config import Config, corrected_geometry
from trirail.control import cycle
from trirail.control.commands import Commands
from trirail.control.feedback import MeasuredState
from trirail.control.goal_queue import GoalQueue
from trirail.control.lease import LeaseArbiter
from trirail.control.ledger import ActiveGoal, Ledger
from trirail.control.modes import ModeEvent, ModeState
from trirail.control.outputs import Outputs
from trirail.control.path_checks import PathChecks
from trirail.control.plan_requests import PlannerPort, PlanRequests
from trirail.control.returning_drives import ReturningDrives
from trirail.control.setpoints import Setpoints
from trirail.control.transitions import Transitions
from trirail.errors import RefusalCode, RefusedError
from trirail.motion.backlash_reserve import planned_limits, reserve_for_backlash
from trirail.motion.limits import SETPOINT_TOLERANCE, Bounds, standing_tolerance
from trirail.motion.rules import RULES
from trirail.motion.runs import ZERO_RATES, MotionState, Run, rest
from trirail.motion.schedule import Schedule
from trirail.motion.tool_frames import NamedFrames
from trirail.quantities import apart_from_limit
from trirail.wire.event_codes import EventCode, coded
from trirail.wire.marks import StopAt
from trirail.wire.messages import FaultDetail, Notice, Outcome
from trirail.wire.packets import (
    Announcement,
    CheckRequest,
    CommandRequest,
    Disturbance,
    GoalRequest,
    PlannerLost,
    Request,
)
from trirail.wire.plan_packets import PlanAnswer
from trirail.wire.records import Part
from trirail.wire.vocabulary import FaultCause, Mode

TimedInput = tuple[Request | Disturbance | PlanAnswer | PlannerLost, int]
"""Message for the control, and the time on the monotonic clock at which the message was received [ns]."""


class SteadyState(NamedTuple):
    """State from which the compiled call can run compiled cycles, that is, cycles without Python."""

    run: Run | None
    """Motion from which the setpoints are computed; None if the robot is not executing a motion."""
    follows: bool
    """Whether the setpoints follow the measured sliders. If False and `run` is None, the setpoints do not change."""
    held: bool
    """Argument `held` of trirail.control.cycle.follow."""
    at_rest: bool
    """Argument `at_rest` of trirail.control.cycle.observe."""
    code: int
    """Result of trirail.control.cycle.command in the latest cycle."""
    until: float
    """Cycle after which Python must decide. If it has passed, or is -inf, Python must decide after every cycle."""
    settles_by: int | None
    """Cycle in which the in-position time-out of the current goal elapses; None if no goal is settling."""
    after_stop: tuple[float, float] | None
    """Value of trirail.motion.schedule.Schedule.after_stop, if there is a motion."""


class Control:
    """Control of one robot with its drives: modes, goals, commands, setpoints and outputs."""

    def __init__(self, config: Config, drives: DriveGroup, planner: PlannerPort, rules: int = RULES) -> None:
        """`rules` is the version of the rules by which the rate changes; see trirail.motion.rules."""
        robot = corrected_geometry(config)
        self._labels = robot.labels
        self._drives = drives
        self._period = self.period = config.period
        self.schedule = Schedule(rest(ZERO_RATES), config.period)
        self._planner = PlanRequests(config, planner, self.schedule, rules)
        self.outputs = Outputs(config.outputs, config.inputs, config.period)
        self.ledger = Ledger(self._goal_ended)
        frames, queue = NamedFrames(config.frames), config.motion.queue
        self.lease = LeaseArbiter(config.control.lease, config.period)
        self.goal_queue = GoalQueue(
            self.ledger, self.lease, self._planner, self.schedule, frames, queue, config.period, self.outputs
        )
        self._checks = PathChecks(config, planner, self._planner, self.schedule, self.ledger, frames, self.outputs)
        legs, step_length = robot.packed(), config.limits.slider.fastest * config.period
        self._following_error_limit = config.limits.slider.following_error
        take_up = reserve_for_backlash(config.correction.backlash, config.limits.slider)
        self.measured = MeasuredState(
            legs, config.period, step_length, self._following_error_limit, config.limits.in_position, take_up
        )
        bounds = Bounds(config.limits, config.period, SETPOINT_TOLERANCE, robot.labels)
        planned = planned_limits(config.limits, config.correction.backlash)
        tolerance = standing_tolerance(planned, robot.arm)
        self.setpoints = Setpoints(legs, bounds, tolerance, self.measured, step_length)
        self.modes = Transitions(
            drives, self.schedule, self._planner, self.ledger, self.goal_queue, self.measured, self.setpoints
        )
        self._commands = Commands(
            *(config, self.modes, self.lease, self.ledger, self.goal_queue),
            *(self._planner, self.measured, self.setpoints, self.outputs),
        )
        self._returning = ReturningDrives(robot.labels, config.limits.in_position.sliders)
        self._enable_cycles = round(config.watchdogs.enable_timeout / config.period)
        self._solve_code = 0
        self._concluding = False
        """Whether the setpoints of the current cycle have been sent."""
        self.ahead = 0
        """Number of cycles between the newest feedback that the control knows and the present commanded motion."""
        self._goal_before = ""
        """Id of the goal that was active before the newest decision beside the cycles; "" if there was none."""
        self._edges: list[tuple[str, bool, Triple]] = []
        """Digital inputs that have changed: name, new value, and pose of the robot. They have not been handled yet."""

    @property
    def cycles(self) -> int:
        """Number of completed cycles."""
        return self.modes.cycle - 1

    @property
    def state(self) -> ModeState:
        """Current mode, with the flags for the next change once the robot is at rest."""
        return self.modes.state

    @property
    def fault(self) -> str | None:
        """Reason for the latched fault; None if there is no fault."""
        return self.modes.fault

    def steady_state(self) -> SteadyState | None:
        """Return the state from which compiled code can run the next cycles; None if Python must run the next cycle."""
        mode, runs, goal, settling = self.state.mode, self.schedule.runs, self.ledger.goal, self.measured.settling
        follows = self._follows
        stopped_now = mode is Mode.FAULT and self.modes.entered == self.modes.cycle
        if stopped_now or mode in (Mode.ENABLING, Mode.HOMING):
            return None
        if self._returning.watches_jump:
            return None
        if self.measured.feedback.fault is not None:  # Python reads and notes that a reset has cleared it
            return None
        if self.outputs.any:
            self.outputs.follow_mode(mode)
            self._drives.set_outputs(self.outputs.words.tolist())
        if mode is Mode.STOPPING and not runs:
            return None
        run = runs[0] if runs and not follows else None
        if run is not None and cycle.refusal(self._solve_code):
            return None
        code = self._solve_code if self._waits(run) else 0
        until = min(self.lease.alive_until, self.goal_queue.due(self.modes.cycle) - 1)
        if goal is not None and not goal.released:
            until = min(until, goal.alive_until)
        if self.ledger.busy or self._checks.due:
            until = self.cycles
        held = mode not in (Mode.DISABLED, Mode.FAULT)
        after_stop = self.schedule.after_stop if run is not None else None
        return SteadyState(run, follows, held, self._at_rest, code, until, settling.ends, after_stop)

    @property
    def _follows(self) -> bool:
        """Whether the setpoints follow the measured sliders."""
        return self.state.mode not in (Mode.HOLDING, Mode.MOVING, Mode.STOPPING) or not self.measured.homed

    def _waits(self, run: Run | None) -> bool:
        """Return True if the motion has reached its end while its goal is still active.

        Such a goal waits until the robot is in position, or until the client renews the goal.
        """
        if run is None or not run.arrived:
            return False
        goal = self.ledger.goal
        target = goal is not None and goal.kind.waits_at_end
        return self.state.mode is Mode.MOVING and (self.measured.settling.under_way or target)

    def resume(self, newest: int, time: float, code: int | None) -> None:
        """Take over the result of the cycles that the compiled call has run without Python.

        Parameters
        ----------
        newest
            Number of the last cycle that the compiled call has run.
        time
            Time of the run's law in cycle `newest` [s].
        code
            Result of trirail.control.cycle.command in cycle `newest`, if the control must react to it; otherwise None.

        """
        self.schedule.cycle += newest - self.cycles
        self.modes.cycle = newest + 1
        if self.schedule.runs:
            self.schedule.runs[0].time = time
        if code is not None:
            self.modes.cycle, self._solve_code = newest, code
            self.conclude()

    def foresee(self, number: int) -> None:
        """Advance the commanded motion by `number` cycles that compiled code is about to run, and evaluate the last.

        Decisions then take effect after these cycles. They know the feedback of the drives before these cycles.
        """
        self.begin_ahead(number)
        self.advance(number)
        self.modes.cycle += number - 1
        self.conclude()

    def begin_ahead(self, number: int) -> None:
        """Note that the next decisions take effect after `number` further cycles."""
        goal = self.ledger.goal
        self.ahead, self._goal_before = number, goal.id if goal is not None else ""
        self.ledger.passed.clear()

    def advance(self, number: int) -> None:
        """Advance the commanded motion by a number of cycles. The control does not evaluate these cycles."""
        for _ in range(number):
            self._solve_code = self.setpoints.solve(self.schedule, self.schedule.begin_cycle())

    def commanded_arrays(self) -> tuple[NDArray[Any], ...]:
        """Return the arrays that `advance` changes, except for the record."""
        schedule, setpoints = self.schedule, self.setpoints
        return schedule.motion, setpoints.sliders, setpoints.bounds, setpoints.refused_values, self.measured.backlash

    def end_ahead(self) -> None:
        """Let a decision take effect that was made beside the newest cycles, and handle edges of inputs among them."""
        self.ahead = 0
        if self._edges:
            # Edges from before a goal do not concern it, but they concern the goal that has passed on to it.
            goal = self.ledger.goal
            began_before = goal is not None and goal.id == self._goal_before
            self._handle_edges(goal if began_before else None, self.ledger.passed)
            self.decide(())

    def return_to(self, newest: int) -> None:
        """Continue after cycle `newest`, although later cycles were foreseen; only for a fault that stops the robot."""
        self.schedule.cycle += newest - self.cycles
        self.modes.cycle = newest + 1
        self.modes.entered = min(self.modes.entered, self.modes.cycle)

    def cycle(self, read: Callable[[], Feedback], inputs: Iterable[TimedInput] = ()) -> None:
        """Run one complete cycle: handle the inputs, `read` the feedback, execute the cycle, and evaluate it."""
        self.decide(inputs)
        self.execute(read())
        self.conclude()

    def execute(
        self,
        feedback: Feedback,
        mark: Callable[[Part], None] = lambda _: None,
        *,
        behind: int | None = None,
        code: int | None = None,
    ) -> None:
        """Run the steps of one cycle with the drives' feedback at the SYNC of the cycle. Any exception stops the robot.

        Parameters
        ----------
        mark
            Function that is called at the end of each part of the cycle, to measure the duration of the parts.
        behind, code
            Results of `observe`, and of `command` or `hold`, in trirail.control.cycle, if the compiled call has already
            executed these functions for this cycle.

        """
        try:
            if code is None:
                self.observe(feedback, behind)
                mark(Part.MOTION)
                self.solve()
            else:
                self.schedule.cycle += 1
                self._check_solved(code)
        except Exception as error:  # noqa: BLE001 - any error in the program must stop the robot immediately
            self._trip_for(error)
        self._switch_outputs()
        mark(Part.KINEMATICS)
        self.write()
        mark(Part.WRITE)

    def _trip_for(self, error: Exception) -> None:
        words = f"internal error, please report it: {error!r}"
        self.modes.trip(coded(words, EventCode.INTERNAL_ERROR, error=repr(error)), FaultCause.INTERNAL)

    # ------------------------------------------------------------------ the cycle, in its order

    def start(self, feedback: Feedback) -> None:
        """Prepare the first cycle. The commanded slider positions start at the measured positions."""
        if self.outputs.any:
            self.outputs.allow_paths(self._drives.path_outputs)
        self.measured.start(feedback)
        self.setpoints.start()
        self._follow_measured()
        self._planner.warm_up()
        self._report_warnings(feedback)

    def observe(self, feedback: Feedback, behind: int | None = None) -> None:
        """Evaluate the drives' feedback at this SYNC, and trip on a drive fault or an excessive following error.

        `behind` is the result of the compiled `observe`, or None if `observe` has not been called for this cycle yet.
        """
        before = self.measured.feedback
        if behind is None:
            behind = self.measured.update(feedback, self._at_rest)
        # A slider that is watched when the drives get power is watched to the end.
        if self.state.mode in (Mode.DISABLED, Mode.FAULT) or self._returning.watches_jump:
            self._report_jumps(feedback)
        self.report_feedback(before, feedback)
        if not self.ahead:
            self._handle_edges(self.ledger.goal)
        mode = self.state.mode
        if feedback.fault is not None:
            drive, cause, code, message = feedback.fault
            text = coded(message, EventCode.DRIVE_FAULT, cause=cause, drive=drive, code=code)
            if mode is Mode.FAULT and feedback.fault != before.fault:
                # The first fault remains latched. The new fault is treated as a consequence of the first.
                detail = FaultDetail(cause, drive, code)
                self.ledger.notices.append(Notice("fault", "error", message, fault=detail, **text.fields))
            self.modes.trip(text, cause, drive, code)
        elif mode is Mode.ENABLING:
            self._power_up()
        elif mode in (Mode.HOMING, Mode.HOLDING, Mode.MOVING, Mode.STOPPING):
            if behind:
                error, limit = self.measured.following_error[behind - 1], self._following_error_limit
                slider = self._labels[behind - 1]
                shown, most = apart_from_limit(error, limit, "m")
                words = f"slider {slider}: following error {shown} exceeds the limit of {most}"
                text = coded(words, EventCode.FOLLOWING_ERROR, slider=slider, value=error, limit=limit)
                self.modes.trip(text, FaultCause.FOLLOWING_ERROR, NAMES[behind - 1])
            elif not feedback.homing:
                self._end_homing()

    def report_feedback(self, before: Feedback, feedback: Feedback) -> None:
        """Report warnings in the feedback of a cycle, and note the digital inputs that have changed in this cycle.

        A goal that ends at such an edge is stopped in this cycle or, if the cycle runs beside a decision, when the
        decision takes effect (end_ahead).
        """
        self._report_warnings(feedback)
        changed = self.outputs.edges(before.inputs, feedback.inputs)
        self._edges += [(name, value, self.measured.pose) for name, value in changed]

    def _report_warnings(self, feedback: Feedback) -> None:
        """Report warnings of the drives, and drives that were lost or have returned.

        A warning appears in the feedback of only one cycle.
        """
        for warning in feedback.warnings:
            text = coded(warning, EventCode.DRIVE_WARNING, warning=warning)
            self.ledger.notices.append(Notice("service", "warning", warning, **text.fields))
        for level, text in self._returning.update(feedback):
            self.ledger.notices.append(Notice("service", level, text.text, **text.fields))

    def _report_jumps(self, feedback: Feedback) -> None:
        """Report sliders without power whose positions have jumped, for instance because a drive has a new zero."""
        a, b, c = (
            position - velocity * self._period
            for position, velocity in zip(feedback.position, self.measured.velocity, strict=True)
        )
        for level, text in self._returning.update_jumps(feedback, self.measured.jumps, (a, b, c)):
            self.ledger.notices.append(Notice("service", level, text.text, **text.fields))

    def solve(self) -> None:
        """Advance the commanded motion by one period and solve the slider positions for it, in one compiled call."""
        run = self.schedule.begin_cycle()
        if self._follows:
            self._solve_code = 0
            self._follow_measured()
            return
        self._check_solved(self.setpoints.solve(self.schedule, run))
        if len(self.schedule.runs) > 1:
            self.setpoints.record_progress(*self.schedule.progress)

    def _check_solved(self, code: int) -> None:
        """Trip if the last gate has refused the setpoints."""
        self._solve_code = code
        if refused := self.setpoints.refusal(self._solve_code):
            self.modes.trip(coded(refused, EventCode.BAD_SETPOINT), FaultCause.LIMIT)

    def _switch_outputs(self) -> None:
        """Switch the outputs that are due together with the setpoints of this cycle."""
        if not self.outputs.any:
            return
        self.outputs.follow_mode(self.state.mode)
        run = self.schedule.runs[0] if self.schedule.runs and not self._follows else None
        time, record = run.time if run is not None else 0.0, self.measured.record
        self.outputs.step(run, time, self.schedule.version, self.modes.cycle, record)
        record["outputs"] = self.outputs.words
        self._drives.set_outputs(self.outputs.words.tolist())

    def _goal_ended(self, goal: str, outcome: Outcome) -> None:
        """Switch back the outputs that an ended goal has left switched, and report its switches before its end."""
        self._close_outputs(goal, outcome)
        self._report_switches(all_=True)

    def _close_outputs(self, goal: str, outcome: Outcome) -> None:
        self.outputs.close(goal, outcome, self.modes.cycle + self._concluding, self.measured.record)

    def _report_switches(self, *, all_: bool = False) -> None:
        for switches in self.outputs.pop_switches(self.modes.cycle, all_=all_):
            goal, number = switches[-1].goal, len(switches)
            text = coded(
                f"outputs switched on the path: {number}", EventCode.OUTPUTS_SWITCHED, goal=goal, number=number
            )
            self.ledger.notices.append(Notice("output", "info", text.text, goal=goal, marks=switches, **text.fields))

    def _handle_edges(self, goal: ActiveGoal | None, passed: Iterable[ActiveGoal] = ()) -> None:
        """Report digital inputs that have changed, and stop the current goal if it ends at one of these edges.

        `goal` is the current goal, unless the edges are from before its beginning. `passed` are goals that have passed
        on to the current goal since the edges: if one of them ends at such an edge, the robot stops too.
        """
        edges, self._edges = self._edges, []
        for name, value, (x, y, phi) in edges:
            words = (
                f"input {name} switched {'on' if value else 'off'} at x {x * 1e3:.3f} mm, y {y * 1e3:.3f} mm, phi "
                f"{phi:.5f} rad"
            )
            text = coded(words, EventCode.INPUT_CHANGED, input=name, on=float(value), x=x, y=y, phi=phi)
            self.ledger.notices.append(Notice("input", "info", text.text, **text.fields))
            edge = StopAt(name, "rising" if value else "falling")
            if not self.state.has_goal or self.state.released:
                continue
            reached = coded(f"input {name} {edge.edge}", EventCode.INPUT_REACHED, input=name, x=x, y=y, phi=phi)
            if any(one.stop_at == edge for one in passed):
                self.modes.apply_event(ModeEvent.STOP, reached)
                self.modes.withdraw(ModeEvent.STOP, reached)
            elif goal is not None and goal.stop_at == edge:
                self.ledger.note_edge(reached)
                self.modes.withdraw(ModeEvent.INPUT_EDGE, reached)
                self.modes.apply_event(ModeEvent.INPUT_EDGE, reached)
                self._close_outputs(goal.id, "stopped")  # at the edge, which is long before the rest

    def write(self) -> None:
        """Send the setpoints to the drives."""
        self._drives.write(*self.setpoints.sent)

    # ------------------------------------------------------------------ between two cycles

    def conclude(self) -> None:
        """Evaluate the cycle that has ended: end goals and motions that are complete, and answer completed commands."""
        self._concluding = True
        try:
            schedule, code = self.schedule, self._solve_code
            if code and schedule.runs:
                for _ in range(schedule.end_cycle(schedule.runs[0])):
                    self.ledger.pass_on()
            if self.goal_queue.expire(self.modes.cycle):
                self.modes.apply_event(ModeEvent.ARRIVED, coded("standstill", EventCode.STANDSTILL))
            self._check_arrival()
            moves = self.state.mode in (Mode.MOVING, Mode.STOPPING)
            if code and moves and schedule.runs and schedule.runs[0].at_rest:
                self._end_motion(schedule.runs[0])
            self._commands.settle()
            self._report_switches()
        except Exception as error:  # noqa: BLE001
            self._trip_for(error)
        self._concluding = False
        self.modes.cycle += 1

    def decide(self, inputs: Iterable[TimedInput]) -> None:
        """Prepare the next cycle.

        Handle the inputs, end a lease, jog or track that was not renewed in time, start a planned motion, and send the
        next check of a goal to the planner.
        """
        try:
            for each, now_ns in inputs:
                self.handle(each, now_ns)
            self._commands.end_silent_lease()
            released = self.ledger.release(self.modes.cycle) if self.state.mode is Mode.MOVING else None
            if released is not None:
                words = f"goal {released.id} of {released.user} was not renewed in time"
                reason = coded(words, EventCode.NOT_RENEWED, goal=released.id, user=released.user)
                if (refused := released.refusal) is not None:
                    words = f"a renewal of goal {released.id} of {released.user} was refused: {refused.message}"
                    reason = coded(words, EventCode.REFUSED)
                self.modes.apply_event(ModeEvent.NOT_RENEWED, reason)
            beginning = self.goal_queue.step(self.modes.cycle, self._admit, self._place)
            if beginning is not None:
                words = f"goal {beginning.id} of {beginning.user}"
                begun = coded(words, EventCode.GOAL_STARTED, goal=beginning.id, user=beginning.user)
                self.modes.apply_event(ModeEvent.GOAL, begun, beginning)
            self._checks.step(self._place_of_check)
        except Exception as error:  # noqa: BLE001
            self._trip_for(error)

    def prepare(self, answer: PlanAnswer | PlannerLost) -> None:
        """Do the part of handling an answer of the planner that changes nothing; `handle` may follow cycles later."""
        with contextlib.suppress(Exception):  # the motion meets the same error when it begins, which stops the robot
            self._planner.prepare(answer)

    def handle(self, received: Request | Disturbance | PlanAnswer | PlannerLost, now_ns: int) -> None:
        """Handle one input. `now_ns` is the time on the monotonic clock at which the input was received [ns]."""
        try:
            match received:
                case Disturbance():
                    self.modes.handle_disturbance(ModeEvent[received.event], received.text)
                    if received.event == ModeEvent.GATEWAY_LOST.name:
                        self._checks.withdraw(received.reason)
                case CheckRequest():
                    self._checks.enqueue(received)
                case GoalRequest() | CommandRequest():
                    self._answer(received, now_ns)
                case Announcement(notice):
                    self.ledger.notices.append(notice)
                case PlannerLost():
                    self._planner.fail(received.reason)
                    self._checks.fail(received.reason)
                case answer:
                    self._planner.receive(answer)
                    self._checks.receive(answer)
        except Exception as error:  # noqa: BLE001
            self._trip_for(error)

    def _answer(self, request: GoalRequest | CommandRequest, now_ns: int) -> None:
        """Start a command or add a goal to the queue. If the request is not allowed, reply with a refusal."""
        try:
            if isinstance(request, GoalRequest):
                self.goal_queue.enqueue(request, now_ns, self.modes.cycle)
            else:
                self._commands.carry_out(request)
        except RefusedError as refusal:
            self.ledger.refuse(request, refusal)

    # ------------------------------------------------------------------ state for reports

    @property
    def commanded(self) -> MotionState:
        """Commanded motion of the platform in this cycle."""
        return self.schedule.commanded

    @property
    def override(self) -> float:
        """Speed override; 1 is the planned speed."""
        return self._planner.override

    @property
    def target(self) -> Triple | None:
        """End pose of the current goal. For a track, the last reported pose of the target; for a jog, None."""
        last, goal = self.schedule.last, self.ledger.goal
        if goal is None or last is None:
            return None
        if goal.kind.renewed:
            return goal.target
        x, y, phi = last.destination(self.commanded.pose)
        return (x, y, phi)

    # ------------------------------------------------------------------ requests

    def _admit(self) -> bool:
        """Return True if the robot is moving to a goal. Raises RefusedError if the robot cannot accept a goal now."""
        self.modes.check(ModeEvent.GOAL)
        self._check_homed()
        return self.state.mode is Mode.MOVING

    def _check_homed(self) -> None:
        if not self.measured.homed:
            raise RefusedError(RefusalCode.NOT_HOMED, "the positions of the sliders are unknown: send home first")

    def _place(self, origin: Literal["commanded", "measured"]) -> Sequence[float]:
        """Return the pose from which a relative move begins: the end pose of the earlier goals, or the measured pose.

        Raises RefusedError if the robot has stopped on the path of a goal, because the goal is paused or the override
        is 0. In this case, the user would expect the move to begin at the present pose, not at the end of the path.
        """
        if origin == "measured":
            return self.measured.pose
        if self.state.paused or (self.override == 0.0 and self.schedule.last is not None):
            raise RefusedError(
                RefusalCode.MOVING,
                "a goal waits on its path, and the move would start from the end of that path: send stop or resume "
                "first, "
                'or send the move with "from": "measured"',
            )
        return self._end_pose

    def _place_of_check(self, origin: Literal["commanded", "measured"]) -> Sequence[float]:
        """Return the pose from which the path of a check is planned.

        This is the same pose as in `_place`, but a stopped goal is not an error: the check is planned from the end of
        the goal's path.
        """
        self._check_homed()
        return self.measured.pose if origin == "measured" else self._end_pose

    @property
    def _end_pose(self) -> Sequence[float]:
        """Pose at the end of all current goals; the commanded pose if there is none, or if it does not end there.

        A jog or track has no such end, and a goal that an input has stopped does not reach it.
        """
        last, goal = self.schedule.last, self.ledger.goal
        if last is None or goal is None or goal.kind.renewed or self.state.released:
            return self.commanded.pose
        return last.end(self.commanded.pose)

    # ------------------------------------------------------------------ from state to state

    @property
    def _at_rest(self) -> bool:
        """Whether the commanded motion is at rest."""
        return (self.state.mode is Mode.HOLDING and self.measured.homed) or self.measured.settling.under_way

    def _end_motion(self, run: Run) -> None:
        """Handle the end of a motion, either at its target or at a standstill before the target.

        At the target, the goal remains active until the robot is in position.
        """
        goal, settling = self.ledger.goal, self.measured.settling
        if not run.arrived:
            self.modes.apply_event(ModeEvent.STANDSTILL, coded("standstill", EventCode.STANDSTILL))
        elif self.state.mode is Mode.MOVING and goal is not None and goal.kind.waits_at_end:
            return  # the goal is waiting to be renewed
        elif goal is None or not goal.settles or self.state.released:
            self.modes.apply_event(ModeEvent.ARRIVED, coded("standstill", EventCode.STANDSTILL))
        elif not settling.under_way:
            settling.begin(self.modes.cycle)

    def _check_arrival(self) -> None:
        """End a goal after the end of its path, once the robot is in position or the time-out has elapsed."""
        settling = self.measured.settling
        settled = settling.result(self.modes.cycle - self.ahead)
        if settled is None:
            return
        outcome: Outcome = "done" if settled.settle is not None else "unsettled"
        self.ledger.end(outcome, settling.describe(settled, self._labels), settled=settled)
        self.modes.apply_event(ModeEvent.ARRIVED, coded("standstill", EventCode.STANDSTILL))

    def _power_up(self) -> None:
        """Complete the enabling once all drives are enabled; trip if the time-out elapses first."""
        if all(state is PowerState.OPERATION_ENABLED for state in self.measured.feedback.state):
            if not self.measured.homed:
                words = "all drives are enabled; the positions of the sliders are unknown: send home"
                self.modes.apply_event(ModeEvent.POWERED, coded(words, EventCode.POWERED_NOT_HOMED))
            elif self._begin_holding("enabled"):
                self.modes.apply_event(ModeEvent.POWERED, coded("all drives are enabled", EventCode.POWERED))
        elif self.modes.cycle - self.modes.entered > self._enable_cycles:
            waiting = [
                f"{naming.drive(name, self._labels)} is {state}"
                for name, state in zip(NAMES, self.measured.feedback.state, strict=True)
                if state is not PowerState.OPERATION_ENABLED
            ]
            seconds = self._enable_cycles * self._period
            words = f"not all drives were enabled within {seconds:g} s: {', '.join(waiting)}"
            names = [
                name
                for name, state in zip(self._labels, self.measured.feedback.state, strict=True)
                if state is not PowerState.OPERATION_ENABLED
            ]
            text = coded(words, EventCode.ENABLE_TIMEOUT, drives=", ".join(names), timeout=seconds)
            self.modes.trip(text, FaultCause.ENABLE)

    def _end_homing(self) -> None:
        """Change to holding once homing is complete or has been stopped."""
        if self.state.mode not in (Mode.HOMING, Mode.STOPPING) or self.schedule.runs:
            return  # the robot was not homing
        if self.measured.homed and not self._begin_holding("homed"):
            return
        if self.state.mode is Mode.STOPPING:
            self.modes.apply_event(ModeEvent.STANDSTILL, coded("standstill", EventCode.STANDSTILL))
        else:
            self.modes.apply_event(ModeEvent.HOMED, coded("all drives are homed", EventCode.HOMED))

    def _begin_holding(self, done: str) -> bool:
        """Set the commanded motion to rest at the pose of the setpoints, and warn if it is outside the limits.

        If the robot cannot be enabled there, or if no pose matches, trip and return False. `done` is what has happened
        to all drives, during which the sliders may have moved.
        """
        try:
            outside = self.setpoints.check_start()
        except RefusedError as refusal:
            words = f"all drives are {done}, but {refusal}"
            self.modes.trip(coded(words, EventCode.BAD_POSITION), FaultCause.PLACE)
            return False
        if outside is not None:
            self.ledger.notices.append(Notice("service", "warning", outside.text, **outside.fields))
        a, b, c = self.setpoints.rows[0]
        pose = self.measured.pose_of((a, b, c))
        if pose is None:
            words = "the measured slider positions do not correspond to any pose"
            self.modes.trip(coded(words, EventCode.BAD_POSITION), FaultCause.PLACE)
            return False
        self.schedule.commanded = rest(pose)
        self.setpoints.set_cross_slides(pose)
        return True

    def _follow_measured(self) -> None:
        """Set the commanded pose to the measured pose, and move the setpoints towards the measured slider positions."""
        held = self.state.mode not in (Mode.DISABLED, Mode.FAULT)
        stopped_now = self.state.mode is Mode.FAULT and self.modes.entered == self.modes.cycle
        self.setpoints.follow(self.schedule, held=held, stopped_now=stopped_now)
