"""Messages from the loop to the gateway and the recorder, and messages from the recorder to the loop."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Sequence

import msgspec
import numpy as np
from numpy.typing import NDArray
from trirail_drivers.bus.capture import Capture
from trirail_drivers.interface import DriveGroup, UnreadyDrives

from trirail.config import Config
from trirail.control.control import Control
from trirail.processes.clock import Tick
from trirail.processes.cycle_core import MOST_AHEAD
from trirail.wire.decoding import INVALID
from trirail.wire.event_codes import EventCode, coded
from trirail.wire.links import Port
from trirail.wire.messages import Notice
from trirail.wire.packets import (
    Announcement,
    ControlInput,
    EventsWritten,
    GivenInput,
    Kind,
    Status,
    Unrecorded,
    Welcome,
    decode_recorder,
    event_packet,
    message,
)
from trirail.wire.records import HEADER, SIZE
from trirail.wire.text import quoted
from trirail.wire.vocabulary import MODES

BATCHES_PER_SECOND = 50
SENT_TOGETHER = 8
"""Maximum number of events, and also of answers, that one call sends to a peer. More would delay the cycle.

A restarted gateway is sent up to EVENTS_KEPT events.
"""
PROGRESS_EVERY = 0.1
"""Minimum interval between two progress reports while drives are being configured [s]."""
INPUTS_KEPT = 8
"""Maximum number of control inputs that wait for the next batch of records.

They normally wait, because the recorder does not need them earlier.
"""
EVENTS_KEPT = 1000
"""Number of events stored.

A restarted gateway or recorder needs them, because the previous process may not have published or written all of them.
A recorder also needs them if it reads nothing for a while, for example because its disk is slow.
"""


class Reports:
    """Sender of the loop's records in batches, events, answers, and status, which contains what is not in the records.

    No method waits. Events and the newest status are stored for a slow gateway and a slow recorder, answers for a slow
    gateway, and captured frames for a slow recorder. Records and inputs for a slow recorder are lost.
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
        self._welcome = Welcome(lacking, drives.bus_load, drives.missing_protections)
        self._status = Status(None, 1.0, None)
        self._unsent: dict[tuple[Port, type], Status | Welcome] = {}
        """Newest status and welcome for which a peer had no space, to be sent with the next batch."""
        self._bus_load = 0.0
        self._traffic = drives.traffic
        self._bus_measured_at = self._progress_at = 0
        self._unready: UnreadyDrives = (None, None, None)
        self._events = 0
        self._kept: deque[bytes] = deque(maxlen=EVENTS_KEPT)
        self._answers: deque[bytes] = deque()
        self._sent_events = dict.fromkeys((gateway, recorder), 0)
        self._written_events = 0
        """Number of the newest event that a recorder has written."""
        self._inputs = 0
        self._unsent_inputs: list[ControlInput] = []
        self._batch_size = max(1, config.loop.rate_hz // BATCHES_PER_SECOND)
        """Number of records in a full batch. Cycles beside a decision may add MOST_AHEAD records."""
        self._made = control.measured.record.view(np.uint8).data
        """Bytes of the newest cycle's record, which the control fills."""
        self._batch, self._spare = (memoryview(bytearray(1 + (self._batch_size + MOST_AHEAD) * SIZE)) for _ in range(2))
        self._batch[0] = self._spare[0] = Kind.RECORDS
        self._unsent_batch: memoryview | None = None
        """Filled part of a batch that was set aside; it is sent before the records of the present batch."""
        self.batched = 0
        """Number of records in the batch."""
        self._recorded = False
        self._unrecorded = ""

    def note(self, now_ns: int, content: GivenInput, *, urgent: bool = False) -> None:
        """Store an input to the control until it is sent to the recorder.

        Parameters
        ----------
        now_ns
            Time at which the control received the input [ns].
        urgent
            True if the input applies to the present cycle, False if it applies to the next cycle.

        """
        self._inputs += 1
        self._unsent_inputs.append(ControlInput(self._inputs, self._control.modes.cycle, now_ns, content, urgent))

    def record(self, tick: Tick, overruns: int, parts_ns: Sequence[int]) -> None:
        """Complete the record of the newest cycle, and append it to the batch."""
        control = self._control
        ticks = control.modes.cycle, tick.deadline_ns, tick.lateness_ns, overruns
        control.outputs.stamp(tick.deadline_ns)
        HEADER.pack_into(self._made, 0, *ticks, *parts_ns, MODES.index(control.state.mode))
        begin = 1 + self.batched * SIZE
        self._batch[begin : begin + SIZE] = self._made
        self.batched += 1

    @property
    def due_after(self) -> int:
        """Number of cycles after which the batch is full and due to be sent; 0 if it is due now."""
        return max(0, self._batch_size - self.batched)

    @property
    def idle(self) -> bool:
        """True if all events and answers have been sent to the gateway."""
        return not (self._answers or self._sent_events[self._gateway] < self._events)

    @property
    def batch(self) -> NDArray[np.uint8]:
        """Array for the records of a batch, (n, SIZE) bytes, of which the first `batched` rows are filled."""
        return np.frombuffer(self._batch, np.uint8)[1:].reshape(-1, SIZE)

    @property
    def misses_recorder(self) -> bool:
        """True if the recorder was lost and `listen` has not announced that yet."""
        return not self._recorder.no_peer_lost

    def set_batch_aside(self) -> None:
        """Begin another batch, so that the records of this one can be sent while cycles are run."""
        if self._unsent_batch is not None:
            self.flush()
        self._unsent_batch = self._batch[: 1 + self.batched * SIZE] if self.batched else None
        self._batch, self._spare, self.batched = self._spare, self._batch, 0

    def pass_on(self, at_most: int = SENT_TOGETHER) -> None:
        """Send the inputs to the control, then at most `at_most` events and answers each, if there are any.

        The number of an event's cycle is that of the first cycle that shows its effect. This is the present cycle or,
        after the end of the present cycle, the next cycle.
        """
        if self._control.ledger.answers or self._control.ledger.notices or len(self._unsent_inputs) > INPUTS_KEPT:
            self._publish()
        for port in self._sent_events:
            self._send_events(port, at_most)
        if self._answers:
            self._send_answers(at_most)

    def flush(self) -> None:
        """Send the batch of records and captured frames, and accept new peers."""
        self._send_inputs()
        if self._unsent_batch is None and self.batched:
            self.set_batch_aside()
        if self._unsent_batch is not None:
            self._gateway.send(self._unsent_batch)
            self._recorder.send(self._unsent_batch)
            self._unsent_batch = None
        if self._capture is not None and self._recorder.connected:
            for frames in self._capture.drain():
                if not self._recorder.send(bytes((Kind.FRAMES,)) + frames):
                    break
        self._measure_bus_load()
        if self._control.measured.feedback.unready != self._unready:
            self._report_progress()
        for (port, _), unsent in tuple(self._unsent.items()):
            self._send_state(port, unsent)
        self.accept_peers()

    def accept_peers(self) -> None:
        """Accept new connections of the gateway and the recorder, and send them the welcome and the status."""
        for port in (self._gateway, self._recorder):
            if port.accept():
                port.send(message(msgspec.structs.replace(self._welcome, newest_event=self._events)))
                port.send(message(self._status))
                self._sent_events[port] = 0 if port is self._gateway else self._written_events

    def report_protections(self) -> None:
        """Report to the gateway which protections the drives lack, if these have changed."""
        missing = self._drives.missing_protections
        if missing != self._welcome.missing_protections:
            self._welcome = msgspec.structs.replace(self._welcome, missing_protections=missing)
            self._send_state(self._gateway, self._welcome)

    def _report_progress(self) -> None:
        """Send the status with the progress of the drives' configuration, at most every PROGRESS_EVERY."""
        cycles = self._control.cycles
        if (cycles - self._progress_at) * self._period >= PROGRESS_EVERY:
            self._progress_at, self._unready = cycles, self._control.measured.feedback.unready
            self._publish_status()

    def _measure_bus_load(self) -> None:
        """Calculate and report the fraction of the bus capacity that is in use, once per second."""
        cycles = self._control.cycles - self._bus_measured_at
        if cycles * self._period >= 1.0:
            busy_ns, self._traffic = self._drives.traffic - self._traffic, self._drives.traffic
            self._bus_load = round(busy_ns * 1e-9 / (cycles * self._period), 3)
            self._bus_measured_at += cycles
            self._publish_status()

    def listen(self) -> None:
        """Process a message from the recorder, if one has arrived, and announce it or the loss of the recorder."""
        packet = self._recorder.receive()
        if self._recorder.clear_lost() and self._recorded:
            self._recorded = False
            self._unrecorded = "the recorder has died: nothing is recorded until it has restarted"
            lost = coded(self._unrecorded, EventCode.RECORDER_LOST)
            self._control.ledger.notices.append(Notice("service", "warning", lost.text, **lost.fields))
            self._publish_status()
        if packet is None:
            return
        if not self._recorded:
            self._recorded, self._unrecorded = True, ""
        try:
            content = decode_recorder(memoryview(packet)[1:])
        except INVALID as error:  # a faulty recorder must not stop the robot
            words = f"the recorder has sent an invalid packet: {error}"
            text = coded(words, EventCode.RECORDER_UNREADABLE, error=str(error))
            self._control.ledger.notices.append(Notice("service", "warning", text.text, **text.fields))
            return
        match content:
            case Announcement(notice):
                self._control.ledger.notices.append(notice)
            case EventsWritten(newest):
                self._written_events = newest
            case Unrecorded(why):
                self._unrecorded = quoted(why) if why else ""
        self._publish_status()

    def _publish(self) -> None:
        """Send the inputs to the control, number the events, and enqueue the answers."""
        control, ledger = self._control, self._control.ledger
        self._send_inputs()
        cycle = control.modes.cycle
        for notice in ledger.notices:
            self._events += 1
            wall, offset = time.time(), time.time() - time.monotonic()
            self._kept.append(event_packet(notice.event(self._events, cycle * self._period, cycle, wall, offset)))
        ledger.notices.clear()
        self._publish_status()
        self._answers.extend(map(message, ledger.answers))
        ledger.answers.clear()

    def _send_inputs(self) -> None:
        """Send the stored inputs to the control to the recorder."""
        for control_input in self._unsent_inputs:
            self._recorder.send(message(control_input))
        self._unsent_inputs.clear()

    def _publish_status(self) -> None:
        """Send the status to the gateway and the recorder, if it has changed."""
        control, goal = self._control, self._control.ledger.goal
        goal_id, counts = goal.id if goal else None, self._drives.counts
        fault, lag = quoted(control.fault) if control.fault else None, goal.lag if goal else None
        fields = goal_id, control.override, fault, control.target, self._bus_load, counts, control.lease.user, lag
        status = Status(*fields, self._unrecorded, tuple(map(quoted, control.measured.unready)))
        if status != self._status:
            self._status = status
            for port in (self._gateway, self._recorder):
                self._send_state(port, status)

    def _send_state(self, port: Port, state: Status | Welcome) -> None:
        """Send a state to a peer. If there is no space, keep it, because a newer state may never follow."""
        self._unsent.pop((port, type(state)), None)
        if not port.send(message(state)) and port.connected:
            self._unsent[port, type(state)] = state

    def _send_answers(self, at_most: int) -> None:
        """Send at most `at_most` answers. Answers wait for a slow gateway; if the gateway is lost, drop them."""
        if not self._gateway.connected:
            self._answers.clear()
        for _ in range(min(len(self._answers), at_most)):
            if not self._gateway.send(self._answers[0]):
                return
            self._answers.popleft()

    def _send_events(self, port: Port, at_most: int) -> None:
        """Send to a peer at most `at_most` of the stored events that have not been sent to it."""
        sent = max(self._sent_events[port], self._events - len(self._kept))
        last = min(self._events, sent + at_most)
        while sent < last and port.send(self._kept[sent - self._events]):
            sent += 1
        self._sent_events[port] = sent
