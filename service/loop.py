"""The control loop: the only process with deadlines. It waits for nothing but its next tick."""

from __future__ import annotations

import signal
import time
from collections import deque
from collections.abc import Callable
from types import FrameType

import msgspec

from drivers.bus import connect
from drivers.capture import Capture
from drivers.interface import DriveFault, Drives
from service import packets, realtime
from service.clock import Tick, Ticker
from service.config import Config
from service.control import Control
from service.kinematics import warm_up
from service.links import Port
from service.messages import Event
from service.modes import MODES, Mode
from service.modes import Event as ModeEvent
from service.packets import DrivesFault, Input, Kind, Mishap, Request, Situation, Welcome, message
from service.records import LAYOUT
from service.text import quoted

BATCHES_PER_SECOND = 50
EVENTS_KEPT = 1000
"""Events kept for a gateway that comes anew: the one before may have died with some that it had not published."""
OLDEST = 255
"""No feedback is recorded as older [SYNCs]."""
SHUTDOWN = 3.0
"""How long a controlled stop may take before the drives are left to their own quick stop [s]."""


class Loop:
    """Ties control, drives, ticks and the two neighbours together; every cycle is `cycle`."""

    def __init__(
        self,
        config: Config,
        drives: Drives,
        gateway: Port,
        recorder: Port,
        *,
        capture: Capture | None = None,
        lacking: tuple[str, ...] = (),
    ) -> None:
        self._drives = drives
        self._gateway = gateway
        self._recorder = recorder
        self._capture = capture
        self._period = config.period
        self._max_overruns = config.watchdogs.max_overruns
        self._epoch = time.time()
        self._welcome = message(Welcome(lacking, drives.bus_load, self._epoch))
        self._situation = message(Situation(None, 1.0, None))
        self._bitrate = config.can.bitrate
        self._bus_load = 0.0
        self._bits = drives.traffic
        self._weighed_at = 0

        self.control = Control(config, drives)
        self.ending = False
        """Set from outside to make the loop stop the robot, disable the drives and return."""
        self._ending_since: int | None = None
        self._overruns = 0
        self._late_streak = 0
        self._events = 0
        self._kept: deque[bytes] = deque(maxlen=EVENTS_KEPT)
        self._told = 0
        self._inputs = 0
        self._given: list[Input] = []
        self._fault: DriveFault | None = None
        self._batch_size = max(1, config.loop.rate_hz // BATCHES_PER_SECOND)
        self._batch = bytearray(1 + self._batch_size * LAYOUT.size)
        self._batch[0] = Kind.RECORDS
        self._batched = 0
        self._record_ns = 0
        self._recorded = False

    def run(self, ticker: Ticker) -> None:
        """Run cycles until told to end and the robot stands without power."""
        self._meet()  # so that a recorder that is there has every cycle from the first
        self._drives.sync()
        self.control.start(self._drives.read())
        while not self._over():
            self.cycle(ticker.wait())
        self._flush()

    def cycle(self, tick: Tick) -> None:
        """Run one cycle. Nothing in it waits, and nothing that goes wrong in it leaves the robot moving."""
        now = time.perf_counter_ns
        control = self.control
        began = now()
        self._drives.sync()
        synced = now()
        feedback = self._drives.read()
        read = now()
        control.observe(feedback)
        self._watch(tick, feedback.fault)
        decided = moved = now()
        try:
            request = self._gateway.receive() if control.dispatch.ready else None
            if request is not None:
                decoded = packets.decode_request(memoryview(request)[1:])
                self._note(tick, decoded)
                control.handle(decoded, tick.deadline_ns + tick.lateness_ns)
            decided = now()
            control.advance()
            moved = now()
            control.solve()
        except Exception as error:  # noqa: BLE001 - whatever is wrong with the program, the robot must stop now
            control.trip(f"internal error, please report it: {error!r}")
        solved = now()
        control.write()
        written = now()
        parts = (
            synced - began,
            read - synced,
            decided - read,
            moved - decided,
            solved - moved,
            written - solved,
        )
        self._record(tick, parts)
        self._record_ns = now() - written

    def _watch(self, tick: Tick, fault: DriveFault | None) -> None:
        """Count what the ticker missed, notice a fault, a lost gateway and a wish to end."""
        if fault is not self._fault:
            self._fault = fault
            self._note(tick, DrivesFault(fault.message if fault else None))
        if tick.missed:
            self._overruns += tick.missed
            self._late_streak += tick.missed
            if self._late_streak > self._max_overruns:
                text = f"{self._late_streak} ticks missed in a row: the machine is too busy"
                self._happen(tick, ModeEvent.LATE, text)
                self._late_streak = 0
        else:
            self._late_streak = 0
        if self._gateway.take_lost():
            self._happen(tick, ModeEvent.GATEWAY_LOST, "the gateway is gone: controlled stop")
        if self.ending and self._ending_since is None:
            self._ending_since = self.control.cycle
            self._happen(tick, ModeEvent.SHUTDOWN, "the service is ending: controlled stop, drives disabled")

    def _happen(self, tick: Tick, event: ModeEvent, reason: str) -> None:
        self._note(tick, Mishap(event.name, reason))
        self.control.happen(event, reason)

    def _note(self, tick: Tick, given: Request | Mishap | DrivesFault) -> None:
        """Keep what the control is given in this cycle, for the recorder."""
        self._inputs += 1
        self._given.append(Input(self._inputs, self.control.cycle, tick.deadline_ns + tick.lateness_ns, given))

    def _over(self) -> bool:
        if self._ending_since is None:
            return False
        control = self.control
        stands = control.state.mode in (Mode.DISABLED, Mode.FAULT) and not control.measured.powered
        return stands or (control.cycle - self._ending_since) * self._period > SHUTDOWN

    def _record(self, tick: Tick, parts: tuple[int, ...]) -> None:
        """Append this cycle's record; pass batch, answers and events on."""
        control = self.control
        feedback = control.measured.feedback
        rows = control.setpoints.rows
        LAYOUT.pack_into(
            self._batch,
            1 + self._batched * LAYOUT.size,
            control.cycle,
            tick.deadline_ns,
            tick.lateness_ns,
            *parts,
            self._record_ns,
            self._overruns,
            MODES.index(control.state.mode),
            *feedback.state,
            *(min(age, OLDEST) for age in feedback.age),
            *feedback.follows,
            *feedback.homed,
            feedback.homing,
            *control.measured.pose,
            *control.commanded.pose,
            *control.commanded.velocity,
            *control.commanded.acceleration,
            *feedback.position,
            *control.measured.velocity,
            *rows[0],
            *rows[1],
            *rows[2],
            *rows[3],
            *control.measured.following_error,
            *control.progress,
        )
        self._batched += 1
        if self._batched == self._batch_size:
            self._flush()
        if control.desk.answers or control.desk.happenings or self._given:
            self._speak()

    def _flush(self) -> None:
        """Send the batch, take new peers, and what was kept for them; listen to the recorder."""
        if self._batched:
            batch = bytes(self._batch[: 1 + self._batched * LAYOUT.size])
            self._batched = 0
            self._gateway.send(batch)
            self._recorder.send(batch)
        if self._capture is not None and self._recorder.connected:
            for frames in self._capture.take():
                self._recorder.send(bytes((Kind.FRAMES,)) + frames)
        self._weigh()
        self._listen()
        self._meet()
        self._send_events()

    def _weigh(self) -> None:
        """Once a second, work out how much of the bus is in use, and tell it."""
        cycles = self.control.cycle - self._weighed_at
        if cycles * self._period >= 1.0:
            bits, self._bits = self._drives.traffic - self._bits, self._drives.traffic
            self._bus_load = round(bits / (cycles * self._period * self._bitrate), 3)
            self._weighed_at += cycles
            self._situate()

    def _listen(self) -> None:
        """Tell everyone what the recorder has to say, and if it has gone."""
        packet = self._recorder.receive()
        if self._recorder.take_lost() and self._recorded:
            self._recorded = False
            self.control.desk.tell("service", "warning", "the recorder has gone: nothing is recorded until it is back")
        if packet is None:
            return
        self._recorded = True
        try:
            remark = packets.decode_remark(memoryview(packet)[1:])
        except msgspec.DecodeError as error:  # the recorder must not be able to stop the robot
            self.control.desk.tell("service", "warning", f"the recorder said something unreadable: {error}")
        else:
            self.control.desk.tell("service", remark.level, remark.message)

    def _meet(self) -> None:
        """Take new peers."""
        for port in (self._gateway, self._recorder):
            if port.accept():
                port.send(self._welcome)
                port.send(self._situation)
                if port is self._gateway:
                    self._told = 0

    def _speak(self) -> None:
        """Answer requests, number what has happened, and pass on what the control was given."""
        control, desk = self.control, self.control.desk
        for given in self._given:
            self._recorder.send(message(given))
        self._given.clear()
        for happening in desk.happenings:
            self._events += 1
            t = control.cycle * self._period
            event = Event(self._events, t, control.cycle, time.time(), **happening._asdict())
            packet = packets.told(event)
            self._kept.append(packet)
            self._recorder.send(packet)
        desk.happenings.clear()
        self._situate()
        self._send_events()
        for answer in desk.answers:
            self._gateway.send(message(answer))
        desk.answers.clear()

    def _situate(self) -> None:
        """Tell what records do not say, where that has changed."""
        control, goal = self.control, self.control.desk.goal
        goal_id, counts = goal.id if goal else None, control.measured.feedback.counts
        fault = quoted(control.fault) if control.fault else None
        situation = message(Situation(goal_id, control.override, fault, control.target, self._bus_load, counts))
        if situation != self._situation:
            self._situation = situation
            self._gateway.send(situation)
            self._recorder.send(situation)

    def _send_events(self) -> None:
        """Tell the gateway of every event that is kept and that it does not know."""
        self._told = max(self._told, self._events - len(self._kept))
        while self._told < self._events and self._gateway.send(self._kept[self._told - self._events]):
            self._told += 1


def main(config: Config, gateway: Port, recorder: Port, ready: Callable[[object], None]) -> int:
    """Run the loop's process; `ready` is called with what the loop runs without once it turns."""
    drives: Drives | None = None
    try:
        warm_up()
        capture = Capture() if config.telemetry.capture_can else None
        drives = connect(config.can, config.drives, capture=capture)
        drives.configure(config.period)
        lacking = realtime.acquire(config.loop)
        loop = Loop(config, drives, gateway, recorder, capture=capture, lacking=lacking)

        def end(_signal: int, _frame: FrameType | None) -> None:
            loop.ending = True

        signal.signal(signal.SIGTERM, end)
        ready({"lacking": lacking, "bus_load": drives.bus_load})
        loop.run(Ticker(round(config.period * 1e9)))
    finally:
        if drives is not None:
            drives.close()
        gateway.close()
        recorder.close()
    return 0
