"""What a scrape of the metrics costs the loop: its lateness in a run with one each second, with the cycles around the
scrapes and with those left out.

Both are of the same seconds, so that what the machine itself is late by is in both; two windows, one after the other,
differ by a factor on a machine that others use. How far leaving out any cycles moves a percentile is told by leaving
out as many half-way between the scrapes.
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
EVERY = 1.0
"""Between two scrapes [s]; Prometheus asks once in 15 s if it is told nothing else."""
AFTER = 0.02
"""What a scrape has set off is over so long after its answer [s]."""
AIM = 0.05
"""The scrapes may change lateness p99.9 by less than this share."""


def measure(seconds: float, rate: int = 1000) -> dict[str, Any]:
    """Measure for so many seconds; lateness in microseconds at QUANTILES."""
    port = free_port()
    with rig(rate, own=True, metrics_port=port) as made:
        without_pause(made.robot, 3.0)  # what happens once has happened
        due, late, scrapes = _moving_and_scraped(made.robot, rate, seconds, port)
    near = within(due, scrapes + np.array([0.0, AFTER]))
    between = within(due, scrapes + np.array([0.0, AFTER]) + EVERY / 2.0)
    kinds = {"all cycles": late, "without those of scrapes": late[~near], "without others": late[~between]}
    spread = {kind: [float(value) for value in np.percentile(each, QUANTILES)] for kind, each in kinds.items()}
    return {
        "rate_hz": rate,
        "quantiles": QUANTILES,
        "cycles": len(late),
        "cycles_of_scrapes": int(np.count_nonzero(near)),
        "scrapes": len(scrapes),
        "scrape_ms": 1e3 * float(np.median(np.diff(scrapes))),
        "lateness_us": spread,
        "lateness_of_scrapes_us": [float(value) for value in np.percentile(late[near], QUANTILES)],
        "p999_ratio": spread["all cycles"][2] / spread["without those of scrapes"][2],
        "p999_ratio_of_others": spread["all cycles"][2] / spread["without others"][2],
    }


def _moving_and_scraped(
    robot: Robot, rate: int, seconds: float, port: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Keep the robot in motion and scrape a port once in EVERY.

    Returns when each cycle was due [s], how late it was [µs], and when each scrape began and was answered [s], (n, 2);
    all by the monotonic clock.
    """
    batches: list[bytes] = []
    scrapes: list[tuple[float, float]] = []
    ended = threading.Event()

    def scrape() -> None:
        while not ended.wait(EVERY):
            scrapes.append(_scrape(port))

    scraping = threading.Thread(target=scrape)
    with robot.records(batches.append):
        scraping.start()
        without_pause(robot, seconds)
        ended.set()
        scraping.join()
    rows = np.concatenate([unpack(batch) for batch in batches])
    missed = np.diff(rows["overruns"], prepend=rows["overruns"][0])
    return rows["deadline_ns"] / 1e9, rows["lateness_ns"] / 1e3 + missed * 1e6 / rate, np.array(scrapes)


def within(times: NDArray[np.float64], spans: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which of times, (n,), are within any of spans, (m, 2), that follow one another."""
    following = np.searchsorted(spans[:, 1], times)
    found: NDArray[np.bool_] = (following < len(spans)) & (spans[np.minimum(following, len(spans) - 1), 0] <= times)
    return found


def _scrape(port: int) -> tuple[float, float]:
    """Return when it began and was answered, by the monotonic clock [s]."""
    began = time.monotonic()
    with urllib.request.urlopen(f"http://{HOST}:{port}/metrics", timeout=5.0) as reply:
        reply.read()
    return began, time.monotonic()


def main(seconds: float, json: bool = False) -> None:
    """Measure and print."""
    told = measure(seconds)
    if json:
        print(json_format.dumps(told))
        return
    print(f"{'lateness [µs]':28}{'p50':>9}{'p99':>9}{'p99.9':>9}{'max':>9}   of {told['cycles']} cycles")
    for kind, values in told["lateness_us"].items():
        print(f"{kind:28}" + "".join(f"{value:9.1f}" for value in values))
    of_scrapes = "".join(f"{value:9.1f}" for value in told["lateness_of_scrapes_us"])
    print(f"{'those of scrapes alone':28}{of_scrapes}   of {told['cycles_of_scrapes']} cycles")
    print(f"{told['scrapes']} scrapes, one a second, each answered within {told['scrape_ms']:.1f} ms in the median")
    print(
        f"lateness p99.9 by the scrapes: {told['p999_ratio'] - 1.0:+.1%} (aim: {AIM:.0%} at most); "
        f"by as many other cycles: {told['p999_ratio_of_others'] - 1.0:+.1%}"
    )
