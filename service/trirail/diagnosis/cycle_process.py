"""Process in which trirail.diagnosis.cycle_timing measures the service's cycle.

It runs the loop of the service, with the robot, protocol, rate, corrections and real-time rights of the configuration,
and holds the robot enabled. Another process replaces the drives by simulated ones, as in a service with simulated
drives; the configured bus is never used. All times are those of the records that the loop writes.
"""

from __future__ import annotations

import logging
import os
import signal
import sys
from collections.abc import Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final

import numpy as np
from msgspec import structs
from trirail_drivers.bus.capture import Capture
from trirail_drivers.connection.opening import connect
from trirail_drivers.connection.serving import exchange
from trirail_drivers.errors import DriveError
from trirail_drivers.interface import NAMES, DriveGroup

from trirail.config import Config
from trirail.diagnosis.cycle_timing import Cycles
from trirail.errors import ServiceError, TrirailError
from trirail.processes import compiling, realtime
from trirail.processes.heartbeats import Heartbeats
from trirail.processes.ports import Ports
from trirail.wire import links
from trirail.wire.links import Port
from trirail.wire.packets import CommandRequest, Kind, Refused, decode_answer, message
from trirail.wire.records import SIZE, Part, unpack
from trirail.wire.vocabulary import MODES, Command, Mode

PROGRESS_EVERY_S: Final = 0.25
"""Interval between two reports of progress [s]."""
MAX_COMMANDS: Final = 10
"""Maximum number of attempts to enable the robot or to reset a fault."""
MISSED_POSITIONS: Final = 1_000
MISSED_SYNCS: Final = 100_000
"""Settings with which stalls of the machine are counted, and do not end the measurement by a fault of the drives."""


class _HeldRobot:
    """Loop that holds the robot enabled, and the records of its newest cycles."""

    def __init__(self, config: Config, drives: DriveGroup, capture: Capture | None, folder: Path) -> None:
        # Imported here, because the first import compiles and must be reported.
        from trirail.processes.clock import Ticker
        from trirail.processes.loop import Loop

        ports = Ports(*(Port(links.listen(folder / name)) for name in Ports._fields))
        self._gateway, self._recorder = links.connect(folder / "gateway"), links.connect(folder / "recorder")
        self._rate_hz, self._period_ns, self._drives = config.loop.rate_hz, round(config.period * 1e9), drives
        self._loop = Loop(config, drives, ports, Heartbeats.create(), capture=capture)
        self._ticker = Ticker(self._period_ns, busy_wait_ns=config.loop.busy_wait_ns)
        self._batches: list[bytes] = []
        self._unanswered = 0

    def enable(self) -> None:
        """Run cycles until the robot holds its pose. Raises ServiceError if that is not possible."""
        self._loop.begin()
        commands, reason = 0, ""
        while self._newest_mode is not Mode.HOLDING:
            # The first cycles are late, since their memory is not in the caches, and may interrupt the power-up.
            if self._newest_mode in (Mode.DISABLED, Mode.FAULT):
                if (commands := commands + 1) > MAX_COMMANDS:
                    raise ServiceError(f"the robot with simulated drives could not be enabled: {reason}")
                name = Command.ENABLE if self._newest_mode is Mode.DISABLED else Command.RESET
                self._gateway.send(message(CommandRequest(commands, "", name)))
            self._batches.clear()
            while not self._batches:
                answers = [decode_answer(packet[1:]) for packet in self._turn() if packet[0] == Kind.MESSAGE]
                reason = next((each.message for each in answers if isinstance(each, Refused)), reason)
        self._unanswered = self._lost

    def run_cycles(self, number: int) -> None:
        """Run cycles until `number` of them have been recorded since the robot was enabled, or until a fault."""
        while self._recorded < number and (self._newest_mode is not Mode.FAULT or not self._recorded):
            self._turn()

    def times(self, number: int) -> Cycles:
        """Return the times of the first `number` cycles, or of those up to a fault."""
        before = len(self._batches[0]) // SIZE - 1
        rows = unpack(b"".join(self._batches))[before : before + number + 1]
        faults = np.flatnonzero(rows["mode"][1:] == MODES.index(Mode.FAULT))
        rows = rows[: faults[0] + 2 if len(faults) else None]
        parts = rows["parts_ns"][1:].astype(np.int64)
        return Cycles(
            lateness=rows["lateness_ns"][1:] + np.diff(rows["overruns"]) * self._period_ns,
            work=parts[:, : Part.WRITE + 1].sum(axis=1),
            to_record=parts[:, : Part.RECORD + 1].sum(axis=1),
            period=self._period_ns,
            unanswered=self._lost - self._unanswered,
            fault=self._loop.control.fault or "",
        )

    @property
    def _newest_mode(self) -> Mode | None:
        """Mode in the newest record; None before the first one."""
        return MODES[unpack(self._batches[-1])["mode"][-1]] if self._batches else None

    @property
    def _recorded(self) -> int:
        """Number of records since the batch in which the robot was first enabled."""
        return sum(map(len, self._batches[1:])) // SIZE

    @property
    def _lost(self) -> int:
        return sum(each.feedback_lost for each in self._drives.counts)

    def _turn(self) -> list[bytes]:
        """Run the next cycles, keep their records, and return the packets for the gateway."""
        self._loop.turn(self._ticker)
        self._batches += [packet[1:] for packet in self._recorder.packets() if packet[0] == Kind.RECORDS]
        return list(self._gateway.packets())


def _tolerant(config: Config) -> Config:
    """Return a configuration whose simulated drives need no homing, and tolerate late cycles and lost positions."""
    each = {name: structs.replace(drive, homing=None) for name, drive in zip(NAMES, config.drives.each, strict=True)}
    drives = structs.replace(config.drives, missed_positions=MISSED_POSITIONS, **each)
    simulated = structs.replace(config.can.simulated, missed_syncs=MISSED_SYNCS)
    return structs.replace(config, drives=drives, can=structs.replace(config.can, simulated=simulated))


def _measure(config: Config, folder: Path, seconds: float) -> Iterator[float | Cycles]:
    """Yield the fraction of the cycles that has been completed, and finally their times."""
    progress = compiling.Progress(lambda words: print(f"trirail: {words}", file=sys.stderr, flush=True), 0.0)  # noqa: T201
    compiling.compile_all(progress.begin)
    config = _tolerant(config)
    capture = Capture() if config.telemetry.capture_can else None
    try:
        drives = _connect_simulated(config, folder / "drives", capture)
        drives.configure(config.period, config.limits.slider.fastest)
    except DriveError as error:
        raise ServiceError(f"simulated drives: {error}") from error
    realtime.acquire(config.loop)
    robot = _HeldRobot(config, drives, capture, folder)
    robot.enable()
    number, step = (max(1, round(each * config.loop.rate_hz)) for each in (seconds, PROGRESS_EVERY_S))
    for begun in range(0, number, step):
        end = min(begun + step, number)
        robot.run_cycles(end)
        yield end / number
    yield robot.times(number)


def _connect_simulated(config: Config, path: Path, capture: Capture | None) -> DriveGroup:
    """Fork the process of the simulated drives, which ends with this process, and connect to the drives."""
    with links.listen(path) as listening:
        if os.fork() == 0:
            try:
                realtime.die_with_parent(signal.SIGKILL)
                realtime.stay_beside(config.loop, realtime.DRIVES_BELOW)
                exchange(listening.accept()[0], config.can, config.drives, lambda: None)
            finally:
                os._exit(0)
        section = structs.replace(config.can, interface="unix", channel=str(path))
        return connect(section, config.drives, capture=capture, io=config.drive_io)


def main(connection: Connection[Any, Any]) -> None:
    """Measure the cycle for the process at the other end, and send it the progress and the times, or the reason."""
    realtime.die_with_parent(signal.SIGKILL)
    logging.disable()  # the drivers log that they wait for drives
    try:
        for each in _measure(*connection.recv()):
            connection.send(each)
    except (TrirailError, OSError) as error:
        connection.send(str(error))
    os._exit(0)  # the thread beside the loop never ends


if __name__ == "__main__":
    main(Connection(int(sys.argv[1])))
