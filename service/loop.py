"""The control loop: the only process with deadlines. It waits for nothing but its next tick."""

from __future__ import annotations

import signal
import time
from collections import deque
from collections.abc import Callable
from types import FrameType

from drivers.bus import connect
from drivers.capture import Capture
from drivers.interface import Drives
from service import packets, realtime
from service.clock import Tick, Ticker
from service.config import Config
from service.control import Control
from service.kinematics import warm_up
from service.links import Port
from service.messages import Event
from service.modes import MODES, Mode
from service.modes import Event as Mishap
from service.packets import Happened, Kind, Situation, Welcome, message
from service.records import LAYOUT

BATCHES_PER_SECOND = 50
EVENTS_KEPT = 1000
"""Events kept for a gateway that comes anew: the one before may have died with some that it had not published."""
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

        self.control = Control(config, drives)
        self.ending = False
        """Set from outside to make the loop stop the robot, disable the drives and return."""
        self._ending_since: int | None = None
        self._overruns = 0
        self._late_streak = 0
        self._events = 0
        self._kept: deque[bytes] = deque(maxlen=EVENTS_KEPT)
        self._told = 0
        self._batch_size = max(1, config.loop.rate_hz // BATCHES_PER_SECOND)
        self._batch = bytearray(1 + self._batch_size * LAYOUT.size)
        self._batch[0] = Kind.RECORDS
        self._batched = 0
        self._record_ns = 0

    def run(self, ticker: Ticker) -> None:
        """Run cycles until told to end and the robot stands without power."""
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
        self._watch(tick)
        decided = moved = now()
        try:
            request = self._gateway.receive() if control.ready else None
            if request is not None:
                control.handle(packets.decode_request(memoryview(request)[1:]), tick.deadline_ns + tick.lateness_ns)
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

    def _watch(self, tick: Tick) -> None:
        """Count what the ticker missed, notice a lost gateway and a wish to end."""
        control = self.control
        if tick.missed:
            self._overruns += tick.missed
            self._late_streak += tick.missed
            if self._late_streak > self._max_overruns:
                control.happen(Mishap.LATE, f"{self._late_streak} ticks missed in a row: the machine is too busy")
                self._late_streak = 0
        else:
            self._late_streak = 0
        if self._gateway.take_lost():
            control.happen(Mishap.GATEWAY_LOST, "the gateway is gone: controlled stop")
        if self.ending and self._ending_since is None:
            self._ending_since = control.cycle
            control.happen(Mishap.SHUTDOWN, "the service is ending: controlled stop, drives disabled")

    def _over(self) -> bool:
        if self._ending_since is None:
            return False
        control = self.control
        stands = control.state.mode in (Mode.DISABLED, Mode.FAULT) and not control.powered
        return stands or (control.cycle - self._ending_since) * self._period > SHUTDOWN

    def _record(self, tick: Tick, parts: tuple[int, ...]) -> None:
        """Append this cycle's record; pass batch, answers and events on."""
        control = self.control
        feedback = control.feedback
        rows = control.rows
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
            *control.pose,
            *control.commanded.pose,
            *control.commanded.velocity,
            *control.commanded.acceleration,
            *feedback.position,
            *control.velocity,
            *rows[0],
            *rows[1],
            *rows[2],
            *rows[3],
            *control.following_error,
            *control.progress,
        )
        self._batched += 1
        if self._batched == self._batch_size:
            self._flush()
        if control.desk.answers or control.desk.happenings:
            self._speak()

    def _flush(self) -> None:
        """Send the batch, take new peers, and what was kept for them."""
        if self._batched:
            batch = bytes(self._batch[: 1 + self._batched * LAYOUT.size])
            self._batched = 0
            self._gateway.send(batch)
            self._recorder.send(batch)
        if self._capture is not None and self._recorder.connected:
            for frames in self._capture.take():
                self._recorder.send(bytes((Kind.FRAMES,)) + frames)
        for port in (self._gateway, self._recorder):
            if port.accept():
                port.send(self._welcome)
                port.send(self._situation)
                if port is self._gateway:
                    self._told = 0
        self._send_events()

    def _speak(self) -> None:
        """Answer requests and number what has happened."""
        control, desk = self.control, self.control.desk
        for happening in desk.happenings:
            self._events += 1
            t = control.cycle * self._period
            event = Event(self._events, t, control.cycle, time.time(), **happening._asdict())
            packet = message(Happened(event))
            self._kept.append(packet)
            self._recorder.send(packet)
        desk.happenings.clear()
        goal_id = desk.goal.id if desk.goal else None
        situation = message(Situation(goal_id, control.override, control.fault, control.target))
        if situation != self._situation:
            self._situation = situation
            self._gateway.send(situation)
            self._recorder.send(situation)
        self._send_events()
        for answer in desk.answers:
            self._gateway.send(message(answer))
        desk.answers.clear()

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
