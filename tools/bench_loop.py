"""The loop under its real neighbours: what a cycle costs, how late it comes, and which ticks it misses.

The service runs as a user runs it, with gateway, recorder and a client that watches every cycle, while goals come
without pause. cyclictest runs in the same minute on the same processor, one priority above the loop, in as many runs as
lateness is compared in. The simulated drives are a process of the service, real-time on the other processor, so that a
cycle is the loop's own; where a virtual machine stalls one of the two, the other waits for it. Faults are counted and
reset. Before the service and after it the bare loop runs, a cycle's frames and nothing else, as trirail doctor measures
it, and cyclictest beside it: what it takes is the machine's share. Of a rate that the service cannot keep that is
said.
"""

from __future__ import annotations

import contextlib
import os
import tempfile
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from bench_beside import Beside
from bench_rig import QUANTILES, Rig, quantiles, rig, without_pause
from numpy.typing import NDArray
from trirail.client.client import Robot
from trirail.config import SIM, load
from trirail.diagnosis import bare_loop
from trirail.errors import TrirailError
from trirail.wire.records import PARTS, Part, unpack
from trirail.wire.vocabulary import Mode

MOST_FAULTS = 0.2
"""With more faults a second a rate is not kept."""
BARE = 1.0 / 6.0
"""The bare loop runs for such a share of the service's time before it, and again after it."""
SETTLE = 2.0
"""Goals before the measurement: what happens once has happened [s]."""


def measure(seconds: float, rates: tuple[int, ...], runs: int) -> dict[str, Any]:
    """Measure each rate [Hz] for so many seconds, in as many runs; microseconds at QUANTILES, and counts."""
    return {"quantiles": QUANTILES, "rates": [_of_a_rate(rate, seconds, runs) for rate in rates]}


def _of_a_rate(rate: int, seconds: float, runs: int) -> dict[str, Any]:
    service: dict[str, Any]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        bare = [_bare(rate, BARE * seconds, folder / "before.json")]
        try:
            service = _service(rate, seconds, runs, folder)
        except (TrirailError, _NotKeptError) as error:
            service = {"not_kept": str(error)}
        bare.append(_bare(rate, BARE * seconds, folder / "after.json"))
    return of_both({"rate_hz": rate, "seconds": seconds, **service}, together(bare))


def of_both(service: dict[str, Any], bare: dict[str, Any]) -> dict[str, Any]:
    """What was found of a service's loop and of the bare one, and their ratios where the service kept the rate."""
    found = {**service, "bare": bare}
    if "not_kept" not in service:
        pairs = {what: zip(service[what], bare[what], strict=True) for what in ("cycle", "lateness")}
        found["to_bare"] = {what: [a / b for a, b in each] for what, each in pairs.items()}
    return found


class _NotKeptError(Exception):
    """The loop could not keep the rate."""


def _service(rate: int, seconds: float, runs: int, folder: Path) -> dict[str, Any]:
    """The service's loop. Raises what kept it from the rate."""
    priority, period_us = load(SIM).loop.priority, 1_000_000 // rate
    found: list[dict[str, Any]] = []
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
            found.append(_run(rows, late, beside, period_us))
    told = faults.told
    if len(told) > MOST_FAULTS * seconds:
        raise _NotKeptError(f"{len(told)} faults in {seconds:g} s, the last: {told[-1]}")
    rows = np.concatenate(batches)
    parts = rows["parts_ns"] / 1000.0
    return {
        "goals": goals,
        "faults": told,
        "beside": beside.name,
        "moving": float(np.mean(np.any(rows["commanded_velocity"] != 0.0, axis=1))),
        "cycles": len(rows),
        "missed": sum(run["missed"] for run in found),
        "lost_by_the_machine": sum(run["lost_by_the_machine"] for run in found),
        "runs": found,
        "parts": {name: quantiles(parts[:, column]) for column, name in enumerate(PARTS)},
        "to_setpoints": quantiles(parts[:, : Part.WRITE + 1].sum(axis=1)),
        "to_record": quantiles(parts[:, : Part.RECORD + 1].sum(axis=1)),
        "cycle": quantiles(parts.sum(axis=1)),
        "lateness": quantiles(np.concatenate([_lateness(each, period_us) for each in batches])),
    }


def _bare(rate: int, seconds: float, result: Path) -> tuple[bare_loop.Cycles, int]:
    """The bare loop, in a process of its own; and the ticks that the machine lost meanwhile."""
    loop = load(SIM).loop
    with ProcessPoolExecutor(1, get_context("spawn"), bare_loop.prepare) as alone:
        alone.submit(os.getpid).result()  # it has compiled
        beside = Beside(seconds, 1_000_000 // rate, loop.priority, result)
        cycles = alone.submit(bare_loop.measure_alone, loop, rate, seconds).result()
    return cycles, beside.ticks_lost(beside.lateness())


def together(parts: list[tuple[bare_loop.Cycles, int]]) -> dict[str, Any]:
    """What all runs of the bare loop took, and the ticks that the machine lost in each."""
    return {
        "cycles": sum(len(cycles.work) for cycles, _ in parts),
        "answers": sum(cycles.answers for cycles, _ in parts),
        "missed": sum(int(cycles.missed.sum()) for cycles, _ in parts),
        "lost_by_the_machine": sum(lost for _, lost in parts),
        "cycle": quantiles(np.concatenate([cycles.work for cycles, _ in parts]) / 1000.0),
        "lateness": quantiles(np.concatenate([cycles.lateness for cycles, _ in parts]) / 1000.0),
    }


class Faults:
    """Faults are counted and reset, and the measurement goes on: a machine that stalls faults any drives outside."""

    def __init__(self, robot: Robot) -> None:
        self.told: list[str] = []
        """What was said of each."""
        self._robot = robot

    def mend(self) -> None:
        """Power up again if the robot is in fault."""
        with contextlib.suppress(TrirailError):  # its cause may last: the next goal is refused too
            state = self._robot.state()
            if state.mode == Mode.FAULT:
                self._robot.reset()
                self.told.append("; ".join(state.faults))
                self._robot.enable()


def _collect(made: Rig, seconds: float, faults: Faults) -> tuple[NDArray[np.void], int]:
    """Keep the robot in motion; every cycle's record, and how many goals were accepted."""
    batches: list[bytes] = []
    with made.robot.records(batches.append):
        accepted = without_pause(made.robot, seconds, faults.mend)
    if not batches:
        raise _NotKeptError("no record of a cycle came")
    return np.concatenate([unpack(batch) for batch in batches]), accepted


def _lateness(rows: NDArray[np.void], period_us: int) -> NDArray[np.float64]:
    """How late each cycle of a run was, (n,) [µs]: after missed ticks by those too."""
    found: NDArray[np.float64] = rows["lateness_ns"] / 1000.0 + _missed(rows) * period_us
    return found


def _missed(rows: NDArray[np.void]) -> NDArray[np.int64]:
    return np.diff(rows["overruns"], prepend=rows["overruns"][0])


def _run(rows: NDArray[np.void], beside: NDArray[np.float64], of: Beside, period_us: int) -> dict[str, Any]:
    """One run's lateness beside the machine's own."""
    lateness = quantiles(_lateness(rows, period_us))
    own = quantiles(beside)
    return {
        "lateness": lateness,
        "beside": own,
        "ratio": [a / b if b else 0.0 for a, b in zip(lateness, own, strict=True)],
        "missed": int(_missed(rows).sum()),
        "lost_by_the_machine": of.ticks_lost(beside),
    }
