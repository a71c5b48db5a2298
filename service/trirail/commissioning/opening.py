"""Opening of the bus for a commissioning. When the bus is closed, the drives have no power, even after an error."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from trirail_drivers.connection.opening import open_bus
from trirail_drivers.interface import Clock, DriveGroup
from trirail_drivers.protocols import PROTOCOLS
from trirail_drivers.simulated import SimulatedBus

from trirail.commissioning.bench import Bench
from trirail.commissioning.person import Operator
from trirail.commissioning.session import Environment, Session
from trirail.commissioning.steps import Steps
from trirail.config import Config
from trirail.kinematics.robot import warm_up
from trirail.processes import realtime
from trirail.processes.clock import Ticker


class SimulatedClock:
    """Clock of simulated drives, which advances by one period in each cycle so that a busy machine misses no cycle."""

    def __init__(self, period: float, sleep: Callable[[float], None]) -> None:
        self._period = period
        self._sleep = sleep
        self._now = self._due = time.monotonic()
        self._free_since: float | None = None

    def __call__(self) -> float:
        """Return the time [s]."""
        return self._now if self._free_since is None else self._now + time.monotonic() - self._free_since

    def tick(self) -> int:
        """Wait for the next cycle, and advance the clock by one period; return 0, since no cycle can be missed."""
        self._now += self._period
        self._due = max(self._due + self._period, time.monotonic() - self._period)
        self._sleep(max(0.0, self._due - time.monotonic()))
        return 0

    def run_freely(self) -> None:
        """Advance with the machine's clock from now on.

        The closing of a driver waits for some time, while no cycle advances this clock.
        """
        self._free_since = time.monotonic()


@contextmanager
def _without_interrupts() -> Iterator[None]:
    """Ignore Ctrl-C, which would end the ramps of drives that are being closed. Closing takes a limited time."""
    handler = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)


@contextmanager
def open_steps(
    config: Config,
    faults: Sequence[str],
    operator: Operator,
    interrupted: Callable[[], bool],
    sleep: Callable[[float], None] = time.sleep,
) -> Iterator[Steps]:
    """Open the configured bus, and yield the steps of a commissioning.

    `faults` are the faults that simulated drives shall show. If the drives are real, the process acquires real-time
    rights according to `loop.realtime`, like the service. Raises BusError, FaultSyntaxError and ServiceError.
    """
    warm_up()
    driver: DriveGroup | None = None
    simulated = SimulatedClock(config.period, sleep)
    clock: Clock = simulated if config.can.interface == "simulated" else time.monotonic
    with open_bus(config.can, config.drives, clock) as bus:
        rules = None
        if isinstance(bus, SimulatedBus):
            for line in faults:
                bus.faults.add(line)
            rules = bus.faults.carriages
        else:
            for missing in realtime.acquire(config.loop):
                operator.show(f"without {missing}")

        def make_bench() -> Bench:
            nonlocal driver
            check = PROTOCOLS[config.drives.protocol].check_exclusive
            # No other program reaches simulated drives. Once a driver is made, a running service has stopped with a
            # fault, and some interfaces return the driver's own frames.
            if driver is None and clock is not simulated:
                check(bus, config.drives, clock)
            driver = PROTOCOLS[config.drives.protocol].driver(bus, config.can.timing, config.drives, clock)
            driver.configure(config.period, config.limits.slider.fastest, travel=config.limits.slider.positions)
            ticker = Ticker(round(config.period * 1e9))
            tick = simulated.tick if clock is simulated else lambda: ticker.wait().missed
            return Bench(config, driver, tick, interrupted)

        inputs = PROTOCOLS[config.drives.protocol].inputs
        read = None if inputs is None else inputs(bus, config.drives, clock)
        press = bus.press if isinstance(bus, SimulatedBus) else None
        try:
            yield Steps(Session(Environment(config, bus, make_bench, rules, operator, interrupted, read, press)))
        finally:
            simulated.run_freely()
            if driver is not None:
                with _without_interrupts():
                    driver.close()
