"""Real-time performance of the loop in a complete service: cost of a cycle, lateness and missed ticks.

The service runs as for a user, with gateway, recorder and a client that watches every cycle, under continuous goals.
The measurement is divided into several runs. In each run, cyclictest runs at the same time on the same processor, one
priority above the loop, to measure the lateness of the machine. The simulated drives are a process of the service,
which runs in real time on the other processor, so that a cycle contains only the loop. If a virtual machine stalls one
of the two processors, the other waits. Faults are counted and reset.

Before and after the service, a bare loop that only exchanges a cycle's frames runs together with cyclictest. The time
of the bare loop is the machine's share of the service's time. After the service, it runs once more while an ordinary
program keeps the other processors busy, as the other processes of the service do at times. If the service cannot keep a
rate, the report says so.
"""

from __future__ import annotations

import contextlib
import os
import tempfile
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import bare_loop
import numpy as np
from bench_beside import Beside
from bench_rig import QUANTILES, Rig, quantiles, rig, without_pause
from numpy.typing import NDArray
from trirail.client.client import Robot
from trirail.config import SIM, load
from trirail.errors import TrirailError
from trirail.wire.records import PART_NAMES, Part, unpack
from trirail.wire.vocabulary import Mode

MOST_FAULTS = 0.2
"""Maximum number of faults per second at which the service still counts as able to keep the rate [1/s]."""
BARE = 1.0 / 6.0
"""Duration of the bare loop before the service, and again after it, as a fraction of the service's duration."""
SETTLE = 2.0
"""Duration for which goals are sent before the measurement, to exclude one-time effects [s]."""


def measure(seconds: float, rates: tuple[int, ...], runs: int) -> dict[str, Any]:
    """Measure each rate [Hz] for `seconds`, divided into `runs` runs; return times at QUANTILES [µs], and counts."""
    return {"quantiles": QUANTILES, "rates": [_measure_rate(rate, seconds, runs) for rate in rates]}


def _measure_rate(rate: int, seconds: float, runs: int) -> dict[str, Any]:
    service: dict[str, Any]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        bare = [_bare(rate, BARE * seconds, folder / "before.json")]
        try:
            service = _service(rate, seconds, runs, folder)
        except (TrirailError, _NotKeptError) as error:
            service = {"not_kept": str(error)}
        bare.append(_bare(rate, BARE * seconds, folder / "after.json"))
        beside_busy = _bare(rate, BARE * seconds, folder / "busy.json", busy=True)
    loops = {"bare": together(bare), "bare_beside_busy": together([beside_busy])}
    return with_ratios({"rate_hz": rate, "seconds": seconds, **service}, loops)


def with_ratios(service: dict[str, Any], loops: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Return the results of the service's loop and of the bare loops, and their ratios if the service kept the rate."""
    results = {**service, **loops}
    if "not_kept" not in service:
        for name, bare in loops.items():
            pairs = {what: zip(service[what], bare[what], strict=True) for what in ("cycle", "lateness")}
            results[f"to_{name}"] = {what: [a / b for a, b in each] for what, each in pairs.items()}
    return results


class _NotKeptError(Exception):
    """The loop could not keep the rate."""


def _service(rate: int, seconds: float, runs: int, folder: Path) -> dict[str, Any]:
    """Measure the service's loop. Raises TrirailError or _NotKeptError if it cannot keep the rate."""
    priority, period_us = load(SIM).loop.priority, 1_000_000 // rate
    results: list[dict[str, Any]] = []
    batches: list[NDArray[np.void]] = []
    goals = 0
    with rig(rate, own=True) as made:
        faults = Faults(made.robot)
        without_pause(made.robot, SETTLE, faults.mend)
        for run in range(runs):
            beside = Beside(seconds / runs, period_us, priority, folder / f"{run}.json")
            rows, accepted = _collect(made, seconds / runs, faults)
            late = beside.lateness()
            goals += accepted
            batches.append(rows)
            results.append(_run(rows, late, beside, period_us))
    messages = faults.told
    if len(messages) > MOST_FAULTS * seconds:
        raise _NotKeptError(f"{len(messages)} faults in {seconds:g} s, the last: {messages[-1]}")
    rows = np.concatenate(batches)
    parts = rows["parts_ns"] / 1000.0
    return {
        "goals": goals,
        "faults": messages,
        "beside": beside.name,
        "moving": float(np.mean(np.any(rows["commanded_velocity"] != 0.0, axis=1))),
        "cycles": len(rows),
        "missed": sum(run["missed"] for run in results),
        "lost_by_the_machine": sum(run["lost_by_the_machine"] for run in results),
        "runs": results,
        "parts": {name: quantiles(parts[:, column]) for column, name in enumerate(PART_NAMES)},
        "to_setpoints": quantiles(parts[:, : Part.WRITE + 1].sum(axis=1)),
        "to_record": quantiles(parts[:, : Part.RECORD + 1].sum(axis=1)),
        "cycle": quantiles(parts.sum(axis=1)),
        "lateness": quantiles(np.concatenate([_lateness(each, period_us) for each in batches])),
    }


def _bare(rate: int, seconds: float, result: Path, *, busy: bool = False) -> tuple[bare_loop.BareCycles, int]:
    """Measure the bare loop in a separate process; return its cycles and the number of ticks that the machine lost."""
    loop = load(SIM).loop
    with ProcessPoolExecutor(1, get_context("spawn"), bare_loop.prepare) as alone:
        alone.submit(os.getpid).result()  # wait until it has compiled the loop
        beside = Beside(seconds, 1_000_000 // rate, loop.priority, result)
        cycles = alone.submit(bare_loop.measure, loop, rate, seconds, busy=busy).result()
    return cycles, beside.ticks_lost(beside.lateness())


def together(parts: list[tuple[bare_loop.BareCycles, int]]) -> dict[str, Any]:
    """Return the combined results of all runs of the bare loop, and the total number of ticks that the machine lost."""
    return {
        "cycles": sum(len(cycles.work) for cycles, _ in parts),
        "answers": sum(cycles.answers for cycles, _ in parts),
        "missed": sum(int(cycles.missed.sum()) for cycles, _ in parts),
        "lost_by_the_machine": sum(lost for _, lost in parts),
        "cycle": quantiles(np.concatenate([cycles.work for cycles, _ in parts]) / 1000.0),
        "lateness": quantiles(np.concatenate([cycles.lateness for cycles, _ in parts]) / 1000.0),
    }


class Faults:
    """Counter of faults, which also resets them, since every stall of the machine causes a fault of the drives."""

    def __init__(self, robot: Robot) -> None:
        self.told: list[str] = []
        """Messages of the faults."""
        self._robot = robot

    def mend(self) -> None:
        """If the robot is in fault, reset the fault and power the robot up again."""
        with contextlib.suppress(TrirailError):  # the cause may persist; then the next goal is refused too
            state = self._robot.state()
            if state.mode == Mode.FAULT:
                self._robot.reset()
                self.told.append("; ".join(state.faults))
                self._robot.enable()


def _collect(made: Rig, seconds: float, faults: Faults) -> tuple[NDArray[np.void], int]:
    """Send goals continuously; return the record of every cycle, and the number of accepted goals."""
    batches: list[bytes] = []
    with made.robot.records(batches.append):
        accepted = without_pause(made.robot, seconds, faults.mend)
    if not batches:
        raise _NotKeptError("no record of a cycle came")
    return np.concatenate([unpack(batch) for batch in batches]), accepted


def _lateness(rows: NDArray[np.void], period_us: int) -> NDArray[np.float64]:
    """Return the lateness of each cycle of a run, including the ticks missed before the cycle, (n,) [µs]."""
    lateness: NDArray[np.float64] = rows["lateness_ns"] / 1000.0 + _missed(rows) * period_us
    return lateness


def _missed(rows: NDArray[np.void]) -> NDArray[np.int64]:
    return np.diff(rows["overruns"], prepend=rows["overruns"][0])


def _run(rows: NDArray[np.void], beside: NDArray[np.float64], of: Beside, period_us: int) -> dict[str, Any]:
    """Return the lateness of the loop in one run, that of the machine itself, and their ratio."""
    lateness = quantiles(_lateness(rows, period_us))
    own = quantiles(beside)
    return {
        "lateness": lateness,
        "beside": own,
        "ratio": [a / b if b else 0.0 for a, b in zip(lateness, own, strict=True)],
        "missed": int(_missed(rows).sum()),
        "lost_by_the_machine": of.ticks_lost(beside),
    }
