"""Cost of a start: time and processor time until the service answers, and the memory of each process at rest."""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path
from typing import Any

from trirail.client import own_service
from trirail.processes.operating_system import processes
from trirail.telemetry.sinks import free_port

TICK = os.sysconf("SC_CLK_TCK")
START_DURATION_S = 3.0
"""Time after the service has first answered, until all work of the start is done [s]."""
WATCHED = 5.0
"""Duration of the observation of a service at rest [s]."""


def measure() -> dict[str, Any]:
    """Start a service on simulated drives twice, and measure the second start, which compiles nothing."""
    with tempfile.TemporaryDirectory(prefix="trirail-") as folder:
        for place in (Path(folder, "first"), Path(folder, "second")):
            place.mkdir()
            results = _start(place)
    return results


def _start(folder: Path) -> dict[str, Any]:
    config, _ = own_service.private(folder, free_port())
    began = time.monotonic()
    with own_service.service(config, folder / "bench.rrd") as service:
        up = time.monotonic() - began
        pids = processes(service.pid)
        until_up = sum(_processor(pid) for pid in pids.values())
        time.sleep(START_DURATION_S)
        before = {name: _processor(pid) for name, pid in pids.items()}
        time.sleep(WATCHED)
        each = {
            name: {"megabytes": _memory(pid), "share": (_processor(pid) - before[name]) / WATCHED}
            for name, pid in pids.items()
        }
    total = sum(one["megabytes"] for one in each.values())
    return {"up": up, "processor": until_up, "processes": each, "megabytes": total}


def _processor(pid: int) -> float:
    """Return the processor time of a process and of its finished children [s]."""
    spent = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[11:15]
    return sum(map(int, spent)) / TICK


def _memory(pid: int) -> float:
    """Return the memory of a process, including its share of memory that several processes use (PSS) [1e6 bytes]."""
    lines = Path(f"/proc/{pid}/smaps_rollup").read_text(encoding="utf-8").splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("Pss:")) * 1024e-6
