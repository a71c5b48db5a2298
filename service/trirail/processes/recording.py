"""The recorder's process: passes the loop's packets to the recorder and to the black box."""

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
from trirail.processes.monitoring import TOLD_EVERY, RecorderMeasured
from trirail.processes.realtime import give_back
from trirail.telemetry.blackbox import BlackBox
from trirail.telemetry.readout import ReadoutState
from trirail.telemetry.recorder import Recorder
from trirail.wire.event_codes import EventCode, EventText, coded
from trirail.wire.links import LinkClosed, PacketLink
from trirail.wire.messages import Level, Notice
from trirail.wire.packets import (
    Announcement,
    Answer,
    ControlInput,
    Happened,
    Kind,
    RecorderSaid,
    Status,
    Unrecorded,
    Welcome,
    decode_answer,
    message,
)
from trirail.wire.records import last_cycle

GATHER = 0.14
"""Time for packets to gather before they are read: to wake for each costs more than its content [s].

A killed recorder loses the packets not written: those of that time, and the loop's batch; less than 0.2 s.
"""

NOT_FOR_OTHERS = 0o027
"""Least umask of recordings: files are written by their owner, read by the group, and by nobody else."""


class Intake:
    """Intake of the loop's packets for the recorder and the black box, with notices to the loop."""

    def __init__(self, config: Config, record: str | None, link: PacketLink, ready: Callable[[object], None]) -> None:
        self._link = link
        self._ready = ready
        self._cycle = 0
        self._told_unrecorded = ""
        self._loop_death = LoopDeath(config.period)
        path = Path(record) if record else None
        directory = Path(config.telemetry.directory)
        sidecars = path is None  # the user has named a single file, and knows where it is
        self.recorder = recorder = Recorder(config, directory, path=path, sidecars=sidecars, warn=self._warn)
        folder = recorder.path.parent

        def box(name: str, reason: str) -> Recorder:
            return Recorder(config, folder, name=name, reason=reason, sidecars=sidecars, live=False)

        self._box = BlackBox(config.loop.rate_hz, box, self._warn)

    def on_packet(self, packet: bytes) -> None:
        """Process a packet."""
        self._loop_death.heard()
        content = packet[1:]
        if packet[0] == Kind.RECORDS:
            self._cycle = last_cycle(content)
            self.recorder.records(content)
            self._box.records(content)
        elif packet[0] == Kind.FRAMES:
            self.recorder.frames(content)
        else:
            self._hear(decode_answer(content))

    def save(self) -> None:
        """Write the packets processed; report to the loop when that begins to fail, and when it works again."""
        self.recorder.save()
        what, why = self.recorder.unrecorded  # its reason changes with every byte of the disk
        if what != self._told_unrecorded and self._send(Unrecorded(what and f"{what}: {why}")):
            self._told_unrecorded = what

    def loop_gone(self) -> None:
        """Record the death of the loop in its place, if it has died."""
        for event in self._loop_death.events(self._cycle):
            self._hear(Happened(event))

    def close(self) -> None:
        """Complete all files."""
        self.recorder.close()
        self._box.close()

    def _hear(self, said: Answer) -> None:
        recorder, box = self.recorder, self._box
        self._loop_death.follow(said)
        match said:
            case Happened(event):
                recorder.event(event)
                box.event(event)
            case ControlInput():
                recorder.control_input(said)
                box.control_input(said)
            case Status():
                standing = ReadoutState(said.goal, said.target, said.override, said.fault)
                recorder.update_state(standing)
                box.latch("update_state", standing)
            case Welcome():
                recorder.bus_load(said.bus_load)
                box.latch("bus_load", said.bus_load)
                path = str(recorder.path)
                self._announce("info", coded(f"recording to {path}", EventCode.RECORDING, file=path))
                self._ready({"recording": str(recorder.path), "live": recorder.live_url})

    def _warn(self, text: EventText) -> None:
        """Warn in the service's log, and announce it to everyone."""
        with contextlib.suppress(OSError):  # the log may be on the disk that takes no more
            print(f"trirail: recorder: {text}", file=sys.stderr, flush=True)  # noqa: T201 - the log
        self._announce("warning", text)

    def _announce(self, level: Level, text: EventText) -> None:
        """Have the loop announce a notice."""
        self._send(Announcement(Notice("service", level, text.text, **text.fields)))

    def _send(self, said: RecorderSaid) -> bool:
        """Send a packet to the loop; return False if that takes no more now, or has gone."""
        with contextlib.suppress(LinkClosed):
            return self._link.send(message(said))
        return False


def main(
    config: Config,
    record: str | None,
    link: PacketLink,
    heart: Heart,
    ready: Callable[[object], None],
    measured: Callable[[msgspec.Struct], None],
) -> int:
    """Record until the loop has gone or SIGTERM; send `measured` the gaps, if there are metrics."""
    os.umask(NOT_FOR_OTHERS | os.umask(NOT_FOR_OTHERS))
    intake = Intake(config, record, link, ready)
    give_back()
    ending = False

    def end(_signal: int, _frame: object) -> None:
        nonlocal ending
        ending = True

    signal.signal(signal.SIGTERM, end)
    poll = select.poll()
    poll.register(link.fileno(), select.POLLIN)
    told = -math.inf
    try:
        while not ending:
            heart.beat()
            poll.poll(500)
            time.sleep(GATHER)
            while (packet := link.receive()) is not None:
                intake.on_packet(packet)
                heart.beat()
            intake.save()
            if config.telemetry.metrics_port and time.monotonic() >= told + TOLD_EVERY:
                told = time.monotonic()
                measured(RecorderMeasured(*intake.recorder.missing))
    except LinkClosed:
        intake.loop_gone()
    finally:
        heart.rest()  # files take their time to be completed
        intake.close()
    return 0
