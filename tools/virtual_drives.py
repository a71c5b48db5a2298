"""Simulated drives as a separate program, on any python-can bus.

python tools/virtual_drives.py configs/sim.toml --interface unix --channel /tmp/can.sock
python tools/virtual_drives.py configs/vcan.toml --interface socketcan --channel vcan0 --faults faults.txt

Faults come from a file or the keyboard: `A silent for 0.5`, `with 0.01 C drop tpdo2`; `help` lists them.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import select
import signal
import sys
import time
from pathlib import Path
from types import FrameType

import can
import msgspec
from trirail.config import Config, load
from trirail.errors import TrirailError
from trirail_drivers.bus.unixbus import UnixBus
from trirail_drivers.config import Drives
from trirail_drivers.connection.opening import open_bus, simulated_bus
from trirail_drivers.interface import NAMES
from trirail_drivers.simulated import SimulatedBus
from trirail_drivers.simulated.faultlines import HELP, FaultSyntaxError

_POLLS = 5
"""Polls of the drives' own timers per cycle without frames."""


class Report:
    """Printer of one line on stdout for each change of a drive's power state."""

    def __init__(self, drives: Drives, bus: SimulatedBus) -> None:
        self._axes = list(zip(NAMES, drives.each, bus.drives, strict=True))
        self._said: dict[str, str] = {}

    def once(self, text: str) -> None:
        """Print a text, the first time only."""
        if text not in self._said:
            self._said[text] = text
            print_now(text)

    def update(self) -> None:
        """Print the changes of state."""
        for name, axis, drive in self._axes:
            state = str(drive.state)
            if self._said.get(name) != state:
                self._said[name] = state
                position = axis.direction * drive.servo.position / axis.counts_per_metre + axis.offset
                print_now(f"{name} {state}, {position * 1e3:.3f} mm")


class Console:
    """Non-blocking reader of typed lines."""

    def __init__(self, bus: SimulatedBus) -> None:
        self._faults = bus.faults
        self._typed = b""
        self._open = sys.stdin is not None

    def poll(self) -> None:
        """Execute the lines that have arrived since the last call."""
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
    """Carry frames between a bus and the simulated drives until interrupted; poll their timers every `poll` [s]."""
    while True:
        console.poll()
        try:
            frame = wire.recv(poll)
        except can.CanOperationError as error:  # a bus that is down: the watchdogs run, and it may recover
            report.once(f"cannot receive: {error}")
            frame = None
            time.sleep(poll)
        if frame is not None:
            with contextlib.suppress(can.CanOperationError):  # bus-off: no receiver
                drives.send(frame)
        while (answer := drives.recv(0.0)) is not None:
            if not answer.is_error_frame or _carries_error_frames(wire):
                try:
                    wire.send(answer)
                except can.CanOperationError as error:  # a full queue or a bus that is down: drives continue
                    report.once(f"cannot send: {error}")
        report.update()


def _carries_error_frames(wire: can.BusABC) -> bool:
    """Return whether others receive error frames as such; a real controller would send a data frame instead."""
    return isinstance(wire, UnixBus) or "vcan" in wire.channel_info or "virtual" in wire.channel_info.lower()


def main() -> int:
    """Run until SIGINT or SIGTERM."""
    arguments = argparse.ArgumentParser(description="Three CiA 402 drives, simulated, on a CAN bus.")
    arguments.add_argument("config", type=Path, help="configuration file with [can] and [drives]")
    arguments.add_argument("--interface", required=True, help='"unix" (listens), or a python-can interface')
    arguments.add_argument("--channel", required=True, help="path of the socket, or the interface's channel")
    arguments.add_argument("--faults", type=Path, help="file of faults, one a line")
    arguments.add_argument("--seed", type=int, default=0, help="what faults that come by chance begin with")
    options = arguments.parse_args()

    signal.signal(signal.SIGINT, _interrupt)
    signal.signal(signal.SIGTERM, _interrupt)
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
    """Return the bus of the drives, with the file's bitrate and options; on a unix socket, it is the listening end."""
    if interface == "unix":
        return UnixBus(channel, listen=True)
    section = msgspec.structs.replace(config.can, interface=interface, channel=channel)
    return open_bus(section, config.drives)


def print_now(text: str) -> None:
    """Print a line without buffering, also into a pipe."""
    print(text, flush=True)


def _interrupt(_signal: int, _frame: FrameType | None) -> None:
    raise KeyboardInterrupt


if __name__ == "__main__":
    sys.exit(main())
