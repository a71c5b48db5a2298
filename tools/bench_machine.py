"""What the machine itself takes of a cycle: the same work hot, without a pause, and cold, once in a period after sleep.

Between two cycles others have the processor's caches, and a frame that is sent wakes whoever waits for it. What a cycle
costs at its rate is so many times what the same code costs in a loop of its own; no program takes that away.
"""

from __future__ import annotations

import contextlib
import gc
import json as json_format
import os
import socket
import time
from collections.abc import Iterator
from typing import Any

import numpy as np

QUANTILES = (50.0, 99.0)
FRAME = bytes(16)
PRIORITY = 70


def measure(period: float, cycles: int) -> dict[str, Any]:
    """Microseconds of some arithmetic, of a send that wakes its receiver and of one that does not, cold and hot."""
    with _receiver() as wire:
        gc.collect()
        gc.disable()
        try:
            cold, hot = _each(wire, period, cycles), _each(wire, 0.0, cycles)
        finally:
            gc.enable()
    columns = ("arithmetic", "send_that_wakes", "send_after_it")
    found = {
        name: {"cold": [float(v) for v in one], "hot": [float(v) for v in other]}
        for name, one, other in zip(columns, cold, hot, strict=True)
    }
    return {"period": period, "quantiles": QUANTILES, **found}


def _each(wire: socket.socket, period: float, cycles: int) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Quantiles of the three parts of a cycle [µs]."""
    rows, due = np.empty((cycles, 3)), time.perf_counter()
    for row in rows:
        due += period
        time.sleep(max(0.0, due - time.perf_counter()))
        began = time.perf_counter_ns()
        sum(range(200))
        reckoned = time.perf_counter_ns()
        wire.send(FRAME)
        woken = time.perf_counter_ns()
        wire.send(FRAME)
        row[:] = reckoned - began, woken - reckoned, time.perf_counter_ns() - woken
    return np.percentile(rows / 1000.0, QUANTILES, axis=0).T


@contextlib.contextmanager
def _receiver() -> Iterator[socket.socket]:
    """A socket whose other end a process of its own waits at, real-time and on the other processor where it may."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    processors = sorted(os.sched_getaffinity(0))
    pid = os.fork()
    if pid == 0:
        ours.close()
        _real_time(processors[0], PRIORITY)
        while theirs.recv(len(FRAME)):
            pass
        os._exit(0)
    theirs.close()
    _real_time(processors[-1], PRIORITY + 10)
    try:
        yield ours
    finally:
        ours.close()
        os.waitpid(pid, 0)


def _real_time(processor: int, priority: int) -> None:
    with contextlib.suppress(OSError):
        os.sched_setaffinity(0, {processor})
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))


def main(period: float, cycles: int, json: bool = False) -> None:
    """Print the measurements as a table, or as one JSON object."""
    found = measure(period, cycles)
    if json:
        print(json_format.dumps(found))
        return
    print(f"{f'every {period * 1e3:g} ms, p50 / p99 [µs]':32}{'cold':>16}{'hot':>16}{'ratio':>8}")
    for name in ("arithmetic", "send_that_wakes", "send_after_it"):
        cold, hot = found[name]["cold"], found[name]["hot"]
        told = [f"{p50:.1f} / {p99:.1f}" for p50, p99 in (cold, hot)]
        print(f"{name.replace('_', ' '):32}{told[0]:>16}{told[1]:>16}{cold[0] / hot[0]:8.1f}")
