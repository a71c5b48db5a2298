"""Simulated drives as a separate program, on any python-can bus.

python tools/virtual_drives.py configs/sim.toml --interface unix --channel /tmp/can.sock
python tools/virtual_drives.py configs/vcan.toml --interface socketcan --channel vcan0 --faults faults.txt

Faults are read from a file or from the keyboard, such as `A silent for 0.5` or `with 0.01 C drop tpdo2`. `help` lists
all faults.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import select
import sys
import time
from pathlib import Path

import can
import msgspec
from interruption import interrupt_on_signals
from trirail.config import Config, load
from trirail.errors import TrirailError
from trirail_drivers.bus.unixbus import UnixBus
from trirail_drivers.config import Drives
from trirail_drivers.connection.opening import open_bus, simulated_bus
from trirail_drivers.interface import NAMES
from trirail_drivers.simulated import SimulatedBus
from trirail_drivers.simulated.faultlines import HELP, FaultSyntaxError

_POLLS = 5
"""Number of times per cycle that the drives' timers are polled while no frame arrives."""


class Report:
    """Printer of a line to standard output for each change of a drive's state."""

    def __init__(self, drives: Drives, bus: SimulatedBus) -> None:
        self._axes = list(zip(NAMES, drives.each, bus.drives, strict=True))
        self._said: dict[str, str] = {}

    def once(self, text: str) -> None:
        """Print a text, unless it has been printed before."""
        if text not in self._said:
            self._said[text] = text
            print_now(text)

    def update(self) -> None:
        """Print a line for each drive whose state has changed, with the position of its slider."""
        for name, axis, drive in self._axes:
            state = str(drive.state)
            if self._said.get(name) != state:
                self._said[name] = state
                position = axis.direction * drive.servo.position / axis.counts_per_metre + axis.offset
                print_now(f"{name} {state}, {position * 1e3:.3f} mm")


class Console:
    """Reader of the commands and faults that are typed, one on a line. It never waits."""

    def __init__(self, bus: SimulatedBus) -> None:
        self._faults = bus.faults
        self._typed = b""
        self._open = sys.stdin is not None

    def poll(self) -> None:
        """Execute the lines that have been typed since the last call."""
        if not self._open or not select.select([sys.stdin], [], [], 0.0)[0]:
            return
        chunk = os.read(sys.stdin.fileno(), 4096)
        self._open = bool(chunk)
        *lines, self._typed = (self._typed + chunk).split(b"\n")
        for line in lines:
            self._obey(line.decode(errors="replace").strip())

    def _obey(self, line: str) -> None:
        match line:
            case "":
                return
            case "help":
                print_now(HELP)
            case "list":
                print_now("\n".join(self._faults.lines()) or "no faults")
            case "clear":
                self._faults.clear()
                print_now("no faults")
            case _:
                try:
                    self._faults.add(line)
                except FaultSyntaxError as error:
                    print_now(f"{error} (help lists all)")


def bridge(wire: can.BusABC, drives: SimulatedBus, report: Report, console: Console, poll: float) -> None:
    """Pass frames between a bus and the simulated drives until interrupted; poll their timers every `poll` [s]."""
    while True:
        console.poll()
        try:
            frame = wire.recv(poll)
        except can.CanOperationError as error:  # the bus is down, but may recover; the watchdogs run
            report.once(f"cannot receive: {error}")
            frame = None
            time.sleep(poll)
        if frame is not None:
            with contextlib.suppress(can.CanOperationError):  # bus-off: nobody receives the frame
                drives.send(frame)
        while (answer := drives.recv(0.0)) is not None:
            if not answer.is_error_frame or _carries_error_frames(wire):
                try:
                    wire.send(answer)
                except can.CanOperationError as error:  # the queue is full or the bus is down
                    report.once(f"cannot send: {error}")
        report.update()


def _carries_error_frames(wire: can.BusABC) -> bool:
    """Return whether a bus transmits error frames to other nodes; a real controller would send a data frame instead."""
    return isinstance(wire, UnixBus) or "vcan" in wire.channel_info or "virtual" in wire.channel_info.lower()


def main() -> int:
    """Run the drives until SIGINT or SIGTERM; return the exit code."""
    arguments = argparse.ArgumentParser(description="Three CiA 402 drives, simulated, on a CAN bus.")
    arguments.add_argument("config", type=Path, help="configuration file with [can] and [drives]")
    arguments.add_argument("--interface", required=True, help='"unix" (listens), or a python-can interface')
    arguments.add_argument("--channel", required=True, help="path of the socket, or the interface's channel")
    arguments.add_argument("--faults", type=Path, help="file of faults, one a line")
    arguments.add_argument("--seed", type=int, default=0, help="what faults that come by chance begin with")
    options = arguments.parse_args()

    interrupt_on_signals()
    try:
        config = load(options.config)
        with (
            bus_to_be_on(options.interface, options.channel, config) as wire,
            simulated_bus(config.can, config.drives) as bus,
        ):
            bus.faults.announce = print_now
            bus.faults.seed(options.seed)
            if options.faults:
                bus.faults.load(options.faults)
            bridge(wire, bus, Report(config.drives, bus), Console(bus), config.period / _POLLS)
    except KeyboardInterrupt:
        pass
    except (TrirailError, can.CanError) as error:
        print(f"virtual_drives: {error}", file=sys.stderr)
        return 1
    return 0


def bus_to_be_on(interface: str, channel: str, config: Config) -> can.BusABC:
    """Open the bus of the drives with the configured bit rate and options; for "unix", open the listening end."""
    if interface == "unix":
        return UnixBus(channel, listen=True, fd=config.can.fd)
    section = msgspec.structs.replace(config.can, interface=interface, channel=channel)
    return open_bus(section, config.drives)


def print_now(text: str) -> None:
    """Print a line immediately, even if standard output is a pipe."""
    print(text, flush=True)


if __name__ == "__main__":
    sys.exit(main())
