"""The control loop: the only process with deadlines. It waits for nothing but its next tick."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterable, Iterator, MutableSequence

from trirail_drivers.bus.capture import Capture
from trirail_drivers.driver.cyclic import Lender
from trirail_drivers.interface import NAMES, DriveFault, DriveGroup, Feedback

from trirail.config import Config
from trirail.control.control import Control, Given
from trirail.control.modes import ModeEvent
from trirail.processes.clock import SPARE_NS, Doors, Overruns, Tick, Ticker
from trirail.processes.heartbeats import Haste, Heartbeats, Watch
from trirail.processes.ports import URGENT_REQUESTS_A_CYCLE, GatewayLink, PlannerLink, Ports
from trirail.processes.quiet import Reached
from trirail.processes.quiet_cycles import QuietCycles
from trirail.processes.reports import Reports
from trirail.wire.event_codes import EventCode, coded
from trirail.wire.packets import (
    Disturbance,
    DrivesFault,
    Request,
)
from trirail.wire.records import MAX_PART_NS, Part
from trirail.wire.vocabulary import Mode

DECIDING_NS = 300_000
"""Time before the next tick below which requests already read wait until its setpoints have been sent [ns]."""
SAYING_NS = 150_000
"""The same for messages about decisions [ns]."""
LEAST_PATIENCE = 3
"""Fewest cycles for which the gateway may be silent, at any rate of the loop."""
SHUTDOWN = 3.0
"""Longest controlled stop before the drives are left to their own quick stop [s]."""


class Loop:
    """Control loop: connects control, drives, ticks and the neighbours; every cycle is `cycle`."""

    def __init__(
        self,
        config: Config,
        drives: DriveGroup,
        ports: Ports,
        heartbeats: Heartbeats,
        *,
        capture: Capture | None = None,
        lacking: tuple[str, ...] = (),
        quiet: bool = True,
        now: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """`quiet`: the compiled call runs the cycles without events; else Python runs all.

        `now`: the clock of the ticks [ns].
        """
        self._now = now
        self._drives = drives
        patience = max(LEAST_PATIENCE, round(config.watchdogs.gateway_timeout * config.loop.rate_hz))
        watch = Watch(heartbeats.of("gateway"), patience)
        self._gateway = GatewayLink(ports.gateway, watch, config.watchdogs.gateway_timeout)
        self._planner = PlannerLink(ports.planner)
        self._period = config.period
        self._period_ns = round(config.period * 1e9)

        self.control = Control(config, drives, self._planner)
        self._reports = Reports(config, self.control, drives, ports.gateway, ports.recorder, capture, lacking)
        self.ending = False
        """Set from outside to make the loop stop the robot, disable the drives and return."""
        self._ending_since: int | None = None
        self._overruns = Overruns(config.watchdogs.max_overruns)
        self._heart = heartbeats.of("loop")
        self._haste = Haste(heartbeats)
        self._doors = Doors(ports)
        self._never_listens = self._period_ns <= SPARE_NS
        self._listened = self._never_listens
        """Whether no further call is served before the next tick."""
        self._unsaid = False
        """Whether messages about decisions wait for lack of time."""
        self._quiet: QuietCycles | None = None
        if quiet and isinstance(drives, Lender):
            beside = self._reports, heartbeats, ports.gateway, self._doors, watch, self._haste
            self._quiet = QuietCycles(self.control, drives, *beside)
        self._fault: DriveFault | None = None
        self._unready: tuple[str, ...] = ()
        self._marked_ns = 0
        self._parts_ns: MutableSequence[int] = [0] * len(Part) if self._quiet is None else self._quiet.parts_ns

    def run(self, ticker: Ticker) -> None:
        """Run cycles until `ending` is set and the robot is at rest without power."""
        self.begin()
        while not self._over():
            self.turn(ticker)
        self._say()
        self._flush()

    def begin(self) -> None:
        """Accept the peers that are there already, and read the drives, before the first cycle."""
        self._planner.accept()
        self._reports.accept_peers()  # so that a recorder that is there has every cycle from the first
        self._drives.sync()
        self.control.start(self._drives.read())

    @property
    def quiet_cycles(self) -> int:
        """Number of cycles run by the compiled call."""
        return self._quiet.cycles if self._quiet is not None else 0

    def turn(self, ticker: Ticker) -> None:
        """Run the cycles without events, or one with an event; then decide what comes next.

        If a neighbour calls during the wait for the next tick, only decide: once before each tick.
        """
        quiet, newest = self._quiet, None
        disturbed = self.ending or self._gateway.frozen or not self._planner.idle
        if quiet is not None and not disturbed:
            newest = quiet.run(ticker, self._overruns, listens=not self._listened, once=self._postponed)
        elif quiet is not None:
            quiet.leave()
        if newest is None and not self._listened and ticker.listen(self._doors):
            self._hear(ticker)
        elif newest is None:
            self.cycle(ticker.wait())
        elif newest.reached is Reached.WAITED:
            self.cycle(ticker.tick())
        elif newest.reached is Reached.SYNCED:
            self._marked_ns = newest.marked_ns
            self._go_on(Tick(newest.deadline_ns, newest.lateness_ns, newest.missed))
        elif newest.reached in (Reached.OBSERVED, Reached.SOLVED):
            self._marked_ns = newest.marked_ns
            code = newest.found if newest.reached is Reached.SOLVED else None
            self.control.execute(self.control.measured.feedback, self._mark, behind=newest.behind, code=code)
            self._end(Tick(newest.deadline_ns, newest.lateness_ns, newest.missed))
        elif newest.reached is Reached.CALLED:
            self._hear(ticker)
        elif quiet is not None:
            self._listened = self._never_listens
            if newest.called or self._postponed or self._reports.full:
                self._decide(newest.deadline_ns + self._period_ns, newest.called)
                quiet.add(Part.DECIDE)

    def cycle(self, tick: Tick) -> None:
        """Run one cycle. Nothing in it waits, and no failure in it leaves the robot moving."""
        self._marked_ns = time.perf_counter_ns()
        self._drives.sync()
        self._mark(Part.SYNC)
        self._go_on(tick)

    def _go_on(self, tick: Tick) -> None:
        """Run a cycle from its SYNC on: the setpoints leave before any decision that can wait."""
        now_ns = tick.deadline_ns + tick.lateness_ns
        if self._haste.hurried() or self._gateway.ended:
            self._gateway.read(URGENT_REQUESTS_A_CYCLE)
            self._handle_urgent(self._gateway.requests(), now_ns)
        feedback = self._drives.read()
        self._mark(Part.READ)
        self._handle_urgent(self._watch(tick, feedback), now_ns)
        self._mark(Part.MODE)
        self.control.execute(feedback, self._mark)
        self._end(tick)

    def _end(self, tick: Tick) -> None:
        """Record a cycle whose setpoints have left, and decide by its results and by requests."""
        self._listened = self._never_listens
        self._reports.record(tick, self._overruns.all, self._parts_ns)
        self._mark(Part.RECORD)
        self._reports.pass_on()
        self.control.conclude()
        self._decide(tick.deadline_ns + self._period_ns)
        self._mark(Part.DECIDE)

    def _handle_urgent(self, given: Iterable[Request | Disturbance], now_ns: int) -> None:
        """Apply stops and disturbances in this very cycle."""
        for what in given:
            self._reports.note(now_ns, what, urgent=True)
            self.control.handle(what, now_ns)

    @property
    def _postponed(self) -> bool:
        """Whether there was no time left for all the work behind the newest setpoints."""
        return self._unsaid or self._gateway.postponed

    def _decide(self, next_ns: int, called: bool = True) -> None:
        """Decide what happens at the next tick, which is due at `next_ns`, if a neighbour has `called`.

        Requests and messages without enough time before that tick wait until its setpoints have been sent, once.
        """
        waited = self._gateway.postponed
        if called or waited:
            self._gateway.read()
            in_time = waited or next_ns - self._now() >= DECIDING_NS
            self.control.decide(self._noted(next_ns, self._gateway.requests() if in_time else ()))
        if self._unsaid or ((called or waited) and next_ns - self._now() >= SAYING_NS):
            self._say()
        elif called or waited:
            self._unsaid = True
            self._reports.postpone()
        if self._reports.full:
            self._flush()

    def _say(self) -> None:
        """Send events and answers, and receive from the recorder."""
        self._unsaid = False
        self._reports.listen()
        self._reports.pass_on()

    def _hear(self, ticker: Ticker) -> None:
        """Decide by requests that arrive in the wait for the next tick: they take effect then, not a cycle later."""
        self._listened = True
        self._gateway.read()
        if given := list(self._noted(ticker.deadline_ns + self._period_ns, self._gateway.requests(), waiting=True)):
            self.control.decide(given)
        self._say()

    def _noted(self, now_ns: int, requests: Iterable[Request], *, waiting: bool = False) -> Iterator[Given]:
        """Yield requests and the planner's answers, and keep them for the recorder."""
        for what in itertools.chain(requests, self._planner.answers()):
            self._reports.note(now_ns, what, waiting=waiting)
            yield what, now_ns

    def _mark(self, part: Part) -> None:
        """Record how long a part of the cycle took, at its end; 0 if a simulated time was ahead."""
        now = time.perf_counter_ns()
        self._parts_ns[part] = min(max(0, now - self._marked_ns), MAX_PART_NS)
        self._marked_ns = now

    def _watch(self, tick: Tick, feedback: Feedback) -> Iterator[Disturbance]:
        """Count the ticks missed; yield the disturbances: late ticks, a lost gateway, a request to end."""
        fault = feedback.fault
        unready = tuple(name for name, each in zip(NAMES, feedback.unready, strict=True) if each is not None)
        if fault is not self._fault or unready != self._unready:
            self._fault, self._unready = fault, unready
            said = DrivesFault(fault.message if fault else None, unready)
            self._reports.note(tick.deadline_ns + tick.lateness_ns, said)
            self._reports.report_protections()
        if in_a_row := self._overruns.too_many(tick.missed):
            words = f"{in_a_row} ticks missed in a row: the machine is too busy"
            late = coded(words, EventCode.MACHINE_BUSY, ticks=in_a_row)
            yield Disturbance(ModeEvent.LATE.name, late.text, **late.fields)
        if (lost := self._gateway.lost()) is not None:
            yield Disturbance(ModeEvent.GATEWAY_LOST.name, lost.text, **lost.fields)
        if self.ending and self._ending_since is None:
            self._ending_since = self.control.cycles
            end = coded("the service is ending: controlled stop, drives disabled", EventCode.SHUTDOWN)
            yield Disturbance(ModeEvent.SHUTDOWN.name, end.text, **end.fields)

    def _over(self) -> bool:
        if self._ending_since is None:
            return False
        control = self.control
        stands = control.state.mode in (Mode.DISABLED, Mode.FAULT) and not control.measured.powered
        return stands or (control.cycles - self._ending_since) * self._period > SHUTDOWN

    def _flush(self) -> None:
        """Give a sign of life, flush the batch, and accept new peers."""
        self._heart.beat()
        self._planner.accept()
        self._reports.flush()
