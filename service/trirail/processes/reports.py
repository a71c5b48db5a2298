"""What the loop says to the processes beside it, and what the recorder has to say."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Sequence

import msgspec
import numpy as np
from numpy.typing import NDArray
from trirail_drivers.bus.capture import Capture
from trirail_drivers.interface import DriveGroup

from trirail.config import Config
from trirail.control.control import Control
from trirail.processes.clock import Tick
from trirail.wire.links import Port
from trirail.wire.messages import Notice
from trirail.wire.packets import (
    ControlInput,
    GivenInput,
    Kind,
    Remark,
    Status,
    Welcome,
    decode_recorder,
    event_packet,
    message,
)
from trirail.wire.records import HEAD, SIZE
from trirail.wire.text import quoted
from trirail.wire.vocabulary import MODES

BATCHES_PER_SECOND = 50
ANSWERS_A_CYCLE = 8
INPUTS_KEPT = 8
"""So much of what the control was given may wait for the next batch of records; the recorder has no use for it before.
"""
EVENTS_KEPT = 1000
"""Events kept for a gateway that comes anew: the one before may have died with some that it had not published."""


class Reports:
    """Passes on what each cycle has made: records in batches, events, answers, and what records do not say.

    Nothing in it waits: what the gateway is too slow for is kept for it, what the recorder is too slow for it lacks.
    """

    def __init__(
        self,
        config: Config,
        control: Control,
        drives: DriveGroup,
        gateway: Port,
        recorder: Port,
        capture: Capture | None,
        lacking: tuple[str, ...],
    ) -> None:
        self._control = control
        self._drives = drives
        self._gateway = gateway
        self._recorder = recorder
        self._capture = capture
        self._period = config.period
        self._welcome = message(Welcome(lacking, drives.bus_load, drives.missing_protections))
        self._status = Status(None, 1.0, None)
        self._bitrate = config.can.bitrate
        self._bus_load = 0.0
        self._bits = drives.traffic
        self._weighed_at = 0
        self._events = 0
        self._kept: deque[bytes] = deque(maxlen=EVENTS_KEPT)
        self._answers: deque[bytes] = deque()
        self._told = 0
        self._inputs = 0
        self._given: list[ControlInput] = []
        self._postponed = 0, 0
        """How many events wait that belong to an earlier cycle than what comes behind them, and to which."""
        self._batch_size = max(1, config.loop.rate_hz // BATCHES_PER_SECOND)
        self._made = control.measured.record.view(np.uint8).data
        """The cycle's record, as the control makes it."""
        self._batch = memoryview(bytearray(1 + self._batch_size * SIZE))
        self._batch[0] = Kind.RECORDS
        self.batched = 0
        """Records in the batch."""
        self._recorded = False
        self._unrecorded = ""

    def note(self, now_ns: int, given: GivenInput, *, urgent: bool = False, waiting: bool = False) -> None:
        """Keep what the control is given before the next cycle or, `urgent`, in the one under way: for the recorder.

        `waiting` as of a ControlInput.
        """
        self._inputs += 1
        self._given.append(ControlInput(self._inputs, self._control.modes.cycle, now_ns, given, urgent, waiting))

    def record(self, tick: Tick, overruns: int, parts_ns: Sequence[int]) -> None:
        """Append the newest cycle's record."""
        control = self._control
        ticks = control.modes.cycle, tick.deadline_ns, tick.lateness_ns, overruns
        HEAD.pack_into(self._made, 0, *ticks, *parts_ns, MODES.index(control.state.mode))
        begin = 1 + self.batched * SIZE
        self._batch[begin : begin + SIZE] = self._made
        self.batched += 1

    @property
    def full(self) -> bool:
        """Whether the batch is, and is to be flushed."""
        return self.batched == self._batch_size

    @property
    def idle(self) -> bool:
        """Whether nothing waits to be passed on but what goes with a batch."""
        return not (self._answers or self._told < self._events)

    @property
    def batch(self) -> NDArray[np.uint8]:
        """Room for the records of a batch, (n, SIZE) bytes; `batched` of them are there."""
        return np.frombuffer(self._batch, np.uint8)[1:].reshape(-1, SIZE)

    def pass_on(self) -> None:
        """Pass on what has happened and what is answered, if anything, and what the control was given before that.

        An event belongs to the first cycle that it shows in: that under way or, behind its end, the next.
        """
        if self._control.ledger.answers or self._control.ledger.notices or len(self._given) > INPUTS_KEPT:
            self._publish()
        if self._answers:
            self._send_answers()

    def postpone(self) -> None:
        """Leave what has happened to be passed on behind the next cycle: it shows in that already."""
        self._postponed = len(self._control.ledger.notices), self._control.modes.cycle

    def flush(self) -> None:
        """Send the batch, take new peers, and what was kept for them."""
        self._send_given()
        if self.batched:
            batch = self._batch[: 1 + self.batched * SIZE]
            self.batched = 0
            self._gateway.send(batch)
            self._recorder.send(batch)
        if self._capture is not None and self._recorder.connected:
            for frames in self._capture.drain():
                self._recorder.send(bytes((Kind.FRAMES,)) + frames)
        self._measure_bus_load()
        self.accept_peers()
        self._send_events()

    def accept_peers(self) -> None:
        """Take new peers."""
        for port in (self._gateway, self._recorder):
            if port.accept():
                port.send(self._welcome)
                port.send(message(self._status))
                if port is self._gateway:
                    self._told = 0

    def _measure_bus_load(self) -> None:
        """Once a second, work out how much of the bus is in use, and tell it."""
        cycles = self._control.cycles - self._weighed_at
        if cycles * self._period >= 1.0:
            bits, self._bits = self._drives.traffic - self._bits, self._drives.traffic
            self._bus_load = round(bits / (cycles * self._period * self._bitrate), 3)
            self._weighed_at += cycles
            self._publish_status()

    def listen(self) -> None:
        """Tell everyone what the recorder has to say, and if it has gone."""
        packet = self._recorder.receive()
        if self._recorder.take_lost() and self._recorded:
            self._recorded = False
            self._unrecorded = "the recorder has gone: nothing is recorded until it is back"
            self._control.ledger.notices.append(Notice("service", "warning", self._unrecorded))
            self._publish_status()
        if packet is None:
            return
        if not self._recorded:
            self._recorded, self._unrecorded = True, ""
        try:
            said = decode_recorder(memoryview(packet)[1:])
        except msgspec.DecodeError as error:  # the recorder must not be able to stop the robot
            self._control.ledger.notices.append(
                Notice("service", "warning", f"the recorder said something unreadable: {error}")
            )
            return
        if isinstance(said, Remark):
            self._control.ledger.notices.append(Notice("service", said.level, said.message))
        else:
            self._unrecorded = quoted(said.why) if said.why else ""
        self._publish_status()

    def _publish(self) -> None:
        """Answer requests, number what has happened, and pass on what the control was given."""
        control, ledger = self._control, self._control.ledger
        self._send_given()
        (postponed, earlier), self._postponed = self._postponed, (0, 0)
        for number, notice in enumerate(ledger.notices):
            self._events += 1
            cycle = earlier if number < postponed else control.modes.cycle
            packet = event_packet(notice.event(self._events, cycle * self._period, cycle, time.time()))
            self._kept.append(packet)
            self._recorder.send(packet)
        ledger.notices.clear()
        self._publish_status()
        self._send_events()
        self._answers.extend(map(message, ledger.answers))
        ledger.answers.clear()

    def _send_given(self) -> None:
        """Tell the recorder what the control was given."""
        for given in self._given:
            self._recorder.send(message(given))
        self._given.clear()

    def _publish_status(self) -> None:
        """Tell what records do not say, where that has changed."""
        control, goal = self._control, self._control.ledger.goal
        goal_id, counts = goal.id if goal else None, control.measured.feedback.counts
        fault, lag = quoted(control.fault) if control.fault else None, goal.lag if goal else None
        said = goal_id, control.override, fault, control.target, self._bus_load, counts, control.lease.user, lag
        status = Status(*said, self._unrecorded)
        if status != self._status:
            self._status, packet = status, message(status)
            self._gateway.send(packet)
            self._recorder.send(packet)

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
