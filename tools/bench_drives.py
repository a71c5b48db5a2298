"""Simulated drives on a bus between processes, to which other programs can listen to measure the loop's frames.

python tools/bench_drives.py CONFIG PATH        real-time if permitted, on another processor than the loop

tools/virtual_drives.py is the version for users: it accepts faults and reports the drives' states.
"""

from __future__ import annotations

import contextlib
import gc
import os
import signal
import sys
from pathlib import Path
from types import FrameType

from trirail.config import load
from trirail_drivers.bus.unixbus import UnixBus
from trirail_drivers.connection.opening import simulated_bus

PRIORITY = 70
"""Priority for SCHED_FIFO, below the loop's priority of 80."""
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
        print("ready", flush=True)
        while True:
            frame = wire.recv(POLL)
            if frame is not None:
                drives.send(frame)
            while (answer := drives.recv(0.0)) is not None:
                wire.send(answer)


def _end(_signal: int, _frame: FrameType | None) -> None:
    raise SystemExit


if __name__ == "__main__":
    main()
