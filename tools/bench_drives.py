"""Simulated drives on a bus between processes, to which other programs can listen to measure the loop's frames.

python tools/bench_drives.py CONFIG PATH PROCESSOR [TIMES]

The drives run on PROCESSOR, which must not be the loop's. Without TIMES, they sleep until a frame arrives, and have
real-time priority if permitted. With TIMES, they poll for frames all the time from the first SYNC on, as the hardware
of a CAN controller does, and they write the times at which SYNCs arrived to the file TIMES at SIGTERM, as 64-bit floats
in seconds. If they slept, the times would include their own wake-up, which takes longer than all that a sender does.
The kernel does not stamp a frame between processes.

tools/virtual_drives.py is the version for users: it accepts faults and reports the drives' states.
"""

from __future__ import annotations

import contextlib
import gc
import os
import select
import signal
import sys
import time
from array import array
from functools import partial
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
MAX_POLLS = 5_000
"""Number of polls without a frame after which the drives' timers are polled; a few milliseconds."""


def main() -> None:
    """Run the drives until SIGTERM."""
    config = load(Path(sys.argv[1]))
    signal.signal(signal.SIGTERM, _end)
    times = Path(sys.argv[4]) if len(sys.argv) > 4 else None
    with contextlib.suppress(OSError):
        os.sched_setaffinity(0, {int(sys.argv[3])})
        if times is None:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
        else:
            os.nice(-20)  # a real-time process that never sleeps would be throttled
    with UnixBus(sys.argv[2], listen=True) as wire, simulated_bus(config.can, config.drives) as drives:
        gc.collect()
        gc.freeze()
        gc.disable()
        syncs, polled = array("d"), select.poll()
        polled.register(wire.fileno(), select.POLLIN)
        polls = times is not None and (os.cpu_count() or 1) > 1
        sleep, busy_poll = partial(polled.poll, POLL * 1000.0), partial(_busy_poll, polled)
        print("ready", flush=True)
        try:
            while True:
                # Before the first SYNC, the kernel needs this processor too: to load a sender took two minutes.
                (busy_poll if polls and syncs else sleep)()
                arrived = time.monotonic()
                while (frame := wire.recv(0.0)) is not None:
                    if frame.arbitration_id == SYNC:
                        syncs.append(arrived)
                    drives.send(frame)
                    arrived = time.monotonic()
                while (answer := drives.recv(0.0)) is not None:
                    wire.send(answer)
        finally:
            if times is not None:
                times.write_bytes(syncs.tobytes())


def _busy_poll(polled: select.poll) -> None:
    """Poll for a frame without sleeping, at most MAX_POLLS times."""
    for _ in range(MAX_POLLS):
        if polled.poll(0):
            return


def _end(_signal: int, _frame: FrameType | None) -> None:
    raise SystemExit


if __name__ == "__main__":
    main()
