"""Control loop, which is the only process with deadlines and never waits for anything except its next tick."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterable, Iterator, MutableSequence

from trirail_drivers.bus.capture import Capture
from trirail_drivers.driver.cyclic import CompiledDrives
from trirail_drivers.interface import NAMES, DriveFault, DriveGroup, Feedback

from trirail.config import Config
from trirail.control.control import Control, TimedInput
from trirail.control.modes import ModeEvent
from trirail.processes.clock import Overruns, PollSet, Suspensions, Tick, Ticker
from trirail.processes.cycle_caller import CallResult, CycleCaller, DecisionRequest
from trirail.processes.cycle_core import MOST_AHEAD, Reached
from trirail.processes.ending import MAX_SHUTDOWN_S, stops_within
from trirail.processes.heartbeats import Heartbeats, UrgentFlag, Watch
from trirail.processes.ports import URGENT_REQUESTS_A_CYCLE, GatewayLink, PlannerLink, Ports
from trirail.processes.reports import EVENTS_KEPT, Reports
from trirail.wire.event_codes import EventCode, coded
from trirail.wire.packets import (
    DecidedAhead,
    Disturbance,
    DrivesFault,
    Request,
)
from trirail.wire.records import MAX_PART_NS, Part
from trirail.wire.vocabulary import Mode

DECISION_BUDGET_NS = 300_000
"""Least time that is assumed for a decision beside the cycles [ns]."""
HANDOVER_NS = 300_000
"""Time for taking over the result of a decision beside the cycles, and for preparing the next motion [ns].

A decision follows many cycles of compiled code, so that the caches of the processor no longer hold Python's code.
"""
BUDGET_DECAY = 1 / 32
"""Fraction by which the budget shrinks each time a decision takes less time than the budget."""
MIN_GATEWAY_TIMEOUT_CYCLES = 3
"""Minimum time-out for the gateway's heartbeat, in cycles."""

_STILL_IN_USE = (Mode.ENABLING, Mode.HOMING, Mode.HOLDING, Mode.MOVING)
"""Modes in which a robot is only if a request arrived after the end of the service was announced."""


class TimeBudget:
    """Time that a decision needs, which is longer on a slower machine.

    It is the longest recent duration of a decision, within limits [ns].
    """

    def __init__(self, shortest_ns: int, longest_ns: int) -> None:
        self._shortest_ns = shortest_ns
        self._longest_ns = max(shortest_ns, longest_ns)
        self.ns = shortest_ns

    def note(self, duration_ns: int) -> None:
        """Take a duration into account."""
        shrunk_ns = round(self.ns * (1 - BUDGET_DECAY))
        self.ns = min(max(self._shortest_ns, shrunk_ns, duration_ns), self._longest_ns)


class Loop:
    """Control loop, which connects the control, the drives, the ticks and the neighbouring processes."""

    def __init__(
        self,
        config: Config,
        drives: DriveGroup,
        ports: Ports,
        heartbeats: Heartbeats,
        *,
        capture: Capture | None = None,
        lacking: tuple[str, ...] = (),
        compiled: bool = True,
        suspensions: Suspensions | None = None,
        now: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """Create and connect the parts of the loop.

        Parameters
        ----------
        lacking
            Real-time rights that the loop could not acquire, which it reports in its welcome.
        compiled
            True if the compiled call runs the cycles without events, False if Python runs every cycle.
        suspensions
            Detector of suspensions of the computer; None for one with the computer's own clocks.
        now
            Clock with which the duration of decisions is measured [ns].

        """
        self._now = now
        self._suspensions = suspensions or Suspensions()
        self._drives = drives
        patience = max(MIN_GATEWAY_TIMEOUT_CYCLES, round(config.watchdogs.gateway_timeout * config.loop.rate_hz))
        watch = Watch(heartbeats.heart("gateway"), patience)
        self._gateway = GatewayLink(ports.gateway, watch, config.watchdogs.gateway_timeout)
        self._planner = PlannerLink(ports.planner)
        self._period = config.period
        self._period_ns = round(config.period * 1e9)

        self.control = Control(config, drives, self._planner)
        self._reports = Reports(config, self.control, drives, ports.gateway, ports.recorder, capture, lacking)
        self.ending = False
        """Set this to True from outside to make the loop stop the robot, disable the drives and return."""
        self._ending_since: int | None = None
        self._stops_within = stops_within(config.drives)
        self._overruns = Overruns(config.watchdogs.max_overruns)
        self._heart = heartbeats.heart("loop")
        self._urgent_flag = UrgentFlag(heartbeats)
        self._work: Callable[[], None] | None = None
        """Work that is due beside the next cycles."""
        self._decision_budget = TimeBudget(DECISION_BUDGET_NS, MOST_AHEAD * self._period_ns)
        self._caller: CycleCaller | None = None
        if compiled and isinstance(drives, CompiledDrives):
            shared = self._reports, heartbeats, ports.gateway, PollSet(ports), watch, self._urgent_flag
            self._caller = CycleCaller(self.control, drives, *shared, config.loop.busy_wait_ns, self._decide_ahead)
        self._decided_after = 0
        """Cycle after which the newest decision has taken effect."""
        self._fault: DriveFault | None = None
        self._unready: tuple[str, ...] = ()
        self._marked_ns = 0
        self._parts_ns: MutableSequence[int] = [0] * len(Part) if self._caller is None else self._caller.parts_ns

    def run(self, ticker: Ticker) -> None:
        """Run cycles until `ending` is set, and then until the drives have lost power or report that they keep it."""
        self.begin()
        while not self._has_ended():
            self.turn(ticker)
        self._reports.pass_on(EVENTS_KEPT)
        self._flush()

    def begin(self) -> None:
        """Accept the processes that wait to connect, and read the drives, before the first cycle."""
        self._planner.accept()
        self._reports.accept_peers()  # before the first cycle, so that a waiting recorder receives every cycle
        self._drives.sync()
        self.control.start(self._drives.read())

    @property
    def compiled_cycles(self) -> int:
        """Number of cycles run by the compiled call."""
        return self._caller.cycles if self._caller is not None else 0

    def turn(self, ticker: Ticker) -> None:
        """Run cycles without events in compiled code, or one cycle with an event in Python; then handle requests."""
        caller, newest = self._caller, None
        disturbed = self.ending or self._gateway.frozen or not self._planner.idle or self._suspensions.occurred()
        if caller is not None and not disturbed:
            work, self._work = self._work, None
            newest = caller.run(ticker, self._overruns, self._decision_budget.ns + HANDOVER_NS, work)
        elif caller is not None:
            caller.continue_in_python()
        if newest is None:
            if self._work is not None:
                self._work()
                self._work = None
            self.cycle(ticker.wait())
        elif caller is not None and newest.ahead is not None:
            self._finish_ahead(caller, ticker, newest, newest.ahead)
        elif newest.reached is Reached.WAITED:
            self.cycle(ticker.tick())
        elif newest.reached is Reached.SYNCED:
            self._marked_ns = newest.marked_ns
            self._continue_after_sync(newest.tick)
        elif newest.reached in (Reached.OBSERVED, Reached.SOLVED):
            self._continue_solved(newest)
        elif caller is not None:
            self._follow_up(caller, newest)

    def _follow_up(self, caller: CycleCaller, newest: CallResult) -> None:
        """Decide before the next tick, if that is due after a complete cycle."""
        next_ns = newest.deadline_ns + self._period_ns
        decides = newest.called or newest.decides or self._reports.misses_recorder
        if decides:
            began_ns = self._now()
            caller.conclude(newest)
            self._decide(next_ns, called=newest.called, due=newest.decides)
            self._decision_budget.note(self._now() - began_ns)
            caller.add(Part.DECIDE)
        self._send_beside(reports=decides)

    def _send_beside(self, *, reports: bool) -> None:
        """Send the batch of records, if it is due, and events and answers beside the next cycles."""
        if flushes := not self._reports.due_after:
            self._reports.set_batch_aside()
        if reports or flushes:
            self._work = self._send_and_flush if flushes else self._send_reports

    def _send_and_flush(self) -> None:
        self._send_reports()
        self._flush()

    def _decide_ahead(self, request: DecisionRequest) -> None:
        """Decide beside the cycles of a request, in the thread beside compiled code."""
        control, number = self.control, request.number
        next_ns = request.deadline_ns + (number + 1) * self._period_ns
        control.resume(request.cycle, request.time, None)
        control.modes.hold_commands()
        self._reports.note(next_ns, DecidedAhead(number, again=self._decided_after == request.cycle))
        control.foresee(number)
        if request.called:
            self._read()
        self._pass_to_control(self._noted(next_ns))
        self._decision_budget.note(self._now() - request.requested_ns)

    def _finish_ahead(self, caller: CycleCaller, ticker: Ticker, newest: CallResult, last: int) -> None:
        """Let a decision take effect that was made beside the newest cycles, after cycle `last`."""
        self._finish_beside(caller, ticker, newest, last)
        self._drives.next_sync = (ticker.deadline_ns + self._period_ns) * 1e-9
        self.control.modes.send_commands()
        self.control.end_ahead()
        self._send_beside(reports=True)

    def _finish_beside(self, caller: CycleCaller, ticker: Ticker, newest: CallResult, last: int) -> None:
        """Finish the cycles beside which the control has decided, up to cycle `last`, if they have needed Python.

        They go on with the motion from before the decision. A fault or a quick stop ends them, even if the decision has
        already handled the quick stop.
        """
        reached, tick, done = newest.reached, newest.tick, newest.cycle
        self._marked_ns = newest.marked_ns
        if reached is not Reached.DONE:
            caller.pass_on_frames(reached)
        if reached is Reached.WRITTEN:
            caller.send_on()
        while reached in (Reached.OBSERVED, Reached.SOLVED) or done < last:
            if reached not in (Reached.SYNCED, Reached.OBSERVED, Reached.SOLVED):
                tick = ticker.tick() if reached is Reached.WAITED else ticker.wait()
                self._sync()
                reached = Reached.SYNCED
            if reached is Reached.SYNCED:
                if self.control.state.mode is Mode.FAULT or self._quick_stop_waits():
                    self._end_ahead(caller, done)
                    self._continue_after_sync(tick)
                    return
                feedback = self._drives.read()
                self._mark(Part.READ)
                if feedback.fault is not None:
                    self._end_ahead(caller, done)
                    self._handle_urgent(self._watch(tick, feedback), tick.deadline_ns + tick.lateness_ns)
                    self.control.execute(feedback, self._mark)
                    self._end(tick)
                    return
                self._overruns.count(tick.missed)
                before = self.control.measured.feedback
                self._mark(Part.MODE)
                # Warnings are reported below, and only once.
                reached = caller.solve(feedback._replace(warnings=()), tick, self._marked_ns)
                caller.copy_measured_back()
                self.control.report_feedback(before, feedback)
            if caller.is_refused(reached):
                self._end_ahead(caller, done)
                self._continue_solved(caller.result(reached))
                return
            self._marked_ns = caller.marked_ns
            self._drives.write(*caller.setpoints)
            self._mark(Part.WRITE)
            done, reached = caller.record(self._overruns), Reached.DONE
        caller.copy_measured_back()

    def _quick_stop_waits(self) -> bool:
        """Return True if the gateway has sent a quick stop; other stops wait until they can brake the new motion."""
        if self._urgent_flag.raised:
            self._gateway.read(URGENT_REQUESTS_A_CYCLE)
        return self._gateway.has_quick_stop

    def _end_ahead(self, caller: CycleCaller, done: int) -> None:
        """Let the control continue after cycle `done`, although its decisions were to take effect later."""
        caller.copy_back()
        self.control.ahead = 0
        self.control.return_to(done)
        self._reports.note(self._now(), DecidedAhead(0))
        self.control.modes.send_commands()

    def _continue_solved(self, newest: CallResult) -> None:
        """Run the rest of a cycle whose feedback has been evaluated, and end the cycle."""
        self._marked_ns = newest.marked_ns
        code = newest.code if newest.reached is Reached.SOLVED else None
        self.control.execute(self.control.measured.feedback, self._mark, behind=newest.behind, code=code)
        self._end(newest.tick)

    def cycle(self, tick: Tick) -> None:
        """Run one cycle in Python. Nothing in a cycle waits, and any failure in a cycle stops the robot."""
        self._sync()
        self._continue_after_sync(tick)

    def _sync(self) -> None:
        """Begin a cycle in Python, at its tick."""
        self._marked_ns = time.perf_counter_ns()
        self._drives.sync()
        self._mark(Part.SYNC)

    def _continue_after_sync(self, tick: Tick) -> None:
        """Run the rest of a cycle after its SYNC. Setpoints are sent before any decision that can wait."""
        now_ns = tick.deadline_ns + tick.lateness_ns
        if self._urgent_flag.was_raised() or self._gateway.ended:
            self._gateway.read(URGENT_REQUESTS_A_CYCLE)
            self._handle_urgent(self._gateway.requests(), now_ns)
        feedback = self._drives.read()
        self._mark(Part.READ)
        self._handle_urgent(self._watch(tick, feedback), now_ns)
        self._mark(Part.MODE)
        self.control.execute(feedback, self._mark)
        self._end(tick)

    def _end(self, tick: Tick) -> None:
        """Record a cycle after its setpoints have been sent, then handle its results and the waiting requests."""
        next_ns = tick.deadline_ns + self._period_ns
        self._drives.next_sync = next_ns * 1e-9
        self._reports.record(tick, self._overruns.all, self._parts_ns)
        self._mark(Part.RECORD)
        self._reports.pass_on()
        self.control.conclude()
        self._decide(next_ns)
        self._send_reports()
        if not self._reports.due_after:
            self._flush()
        self._mark(Part.DECIDE)

    def _handle_urgent(self, inputs: Iterable[Request | Disturbance], now_ns: int) -> None:
        """Handle urgent requests, such as stops, and disturbances, such as a lost process, in the present cycle."""
        for each in inputs:
            self._reports.note(now_ns, each, urgent=True)
            self.control.handle(each, now_ns)

    def _decide(self, next_ns: int, *, called: bool = True, due: bool = True) -> None:
        """Handle requests before the next tick.

        Parameters
        ----------
        next_ns
            Deadline of the next tick [ns].
        called
            Whether a neighbour may have called. If not, there is nothing to read.
        due
            Whether the control must decide, even if nothing has been received.

        """
        self._drives.next_sync = next_ns * 1e-9
        if called:
            self._read()
        inputs = list(self._noted(next_ns))
        if due or inputs:
            self._pass_to_control(inputs)

    def _pass_to_control(self, inputs: Iterable[TimedInput]) -> None:
        self.control.decide(inputs)
        self._decided_after = self.control.cycles
        if self._caller is not None:
            self._caller.decided = True

    def _send_reports(self) -> None:
        """Send events and answers, and receive the recorder's messages."""
        self._reports.listen()
        self._reports.pass_on()

    def _read(self) -> None:
        """Read the neighbours' packets, without any effect on the control."""
        self._gateway.read()
        self._planner.read(self.control.prepare)

    def _noted(self, now_ns: int) -> Iterator[TimedInput]:
        """Yield the requests and the planner's answers, each with the time `now_ns`, and note each for the recorder."""
        for what in itertools.chain(self._gateway.requests(), self._planner.answers()):
            self._reports.note(now_ns, what)
            yield what, now_ns

    def _mark(self, part: Part) -> None:
        """Record the duration of a part of the cycle at the end of the part; 0 if a simulated clock was ahead."""
        now = time.perf_counter_ns()
        self._parts_ns[part] = min(max(0, now - self._marked_ns), MAX_PART_NS)
        self._marked_ns = now

    def _watch(self, tick: Tick, feedback: Feedback) -> Iterator[Disturbance]:
        """Yield a disturbance for late ticks, a suspension, a lost gateway and a request to end the service.

        Also note changes of the drives' fault and readiness for the recorder.
        """
        fault = feedback.fault
        unready = tuple(name for name, each in zip(NAMES, feedback.unready, strict=True) if each is not None)
        if fault is not self._fault or unready != self._unready:
            self._fault, self._unready = fault, unready
            drives_fault = DrivesFault(fault.message if fault else None, unready)
            self._reports.note(tick.deadline_ns + tick.lateness_ns, drives_fault)
            self._reports.report_protections()
        if in_a_row := self._overruns.too_many(tick.missed):
            words = f"{in_a_row} ticks missed in a row: the machine is too busy"
            late = coded(words, EventCode.MACHINE_BUSY, ticks=in_a_row)
            yield Disturbance(ModeEvent.LATE.name, late.text, **late.fields)
        if suspended_s := self._suspensions.pop_duration():
            words = f"the computer was suspended for {suspended_s:.1f} s: the robot stops"
            suspended = coded(words, EventCode.SUSPENDED, duration=suspended_s)
            yield Disturbance(ModeEvent.LATE.name, suspended.text, **suspended.fields)
        if (lost := self._gateway.lost()) is not None:
            yield Disturbance(ModeEvent.GATEWAY_LOST.name, lost.text, **lost.fields)
        if self.ending and (self._ending_since is None or self.control.state.mode in _STILL_IN_USE):
            self._ending_since = self._ending_since or self.control.cycles
            end = coded("the service is ending: controlled stop, drives disabled", EventCode.SHUTDOWN)
            yield Disturbance(ModeEvent.SHUTDOWN.name, end.text, **end.fields)
        elif self.control.state.mode is Mode.STOPPING and self._ending_for > MAX_SHUTDOWN_S:
            words = f"the service is ending: not stopped within {MAX_SHUTDOWN_S:g} s, so the drives quick-stop"
            slow = coded(words, EventCode.SHUTDOWN_SLOW, timeout=MAX_SHUTDOWN_S)
            yield Disturbance(ModeEvent.QUICK_STOP.name, slow.text, **slow.fields)

    @property
    def _ending_for(self) -> float:
        """Time since the end of the service was announced [s]; 0 before."""
        return (self.control.cycles - self._ending_since) * self._period if self._ending_since is not None else 0.0

    def _has_ended(self) -> bool:
        if self._ending_since is None:
            return False
        measured = self.control.measured
        if not measured.powered:
            return self.control.state.mode in (Mode.DISABLED, Mode.FAULT)
        fault = measured.feedback.fault
        return (fault is not None and fault.cause == "timeout") or self._ending_for > self._stops_within

    def _flush(self) -> None:
        """Count a heartbeat, send the batch of records, and accept processes that want to connect."""
        self._heart.beat()
        self._planner.accept()
        self._reports.flush()
