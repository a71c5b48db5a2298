"""Lateness of the machine itself during a benchmark, measured by cyclictest or else by a loop that only sleeps.

Both programs sleep until absolute deadlines with SCHED_FIFO, on the processor and with the period of the service's
loop, one priority above the loop. A wake-up that is later than a period means ticks in which no program could have run.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import FrameType

import numpy as np
from numpy.typing import NDArray
from trirail.processes.clock import Ticker

MAX_LATENESS_US = 100_000
"""Largest lateness that the histogram distinguishes [µs]."""


class Beside:
    """Measurement of the machine's own lateness in a separate process, which ends by itself after `seconds`."""

    def __init__(self, seconds: float, period_us: int, priority: int, result: Path) -> None:
        self.period_us = period_us
        self._result = result
        self._seconds = seconds
        self.name = "cyclictest" if shutil.which("cyclictest") and os.geteuid() == 0 else "a loop that only sleeps"
        processor = max(os.sched_getaffinity(0))
        if self.name == "cyclictest":
            options = f"-q -m -p {min(99, priority + 1)} -i {period_us} -a {processor} -t 1 -h {MAX_LATENESS_US}"
            command = ["cyclictest", *options.split(), "-D", str(max(1, round(seconds))), f"--json={result}"]
        else:
            arguments = (str(value) for value in (seconds, period_us, priority + 1, processor))
            command = [sys.executable, __file__, *arguments, str(result)]
        self._process = subprocess.Popen(command, stdout=subprocess.DEVNULL)

    def lateness(self) -> NDArray[np.float64]:
        """Wait for the end of the measurement; return the lateness of each wake-up [µs]."""
        self._process.wait(self._seconds + 60.0)
        result = json.loads(self._result.read_text(encoding="utf-8"))
        counts = result["thread"]["0"]["histogram"] if "thread" in result else result
        return np.repeat([float(value) for value in counts], list(counts.values()))

    def ticks_lost(self, lateness: NDArray[np.float64]) -> int:
        """Return the number of ticks that were lost because a wake-up was more than a period late."""
        return int(np.sum(lateness // self.period_us))


def main() -> None:
    """Sleep from deadline to deadline, and write a histogram of the lateness to the given file."""
    seconds, period_us, priority, processor = (float(value) for value in sys.argv[1:5])
    signal.signal(signal.SIGTERM, _end)
    try:
        os.sched_setaffinity(0, {int(processor)})
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(int(priority)))
    except OSError as error:
        print(f"without real-time rights: {error}", file=sys.stderr)
    histogram = np.zeros(MAX_LATENESS_US + 1, dtype=np.int64)
    ticker, end = Ticker(round(period_us * 1e3)), time.monotonic() + seconds
    while time.monotonic() < end:
        tick = ticker.wait()
        histogram[min(MAX_LATENESS_US, round((tick.lateness_ns * 1e-3) + tick.missed * period_us))] += 1
    counts = {str(value): int(histogram[value]) for value in np.flatnonzero(histogram)}
    Path(sys.argv[5]).write_text(json.dumps(counts), encoding="utf-8")


def _end(_signal: int, _frame: FrameType | None) -> None:
    raise SystemExit


if __name__ == "__main__":
    main()
