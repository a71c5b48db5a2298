"""A drive that others made, on a bus and in real time: python-canopen's LocalNode over the dictionary of a real drive.

python tools/hil_foreign.py CONFIG --interface socketcan --channel vcan0    is drive C of that configuration

What it is made of stands in tests/drivers/foreign.py, and is none of this project's: canopen serves SDO, python-can
carries the frames, and its servo believes only its own units. tools/hil.py has it in its machine.
"""

from __future__ import annotations

import argparse
import signal
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import FrameType

import can
from trirail.config import load

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from drivers.foreign import DISABLED, ENABLED, FAULT, ON, QUICK_STOP, REACTION, READY, ForeignDrive, Truth
from hil_second import COUNTS, MAKE, REVOLUTIONS
from virtual_drives import bus_to_be_on

STEP = 0.005
"""How often it looks at its own timers, if no frame comes [s]."""
NAMES = {
    DISABLED: "switch on disabled",
    READY: "ready to switch on",
    ON: "switched on",
    ENABLED: "operation enabled",
    QUICK_STOP: "quick stop active",
    REACTION: "fault reaction active",
    FAULT: "fault",
}


def serve(bus: can.BusABC, node: int, say: Callable[[str], None], going: Callable[[], bool]) -> None:
    """Be a drive on a bus for as long as `going`; say each change of its state, with where its slider is."""
    rpm = 60.0 * REVOLUTIONS
    drive = ForeignDrive(MAKE, node, bus, time.monotonic, Truth(COUNTS, rpm, rpm))
    said = None
    while going():
        drive.pump(STEP)
        if drive.state != said:
            said = drive.state
            say(f"C {NAMES[said]}, {drive.servo.position * 1e3:.3f} mm")


def main() -> int:
    """Run until SIGINT or SIGTERM."""
    arguments = argparse.ArgumentParser(description="A CiA 402 drive that others made, on a CAN bus.")
    arguments.add_argument("config", type=Path, help="configuration file with [drives.C]")
    arguments.add_argument("--interface", required=True, help="a python-can interface")
    arguments.add_argument("--channel", required=True, help="the interface's channel")
    options = arguments.parse_args()
    signal.signal(signal.SIGTERM, _interrupt)
    config = load(options.config)
    with suppress(KeyboardInterrupt), bus_to_be_on(options.interface, options.channel, config) as bus:
        serve(bus, config.drives.C.node, lambda line: print(line, flush=True), lambda: True)
    return 0


def _interrupt(_signal: int, _frame: FrameType | None) -> None:
    raise KeyboardInterrupt


if __name__ == "__main__":
    sys.exit(main())
