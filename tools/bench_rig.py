"""Service for the benchmarks, on its own simulated drives or on a bus with listeners, and continuous goals for it."""

from __future__ import annotations

import contextlib
import os
import random
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from trirail.client import own_service
from trirail.client.client import Robot
from trirail.errors import TrirailError

GOALS_HZ = 20.0
"""Rate of the continuous goals [1/s], so high that each goal replaces the previous goal before that has ended."""
SPAN = (0.05, 0.05, 0.4)
"""Maximum distance of the goals from the centre in each coordinate [m, m, rad]."""
BITRATE = 8_000_000
"""Bit rate of the virtual bus [bit/s], so high that the bus load does not limit the measured rates."""


PROCESSORS = sorted(os.sched_getaffinity(0))
"""Processors of the benchmarks. The drives on a bus run on the first, and the loop on the last."""
QUANTILES = (50.0, 99.0, 99.9, 100.0)


class Rig(NamedTuple):
    """Running service, and a client of this service."""

    robot: Robot
    locator: str
    bus: str
    """Path of the bus between processes; "" if the service simulates the drives itself."""


def quantiles(values: list[float] | NDArray[np.float64]) -> list[float]:
    """Return the values at QUANTILES."""
    if not len(values):
        raise SystemExit("there is nothing to measure")
    return [float(value) for value in np.percentile(values, QUANTILES)]


@contextlib.contextmanager
def rig(rate_hz: int, own: bool = False, sections: str = "", times: Path | None = None) -> Iterator[Rig]:
    """Run an enabled service at a rate, on its `own` simulated drives or on drives on a bus with listeners.

    `sections` are added to its configuration. The drives on the bus write the arrivals of SYNC to `times` at the end.
    """
    with tempfile.TemporaryDirectory(prefix="trirail-") as name, contextlib.ExitStack() as stack:
        folder = Path(name)
        config, locator = configured(folder, rate_hz, own)
        with config.open("a", encoding="utf-8") as file:
            file.write(f"\n{sections}")
        bus = "" if own else str(folder / "can")
        if bus:
            stack.enter_context(drives(config, bus, times))
        stack.enter_context(own_service.service(config, folder / "bench.rrd"))
        robot = stack.enter_context(Robot("demo", locator, user="bench"))
        robot.enable()
        yield Rig(robot, locator, bus)
        with contextlib.suppress(TrirailError):  # the robot may be in fault, which is reported elsewhere
            robot.disable()


def configured(folder: Path, rate_hz: int, own: bool) -> tuple[Path, str]:
    """Write the configuration of a service; return the file and the locator of the service."""
    config, locator = own_service.private(folder)
    text = config.read_text(encoding="utf-8")
    changes = {"rate_hz": str(rate_hz), "bitrate": str(BITRATE)}
    if not own:
        changes["interface"] = f'"unix"\nchannel = "{folder}/can"'
    for key, value in changes.items():
        text, count = re.subn(rf"^{key} = [^#\n]*", f"{key} = {value} ", text, flags=re.MULTILINE)
        if count != 1:
            raise SystemExit(f"{config}: {key} was expected once, it is there {count} times")
    config.write_text(text, encoding="utf-8")
    return config, locator


@contextlib.contextmanager
def drives(config: Path, bus: str, times: Path | None = None) -> Iterator[None]:
    """Run the drives of a configuration in a separate process, which writes the arrivals of SYNC to `times`."""
    program = Path(__file__).with_name("bench_drives.py")
    command = [sys.executable, str(program), str(config), bus, str(PROCESSORS[0])]
    if times is not None:
        command.append(str(times))
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            if process.stdout is None or process.stdout.readline() != "ready\n":
                raise SystemExit("the drives could not start")
            yield
        finally:
            process.terminate()


def without_pause(robot: Robot, seconds: float, refused: Callable[[], None] = lambda: None) -> int:
    """Send GOALS_HZ goals per second for `seconds`; return the number of accepted goals.

    `refused` is called after each refused goal.
    """
    choice, accepted = random.Random(1), 0
    due = began = time.monotonic()
    while time.monotonic() < began + seconds:
        x, y, phi = (choice.uniform(-span, span) for span in SPAN)
        try:
            robot.move_to(x=x, y=y, phi=phi)
            accepted += 1
        except TrirailError:
            refused()
        due += 1.0 / GOALS_HZ
        time.sleep(max(0.0, due - time.monotonic()))
    return accepted
