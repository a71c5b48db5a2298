"""The recorder's process: takes what the loop sends and gives it to the recorder and to the black box."""

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
from trirail.telemetry.readout import Standing
from trirail.telemetry.recorder import Recorder
from trirail.telemetry.session_index import SessionIndex
from trirail.wire.links import Closed, PacketLink
from trirail.wire.messages import Level
from trirail.wire.packets import (
    Answer,
    ControlInput,
    Happened,
    Kind,
    RecorderSaid,
    Remark,
    Status,
    Unrecorded,
    Welcome,
    decode_answer,
    message,
)
from trirail.wire.records import last_cycle

GATHER = 0.14
"""How long to let packets gather before they are taken: to wake for each costs more than what is in it [s].

A killed recorder loses what it has not written: that much, and the batch that the loop holds. It is less than 0.2 s.
"""

NOT_FOR_OTHERS = 0o027
"""Least umask of what is recorded: files are written by their owner, read by the group, and by nobody else."""


class Intake:
    """Takes the loop's packets to the recorder and the black box, and tells the loop what it should know."""

    def __init__(self, config: Config, record: str | None, link: PacketLink, ready: Callable[[object], None]) -> None:
        self._link = link
        self._ready = ready
        self._cycle = 0
        self._told_unrecorded = ""
        self._loop_death = LoopDeath(config.period)
        path = Path(record) if record else None
        directory = Path(config.telemetry.directory)
        index = None if path else SessionIndex(directory)  # where somebody wants one file he finds it by himself
        self.recorder = recorder = Recorder(config, directory, path=path, index=index, warn=self._warn)
        folder = recorder.path.parent

        def box(name: str, reason: str) -> Recorder:
            return Recorder(config, folder, name=name, reason=reason, index=index, live=False)

        self._box = BlackBox(config.loop.rate_hz, box, self._warn)

    def on_packet(self, packet: bytes) -> None:
        """Take a packet."""
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
        """Write what has been taken; tell everyone where that fails, and once it does no more."""
        self.recorder.save()
        what, why = self.recorder.unrecorded  # its reason changes with every byte of the disk
        if what != self._told_unrecorded and self._send(Unrecorded(what and f"{what}: {why}")):
            self._told_unrecorded = what

    def loop_gone(self) -> None:
        """The loop has gone: where it has died, keep what it can no longer say."""
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
                standing = Standing(said.goal, said.target, said.override, said.fault)
                recorder.stands(standing)
                box.stands("stands", standing)
            case Welcome():
                recorder.bus_load(said.bus_load)
                box.stands("bus_load", said.bus_load)
                self._remark("info", f"recording to {recorder.path}")
                self._ready({"recording": str(recorder.path), "live": recorder.live_url})

    def _warn(self, words: str) -> None:
        """Say it in the service's log, and to everyone."""
        with contextlib.suppress(OSError):  # the log may be on the disk that takes no more
            print(f"trirail: recorder: {words}", file=sys.stderr, flush=True)  # noqa: T201 - the log
        self._remark("warning", words)

    def _remark(self, level: Level, words: str) -> None:
        """Have the loop tell everyone."""
        self._send(Remark(level, words))

    def _send(self, said: RecorderSaid) -> bool:
        """Send it to the loop; False where that takes no more now, or has gone and nobody is left to be told."""
        with contextlib.suppress(Closed):
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
    """Record until the loop has gone or the process is told to end; tell `measured` of gaps, if there are metrics."""
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
    except Closed:
        intake.loop_gone()
    finally:
        heart.rest()  # files take their time to be completed
        intake.close()
    return 0
