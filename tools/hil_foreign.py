"""Third-party drive on a bus in real time: python-canopen's LocalNode with the dictionary of a real drive.

python tools/hil_foreign.py CONFIG --interface socketcan --channel vcan0    drive C of that configuration

tests/drivers/foreign.py assembles the drive from parts outside this project: canopen answers SDO requests, python-can
transmits the frames, and the servo uses only its own units. tools/hil.py runs this program in its emulated machine.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import can
from trirail.config import load

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from drivers.foreign import DISABLED, ENABLED, FAULT, ON, QUICK_STOP, REACTION, READY, ForeignDrive, Truth
from hil_second import COUNTS, MAKE, REVOLUTIONS
from interruption import interrupt_on_signals
from virtual_drives import bus_to_be_on

STEP = 0.005
"""Interval at which the drive's timers are polled while no frame arrives [s]."""
NAMES = {
    DISABLED: "switch on disabled",
    READY: "ready to switch on",
    ON: "switched on",
    ENABLED: "operation enabled",
    QUICK_STOP: "quick stop active",
    REACTION: "fault reaction active",
    FAULT: "fault",
}


class LastingBus(can.BusABC):
    """Bus that may be down. While it is down, no frame arrives, sent frames are lost, and only the watchdogs act."""

    def __init__(self, bus: can.BusABC) -> None:
        self._bus = bus
        self._can_protocol = bus.protocol
        self.channel_info = bus.channel_info
        super().__init__(channel=self.channel_info)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send a frame, or drop it if the bus is down."""
        with suppress(can.CanOperationError):
            self._bus.send(msg, timeout)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """Return the next frame, or None if no frame arrives in time."""
        try:
            return self._bus.recv(timeout)
        except can.CanOperationError:
            time.sleep(STEP)
            return None

    def shutdown(self) -> None:
        """Close the underlying bus."""
        super().shutdown()
        self._bus.shutdown()


def serve(bus: can.BusABC, node: int, say: Callable[[str], None], going: Callable[[], bool]) -> None:
    """Run a drive on a bus while `going` returns True.

    Print a line for each change of the drive's state, with the position of the slider, and for each change of the
    digital outputs, with the bits of 60FEh:01, the number of the SYNC, and the wall-clock time [s].
    """
    rpm = 60.0 * REVOLUTIONS
    drive = ForeignDrive(MAKE, node, bus, time.monotonic, Truth(COUNTS, rpm, rpm))
    reported = None
    while going():
        drive.pump(STEP)
        if drive.state != reported:
            reported = drive.state
            say(f"C {NAMES[reported]}, {drive.servo.position * 1e3:.3f} mm")
        for sync, bits in drive.switched:
            say(f"outputs {bits:08X} at SYNC {sync}, {time.time():.3f}")
        drive.switched.clear()


def main() -> int:
    """Run until SIGINT or SIGTERM."""
    arguments = argparse.ArgumentParser(description="A CiA 402 drive that others made, on a CAN bus.")
    arguments.add_argument("config", type=Path, help="configuration file with [drives.C]")
    arguments.add_argument("--interface", required=True, help="a python-can interface")
    arguments.add_argument("--channel", required=True, help="the interface's channel")
    options = arguments.parse_args()
    interrupt_on_signals()
    config = load(options.config)
    with suppress(KeyboardInterrupt), bus_to_be_on(options.interface, options.channel, config) as bus:
        serve(LastingBus(bus), config.drives.C.node, lambda line: print(line, flush=True), lambda: True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
