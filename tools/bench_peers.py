"""Intervals of SYNC at the drives: trirail's loop, python-canopen's SYNC, LinuxCNC's servo thread, and the machine.

trirail and python-canopen send over the same bus between processes to the same drives, which note when each SYNC
arrives. The drives have a processor for themselves, on which they poll for frames all the time, since their own wake-up
would hide the deviations. A bare compiled loop, which sleeps until each deadline and only sends SYNC and setpoints,
shows what a wake-up costs. trirail wakes up earlier (`loop.busy_wait`). python-canopen runs unchanged, with the loop's
privileges, and with setpoints. LinuxCNC's servo thread drives no drives, so its intervals are those of its own clock.
The machine's own lateness is measured before and after them, with the same priority on the same processor.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import bare_loop
import bench_linuxcnc
import numpy as np
from bench_beside import Beside
from bench_rig import PROCESSORS, QUANTILES, configured, drives, quantiles, rig, without_pause
from trirail.diagnosis.bus_timing import BareBus
from trirail.processes.clock import Ticker
from trirail_drivers.bus.frames import Frame
from trirail_drivers.bus.unixbus import UnixBus
from trirail_drivers.cia402 import canopen_frames as layout

RATE = 1000
PRIORITY = 80
NODES = (1, 2, 3)


def measure(seconds: float) -> dict[str, Any]:
    """Listen to each for `seconds`; return the deviations of SYNC's interval from its period [µs].

    `machine_us` is the machine's own share: the deviation of a wake-up's lateness from its median, in runs before and
    after the others. `ratio` compares trirail's deviation with the larger of the two.
    """
    with _away_from_the_drives():
        before = _machine(seconds)
        deviations = {
            "trirail, moving": _trirail(seconds),
            "a bare compiled loop": _sent(seconds, "bare"),
            "python-canopen": _sent(seconds, "its own thread"),
            "python-canopen, SCHED_FIFO": _sent(seconds, "real time"),
            "python-canopen, SCHED_FIFO, with setpoints": _sent(seconds, "setpoints"),
        }
        linuxcnc = _linuxcnc(seconds)
        if not isinstance(linuxcnc, str):
            deviations["LinuxCNC's servo thread, without drives"] = linuxcnc
        after = _machine(seconds)
    machine = [max(pair) for pair in zip(before, after, strict=True)]
    return {
        "rate_hz": RATE,
        "quantiles": QUANTILES,
        "deviation_us": deviations,
        "machine_us": {"before": before, "after": after},
        "ratio": _ratios(deviations["trirail, moving"], machine),
        "ratio_to_bare": _ratios(deviations["trirail, moving"], deviations["a bare compiled loop"]),
        "linuxcnc": linuxcnc if isinstance(linuxcnc, str) else "",
    }


@contextlib.contextmanager
def _away_from_the_drives() -> Iterator[None]:
    """Keep this process, and the processes that it starts, off the drives' processor, if there is another one."""
    others = set(PROCESSORS[1:]) or set(PROCESSORS)
    os.sched_setaffinity(0, others)
    try:
        yield
    finally:
        os.sched_setaffinity(0, PROCESSORS)


def _ratios(ours: list[float], others: list[float]) -> list[float]:
    return [our / other for our, other in zip(ours, others, strict=True)]


def _machine(seconds: float) -> list[float]:
    """Return the deviations of the lateness of wake-ups from their median at QUANTILES [µs]."""
    with tempfile.TemporaryDirectory(prefix="trirail-") as folder:
        late = Beside(seconds, 1_000_000 // RATE, PRIORITY, Path(folder, "lateness.json")).lateness()
    return [max(1.0, value) for value in quantiles(np.abs(late - np.median(late)))]


def _trirail(seconds: float) -> list[float]:
    with tempfile.TemporaryDirectory(prefix="trirail-") as folder:
        times = Path(folder, "syncs")
        with rig(RATE, times=times) as made:
            without_pause(made.robot, 1.0)
            began = time.monotonic()
            without_pause(made.robot, seconds)
            ended = time.monotonic()
        return _deviations([each for each in _arrivals(times) if began < each < ended])


def _sent(seconds: float, way: str) -> list[float]:
    """Return the deviations of SYNCs that a program without a robot sends; see `_send_sync`."""
    with tempfile.TemporaryDirectory(prefix="trirail-") as folder:
        config, _ = configured(Path(folder), RATE, own=False)
        path, times = f"{folder}/can", Path(folder, "syncs")
        with drives(config, path, times):
            subprocess.run([sys.executable, __file__, path, str(seconds), way], check=True)
        return _deviations(_arrivals(times)[1:])  # the drives sleep until the first


def _arrivals(times: Path) -> list[float]:
    """Return the times at which SYNCs arrived at the drives [s]."""
    arrivals: list[float] = np.frombuffer(times.read_bytes()).tolist()
    return arrivals


def _deviations(arrivals: list[float]) -> list[float]:
    """Return the absolute deviations of the intervals from the period at QUANTILES [µs]."""
    if len(arrivals) < RATE // 10:
        raise SystemExit(f"only {len(arrivals)} SYNCs arrived")
    return quantiles(np.abs(np.diff(arrivals) - 1.0 / RATE) * 1e6)


def _linuxcnc(seconds: float) -> list[float] | str:
    """Return the deviations of LinuxCNC's servo thread at QUANTILES [µs], or why there are none."""
    if not bench_linuxcnc.INSTALLED:
        return "not installed (Debian's package is linuxcnc-uspace)"
    try:
        measured = bench_linuxcnc.intervals(seconds, RATE, PRIORITY)
    except (OSError, RuntimeError, subprocess.TimeoutExpired) as error:
        return str(error)
    return quantiles(np.abs(measured - 1.0 / RATE) * 1e6)


def _send_sync(path: str, seconds: float, way: str) -> None:
    """Send SYNC on the bus for `seconds`.

    `way` is "its own thread" for python-canopen's periodic SYNC; "real time" for the same with the loop's priority; or
    "setpoints" for SYNC and three setpoints from a loop with that priority, which sleeps to absolute deadlines. "bare"
    is that loop in compiled code, without python-canopen.
    """
    import canopen

    if way == "bare":
        bare_loop.prepare()
    if way != "its own thread":
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    signal.signal(signal.SIGTERM, lambda *_: sys.exit())
    with UnixBus(path) as bus:
        if way == "bare":
            _run_bare(bus, seconds)
            return
        network = canopen.Network(bus)
        if way == "setpoints":
            setpoint, ticker, end = (
                layout.SETPOINT.pack(0, 0),
                Ticker(1_000_000_000 // RATE),
                time.monotonic() + seconds,
            )
            while time.monotonic() < end:
                ticker.wait()
                network.sync.transmit()
                for node in NODES:
                    network.send_message(layout.RPDO2 + node, setpoint)
        else:
            network.sync.start(1.0 / RATE)
            time.sleep(seconds)
            network.sync.stop()  # type: ignore[no-untyped-call]


def _run_bare(bus: UnixBus, seconds: float) -> None:
    """Send SYNC and three setpoints in the compiled loop of trirail.diagnosis.bus_timing."""
    if bus.carrier is None:
        raise SystemExit("the drives have closed the bus")
    setpoints = [Frame(layout.RPDO2 + node, bytes(8)) for node in NODES]
    unused = np.zeros(max(1, round(seconds * RATE)), np.int64)
    BareBus(bus.carrier.fileno(), Frame(layout.SYNC), setpoints).exchange(1_000_000_000 // RATE, unused, unused.copy())


if __name__ == "__main__":
    _send_sync(sys.argv[1], float(sys.argv[2]), sys.argv[3])
