"""What a scrape of the metrics costs the loop: its lateness with one each second, and without, by turns in one run.

Each round has three windows: quiet, scraped, and quiet once more. What the two quiet ones differ by is how well the
machine repeats itself: an effect below that cannot be told from none.
"""

from __future__ import annotations

import json as json_format
import threading
import time
import urllib.request
from typing import Any

import numpy as np
from bench_rig import rig, without_pause
from numpy.typing import NDArray
from trirail.client.client import Robot
from trirail.telemetry.sinks import HOST, free_port
from trirail.wire.records import unpack

QUANTILES = (50.0, 99.0, 99.9, 100.0)
WINDOWS = ("quiet", "scraped", "quiet again")
LONG = 5.0
"""Each window [s]."""
EVERY = 1.0
"""Between two scrapes [s]; Prometheus asks once in 15 s if it is told nothing else."""
AIM = 0.05
"""The scrapes may change lateness p99.9 by less than this share."""


def measure(seconds: float, rate: int = 1000) -> dict[str, Any]:
    """Measure for so many seconds of each kind of window; microseconds at QUANTILES."""
    port = free_port()
    rounds = max(1, round(seconds / LONG))
    found: dict[str, list[NDArray[np.float64]]] = {window: [] for window in WINDOWS}
    scrapes: list[float] = []
    with rig(rate, inside=True, metrics_port=port) as made:
        without_pause(made.robot, 3.0)  # what happens once has happened
        for _ in range(rounds):
            for window in WINDOWS:
                asked = port if window == "scraped" else None
                found[window].append(_lateness(made.robot, rate, asked, scrapes))
    spread = {
        window: [float(value) for value in np.percentile(np.concatenate(each), QUANTILES)]
        for window, each in found.items()
    }
    by_round = {window: [float(np.percentile(each, 99.9)) for each in windows] for window, windows in found.items()}
    quiet = np.array(by_round["quiet"]) + np.array(by_round["quiet again"])
    every_quiet = np.concatenate(found["quiet"] + found["quiet again"])
    return {
        "rate_hz": rate,
        "quantiles": QUANTILES,
        "seconds": rounds * LONG,
        "scrapes": len(scrapes),
        "scrape_ms": 1e3 * float(np.median(scrapes)),
        "lateness_us": spread,
        "p999_ratio": spread["scraped"][2] / float(np.percentile(every_quiet, 99.9)),
        "p999_ratio_median_of_rounds": float(np.median(2.0 * np.array(by_round["scraped"]) / quiet)),
        "p999_ratio_of_quiet": spread["quiet again"][2] / spread["quiet"][2],
    }


def _lateness(robot: Robot, rate: int, port: int | None, took: list[float]) -> NDArray[np.float64]:
    """Keep the robot in motion for a window, and scrape a port once in EVERY; return how late each cycle was [µs]."""
    batches: list[bytes] = []
    ended = threading.Event()

    def scrapes() -> None:
        while port is not None and not ended.wait(EVERY):
            took.append(_scrape(port))

    scraping = threading.Thread(target=scrapes)
    with robot.records(batches.append):
        scraping.start()
        without_pause(robot, LONG)
        ended.set()
        scraping.join()
    rows = np.concatenate([unpack(batch) for batch in batches])
    missed = np.diff(rows["overruns"], prepend=rows["overruns"][0])
    late: NDArray[np.float64] = rows["lateness_ns"] / 1e3 + missed * 1e6 / rate
    return late


def _scrape(port: int) -> float:
    """Return how long it took [s]."""
    began = time.perf_counter()
    with urllib.request.urlopen(f"http://{HOST}:{port}/metrics", timeout=5.0) as reply:
        reply.read()
    return time.perf_counter() - began


def main(seconds: float, json: bool = False) -> None:
    """Measure and print."""
    told = measure(seconds)
    if json:
        print(json_format.dumps(told))
        return
    print(f"{'lateness [µs]':16}{'p50':>9}{'p99':>9}{'p99.9':>9}{'max':>9}   {told['seconds']:g} s each")
    for window, values in told["lateness_us"].items():
        print(f"{window:16}" + "".join(f"{value:9.1f}" for value in values))
    print(f"{told['scrapes']} scrapes, one a second, each answered within {told['scrape_ms']:.1f} ms in the median")
    print(
        f"p99.9 with scrapes: {told['p999_ratio'] - 1.0:+.1%} of that without (aim: {AIM:.0%} at most), in the median "
        f"of rounds {told['p999_ratio_median_of_rounds'] - 1.0:+.1%}; one quiet half against the other: "
        f"{told['p999_ratio_of_quiet'] - 1.0:+.1%}"
    )
