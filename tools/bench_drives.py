"""Simulated drives on a bus between processes, to which other programs can listen to measure the loop's frames.

python tools/bench_drives.py CONFIG PATH [TIMES]    real-time if permitted, away from the loop's processor

At SIGTERM, the times at which SYNCs arrived are written to the file TIMES, as 64-bit floats in seconds. The drives note
them because they have real-time priority; the kernel stamps a frame between processes only when it is read.

tools/virtual_drives.py is the version for users: it accepts faults and reports the drives' states.
"""

from __future__ import annotations

import contextlib
import gc
import os
import signal
import sys
import time
from array import array
from pathlib import Path
from types import FrameType

from trirail.config import load
from trirail_drivers.bus.unixbus import UnixBus
from trirail_drivers.cia402.canopen_frames import SYNC
from trirail_drivers.connection.opening import simulated_bus

PRIORITY = 75
"""Priority for SCHED_FIFO: below the loop's 80 and above the planner's 70, which plans on the same processor. With the
planner's own priority, frames waited for the planner: 700 µs at each goal."""
POLL = 0.01
"""Interval at which the drives' timers are polled while no frame arrives [s]."""


def main() -> None:
    """Run the drives until SIGTERM."""
    config = load(Path(sys.argv[1]))
    signal.signal(signal.SIGTERM, _end)
    with contextlib.suppress(OSError):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    with UnixBus(sys.argv[2], listen=True) as wire, simulated_bus(config.can, config.drives) as drives:
        gc.collect()
        gc.freeze()
        gc.disable()
        syncs = array("d")
        print("ready", flush=True)
        try:
            while True:
                frame = wire.recv(POLL)
                if frame is not None:
                    if frame.arbitration_id == SYNC:
                        syncs.append(time.monotonic())
                    drives.send(frame)
                while (answer := drives.recv(0.0)) is not None:
                    wire.send(answer)
        finally:
            if len(sys.argv) > 3:
                Path(sys.argv[3]).write_bytes(syncs.tobytes())


def _end(_signal: int, _frame: FrameType | None) -> None:
    raise SystemExit


if __name__ == "__main__":
    main()
