"""Benchmarks: `python tools/bench.py loop`, `latency`, …, each with --json for programs; `all` is `make bench`.

Speed is given as a ratio within one run, because machines differ.
"""

from __future__ import annotations

import json as json_format
import os
import signal
import sys
from collections.abc import Iterator
from typing import Any

from cyclopts import App

app = App(help="Speed, as ratios within one run: the machines this runs on are not alike.")

# Each command imports its benchmark itself: `frames` also runs in an emulated machine, where imports are slow.


def report(results: dict[str, Any], json: bool) -> None:
    """Print the results, as one JSON object or in lines; a list of numbers gives the values at `quantiles`."""
    print(json_format.dumps(results) if json else "\n".join(lines(results)))


def lines(results: dict[str, Any], indent: str = "") -> Iterator[str]:
    """Yield the results line by line."""
    for name, value in results.items():
        parts = value if isinstance(value, list) and any(isinstance(part, dict) for part in value) else [value]
        for part in parts:
            if isinstance(part, dict):
                yield f"{indent}{name}"
                yield from lines(part, indent + "  ")
            else:
                numbers = part if isinstance(part, list | tuple) else [part]
                shown = (f"{number:.4g}" if isinstance(number, float) else str(number) for number in numbers)
                yield f"{indent}{name:{max(1, 32 - len(indent))}} {' / '.join(shown)}"


@app.command
def loop(*, seconds: float = 60.0, rates: tuple[int, ...] = (1000, 2000), runs: int = 5, json: bool = False) -> None:
    """Run the whole service, goals without pause; time its loop beside cyclictest and the bare loop, at each rate."""
    import bench_loop

    report(bench_loop.measure(seconds, rates, runs), json)


@app.command
def latency(*, goals: int = 100, json: bool = False) -> None:
    """Time from a goal's put to the first setpoint that it changes on the bus, at rest and in motion."""
    import bench_latency
    import bench_rig

    with bench_rig.rig(1000) as made:
        report(bench_latency.measure(made, goals), json)


@app.command
def fairness(*, goals: int = 1000, json: bool = False) -> None:
    """Time until one user's goals and stops are answered, quiet and while another floods, and the ratio of the two."""
    import bench_fairness
    import bench_rig

    with bench_rig.rig(1000, own=True) as made:
        report(bench_fairness.measure(made, goals), json)


@app.command
def frames(*, cycles: int = 3000, json: bool = False) -> None:
    """Time one cycle's frames by python-can, and on the bus's own socket."""
    import bench_frames

    report(bench_frames.measure(cycles), json)


@app.command
def peers(*, seconds: float = 15.0, json: bool = False) -> None:
    """Measure the intervals of SYNC beside python-canopen's, on the same bus."""
    import bench_peers

    report(bench_peers.measure(seconds), json)


@app.command
def outputs(*, pulses: int = 20, tries: int = 10, json: bool = False) -> None:
    """Compare where outputs switch with their marks, and with a client that watches the state; time the switch."""
    import bench_outputs
    import bench_rig

    with bench_rig.rig(1000, own=True, sections=bench_outputs.SECTIONS) as made:
        report(bench_outputs.measure(made, pulses, tries), json)


@app.command
def kinematics(*, json: bool = False) -> None:
    """Time the recursion against a straightforward numpy port of the paper's matrices."""
    import bench_kinematics

    report(bench_kinematics.measure(), json)


@app.command
def align(*, parts: int = 200, goals: int = 20, stages: int = 20, json: bool = False) -> None:
    """Align seeded parts on computed stages of both kinds, by right and wrong models, and time it on a service.

    Then calibrate the geometry of `stages` stages of each kind by their cameras, and align all over their travel.
    """
    import bench_align
    import bench_geometry

    results = bench_align.measure(parts, goals) if parts else {}
    results |= {"pixels, rms of a mark's error": bench_geometry.marks(20)}
    report(results | {"geometry by cameras": bench_geometry.measure(stages)}, json)


@app.command
def start(*, json: bool = False) -> None:
    """Time the start of a service on simulated drives, and weigh its processes."""
    import bench_start

    report(bench_start.measure(), json)


@app.command(name="all")
def everything(*, brief: bool = False, json: bool = False) -> None:
    """Run all of these, under ten minutes, and end with one table against the aims; `brief` only for a look."""
    import bench_aims

    bench_aims.main(brief, json)


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(os.EX_TEMPFAIL))  # so that its services end with it
    app()
