"""The loop under its real neighbours: what a cycle costs, how late it comes, and which ticks it misses.

The service runs as a user runs it, with gateway, recorder and a client that watches every cycle, while goals come
without pause. cyclictest runs in the same minute on the same processor, one priority above the loop, in as many runs as
lateness is compared in. The simulated drives are a process of their own, real-time on the other processor, so that a
cycle is the loop's own; where a virtual machine stalls one of the two, the other waits for it. Faults are counted and
reset. Where the drives cannot keep up they are inside, and their own share is timed and taken off.
"""

from __future__ import annotations

import contextlib
import json as json_format
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from bench_beside import Beside
from bench_rig import GOALS_HZ, Rig, rig, without_pause
from numpy.typing import NDArray
from trirail.client.client import Robot
from trirail.config import SIM, load
from trirail.errors import TrirailError
from trirail.wire.records import PARTS, unpack
from trirail.wire.vocabulary import Mode
from trirail_drivers.cia402.drives import Cia402
from trirail_drivers.connection.opening import simulated_bus
from trirail_drivers.simulated import SimulatedBus

QUANTILES = (50.0, 99.0, 99.9, 100.0)
HEADER = f"{'':30}{'p50':>9}{'p99':>9}{'p99.9':>9}{'max':>9}   µs"
MOST_FAULTS = 0.2
"""With more faults a second drives in a process of their own cannot keep up."""
SETTLE = 2.0
"""Goals before the measurement: what happens once has happened [s]."""


def measure(seconds: float, rates: tuple[int, ...], runs: int) -> dict[str, Any]:
    """Measure each rate [Hz] for so many seconds, in as many runs; microseconds at QUANTILES, and counts."""
    return {"quantiles": QUANTILES, "rates": [_of_a_rate(rate, seconds, runs) for rate in rates]}


def _of_a_rate(rate: int, seconds: float, runs: int) -> dict[str, Any]:
    try:
        return _measured(rate, seconds, runs, inside=False)
    except _CannotKeepUpError as error:
        return {**_measured(rate, seconds, runs, inside=True), "why_inside": str(error)}


class _CannotKeepUpError(Exception):
    """The drives in a process of their own were too slow for the rate."""


def _measured(rate: int, seconds: float, runs: int, inside: bool) -> dict[str, Any]:
    priority, period_us = load(SIM).loop.priority, 1_000_000 // rate
    found: list[dict[str, Any]] = []
    batches: list[NDArray[np.void]] = []
    goals = 0
    share = _drives_share(1.0 / rate) if inside else 0.0
    try:
        with rig(rate, inside) as made, tempfile.TemporaryDirectory() as folder:
            faults = Faults(made.robot)
            without_pause(made.robot, SETTLE, faults.mend)
            for run in range(runs):
                beside = Beside(seconds / runs, period_us, priority, Path(folder) / f"{run}.json")
                rows, accepted = _collect(made, seconds / runs, faults)
                late = beside.lateness()
                goals += accepted
                batches.append(rows)
                found.append(_run(rows, late, beside, period_us))
    except TrirailError as error:
        if inside:
            raise
        raise _CannotKeepUpError(str(error)) from error
    told = faults.told
    if not inside and len(told) > MOST_FAULTS * seconds:
        raise _CannotKeepUpError(f"{len(told)} faults in {seconds:g} s, the last: {told[-1]}")
    rows = np.concatenate(batches)
    parts = rows["parts_ns"] / 1000.0
    return {
        "rate_hz": rate,
        "drives": "inside" if inside else "own process",
        "drives_share_us": share,
        "seconds": seconds,
        "goals": goals,
        "faults": told,
        "beside": beside.name,
        "moving": float(np.mean(np.any(rows["commanded_velocity"] != 0.0, axis=1))),
        "cycles": len(rows),
        "missed": sum(run["missed"] for run in found),
        "lost_by_the_machine": sum(run["lost_by_the_machine"] for run in found),
        "runs": found,
        "parts": {name: quantiles(parts[:, column]) for column, name in enumerate(PARTS)},
        "cycle": quantiles(parts.sum(axis=1) - share),
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
        raise _CannotKeepUpError("no record of a cycle came")
    return np.concatenate([unpack(batch) for batch in batches]), accepted


def _run(rows: NDArray[np.void], beside: NDArray[np.float64], of: Beside, period_us: int) -> dict[str, Any]:
    """One run's lateness beside the machine's own: a cycle after missed ticks is late by those too."""
    missed = np.diff(rows["overruns"], prepend=rows["overruns"][0])
    lateness = quantiles(rows["lateness_ns"] / 1000.0 + missed * period_us)
    own = quantiles(beside)
    return {
        "lateness": lateness,
        "beside": own,
        "ratio": [a / b if b else 0.0 for a, b in zip(lateness, own, strict=True)],
        "missed": int(missed.sum()),
        "lost_by_the_machine": of.ticks_lost(beside),
    }


def _drives_share(period: float) -> float:
    """What simulated drives take of a cycle where they are inside, in the median [µs]."""
    config, spent = load(SIM), [0.0]

    class Timed(SimulatedBus):
        """Adds up what its own work takes."""

        def send(self, msg: Any, timeout: float | None = None) -> None:
            began = time.perf_counter()
            super().send(msg, timeout)
            spent[0] += time.perf_counter() - began

        def recv(self, timeout: float | None = None) -> Any:
            began = time.perf_counter()
            try:
                return super().recv(timeout)
            finally:
                spent[0] += time.perf_counter() - began

    made = simulated_bus(config.can, config.drives)
    bus = Timed(made.drives, time.monotonic, made.faults)
    driver, each = Cia402(bus, 100_000_000, config.drives), []
    try:
        driver.configure(period)
        for _ in range(3000):
            spent[0] = 0.0
            driver.sync()
            feedback = driver.read()
            driver.write(feedback.position, (0.0, 0.0, 0.0))
            each.append(spent[0])
    finally:
        driver.close()
    return float(np.median(each) * 1e6)


def quantiles(values: NDArray[np.float64]) -> list[float]:
    """The values at QUANTILES."""
    return [float(value) for value in np.percentile(values, QUANTILES)]


def main(seconds: float, rates: tuple[int, ...], runs: int, json: bool = False) -> None:
    """Print the measurements as a table, or as one JSON object."""
    measured = measure(seconds, rates, runs)
    if json:
        print(json_format.dumps(measured))
        return
    for found in measured["rates"]:
        _show(found)


def _show(found: dict[str, Any]) -> None:
    print(
        f"{found['rate_hz']} Hz, {found['seconds']:g} s, {found['goals']} goals at {GOALS_HZ:g} Hz, moving "
        f"{found['moving']:.0%} of the time; drives: {found['drives']}"
    )
    if "why_inside" in found:
        print(f"  in a process of their own they could not keep up: {found['why_inside']}")
        print(f"  their own share, {found['drives_share_us']:.1f} µs in the median, is taken off the whole cycle")
    for fault, times in Counter(found["faults"]).items():
        print(f"  {times} times in fault, and reset: {fault}")
    print(HEADER)
    print(line("the whole cycle", found["cycle"]))
    for name in PARTS:
        print(line(f"  {name}", found["parts"][name]))
    for run in found["runs"]:
        print(line("lateness of the loop", run["lateness"]))
        print(line(f"  {found['beside']}", run["beside"]))
        print(line("  ratio", run["ratio"], ".2f"))
    print(
        f"ticks missed: {found['missed']} of {found['cycles']}; {found['beside']} lost "
        f"{found['lost_by_the_machine']} in the same time\n"
    )


def line(name: str, values: list[float], form: str = ".1f") -> str:
    """A row of a table under HEADER."""
    return f"{name:30}" + "".join(f"{value:9{form}}" for value in values)
