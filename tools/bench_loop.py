"""The loop under its real neighbours: lateness beside cyclictest's, and where a cycle's time goes.

The service runs as a user runs it, with gateway, recorder and two clients that watch the state, while a third
keeps it moving. cyclictest runs at the same time on the same processor with the next higher priority, so both
are woken by the same machine in the same minute.
"""

from __future__ import annotations

import contextlib
import json as json_format
import os
import shutil
import signal
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from moving import keep_moving
from numpy.typing import NDArray
from trirail.client.client import Robot
from trirail.config import SIM, load
from trirail.errors import ServiceError
from trirail.processes.interpreter import python
from trirail.wire.records import PARTS, unpack

QUANTILES = (50.0, 99.0, 99.9, 100.0)
HEADER = f"{'':28}{'p50':>9}{'p99':>9}{'p99.9':>9}{'max':>9}   µs"


def measure(seconds: float) -> dict[str, Any]:
    """Run everything for so many seconds; return microseconds at QUANTILES, and counts."""
    config = load(SIM)
    with tempfile.TemporaryDirectory() as folder:
        service = _start("run", str(SIM), "--record", f"{folder}/bench.rrd")
        watchers: list[subprocess.Popen[bytes]] = []
        try:
            with _connect(config.robot.name, config.zenoh.listen[0], service) as robot:
                watchers = [_start("watch", "--json") for _ in range(2)]
                robot.enable()
                cyclictest = _cyclictest(seconds, config.loop.priority, Path(folder) / "cyclictest.json")
                rows = _collect(robot, seconds)
                robot.disable()
        finally:
            for process in [*watchers, service]:
                process.send_signal(signal.SIGINT)
                process.wait(20)
        beside = _histogram(cyclictest) if cyclictest else None
    parts = rows["parts_ns"] / 1000.0
    lateness = rows["lateness_ns"] / 1000.0
    return {
        "cycles": len(rows),
        "missed": int(rows["overruns"][-1] - rows["overruns"][0]),
        "moving": float(np.mean(np.any(rows["commanded_velocity"] != 0.0, axis=1))),
        "lateness": _quantiles(lateness),
        "cyclictest": beside,
        "ratio": [a / b for a, b in zip(_quantiles(lateness), beside, strict=True)] if beside else None,
        "parts": {name: _quantiles(parts[:, column]) for column, name in enumerate(PARTS)},
        "cycle": _quantiles(parts.sum(axis=1)),
    }


def _start(*arguments: str) -> subprocess.Popen[bytes]:
    return subprocess.Popen(python("-m", "trirail", *arguments), stdout=subprocess.DEVNULL)


def _connect(name: str, locator: str, service: subprocess.Popen[bytes]) -> Robot:
    for _ in range(600):
        if service.poll() is not None:
            raise SystemExit("the service could not start")
        with contextlib.suppress(ServiceError), contextlib.ExitStack() as stack:
            robot = stack.enter_context(Robot(name, locator, user="bench"))
            robot.state()
            stack.pop_all()
            return robot
        time.sleep(0.1)
    raise SystemExit("the service is not up after a minute")


def _collect(robot: Robot, seconds: float) -> NDArray[np.void]:
    """Keep the robot moving, and its records."""
    batches: list[bytes] = []
    with robot.records(batches.append):
        keep_moving(robot, seconds)
    return np.concatenate([unpack(batch) for batch in batches])


def _cyclictest(seconds: float, priority: int, result: Path) -> tuple[subprocess.Popen[bytes], Path] | None:
    if shutil.which("cyclictest") is None or os.geteuid() != 0:
        return None
    processor = max(os.sched_getaffinity(0))
    command = f"cyclictest -q -m -p {min(99, priority + 1)} -i 1000 -a {processor} -t 1 -h 100000"
    options = ["-D", str(max(1, round(seconds))), f"--json={result}"]
    return subprocess.Popen([*command.split(), *options], stdout=subprocess.DEVNULL), result


def _histogram(cyclictest: tuple[subprocess.Popen[bytes], Path]) -> list[float]:
    process, result = cyclictest
    process.wait(30)
    counts = json_format.loads(result.read_text())["thread"]["0"]["histogram"]
    return _quantiles(np.repeat([float(value) for value in counts], list(counts.values())))


def _quantiles(values: NDArray[np.float64]) -> list[float]:
    return [float(value) for value in np.percentile(values, QUANTILES)]


def main(seconds: float, json: bool = False) -> None:
    """Print the measurements as a table, or as one JSON object."""
    measured = measure(seconds)
    if json:
        print(json_format.dumps(measured))
        return
    print(f"{measured['cycles']} cycles, {measured['missed']} missed, moving {measured['moving']:.0%} of the time")
    print(HEADER)
    print(_line("lateness of the loop", measured["lateness"]))
    if measured["cyclictest"]:
        print(_line("lateness of cyclictest", measured["cyclictest"]))
        print(_line("  ratio", measured["ratio"], ".2f"))
    else:
        print("  (cyclictest: not installed, or not root; Debian's package is rt-tests)")
    for name in PARTS:
        print(_line(f"  {name}", measured["parts"][name]))
    print(_line("the whole cycle", measured["cycle"]))


def _line(name: str, values: list[float], form: str = ".1f") -> str:
    return f"{name:28}" + "".join(f"{value:9{form}}" for value in values)
