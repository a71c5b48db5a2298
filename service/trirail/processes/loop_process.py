"""Loop process, which runs a rehearsal, connects the drives, acquires real-time rights and runs the loop.

Before the first cycle with the real drives, the loop runs a rehearsal with simulated drives of the configured kind. The
rehearsal executes everything that must later happen without delay: stop, quick stop, fault, lost gateway and end. The
memory pages that these need are thereby loaded, and are then locked in memory.
"""

from __future__ import annotations

import itertools
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from pathlib import Path
from types import FrameType

from msgspec import structs
from trirail_drivers import files
from trirail_drivers.bus.capture import Capture
from trirail_drivers.config import Can
from trirail_drivers.connection.opening import connect, simulated_bus
from trirail_drivers.errors import DriveError
from trirail_drivers.interface import NAMES, DriveGroup
from trirail_drivers.protocols import PROTOCOLS

from trirail.config import Config
from trirail.control.commands import power_left
from trirail.errors import ServiceError
from trirail.kinematics.robot import warm_up
from trirail.motion.motion_planner import MotionPlanner
from trirail.processes import realtime
from trirail.processes.clock import Ticker
from trirail.processes.heartbeats import Heartbeats
from trirail.processes.loop import Loop
from trirail.processes.ports import Ports
from trirail.wire import links
from trirail.wire.goals import VelocityGoal
from trirail.wire.links import PacketLink, Port
from trirail.wire.packets import CommandRequest, GoalRequest, Request, message
from trirail.wire.plan_packets import decode_plan_request, encode
from trirail.wire.vocabulary import Command, Mode

PLANNER_WITHIN = 120.0
"""Maximum time to wait until the planner has started [s]. The first start compiles the kinematics."""
STEP_WITHIN = 500
"""Maximum number of cycles for one step of the rehearsal. If a step needs more cycles, the rehearsal ends."""
IN_MOTION = 20
"""Number of cycles for which the robot jogs in the rehearsal."""
SLOW = 0.1
"""Velocity of the jog along x in the rehearsal, as a fraction of the limit."""


class _UnfinishedError(Exception):
    """Error raised if a step of the rehearsal needs more than STEP_WITHIN cycles."""


class _RehearsedTime:
    """Clock that advances by one period per cycle during the rehearsal, so that a busy machine causes no delays."""

    def __init__(self) -> None:
        self._now: float | None = None
        self._offset = 0.0

    def __call__(self) -> float:
        return time.monotonic() + self._offset if self._now is None else self._now

    def advance(self, seconds: float) -> None:
        """Stop following the monotonic clock, and advance by `seconds`."""
        self._now = self() + seconds

    def release(self) -> None:
        """Follow the monotonic clock again, so that code which waits for a deadline does not wait forever."""
        self._offset, self._now = self() - time.monotonic(), None


class _Rehearsal:
    """Rehearsal, which runs the loop without waiting for ticks, with simulated gateway, planner and drives."""

    def __init__(self, config: Config, folder: Path) -> None:
        self._config = config
        self._folder = folder
        self._clock = _RehearsedTime()
        self._bus = simulated_bus(config.can, config.drives, self._clock)
        driver = PROTOCOLS[config.drives.protocol].driver
        self._drives = driver(self._bus, config.can.timing, config.drives, self._clock, None, config.drive_io)
        listening = [links.listen(folder / name) for name in Ports._fields]
        gateway, recorder, planner = listening
        self._ports = Ports(Port(gateway), Port(recorder), Port(planner))
        self._heartbeats = Heartbeats.create()
        # Python runs each cycle, because only Python code needs the rehearsal. The memory pages of compiled code are
        # all loaded in its first cycle.
        self._loop = Loop(config, self._drives, self._ports, self._heartbeats, compiled=False, now=lambda: self._now_ns)
        self._planner_link = links.connect(folder / "planner")
        self._planner = MotionPlanner(config)
        self._gateway: PacketLink | None = None
        self._now_ns = round(self._clock() * 1e9)
        self._tickets = 0
        self._steps = self._script()

    def run(self) -> None:
        """Run all steps of the rehearsal."""
        try:
            self._drives.configure(self._config.period, self._config.limits.slider.fastest)
            self._loop.run(Ticker(round(self._config.period * 1e9), lambda: self._now_ns, self._pass))
        finally:
            self._clock.release()
            self._drives.close()
            self._hang_up()
            self._planner_link.close()
            self._heartbeats.close()
            for port in self._ports:
                port.close()

    def _pass(self, deadline_ns: int) -> None:
        """Advance the clock by one period, answer the loop's requests for plans, and continue the script."""
        self._clock.advance(self._config.period)
        self._now_ns = deadline_ns
        while (packet := self._planner_link.receive()) is not None:
            self._planner_link.send(encode(self._planner.plan(decode_plan_request(packet))))
        next(self._steps)

    def _script(self) -> Iterator[None]:
        yield from self._jog()
        self._send_command(Command.STOP)
        yield from self._wait_until(lambda: self._mode is Mode.HOLDING)
        yield from self._jog()
        self._send_command(Command.QUICK_STOP)
        yield from self._wait_until(lambda: self._mode is Mode.FAULT)
        yield from self._reset()
        yield from self._jog()
        self._bus.faults.add("A fault 2310")
        yield from self._wait_until(lambda: self._mode is Mode.FAULT)
        yield from self._reset()
        yield from self._jog()
        self._hang_up()
        yield from self._wait_until(lambda: self._mode is Mode.HOLDING)
        self._loop.ending = True
        yield from self._wait_until(lambda: False)  # the loop returns before this wait times out

    def _reset(self) -> Iterator[None]:
        """Wait until the drives are unpowered, and reset the fault."""
        yield from self._wait_until(lambda: not self._loop.control.measured.powered)
        self._send_command(Command.RESET)
        yield from self._wait_until(lambda: self._mode is Mode.DISABLED)

    def _jog(self) -> Iterator[None]:
        """Jog the robot. If necessary, first connect a simulated gateway and enable the drives."""
        if self._gateway is None:
            self._gateway = links.connect(self._folder / "gateway")
            yield from self._wait_until(lambda: self._ports.gateway.connected)
        if self._mode is not Mode.HOLDING:
            self._send_command(Command.ENABLE)
            yield from self._wait_until(lambda: self._mode is Mode.HOLDING)
        velocity = VelocityGoal(SLOW * self._config.limits.platform.velocity[0], 0.0, 0.0, timeout=10.0)
        self._tickets += 1
        self._send(GoalRequest(self._tickets, "", f"{self._tickets}", velocity, self._now_ns))
        yield from self._wait_until(lambda: self._mode is Mode.MOVING)
        yield from itertools.repeat(None, IN_MOTION)

    @property
    def _mode(self) -> Mode:
        return self._loop.control.state.mode

    def _wait_until(self, condition: Callable[[], bool]) -> Iterator[None]:
        """Run cycles until a condition is true. Raises _UnfinishedError after STEP_WITHIN cycles."""
        for _ in range(STEP_WITHIN):
            yield
            if self._gateway is not None:
                while self._gateway.receive() is not None:
                    pass
            if condition():
                return
        raise _UnfinishedError(f"the robot was still {self._mode.value} after {STEP_WITHIN} cycles")

    def _send_command(self, name: Command) -> None:
        self._tickets += 1
        with self._heartbeats.urgent_section() if name.stops else nullcontext():
            self._send(CommandRequest(self._tickets, "", name))

    def _send(self, request: Request) -> None:
        if self._gateway is not None:
            self._gateway.send(message(request))

    def _hang_up(self) -> None:
        if self._gateway is not None:
            self._gateway.close()
            self._gateway = None


def rehearse(config: Config) -> tuple[str, ...]:
    """Rehearse stops, faults and the end of the loop. If the rehearsal fails, return the reason, otherwise nothing."""
    each = {name: structs.replace(drive, homing=None) for name, drive in zip(NAMES, config.drives.each, strict=True)}
    config = structs.replace(config, drives=structs.replace(config.drives, **each))
    try:
        with files.temporary_folder() as folder:
            _Rehearsal(config, folder).run()
    except (DriveError, OSError, _UnfinishedError) as error:
        return (f"rehearsed stops: {error}",)
    return ()


def main(
    config: Config,
    bus: Callable[[], Can],
    ports: Ports,
    heartbeats: Heartbeats,
    ready: Callable[[object], None],
) -> int:
    """Run the loop process; return its exit code. Raises ServiceError if a drive has kept its power at the end.

    Parameters
    ----------
    bus
        Function that waits for the bus of the drives, and returns the [can] section for connecting to that bus.
    ready
        Function called immediately before the first cycle, with the rights that the loop lacks and the bus load.

    """
    drives: DriveGroup | None = None
    last_cycle = 0
    try:
        warm_up()
        unrehearsed = rehearse(config)
        ports.planner.await_peer(PLANNER_WITHIN)
        capture = Capture() if config.telemetry.capture_can else None
        # Simulated drives that have died are restarted only with the whole service, so do not wait for them.
        awaits = config.can.interface != "simulated"
        drives = connect(bus(), config.drives, capture=capture, awaits=awaits, io=config.drive_io)
        slider = config.limits.slider
        travel = slider.positions if awaits else None  # the limits of simulated drives are an EDS's default values
        drives.configure(config.period, slider.fastest, travel=travel, awaits=True)
        lacking = (*realtime.acquire(config.loop), *unrehearsed)
        loop = Loop(config, drives, ports, heartbeats, capture=capture, lacking=lacking)

        def end(_signal: int, _frame: FrameType | None) -> None:
            loop.ending = True

        signal.signal(signal.SIGTERM, end)
        ready({"lacking": lacking, "bus_load": drives.bus_load})
        loop.run(Ticker(round(config.period * 1e9), busy_wait_ns=config.loop.busy_wait_ns))
        last_cycle = loop.control.cycles
    finally:
        heartbeats.heart("loop").rest()  # closing the drives may take longer than the time-out of the heartbeat
        if drives is not None:
            drives.close()
        heartbeats.record_end(last_cycle)
        for port in ports:
            port.close()
    if powered := power_left(loop.control.measured):
        raise ServiceError(f"the service has ended, but {powered}: switch off the supply")
    return 0
