"""The recorder's price: its share of a processor and of the disk, while a service keeps a robot moving.

The service runs on simulated drives, as a user runs it: first with a live view that nobody watches, then with somebody
connected to it. What is printed is what the recorder's process takes, beside the limits that it is to keep, and per
cycle of the loop in the same seconds.
"""

from __future__ import annotations

import os
import socket
import tempfile
import time
from pathlib import Path

from bench_rig import without_pause
from trirail.client import own_service
from trirail.client.client import Robot
from trirail.config import load
from trirail.processes.interpreter import child
from trirail.telemetry.sinks import HOST, free_port

CPU_LIMIT = 0.03
"""Share of one processor."""
DISK_LIMIT = 0.5e6
"""Bytes a second."""
_TICKS = os.sysconf("SC_CLK_TCK")


def measure(seconds: float) -> dict[str, dict[str, float]]:
    """Run a service for so many seconds, moving; return what its recorder took, unwatched and watched."""
    port = free_port()
    with tempfile.TemporaryDirectory(prefix="trirail-") as folder:
        config, locator = own_service.private(Path(folder), port)
        rate = load(config).loop.rate_hz
        recording = Path(folder) / "bench.rrd"
        with own_service.service(config, recording) as service, Robot("demo", locator, user="bench") as robot:
            recorder, loop = (child(service.pid, name) for name in ("recorder", "loop"))

            def taken() -> dict[str, float]:
                without_pause(robot, 3.0)  # until all that happens once has happened
                before = _state(recorder, loop, recording, robot)
                without_pause(robot, seconds / 2.0)
                after = _state(recorder, loop, recording, robot)
                return _rates([b - a for a, b in zip(before, after, strict=True)], rate)

            robot.enable()
            unwatched = taken()
            with socket.create_connection((HOST, port)):
                watched = taken()
            robot.disable()
    return {"unwatched": unwatched, "watched": watched}


def _rates(taken: list[float], rate: int) -> dict[str, float]:
    spent, cpu, loop_cpu, written, cycles = taken
    return {
        "seconds": spent,
        "cycles": cycles,
        "rate": cycles / spent,
        "rate_to_wanted": cycles / spent / rate,
        "cpu": cpu / spent,
        "cpu_to_limit": cpu / spent / CPU_LIMIT,
        "cpu_per_cycle_us": cpu / cycles * 1e6,
        "cpu_to_loop": cpu / loop_cpu,
        "bytes_per_second": written / spent,
        "bytes_per_cycle": written / cycles,
        # A busy machine's loop misses ticks: the limit is for the full rate.
        "disk_to_limit": written / cycles * rate / DISK_LIMIT,
    }


def _state(recorder: int, loop: int, recording: Path, robot: Robot) -> tuple[float, ...]:
    """Return time, processor time of recorder and loop [s], bytes and cycles so far."""
    cycles = robot.state().loop.cycles
    return time.monotonic(), _cpu(recorder), _cpu(loop), float(recording.stat().st_size), float(cycles)


def _cpu(process: int) -> float:
    """Return the processor time that a process has taken, in the kernel too [s] (proc(5), stat)."""
    fields = Path(f"/proc/{process}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / _TICKS
