"""The simulated drives as a program of its own, on any python-can bus.

python tools/virtual_drives.py configs/sim.toml --interface unix --channel /tmp/can.sock
python tools/virtual_drives.py configs/vcan.toml --interface socketcan --channel vcan0
"""

from __future__ import annotations

import argparse
import signal
import sys
from pathlib import Path
from types import FrameType

import can

from drivers.config import Drives
from drivers.interface import NAMES
from drivers.simulated import SimulatedBus, simulated_bus
from drivers.unixbus import UnixBus
from service.config import load
from service.errors import TrirailError

_POLLS = 5
"""So many times a cycle the drives' own timers are looked at, if no frame comes."""


class Report:
    """One line on stdout for each change of a drive's power state."""

    def __init__(self, drives: Drives, bus: SimulatedBus) -> None:
        self._axes = list(zip(NAMES, drives.each, bus.drives, strict=True))
        self._said: dict[str, str] = {}

    def update(self) -> None:
        """Say what has changed."""
        for name, axis, drive in self._axes:
            state = str(drive.state)
            if self._said.get(name) != state:
                self._said[name] = state
                position = axis.direction * drive.servo.position / axis.counts_per_metre + axis.offset
                print(f"{name} {state}, {position * 1e3:.3f} mm", flush=True)


def bridge(wire: can.BusABC, drives: SimulatedBus, report: Report, poll: float) -> None:
    """Carry frames between a bus and the simulated drives, until interrupted; look at their timers each `poll` [s]."""
    while True:
        frame = wire.recv(poll)
        if frame is not None:
            drives.send(frame)
        while (answer := drives.recv(0.0)) is not None:
            wire.send(answer)
        report.update()


def main() -> int:
    """Run until SIGINT or SIGTERM."""
    arguments = argparse.ArgumentParser(description="Three CiA 402 drives, simulated, on a CAN bus.")
    arguments.add_argument("config", type=Path, help="configuration file with [can] and [drives]")
    arguments.add_argument("--interface", required=True, help='"unix" (listens), or a python-can interface')
    arguments.add_argument("--channel", required=True, help="path of the socket, or the interface's channel")
    options = arguments.parse_args()

    signal.signal(signal.SIGINT, _interrupt)
    signal.signal(signal.SIGTERM, _interrupt)
    try:
        config = load(options.config)
        with (
            open_bus(options.interface, options.channel, config.can.bitrate) as wire,
            simulated_bus(config.can, config.drives) as bus,
        ):
            bridge(wire, bus, Report(config.drives, bus), config.period / _POLLS)
    except KeyboardInterrupt:
        pass
    except (TrirailError, can.CanError) as error:
        print(f"virtual_drives: {error}", file=sys.stderr)
        return 1
    return 0


def open_bus(interface: str, channel: str, bitrate: int) -> can.BusABC:
    """The bus to be on; over a unix socket the drives are the end that listens."""
    if interface == "unix":
        return UnixBus(channel, listen=True)
    return can.Bus(channel=channel, interface=interface, bitrate=bitrate)


def _interrupt(_signal: int, _frame: FrameType | None) -> None:
    raise KeyboardInterrupt


if __name__ == "__main__":
    sys.exit(main())
