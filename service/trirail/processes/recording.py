"""Recorder process, which passes the loop's packets to the recorder and to the black box."""

from __future__ import annotations

import contextlib
import math
import os
import select
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

import msgspec

from trirail.config import Config
from trirail.processes.heartbeats import Heart
from trirail.processes.loop_death import LoopDeath
from trirail.processes.monitoring import MEASUREMENT_PERIOD_S, RecorderMeasurements
from trirail.processes.realtime import offer_to_oom_killer, release_startup_memory
from trirail.telemetry.blackbox import BlackBox
from trirail.telemetry.readout import ReadoutState
from trirail.telemetry.recorder import Recorder
from trirail.wire.event_codes import EventCode, EventText, coded, encodable
from trirail.wire.links import PACKETS_PER_TURN, LinkClosed, PacketLink
from trirail.wire.messages import Level, Notice
from trirail.wire.packets import (
    Announcement,
    Answer,
    ControlInput,
    EventReport,
    EventsWritten,
    Kind,
    RecorderMessage,
    Status,
    Unrecorded,
    Welcome,
    decode_answer,
    message,
)
from trirail.wire.records import last_cycle

GATHER = 0.14
"""Pause in which packets accumulate before they are read [s]. Waking up for each packet costs more than processing it.

If the recorder is killed, less than 0.2 s of records is lost: the packets of this pause, and the batch in the loop. If
the machine is too slow for the recorder, up to PACKETS_PER_TURN packets and those that wait in the socket are lost as
well. Events are not lost: the loop sends those that were not written to the next recorder.
"""

NOT_FOR_OTHERS = 0o027
"""Umask for recordings: the owner may read and write them, and the group may read them."""


class Intake:
    """Receiver of the loop's packets, which passes them to the recorder and to the black box.

    It also sends notices to the loop, for example if data cannot be written.
    """

    def __init__(
        self,
        config: Config,
        record: str | None,
        link: PacketLink,
        ready: Callable[[object], None],
        last_cycle: Callable[[], int | None] = lambda: None,
    ) -> None:
        self._link = link
        self._ready = ready
        self._cycle = 0
        self._reported_unrecorded = ""
        self._newest_event = self._reported_event = 0
        """Number of the newest event, and the number that was reported to the loop last."""
        self._loop_death = LoopDeath(config.period, last_cycle)
        path = Path(record) if record else None
        directory = Path(config.telemetry.directory)
        sidecars = path is None  # a user who names a single file does not expect further files next to it
        self.recorder = recorder = Recorder(config, directory, path=path, sidecars=sidecars, warn=self._warn)
        folder = recorder.path.parent

        def box(name: str, reason: str) -> Recorder:
            return Recorder(config, folder, name=name, reason=reason, sidecars=sidecars, live=False)

        self._box = BlackBox(config.loop.rate_hz, box, self._warn)
        self._wall_offset_ns: int | None = None
        """Wall clock minus monotonic clock of the black box's newest data [ns]; None before the first records."""

    def on_packet(self, packet: bytes) -> None:
        """Process a packet from the loop."""
        self._loop_death.record_activity()
        content = packet[1:]
        if packet[0] == Kind.RECORDS:
            self._cycle = last_cycle(content)
            self.recorder.records(content)
            self._latch_wall_offset()
            self._box.records(content)
        elif packet[0] == Kind.FRAMES:
            self.recorder.frames(content)
        else:
            self._handle_answer(decode_answer(content))

    def save(self) -> None:
        """Write the processed packets, and report to the loop which events they contained.

        Also report to the loop when writing begins to fail, and when it works again.
        """
        self.recorder.save()
        reports = self._newest_event != self._reported_event and not self.recorder.keeps_events
        if reports and self._send(EventsWritten(self._newest_event)):
            self._reported_event = self._newest_event
        what, why = self.recorder.unrecorded  # only `what` is compared: `why` contains the free space, which changes
        if what != self._reported_unrecorded and self._send(Unrecorded(what and f"{what}: {why}")):
            self._reported_unrecorded = what

    def loop_gone(self) -> None:
        """Record as events that the loop has died or, if it ended normally, that its last cycles are missing."""
        for event in (*self._loop_death.events(self._cycle), *self._loop_death.missing_cycles(self._cycle)):
            self._handle_answer(EventReport(event))

    def close(self) -> None:
        """Complete and close all files."""
        self.recorder.close()
        self._box.close()

    def _latch_wall_offset(self) -> None:
        """Store when the wall clock was set, so that the records of a black box have the time of their own moment."""
        if self._wall_offset_ns != self.recorder.wall_offset_ns:
            self._wall_offset_ns = self.recorder.wall_offset_ns
            self._box.latch("set_wall_offset", self._wall_offset_ns)

    def _handle_answer(self, answer: Answer) -> None:
        recorder, box = self.recorder, self._box
        self._loop_death.follow(answer)
        match answer:
            case EventReport(event):
                self._newest_event = event.seq
                recorder.event(event)
                box.event(event)
            case ControlInput():
                recorder.control_input(answer)
                box.control_input(answer)
            case Status():
                standing = ReadoutState(answer.goal, answer.target, answer.override, answer.fault)
                recorder.update_state(standing)
                box.latch("update_state", standing)
            case Welcome():
                recorder.bus_load(answer.bus_load)
                box.latch("bus_load", answer.bus_load)
                path = str(recorder.path)
                self._announce("info", coded(f"recording to {path}", EventCode.RECORDING, file=path))
                self._ready({"recording": encodable(path), "live": recorder.live_url})

    def _warn(self, text: EventText) -> None:
        """Write a warning to the service's log, and announce it to all clients."""
        with contextlib.suppress(OSError):  # the log may be on the full disk
            if select.select([], [sys.stderr], [], 0.0)[1]:  # otherwise the reader of the log does not read
                print(f"trirail: recorder: {text}", file=sys.stderr, flush=True)  # noqa: T201 - the log
        self._announce("warning", text)

    def _announce(self, level: Level, text: EventText) -> None:
        """Ask the loop to announce a notice."""
        self._send(Announcement(Notice("service", level, text.text, **text.fields)))

    def _send(self, packet: RecorderMessage) -> bool:
        """Send a packet to the loop. Return False if the queue is full, or if the loop has disconnected."""
        with contextlib.suppress(LinkClosed):
            return self._link.send(message(packet))
        return False


def main(
    config: Config,
    record: str | None,
    link: PacketLink,
    heart: Heart,
    ready: Callable[[object], None],
    report_measurements: Callable[[msgspec.Struct], None],
    last_cycle: Callable[[], int | None] = lambda: None,
) -> int:
    """Run the recorder process until the loop disconnects or SIGTERM arrives; return the exit code.

    Parameters
    ----------
    report_measurements
        Function called once per second, if the configuration enables metrics.
    last_cycle
        Function that returns the loop's last cycle if the loop has ended normally, otherwise None.

    """
    offer_to_oom_killer()  # a recorder that has ended is restarted, and the robot moves on
    os.umask(NOT_FOR_OTHERS | os.umask(NOT_FOR_OTHERS))
    ending, received = False, 0

    def end(_signal: int, _frame: object) -> None:
        nonlocal ending
        ending = True

    signal.signal(signal.SIGTERM, end)  # before a file is created, which is deleted if the service does not start
    intake = Intake(config, record, link, ready, last_cycle)
    release_startup_memory()
    poll = select.poll()
    poll.register(link.fileno(), select.POLLIN)
    sent_at = -math.inf
    try:
        while not ending:
            heart.beat()
            if received < PACKETS_PER_TURN:  # otherwise, more packets are waiting
                poll.poll(500)
                time.sleep(GATHER)
            received = 0
            for received, packet in enumerate(link.packets(), start=1):  # noqa: B007 - the count is used in the next turn
                intake.on_packet(packet)
                heart.beat()
            intake.save()
            if config.telemetry.metrics_port and time.monotonic() >= sent_at + MEASUREMENT_PERIOD_S:
                sent_at = time.monotonic()
                report_measurements(RecorderMeasurements(*intake.recorder.missing))
    except LinkClosed:
        with contextlib.suppress(
            LinkClosed
        ):  # if the loop has left a packet unread, its own follow after the first error
            for packet in iter(link.receive, None):
                intake.on_packet(packet)
        intake.loop_gone()
    finally:
        heart.rest()  # completing the files may take longer than the time-out of the heartbeat
        intake.close()
    return 0
