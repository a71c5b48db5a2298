"""The control loop: the only process with deadlines. It waits for nothing but its next tick."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterable, Iterator, MutableSequence

from trirail_drivers.bus.capture import Capture
from trirail_drivers.driver.cyclic import Lender
from trirail_drivers.interface import DriveFault, DriveGroup

from trirail.config import Config
from trirail.control.control import Control, Given
from trirail.control.modes import ModeEvent
from trirail.processes.clock import SPARE_NS, Doors, Overruns, Tick, Ticker
from trirail.processes.heartbeats import Haste, Heartbeats, Watch
from trirail.processes.ports import GatewayLink, PlannerLink, Ports
from trirail.processes.quiet import Reached
from trirail.processes.quiet_cycles import QuietCycles
from trirail.processes.reports import Reports
from trirail.wire.packets import (
    Disturbance,
    DrivesFault,
    Request,
)
from trirail.wire.records import LONGEST, Part
from trirail.wire.vocabulary import Mode

DECIDING_NS = 300_000
"""Where less is left before the next tick, requests that have been read wait for the time behind its setpoints [ns]."""
SAYING_NS = 150_000
"""Likewise what is to be said of what has been decided."""
LEAST_PATIENCE = 3
"""Cycles for which the gateway may be silent, however few there are a second."""
SHUTDOWN = 3.0
"""How long a controlled stop may take before the drives are left to their own quick stop [s]."""


class Loop:
    """Ties control, drives, ticks and the neighbours together; every cycle is `cycle`."""

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
        """`quiet`: cycles in which nothing happens are run by the compiled call; else all by Python.

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
        """Whether nobody else is to be heard before the next tick."""
        self._unsaid = False
        """Whether there was no time left to say what has been decided."""
        self._quiet: QuietCycles | None = None
        if quiet and isinstance(drives, Lender):
            beside = self._reports, heartbeats, ports.gateway, self._doors, watch, self._haste
            self._quiet = QuietCycles(self.control, drives, *beside)
        self._fault: DriveFault | None = None
        self._marked_ns = 0
        self._parts_ns: MutableSequence[int] = [0] * len(Part) if self._quiet is None else self._quiet.parts_ns

    def run(self, ticker: Ticker) -> None:
        """Run cycles until told to end and the robot stands without power."""
        self.begin()
        while not self._over():
            self.turn(ticker)
        self._say()
        self._flush()

    def begin(self) -> None:
        """Take those who are there already, and what the drives say, before the first cycle."""
        self._planner.accept()
        self._reports.accept_peers()  # so that a recorder that is there has every cycle from the first
        self._drives.sync()
        self.control.start(self._drives.read())

    @property
    def quiet_cycles(self) -> int:
        """How many cycles the compiled call has run."""
        return self._quiet.cycles if self._quiet is not None else 0

    def turn(self, ticker: Ticker) -> None:
        """Run the cycles in which nothing happens, or one in which something does; then decide what comes next.

        Or only the last, where somebody calls while the next tick is waited for: once before each tick.
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
        elif newest.reached is Reached.CALLED:
            self._hear(ticker)
        elif quiet is not None:
            self._listened = self._never_listens
            if newest.called or self._postponed or self._reports.full:
                self._decide(newest.deadline_ns + self._period_ns, newest.called)
                quiet.add(Part.DECIDE)

    def cycle(self, tick: Tick) -> None:
        """Run one cycle. Nothing in it waits, and nothing that goes wrong in it leaves the robot moving."""
        self._marked_ns = time.perf_counter_ns()
        self._drives.sync()
        self._mark(Part.SYNC)
        self._go_on(tick)

    def _go_on(self, tick: Tick) -> None:
        """Run what a cycle is from its SYNC on: the setpoints leave before anything is decided that can wait."""
        self._listened = self._never_listens
        now_ns = tick.deadline_ns + tick.lateness_ns
        if self._haste.hurried() or self._gateway.ended:
            self._gateway.read()
            self._handle_urgent(self._gateway.requests(), now_ns)
        feedback = self._drives.read()
        self._mark(Part.READ)
        self._handle_urgent(self._watch(tick, feedback.fault), now_ns)
        self._mark(Part.MODE)
        self.control.execute(feedback, self._mark)
        self._reports.record(tick, self._overruns.all, self._parts_ns)
        self._mark(Part.RECORD)
        self._reports.pass_on()
        self.control.conclude()
        self._decide(tick.deadline_ns + self._period_ns)
        self._mark(Part.DECIDE)

    def _handle_urgent(self, given: Iterable[Request | Disturbance], now_ns: int) -> None:
        """Have what is given its effect in this very cycle: stops, and what has happened."""
        for what in given:
            self._reports.note(now_ns, what, urgent=True)
            self.control.handle(what, now_ns)

    @property
    def _postponed(self) -> bool:
        """Whether there was no time left for all that came behind the newest setpoints."""
        return self._unsaid or self._gateway.postponed

    def _decide(self, next_ns: int, called: bool = True) -> None:
        """Decide what comes at the next tick, which is due at that time, where somebody has `called`.

        What there is no time for before it waits for the time behind its setpoints, once: requests, and what is to be
        said.
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
        """Pass on what has happened and what is answered, and hear the recorder."""
        self._unsaid = False
        self._reports.listen()
        self._reports.pass_on()

    def _hear(self, ticker: Ticker) -> None:
        """Decide by what is said while the next tick is waited for: it has its effect then, and not a cycle later."""
        self._listened = True
        self._gateway.read()
        if given := list(self._noted(ticker.deadline_ns + self._period_ns, self._gateway.requests(), waiting=True)):
            self.control.decide(given)
        self._say()

    def _noted(self, now_ns: int, requests: Iterable[Request], *, waiting: bool = False) -> Iterator[Given]:
        """Yield requests and what the planner has sent, and keep it for the recorder."""
        for what in itertools.chain(requests, self._planner.answers()):
            self._reports.note(now_ns, what, waiting=waiting)
            yield what, now_ns

    def _mark(self, part: Part) -> None:
        """Note how long a part of the cycle has taken, at its end; nothing where a simulated time was ahead."""
        now = time.perf_counter_ns()
        self._parts_ns[part] = min(max(0, now - self._marked_ns), LONGEST)
        self._marked_ns = now

    def _watch(self, tick: Tick, fault: DriveFault | None) -> Iterator[Disturbance]:
        """Count what the ticker missed; yield what has happened: late ticks, a lost gateway, a wish to end."""
        if fault is not self._fault:
            self._fault = fault
            self._reports.note(tick.deadline_ns + tick.lateness_ns, DrivesFault(fault.message if fault else None))
        if in_a_row := self._overruns.too_many(tick.missed):
            yield Disturbance(ModeEvent.LATE.name, f"{in_a_row} ticks missed in a row: the machine is too busy")
        if (lost := self._gateway.lost()) is not None:
            yield Disturbance(ModeEvent.GATEWAY_LOST.name, lost)
        if self.ending and self._ending_since is None:
            self._ending_since = self.control.cycles
            yield Disturbance(ModeEvent.SHUTDOWN.name, "the service is ending: controlled stop, drives disabled")

    def _over(self) -> bool:
        if self._ending_since is None:
            return False
        control = self.control
        stands = control.state.mode in (Mode.DISABLED, Mode.FAULT) and not control.measured.powered
        return stands or (control.cycles - self._ending_since) * self._period > SHUTDOWN

    def _flush(self) -> None:
        """Give a sign of life, pass the batch on, and take new peers."""
        self._heart.beat()
        self._planner.accept()
        self._reports.flush()
