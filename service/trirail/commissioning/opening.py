"""Opens the bus for a commissioning, and leaves the drives without power whatever happens."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from trirail_drivers.connection.opening import open_bus
from trirail_drivers.interface import Clock, DriveGroup
from trirail_drivers.protocols import PROTOCOLS
from trirail_drivers.simulated import SimulatedBus

from trirail.commissioning.bench import Bench
from trirail.commissioning.person import Person
from trirail.commissioning.session import Place, Session
from trirail.commissioning.steps import Steps
from trirail.config import Config
from trirail.kinematics.robot import warm_up
from trirail.processes import realtime
from trirail.processes.clock import Ticker


class SimulatedTime:
    """The time of simulated drives: it goes on by a period a cycle, so a busy machine slows it and misses nothing."""

    def __init__(self, period: float, sleep: Callable[[float], None]) -> None:
        self._period = period
        self._sleep = sleep
        self._now = self._due = time.monotonic()
        self._freed: float | None = None

    def __call__(self) -> float:
        """Tell the time [s]."""
        return self._now if self._freed is None else self._now + time.monotonic() - self._freed

    def tick(self) -> int:
        """Go on by a period, not before its time; return the number of cycles missed, none."""
        self._now += self._period
        self._due = max(self._due + self._period, time.monotonic() - self._period)
        self._sleep(max(0.0, self._due - time.monotonic()))
        return 0

    def free(self) -> None:
        """Go on by itself from now on, where nobody turns cycles any more."""
        self._freed = time.monotonic()


@contextmanager
def open_steps(
    config: Config,
    faults: Sequence[str],
    person: Person,
    interrupted: Callable[[], bool],
    sleep: Callable[[float], None] = time.sleep,
) -> Iterator[Steps]:
    """Yield the steps on the configured bus; `faults` on demand are of simulated drives.

    Real drives have real-time rights, as the service has them: `loop.realtime`. Raises BusError, FaultSyntaxError,
    ServiceError.
    """
    warm_up()
    driver: DriveGroup | None = None
    simulated = SimulatedTime(config.period, sleep)
    clock: Clock = simulated if config.can.interface == "simulated" else time.monotonic
    with open_bus(config.can, config.drives, clock) as bus:
        rules = None
        if isinstance(bus, SimulatedBus):
            for line in faults:
                bus.faults.add(line)
            rules = bus.faults.carriages
        else:
            for lack in realtime.acquire(config.loop):
                person.show(f"without {lack}")

        def make_bench() -> Bench:
            nonlocal driver
            driver = PROTOCOLS[config.drives.protocol].driver(bus, config.can.bitrate, config.drives, clock)
            driver.configure(config.period, config.limits.slider.fastest)
            ticker = Ticker(round(config.period * 1e9))
            tick = simulated.tick if clock is simulated else lambda: ticker.wait().missed
            return Bench(config, driver, tick, interrupted)

        inputs = PROTOCOLS[config.drives.protocol].inputs
        read = None if inputs is None else inputs(bus, config.drives, clock)
        press = bus.press if isinstance(bus, SimulatedBus) else None
        try:
            yield Steps(Session(Place(config, bus, make_bench, rules, person, interrupted, read, press)))
        finally:
            simulated.free()
            if driver is not None:
                driver.close()
