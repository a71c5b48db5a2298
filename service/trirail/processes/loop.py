"""The control loop: the only process with deadlines. It waits for nothing but its next tick."""

from __future__ import annotations

import itertools
import signal
import time
from collections import deque
from collections.abc import Callable, Iterator
from types import FrameType
from typing import NamedTuple

import msgspec
import numpy as np
from trirail_drivers.bus.capture import Capture
from trirail_drivers.connection.opening import connect
from trirail_drivers.interface import DriveFault, DriveGroup

from trirail.config import Config
from trirail.control.control import Control, Given
from trirail.control.modes import ModeEvent
from trirail.kinematics.robot import warm_up
from trirail.processes import realtime
from trirail.processes.clock import Tick, Ticker
from trirail.processes.heartbeats import Heartbeats, Watch
from trirail.processes.planner_port import PlannerLink
from trirail.wire.links import Port
from trirail.wire.messages import Event
from trirail.wire.packets import (
    ControlInput,
    Disturbance,
    DrivesFault,
    Farewell,
    GivenInput,
    Kind,
    Remark,
    Request,
    Status,
    Welcome,
    decode_recorder,
    decode_request,
    message,
    told,
)
from trirail.wire.records import HEAD, SIZE, Part
from trirail.wire.text import quoted
from trirail.wire.vocabulary import MODES, Mode

BATCHES_PER_SECOND = 50
REQUESTS_A_CYCLE = 4
"""Requests that are taken in one cycle: at 1 kHz more than the gateway can send, so that a stop waits for nothing."""
ANSWERS_A_CYCLE = 8
EVENTS_KEPT = 1000
"""Events kept for a gateway that comes anew: the one before may have died with some that it had not published."""
LEAST_PATIENCE = 3
"""Cycles for which the gateway may be silent, however few there are a second."""
PLANNER_WITHIN = 120.0
"""How long the planner may take to come up: the very first start compiles the kinematics [s]."""
SHUTDOWN = 3.0
"""How long a controlled stop may take before the drives are left to their own quick stop [s]."""


class Ports(NamedTuple):
    """Where the processes beside the loop connect."""

    gateway: Port
    recorder: Port
    planner: Port


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
    ) -> None:
        self._drives = drives
        self._gateway = ports.gateway
        self._recorder = ports.recorder
        self._planner = PlannerLink(ports.planner)
        self._capture = capture
        self._period = config.period
        self._max_overruns = config.watchdogs.max_overruns
        self._epoch = time.time()
        self._welcome = message(Welcome(lacking, drives.bus_load, self._epoch, drives.missing_protections))
        self._status = message(Status(None, 1.0, None))
        self._bitrate = config.can.bitrate
        self._bus_load = 0.0
        self._bits = drives.traffic
        self._weighed_at = 0

        self.control = Control(config, drives, self._planner)
        self.ending = False
        """Set from outside to make the loop stop the robot, disable the drives and return."""
        self._ending_since: int | None = None
        self._overruns = 0
        self._late_streak = 0
        self._heart = heartbeats.of("loop")
        self._gateway_timeout = config.watchdogs.gateway_timeout
        patience = max(LEAST_PATIENCE, round(self._gateway_timeout * config.loop.rate_hz))
        self._gateway_watch = Watch(heartbeats.of("gateway"), patience)
        self._gateway_frozen = False
        self._events = 0
        self._kept: deque[bytes] = deque(maxlen=EVENTS_KEPT)
        self._answers: deque[bytes] = deque()
        self._told = 0
        self._inputs = 0
        self._given: list[ControlInput] = []
        self._fault: DriveFault | None = None
        self._batch_size = max(1, config.loop.rate_hz // BATCHES_PER_SECOND)
        self._made = self.control.measured.record.view(np.uint8).data
        """The cycle's record, as the control makes it."""
        self._batch = memoryview(bytearray(1 + self._batch_size * SIZE))
        self._batch[0] = Kind.RECORDS
        self._batched = 0
        self._marked_ns = 0
        self._parts_ns = [0] * len(Part)
        self._recorded = False
        self._unrecorded = ""

    def run(self, ticker: Ticker) -> None:
        """Run cycles until told to end and the robot stands without power."""
        self._accept_peers()  # so that a recorder that is there has every cycle from the first
        self._drives.sync()
        self.control.start(self._drives.read())
        while not self._over():
            self.cycle(ticker.wait())
        self._flush()

    def cycle(self, tick: Tick) -> None:
        """Run one cycle. Nothing in it waits, and nothing that goes wrong in it leaves the robot moving."""
        self._marked_ns = time.perf_counter_ns()
        self._drives.sync()
        self._mark(Part.SYNC)
        feedback = self._drives.read()
        self._mark(Part.READ)
        self.control.cycle(feedback, self._given_in(tick, feedback.fault), self._mark)
        self._record(tick)
        self._mark(Part.RECORD)

    def _mark(self, part: Part) -> None:
        """Note how long a part of the cycle has taken, at its end."""
        now = time.perf_counter_ns()
        self._parts_ns[part] = now - self._marked_ns
        self._marked_ns = now

    def _given_in(self, tick: Tick, fault: DriveFault | None) -> Iterator[Given]:
        """Yield what the control is given in a cycle, and keep it for the recorder."""
        now_ns = tick.deadline_ns + tick.lateness_ns
        for what in itertools.chain(self._watch(tick, fault), self._requests(), self._planner.answers()):
            self._note(tick, what)
            yield what, now_ns

    def _requests(self) -> Iterator[Request]:
        """Take what the gateway has sent: as much as comes in a cycle, and no more than a cycle has time for.

        Nothing is taken of what a frozen one has left, until it serves again.
        """
        for _ in range(0 if self._gateway_frozen else REQUESTS_A_CYCLE):
            packet = self._gateway.receive()
            if packet is None:
                return
            yield decode_request(memoryview(packet)[1:])

    def _watch(self, tick: Tick, fault: DriveFault | None) -> Iterator[Disturbance]:
        """Count what the ticker missed; yield what has happened: late ticks, a lost gateway, a wish to end."""
        if fault is not self._fault:
            self._fault = fault
            self._note(tick, DrivesFault(fault.message if fault else None))
        if tick.missed:
            self._overruns += tick.missed
            self._late_streak += tick.missed
            if self._late_streak > self._max_overruns:
                text = f"{self._late_streak} ticks missed in a row: the machine is too busy"
                self._late_streak = 0
                yield Disturbance(ModeEvent.LATE.name, text)
        else:
            self._late_streak = 0
        if (lost := self._gateway_lost()) is not None:
            yield Disturbance(ModeEvent.GATEWAY_LOST.name, lost)
        if self.ending and self._ending_since is None:
            self._ending_since = self.control.cycles
            yield Disturbance(ModeEvent.SHUTDOWN.name, "the service is ending: controlled stop, drives disabled")

    def _gateway_lost(self) -> str | None:
        """Return how the gateway has been lost in this cycle; None where it has not."""
        if self._gateway.take_lost():
            self._gateway_frozen = False
            return "the gateway is gone: controlled stop"
        if self._gateway_watch.silent():
            if not self._gateway_frozen:
                self._gateway_frozen = True
                return f"the gateway is frozen, no sign of life for {self._gateway_timeout:g} s: controlled stop"
        elif self._gateway_watch.heard:
            self._gateway_frozen = False
        return None

    def _note(self, tick: Tick, given: GivenInput) -> None:
        """Keep what the control is given in this cycle, for the recorder."""
        self._inputs += 1
        self._given.append(ControlInput(self._inputs, self.control.cycles, tick.deadline_ns + tick.lateness_ns, given))

    def _over(self) -> bool:
        if self._ending_since is None:
            return False
        control = self.control
        stands = control.state.mode in (Mode.DISABLED, Mode.FAULT) and not control.measured.powered
        return stands or (control.cycles - self._ending_since) * self._period > SHUTDOWN

    def _record(self, tick: Tick) -> None:
        """Append this cycle's record; pass batch, answers and events on."""
        control = self.control
        ticks = control.cycles, tick.deadline_ns, tick.lateness_ns, self._overruns
        HEAD.pack_into(self._made, 0, *ticks, *self._parts_ns, MODES.index(control.state.mode))
        begin = 1 + self._batched * SIZE
        self._batch[begin : begin + SIZE] = self._made
        self._batched += 1
        if self._batched == self._batch_size:
            self._flush()
        if control.ledger.answers or control.ledger.notices or self._given:
            self._pass_on()
        if self._answers:
            self._send_answers()

    def _flush(self) -> None:
        """Give a sign of life; send the batch, take new peers, and what was kept for them; listen to the recorder."""
        self._heart.beat()
        if self._batched:
            batch = self._batch[: 1 + self._batched * SIZE]
            self._batched = 0
            self._gateway.send(batch)
            self._recorder.send(batch)
        if self._capture is not None and self._recorder.connected:
            for frames in self._capture.take():
                self._recorder.send(bytes((Kind.FRAMES,)) + frames)
        self._measure_bus_load()
        self._listen()
        self._accept_peers()
        self._send_events()

    def _measure_bus_load(self) -> None:
        """Once a second, work out how much of the bus is in use, and tell it."""
        cycles = self.control.cycles - self._weighed_at
        if cycles * self._period >= 1.0:
            bits, self._bits = self._drives.traffic - self._bits, self._drives.traffic
            self._bus_load = round(bits / (cycles * self._period * self._bitrate), 3)
            self._weighed_at += cycles
            self._publish_status()

    def _listen(self) -> None:
        """Tell everyone what the recorder has to say, and if it has gone."""
        packet = self._recorder.receive()
        if self._recorder.take_lost() and self._recorded:
            self._recorded = False
            self._unrecorded = "the recorder has gone: nothing is recorded until it is back"
            self.control.ledger.tell("service", "warning", self._unrecorded)
            self._publish_status()
        if packet is None:
            return
        if not self._recorded:
            self._recorded, self._unrecorded = True, ""
        try:
            said = decode_recorder(memoryview(packet)[1:])
        except msgspec.DecodeError as error:  # the recorder must not be able to stop the robot
            self.control.ledger.tell("service", "warning", f"the recorder said something unreadable: {error}")
            return
        if isinstance(said, Remark):
            self.control.ledger.tell("service", said.level, said.message)
        else:
            self._unrecorded = quoted(said.why) if said.why else ""
        self._publish_status()

    def _accept_peers(self) -> None:
        """Take new peers."""
        self._planner.accept()
        for port in (self._gateway, self._recorder):
            if port.accept():
                port.send(self._welcome)
                port.send(self._status)
                if port is self._gateway:
                    self._told = 0

    def _pass_on(self) -> None:
        """Answer requests, number what has happened, and pass on what the control was given."""
        control, ledger = self.control, self.control.ledger
        for given in self._given:
            self._recorder.send(message(given))
        self._given.clear()
        for notice in ledger.notices:
            self._events += 1
            t = control.cycles * self._period
            event = Event(self._events, t, control.cycles, time.time(), **notice._asdict())
            packet = told(event)
            self._kept.append(packet)
            self._recorder.send(packet)
        ledger.notices.clear()
        self._publish_status()
        self._send_events()
        self._answers.extend(map(message, ledger.answers))
        ledger.answers.clear()

    def _publish_status(self) -> None:
        """Tell what records do not say, where that has changed."""
        control, goal = self.control, self.control.ledger.goal
        goal_id, counts = goal.id if goal else None, control.measured.feedback.counts
        fault, lag = quoted(control.fault) if control.fault else None, goal.lag if goal else None
        said = goal_id, control.override, fault, control.target, self._bus_load, counts, control.lease.user, lag
        status = message(Status(*said, self._unrecorded))
        if status != self._status:
            self._status = status
            self._gateway.send(status)
            self._recorder.send(status)

    def _send_answers(self) -> None:
        """Answer some requests; what the gateway is too slow for waits, what it has gone without is nobody's."""
        if not self._gateway.connected:
            self._answers.clear()
        for _ in range(min(len(self._answers), ANSWERS_A_CYCLE)):
            if not self._gateway.send(self._answers[0]):
                return
            self._answers.popleft()

    def _send_events(self) -> None:
        """Tell the gateway of every event that is kept and that it does not know."""
        self._told = max(self._told, self._events - len(self._kept))
        while self._told < self._events and self._gateway.send(self._kept[self._told - self._events]):
            self._told += 1


def main(config: Config, ports: Ports, heartbeats: Heartbeats, ready: Callable[[object], None]) -> int:
    """Run the loop's process; `ready` is called with what the loop runs without once it turns."""
    drives: DriveGroup | None = None
    ended_as_told = False
    try:
        warm_up()
        ports.planner.await_peer(PLANNER_WITHIN)
        capture = Capture() if config.telemetry.capture_can else None
        drives = connect(config.can, config.drives, capture=capture)
        drives.configure(config.period, config.limits.slider.velocity)
        lacking = realtime.acquire(config.loop)
        loop = Loop(config, drives, ports, heartbeats, capture=capture, lacking=lacking)

        def end(_signal: int, _frame: FrameType | None) -> None:
            loop.ending = True

        signal.signal(signal.SIGTERM, end)
        ready({"lacking": lacking, "bus_load": drives.bus_load})
        loop.run(Ticker(round(config.period * 1e9)))
        ended_as_told = True
    finally:
        heartbeats.of("loop").rest()  # the drives may take their time to stop
        if drives is not None:
            drives.close()
        for port in (ports.gateway, ports.recorder):
            if ended_as_told:
                port.send(message(Farewell()))
        for port in ports:
            port.close()
    return 0
