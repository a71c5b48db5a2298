"""Python code that prepares and calls the compiled function, which runs the cycles without events."""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import numpy as np
from trirail_drivers.driver.cyclic import Cyclic, Lender

from trirail.control.control import Control, SteadyState
from trirail.motion.paths import Path, constant_law
from trirail.motion.runs import Run
from trirail.processes import quiet
from trirail.processes.clock import Overruns, PollSet, Ticker
from trirail.processes.heartbeats import PROCESSES, URGENT_INDEX, Heartbeats, UrgentFlag, Watch
from trirail.processes.quiet import Reached
from trirail.processes.quiet_state import STATE, QuietState
from trirail.processes.reports import Reports
from trirail.wire.links import Port
from trirail.wire.records import MAX_PART_NS, Part
from trirail.wire.vocabulary import MODES

_NO_CYCLE = 1 << 62
"""Number of a cycle that is never reached."""
_IDLE_LAW = constant_law(1.0)
_EMPTY_PATH = Path(np.array([0.0, 1.0]), np.zeros((1, 3, 6)))
"""Law and path that are passed to compiled code if there is no motion."""


class QuietResult(NamedTuple):
    """Result of the compiled call, which describes the newest cycle that the call has begun."""

    reached: Reached
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


class QuietCycles:
    """Caller of the compiled function, with the arrays that this function uses. Call `run` only between two cycles."""

    def __init__(
        self,
        control: Control,
        drives: Lender,
        reports: Reports,
        hearts: Heartbeats,
        gateway: Port,
        poll_set: PollSet,
        watch: Watch,
        urgent_flag: UrgentFlag,
        busy_wait_ns: int,
    ) -> None:
        self.cycles = 0
        """Number of cycles that the compiled function has run."""
        self._control = control
        self._drives = drives
        self._reports = reports
        self._gateway = gateway
        self._watch = watch
        self._urgent_flag = urgent_flag
        self._hearts = np.frombuffer(hearts.counts, np.uint64)[: URGENT_INDEX + 1]
        self._state = QuietState()
        self._moment = np.zeros(2, np.int64)
        self._poll_set = poll_set
        self._lent: Cyclic | None = None
        self._orders = 0
        """Number of orders that the control had given to the drives when the drives lent their tables."""
        self.decided = False
        """True if the control may have changed the motion or the mode since the arguments were prepared."""
        self._steady: SteadyState | None = None
        self._tables: tuple[Any, ...] = ()
        self._motion: tuple[Any, ...] = ()
        """Arguments of the compiled function, valid until the drives lend other tables or the motion changes."""
        self._nothing = np.zeros(1)
        measured, setpoints = control.measured, control.setpoints
        state = self._state
        self.parts_ns = state.parts_ns
        """Durations of the parts of the newest cycle [ns], in the memory to which compiled code writes."""
        state.period, state.period_ns, state.injected_ns = control.period, round(control.period * 1e9), -1
        state.fastest, state.limit, state.step = measured.fastest, measured.limit, setpoints.step
        state.gateway_place, state.gateway_patience = PROCESSES.index("gateway"), watch.patience
        state.report_after, state.busy_wait_ns = control.outputs.report_after, busy_wait_ns

    def run(
        self, ticker: Ticker, overruns: Overruns, spare_ns: int, *, listens: bool, once: bool
    ) -> QuietResult | None:
        """Run cycles until an event or the end of a batch, and return the result for the newest cycle.

        Return None if no cycle was run, because Python must run the next cycle.

        Parameters
        ----------
        spare_ns
            Time before a tick in which calls are not served [ns].
        listens
            True if a call during the wait for the first tick must be served before that tick.
        once
            True to run only one cycle, because messages wait to be sent after that cycle.

        """
        control, state = self._control, self._state
        if not ((once or self._reports.idle) and self._gateway.no_peer_lost and self._tables_ready()):
            self.leave()
            return None
        watch, before = self._watch, control.cycles
        state.injected_ns, state.deadline_ns = ticker.sleep_if_injected(), ticker.deadline_ns
        state.overruns, state.in_a_row, state.allowed = overruns.all, overruns.in_a_row, overruns.allowed
        state.until = before + (1 if once or state.injected_ns >= 0 else max(1, self._reports.due_after))
        state.batched, state.listens, state.spare_ns = self._reports.batched, listens, spare_ns
        state.gateway_seen, state.gateway_turns = watch.seen, watch.silent_turns
        state.urgent_seen = self._urgent_flag.seen
        state.logged, state.report_due = control.outputs.logged, control.outputs.report_due
        self._poll_set.refresh()
        reached = Reached(quiet.run(*self._tables, *self._motion))
        overruns.all, overruns.in_a_row = state.overruns, state.in_a_row
        watch.seen, watch.silent_turns = state.gateway_seen, state.gateway_turns
        self._reports.batched, ticker.deadline_ns = state.batched, state.deadline_ns
        self.cycles += state.cycle - before
        control.outputs.update_log(state.logged, state.report_due)
        decides = state.decides and reached in (Reached.WRITTEN, Reached.DONE)
        if reached not in (Reached.DONE, Reached.CALLED):
            synced = state.synced if reached in (Reached.SYNCED, Reached.OBSERVED, Reached.SOLVED) else None
            self.leave(state.handled, state.arrived, synced=synced, error=max(state.error, 0))
        self._drives.next_sync = (state.deadline_ns + state.period_ns) * 1e-9  # for commands at the end of a motion
        control.resume(state.cycle, state.time, state.code if decides else None)
        if reached is Reached.WRITTEN:
            self._drives.send_on(state.sent)
        tick = state.deadline_ns, state.lateness_ns, state.missed
        return QuietResult(reached, *tick, state.marked_ns, state.called, decides, state.behind, state.code)

    def leave(self, handled: int = 0, arrived: int = 0, *, synced: float | None = None, error: int = 0) -> None:
        """Return lent tables to the drives, with the parameters of trirail_drivers.driver.cyclic.Lender.reclaim."""
        if self._lent is not None:
            self._control.measured.feedback = self._drives.reclaim(handled, arrived, synced=synced, error=error)
            self._lent = None

    def _tables_ready(self) -> bool:
        """Prepare the arguments of the compiled function. Return False if Python must run the next cycle.

        The drives lend their tables until a decision of the control concerns the drives, and not only the motion.
        """
        if self._lent is not None and not self.decided:
            return True
        self._steady, orders = self._control.steady_state(), self._control.modes.orders
        if self._steady is None:
            return False
        if orders != self._orders:
            self.leave()
        if self._lent is None:
            self._lent, self._orders = self._drives.lend(), orders
            self._tables = self._table_arguments(self._lent) if self._lent is not None else ()
        if self._lent is not None:
            self._write_state(self._steady)
            self._motion = self._motion_arguments(self._steady.run)
            self.decided = False
        return self._lent is not None

    def add(self, part: Part) -> None:
        """Add the time since the newest cycle to the duration of one of its parts; 0 if a simulated clock is ahead."""
        passed = max(0, time.perf_counter_ns() - self._state.marked_ns)
        self.parts_ns[part] = min(self.parts_ns[part] + passed, MAX_PART_NS)

    def _write_state(self, steady: SteadyState) -> None:
        state, run = self._state, steady.run
        state.source = quiet.FOLLOW if steady.follows else quiet.HOLD if run is None else quiet.COMMAND
        state.cycle, state.mode = self._control.cycles, MODES.index(self._control.state.mode)
        state.held, state.at_rest, state.code = steady.held, steady.at_rest, steady.code
        state.due = int(min(max(steady.until, state.cycle), _NO_CYCLE))
        state.settles, state.timeout = steady.settles_by is not None, steady.settles_by or 0
        runs = self._control.schedule.runs
        state.time = runs[0].time if runs else 0.0
        if run is not None:
            state.in_sliders, state.target, state.course = run.path.in_sliders, run.target, run.goal_span

    def _table_arguments(self, lent: Cyclic) -> tuple[Any, ...]:
        """Return the arguments of the compiled function that stay the same while the drives lend their tables."""
        measured, setpoints, schedule = self._control.measured, self._control.setpoints, self._control.schedule
        frames = quiet.FrameTables(
            bus=lent.bus,
            arrived=lent.arrived.frames,
            arrivals=lent.arrived.headers,
            starts=lent.begin.frames,
            begin=lent.begin.headers,
            signs=lent.beats.frames,
            beats=lent.beats.headers,
            setpoints=lent.setpoints.frames,
            departures=lent.end,
            pins=lent.outputs.frames,
            switchings=lent.outputs.headers,
            expected=lent.expected,
            axes=lent.axes,
            times=lent.times,
            history=lent.history,
        )
        robot = quiet.RobotArrays(
            legs=measured.legs,
            bounds=setpoints.bounds,
            motion=schedule.motion,
            sliders=setpoints.sliders,
            backlash=measured.backlash,
            refused_values=setpoints.refused_values,
            feedback=measured.numbers,
            written=measured.written,
            jumps=measured.jumping,
            scratch=measured.scratch,
            monitored=measured.settling.monitored,
            record=measured.record,
            packed=measured.record.view(np.uint8),
        )
        neighbours = quiet.Neighbours(self._poll_set.pollfds, self._hearts, self._reports.batch)
        return np.frombuffer(memoryview(self._state), STATE), self._moment, neighbours, frames, robot

    def _motion_arguments(self, run: Run | None) -> tuple[quiet.MotionArrays, quiet.OutputArrays]:
        """Return the arguments of the compiled function that depend on the motion."""
        path, law = (run.path, run.law) if run is not None else (_EMPTY_PATH, _IDLE_LAW)
        furthest = run.furthest if run is not None else self._nothing
        outputs = self._control.outputs
        outputs.prepare(run, self._control.schedule.version)
        motion = quiet.MotionArrays(path.knots, path.pieces, path.tools, law.knots, law.pieces, furthest)
        return motion, quiet.OutputArrays(outputs.state, outputs.planned, outputs.words, outputs.log)
