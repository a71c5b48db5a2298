"""Intervals between SYNCs at a receiver, for trirail's loop and for python-canopen's periodic SYNC.

Both send on the same kind of bus between processes, with the same drives. The receiver is another program on this bus,
and uses the kernel's time of arrival. python-canopen is measured unchanged, and with the privileges of trirail's loop.
LinuxCNC's servo thread is only mentioned, since LinuxCNC measures it itself.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from bench_latency import listener
from bench_rig import QUANTILES, configured, drives, quantiles, rig, without_pause
from trirail_drivers.bus.unixbus import UnixBus
from trirail_drivers.cia402 import canopen_frames as layout

RATE = 1000
PRIORITY = 80


def measure(seconds: float) -> dict[str, Any]:
    """Listen to each program for `seconds`; return the deviations of the SYNC intervals from the period [µs]."""
    return {
        "rate_hz": RATE,
        "quantiles": QUANTILES,
        "deviation_us": {
            "trirail, moving": _trirail(seconds),
            "python-canopen": _canopen(seconds, real_time=False),
            "python-canopen, SCHED_FIFO": _canopen(seconds, real_time=True),
        },
        "linuxcnc": _linuxcnc(),
    }


def _trirail(seconds: float) -> list[float]:
    with rig(RATE) as made:
        without_pause(made.robot, 1.0)
        with listener(made.bus) as heard:
            without_pause(made.robot, seconds)
            return _deviations(heard.arrivals(layout.SYNC))


def _canopen(seconds: float, real_time: bool) -> list[float]:
    with tempfile.TemporaryDirectory(prefix="trirail-") as folder:
        config, _ = configured(Path(folder), RATE, own=False)
        path = f"{folder}/can"
        with drives(config, path), listener(path) as heard:
            command = [sys.executable, __file__, path, str(seconds), str(int(real_time))]
            subprocess.run(command, check=True)
            return _deviations(heard.arrivals(layout.SYNC))


def _deviations(arrivals: list[float]) -> list[float]:
    """Return the absolute deviations of the intervals from the period at QUANTILES [µs]."""
    if len(arrivals) < RATE // 10:
        raise SystemExit(f"only {len(arrivals)} SYNCs arrived")
    return quantiles(np.abs(np.diff(arrivals) - 1.0 / RATE) * 1e6)


def _linuxcnc() -> str:
    """Return a sentence that states whether LinuxCNC's servo thread can be compared on this machine."""
    if shutil.which("halrun") is None:
        return "not installed (Debian's package is linuxcnc-uspace): no servo thread to compare with"
    return "installed: run its latency-histogram beside this, it measures its servo thread itself"


def _send_sync(path: str, seconds: float, real_time: bool) -> None:
    """Let python-canopen send its periodic SYNC on the bus for `seconds`."""
    import canopen

    if real_time:
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    signal.signal(signal.SIGTERM, lambda *_: sys.exit())
    with UnixBus(path) as bus:
        network = canopen.Network(bus)
        network.sync.start(1.0 / RATE)
        time.sleep(seconds)
        network.sync.stop()  # type: ignore[no-untyped-call]


if __name__ == "__main__":
    _send_sync(sys.argv[1], float(sys.argv[2]), bool(int(sys.argv[3])))
