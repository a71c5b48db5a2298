"""Python code that prepares and calls the compiled function, which runs the cycles without events.

Compiled code has arrays of its own for the state of the robot, which are copies of the control's arrays. Python can
therefore decide beside the cycles, in a thread of its own: the control first advances its commanded motion by the
cycles that compiled code is about to run (Control.foresee), so that its decisions take effect after them. Both compute
the same setpoints, since they call the same functions.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from trirail_drivers.driver.cyclic import FINISHED, CompiledDrives, Cyclic, UnfinishedCycle
from trirail_drivers.interface import Feedback, Triple

from trirail.control import cycle
from trirail.control.control import Control, SteadyState
from trirail.control.feedback import pack_feedback
from trirail.motion.paths import Path, constant_law
from trirail.motion.runs import Run
from trirail.processes import cycle_core
from trirail.processes.clock import Overruns, PollSet, Tick, Ticker
from trirail.processes.companion import Companion
from trirail.processes.cycle_core import Reached
from trirail.processes.cycle_state import STATE, CycleState
from trirail.processes.heartbeats import PROCESSES, URGENT_INDEX, Heartbeats, UrgentFlag, Watch
from trirail.processes.reports import Reports
from trirail.wire.links import Port
from trirail.wire.records import MAX_PART_NS, Part
from trirail.wire.vocabulary import MODES

_IDLE_LAW = constant_law(1.0)
_EMPTY_PATH = Path(np.array([0.0, 1.0]), np.zeros((1, 3, 6)))
"""Law and path that are passed to compiled code if there is no motion."""

_WRITTEN_IN_SOLVE = [name for name in cycle_core.RobotArrays._fields if name not in ("legs", "packed")]


class CallResult(NamedTuple):
    """Result of the compiled call, which describes the newest cycle that the call has begun."""

    reached: Reached
    cycle: int
    """Number of the last complete cycle."""
    deadline_ns: int
    lateness_ns: int
    missed: int
    """Number of ticks that were skipped before the cycle."""
    marked_ns: int
    """Time at which the newest part of the cycle ended [ns]."""
    called: bool
    """True if a neighbour has called."""
    decides: bool
    """True if a decision is due."""
    behind: int
    """Result of trirail.control.cycle.observe, if the cycle stopped after that function."""
    code: int
    """Result of trirail.control.cycle.command, if the cycle stopped after that function."""
    ahead: int | None
    """Cycle after which the decision takes effect that Python has made beside the newest cycles; None if there is none.
    """

    @property
    def tick(self) -> Tick:
        """Tick of the cycle."""
        return Tick(self.deadline_ns, self.lateness_ns, self.missed)


class DecisionRequest(NamedTuple):
    """Request of compiled code for a decision beside the next cycles, which takes effect after them."""

    cycle: int
    """Number of the last complete cycle."""
    number: int
    """Number of cycles that run beside the decision."""
    deadline_ns: int
    """Deadline of cycle `cycle` [ns]."""
    requested_ns: int
    """Time of the request [ns]."""
    called: bool
    """True if a neighbour has called."""
    time: float
    """Time of the run's law in cycle `cycle` [s]."""


class _Copies:
    """Copies of the control's arrays for compiled code."""

    def __init__(self) -> None:
        self._kept: list[NDArray[Any]] = []
        self._rows: list[tuple[int, int, int]] = []

    def add(self, array: NDArray[Any]) -> NDArray[Any]:
        """Add an array, and return its copy."""
        copy = array.copy()
        self._kept += array, copy
        self._rows.append((array.ctypes.data, copy.ctypes.data, array.nbytes))
        return copy

    @property
    def table(self) -> NDArray[np.int64]:
        """Table of the copies for compiled code, as in trirail.processes.cycle_core.copy_state."""
        return np.array(self._rows, np.int64)


class CycleCaller:
    """Caller of the compiled function, with the arrays that this function uses. Call `run` only between two cycles."""

    def __init__(
        self,
        control: Control,
        drives: CompiledDrives,
        reports: Reports,
        hearts: Heartbeats,
        gateway: Port,
        poll_set: PollSet,
        watch: Watch,
        urgent_flag: UrgentFlag,
        busy_wait_ns: int,
        decide: Callable[[DecisionRequest], None],
    ) -> None:
        """Prepare the arrays. `decide` is the function that decides beside the cycles."""
        self.cycles = 0
        """Number of cycles that the compiled function has run."""
        self._control = control
        self._drives = drives
        self._reports = reports
        self._gateway = gateway
        self._watch = watch
        self._urgent_flag = urgent_flag
        self._hearts = np.frombuffer(hearts.counts, np.uint64)[: URGENT_INDEX + 1]
        self._state = CycleState()
        self._moment = np.zeros(2, np.int64)
        self._poll_set = poll_set
        self._prepared = False
        """True if the drives' tables suffice for the next cycles."""
        self._orders = 0
        """Number of orders that the control had given to the drives when their tables were prepared."""
        self.decided = False
        """True if the control may have changed the motion or the mode since the arguments were prepared."""
        self._steady: SteadyState | None = None
        self._tables: tuple[Any, ...] = ()
        self._motion: tuple[Any, ...] = ()
        """Arguments of the compiled function, valid until the tables are prepared again or the motion changes."""
        self._nothing = np.zeros(1)
        self._decide = decide
        self._companion = Companion(self._answer)
        self.cycles_beside = 1, cycle_core.MOST_AHEAD
        """Minimum and maximum number of cycles that run beside a decision, which tests change."""
        measured, setpoints = control.measured, control.setpoints
        self._measured, self._commanded, self._furthest = _Copies(), _Copies(), _Copies()
        self._robot = self._robot_arrays()
        self._measured_table = self._measured.table
        self._robot_table = np.concatenate((self._measured_table, self._commanded.table))
        self._outputs = _Copies()
        self._output_state = self._outputs.add(control.outputs.state)
        self._output_words = self._outputs.add(control.outputs.words)
        self._table = self._robot_table
        self._rehearsed = _Copies()
        self._rehearsal: tuple[Any, ...] = ()
        """Arrays of a rehearsal that stay the same until the tables are prepared again."""
        state = self._state
        self.parts_ns = state.parts_ns
        """Durations of the parts of the newest cycle [ns], in the memory to which compiled code writes."""
        state.period, state.period_ns, state.injected_ns = control.period, round(control.period * 1e9), -1
        state.fastest, state.limit, state.step = measured.fastest, measured.limit, setpoints.step
        state.gateway_place, state.gateway_patience = PROCESSES.index("gateway"), watch.patience
        state.report_after, state.busy_wait_ns = control.outputs.report_after, busy_wait_ns
        state.requested = -1

    def run(
        self,
        ticker: Ticker,
        overruns: Overruns,
        budget_ns: int,
        work: Callable[[], None] | None = None,
    ) -> CallResult | None:
        """Run cycles until an event or the end of a batch, and return the result for the newest cycle.

        Return None if no cycle was run, because Python must run the next cycle. Otherwise call `conclude` or, if Python
        has decided beside the newest cycles, `copy_measured_back`, or `copy_back` if the control is taken back.

        Parameters
        ----------
        budget_ns
            Time that a decision beside the cycles needs [ns].
        work
            Work beside the cycles that changes neither the control nor the drives.

        """
        control, state = self._control, self._state
        if not (self._reports.idle and self._gateway.no_peer_lost and self._tables_ready()):
            self.continue_in_python()
            if work is not None:
                work()
            return None
        state.injected_ns = ticker.sleep_if_injected()
        state.until = control.cycles + (1 if state.injected_ns >= 0 else max(1, self._reports.due_after))
        state.deciding, state.requested = False, -1
        state.logged, state.report_due = control.outputs.logged, control.outputs.report_due
        state.budget_ns = budget_ns
        state.least, state.most = self.cycles_beside if self._may_decide_beside else (0, 0)
        state.lead = min(max(state.least, -(-budget_ns // state.period_ns) - 1), state.most)
        self._poll_set.refresh()
        reached = self._call_beside(work, ticker, overruns)
        if state.requested >= 0:
            return self.result(reached)
        control.outputs.update_log(state.logged, state.report_due)
        self.pass_on_frames(reached)
        control.resume(state.cycle, state.time, None)
        if reached is Reached.WRITTEN:
            self.send_on()
        return self.result(reached)

    def run_beside(self, ticker: Ticker, overruns: Overruns) -> Reached:
        """Run cycles with an injected clock, beside a requested decision; return the stage of the newest."""
        state = self._state
        reached, last = Reached.DONE, state.until
        self._answer()  # before the cycles or beside them: the result is the same
        while reached is Reached.DONE and state.cycle < last:
            state.injected_ns, state.until = ticker.sleep_if_injected(), state.cycle + 1
            reached = self._call(ticker, overruns)
        state.until = last
        return reached

    def _answer(self) -> None:
        """Decide beside the cycles."""
        state = self._state
        self._control.outputs.update_log(state.logged, state.report_due)
        request = state.requested, state.until - state.requested, state.requested_deadline_ns, state.requested_ns
        self._decide(DecisionRequest(*request, state.requested_called, state.requested_time))

    def _call_beside(self, work: Callable[[], None] | None, ticker: Ticker, overruns: Overruns) -> Reached:
        """Call the compiled function beside `work`, and beside a decision that it requests, if any."""
        state = self._state
        if state.injected_ns >= 0 or self._calls_python:
            if work is not None:
                work()
            reached = self._call(ticker, overruns)
            return self.run_beside(ticker, overruns) if state.requested >= 0 else reached
        self._companion.start()
        state.doorbell = self._companion.doorbell
        with self._companion.working(work):
            reached = self._call(ticker, overruns)
        if state.requested >= 0:
            self._companion.wait()
        return reached

    def _call(self, ticker: Ticker, overruns: Overruns) -> Reached:
        """Call the compiled function, and return the stage that it has reached."""
        state, watch, before = self._state, self._watch, self._state.cycle
        state.deadline_ns, state.batched = ticker.deadline_ns, self._reports.batched
        state.overruns, state.in_a_row, state.allowed = overruns.all, overruns.in_a_row, overruns.allowed
        state.gateway_seen, state.gateway_turns = watch.seen, watch.silent_turns
        state.urgent_seen = self._urgent_flag.seen
        first, moment, *rest = self._tables
        reached = Reached(cycle_core.run(first, moment, self._table, self._neighbours(), *rest, *self._motion))
        overruns.all, overruns.in_a_row = state.overruns, state.in_a_row
        watch.seen, watch.silent_turns = state.gateway_seen, state.gateway_turns
        self._reports.batched, ticker.deadline_ns = state.batched, state.deadline_ns
        self.cycles += state.cycle - before
        return reached

    def result(self, reached: Reached) -> CallResult:
        """Return the result for the newest cycle, which has reached a stage."""
        state = self._state
        decides = state.decides and reached in (Reached.WRITTEN, Reached.DONE)
        ahead = state.until if state.requested >= 0 else None
        self._drives.next_sync = (state.deadline_ns + state.period_ns) * 1e-9  # for commands at the end of a motion
        tick = state.deadline_ns, state.lateness_ns, state.missed
        return CallResult(
            reached, state.cycle, *tick, state.marked_ns, state.called, decides, state.behind, state.code, ahead
        )

    def pass_on_frames(self, reached: Reached) -> None:
        """Let the drives handle the newest cycle's remaining frames, if it has reached a stage that needs Python."""
        state = self._state
        if reached is not Reached.DONE:
            synced = state.synced if reached in (Reached.SYNCED, Reached.OBSERVED, Reached.SOLVED) else None
            newest = UnfinishedCycle(state.handled, state.arrived, synced, max(state.error, 0))
            self.continue_in_python(newest)

    def conclude(self, newest: CallResult) -> None:
        """Let the control evaluate the newest cycle, if it must react to that cycle."""
        if newest.decides:
            self._control.resume(newest.cycle, self._state.time, newest.code)

    def send_on(self) -> None:
        """Let the drives send the setpoints again that the bus has refused."""
        self._drives.send_on(self._state.sent)

    def solve(self, feedback: Feedback, tick: Tick, marked_ns: int) -> Reached:
        """Evaluate the feedback of a cycle that Python has begun, and compute its setpoints; return the stage.

        `marked_ns` is the time at which the cycle's feedback had been read [ns].
        """
        state = self._state
        state.deadline_ns, state.lateness_ns, state.missed = tick
        state.marked_ns = marked_ns
        self._control.measured.feedback = feedback
        pack_feedback(feedback, self._robot.feedback, self._robot.record)
        first, moment, frames, robot = self._tables
        reached = cycle_core.solve(first, moment, frames, robot, self._motion[1])
        return Reached.SOLVED if reached == cycle_core.CONTINUE else Reached(reached)

    def is_refused(self, reached: Reached) -> bool:
        """Return True if a following error exceeds its limit, or the last gate has refused the setpoints."""
        return reached is Reached.OBSERVED or bool(cycle.refusal(self._state.code))

    @property
    def marked_ns(self) -> int:
        """Time at which the newest part of the newest cycle ended [ns]."""
        return self._state.marked_ns

    @property
    def setpoints(self) -> tuple[Triple, Triple]:
        """Setpoints of the newest cycle: positions [m] and velocities [m/s]."""
        (a, b, c), (u, v, w) = self._robot.sliders[0, :2].tolist()
        return (a, b, c), (u, v, w)

    def record(self, overruns: Overruns) -> int:
        """Append the record of the newest cycle to the batch, and return the number of the cycle."""
        state = self._state
        self._robot.record["outputs"] = self._output_words  # the decision before this cycle may have changed them
        state.overruns, state.batched = overruns.all, self._reports.batched
        number = int(cycle_core.record(self._tables[0], self._robot, self._reports.batch))
        self._reports.batched = state.batched
        return number

    @property
    def _may_decide_beside(self) -> bool:
        """True if Python may decide beside the next cycles.

        They then execute a motion or hold the robot. Compiled code must not need Python to exchange frames.
        """
        return self._prepared and self._state.source != cycle_core.FOLLOW and not self._calls_python

    @property
    def _calls_python(self) -> bool:
        """True if Python exchanges the frames for compiled code, unless the clock is injected."""
        return self._state.injected_ns < 0 and bool(self._drives.tables.bus[0] < 0)

    def copy_measured_back(self) -> None:
        """Copy the measured state of the robot back from compiled code."""
        cycle_core.copy_state(self._measured_table, True)

    def copy_back(self) -> None:
        """Copy the whole state of the robot back from compiled code, without the outputs, which it has not changed."""
        cycle_core.copy_state(np.concatenate((self._robot_table, self._furthest.table)), True)

    def _neighbours(self) -> cycle_core.Neighbours:
        return cycle_core.Neighbours(self._poll_set.pollfds, self._hearts, self._reports.batch)

    def continue_in_python(self, newest: UnfinishedCycle = FINISHED) -> None:
        """Let the drives continue after compiled cycles."""
        if self._prepared:
            self._control.measured.feedback = self._drives.continue_in_python(newest)
            self._prepared = False

    def _tables_ready(self) -> bool:
        """Prepare the arguments of the compiled function. Return False if Python must run the next cycle.

        The drives' tables stay as they are until a decision of the control concerns the drives, not only the motion.
        """
        if self._prepared and not self.decided:
            return True
        self._steady, orders = self._control.steady_state(), self._control.modes.orders
        if self._steady is None:
            return False
        if orders != self._orders:
            self.continue_in_python()
        if not self._prepared:
            self._prepared, self._orders = self._drives.prepare_tables(), orders
            if self._prepared:
                self._tables = self._table_arguments(self._drives.tables)
        if self._prepared:
            self._write_state(self._steady)
            self._motion = self._motion_arguments(self._steady.run)
            self.decided = False
        return self._prepared

    def add(self, part: Part) -> None:
        """Add the time since the newest cycle to the duration of one of its parts; 0 if a simulated clock is ahead."""
        passed = max(0, time.perf_counter_ns() - self._state.marked_ns)
        self.parts_ns[part] = min(self.parts_ns[part] + passed, MAX_PART_NS)

    def _write_state(self, steady: SteadyState) -> None:
        state, run = self._state, steady.run
        state.source = cycle_core.FOLLOW if steady.follows else cycle_core.HOLD if run is None else cycle_core.COMMAND
        state.cycle, state.mode = self._control.cycles, MODES.index(self._control.state.mode)
        state.held, state.at_rest, state.code = steady.held, steady.at_rest, steady.code
        state.due = int(min(max(steady.until, state.cycle + 1), cycle_core.NO_CYCLE))
        state.settles, state.timeout = steady.settles_by is not None, steady.settles_by or 0
        runs = self._control.schedule.runs
        state.time = runs[0].time if runs else 0.0
        if run is not None:
            state.in_sliders, state.target, state.course = run.path.in_sliders, run.target, run.goal_span
            state.stops_first = steady.after_stop is not None
            if steady.after_stop is not None:
                state.stop_duration, state.after_stop = run.end_time, steady.after_stop

    def _table_arguments(self, tables: Cyclic) -> tuple[Any, ...]:
        """Return the arguments of the compiled function that stay the same until the tables are prepared again."""
        frames = cycle_core.FrameTables(
            bus=tables.bus,
            arrived=tables.arrived.frames,
            arrivals=tables.arrived.headers,
            starts=tables.begin.frames,
            begin=tables.begin.headers,
            signs=tables.beats.frames,
            beats=tables.beats.headers,
            setpoints=tables.setpoints.frames,
            departures=tables.end,
            pins=tables.outputs.frames,
            switchings=tables.outputs.headers,
            expected=tables.expected,
            axes=tables.axes,
            times=tables.times,
            history=tables.history,
        )
        state = np.frombuffer(memoryview(self._state), STATE)
        self._rehearsed = _Copies()
        copied, robot = self._rehearsed.add, self._robot
        self._rehearsal = (
            copied(state),
            frames._replace(axes=copied(frames.axes), setpoints=copied(frames.setpoints)),
            robot._replace(**{name: copied(getattr(robot, name)) for name in _WRITTEN_IN_SOLVE}),
        )
        return state, self._moment, frames, robot

    def _robot_arrays(self) -> cycle_core.RobotArrays:
        """Return copies of the control's arrays for compiled code."""
        measured, setpoints, schedule = self._control.measured, self._control.setpoints, self._control.schedule
        record, commanded = self._measured.add(measured.record), self._commanded.add
        return cycle_core.RobotArrays(
            legs=measured.legs,
            bounds=commanded(setpoints.bounds),
            motion=commanded(schedule.motion),
            sliders=commanded(setpoints.sliders),
            backlash=commanded(measured.backlash),
            refused_values=commanded(setpoints.refused_values),
            feedback=self._measured.add(measured.numbers),
            written=self._measured.add(measured.written),
            jumps=self._measured.add(measured.jumping),
            scratch=self._measured.add(measured.scratch),
            monitored=self._measured.add(measured.settling.monitored),
            record=record,
            packed=record.view(np.uint8),
        )

    def _motion_arguments(self, run: Run | None) -> tuple[Any, ...]:
        """Return the arguments of the compiled function that depend on the motion."""
        path, law = (run.path, run.law) if run is not None else (_EMPTY_PATH, _IDLE_LAW)
        self._furthest = _Copies()
        furthest = self._furthest.add(run.furthest if run is not None else self._nothing)
        self._table = np.concatenate((self._robot_table, self._outputs.table, self._furthest.table))
        rehearsed = _Copies()
        rehearsal = *self._rehearsal, rehearsed.add(furthest)
        table = np.concatenate((self._rehearsed.table, rehearsed.table))
        outputs = self._control.outputs
        outputs.prepare(run, self._control.schedule.version)
        motion = cycle_core.MotionArrays(path.knots, path.pieces, path.tools, law.knots, law.pieces, furthest)
        switching = cycle_core.OutputArrays(self._output_state, outputs.planned, self._output_words, outputs.log)
        return cycle_core.Rehearsal(table, *rehearsal), motion, switching
