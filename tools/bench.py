"""Benchmarks: `python tools/bench.py loop`, `latency`, …, each with --json for programs; `all` is `make bench`.

Speeds are stated as ratios of two measurements in the same run, because machines differ.
"""

from __future__ import annotations

import json as json_format
from collections.abc import Iterator
from typing import Any

from cyclopts import App
from interruption import interrupt_on_signals

app = App(help="Speed, as ratios within one run: the machines this runs on are not alike.")

# Each command imports only its own benchmark: `frames` also runs in an emulated machine, in which imports are slow.


def report(results: dict[str, Any], json: bool) -> None:
    """Print the results as lines, or as one JSON object. A list of numbers contains the values at `quantiles`."""
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
    """Run the whole service under continuous goals; compare its loop with cyclictest and a bare loop at each rate."""
    import bench_loop

    report(bench_loop.measure(seconds, rates, runs), json)


@app.command
def latency(*, goals: int = 100, json: bool = False) -> None:
    """Measure the time from the sending of a goal to the first setpoint that it changes on the bus."""
    import bench_latency
    import bench_rig

    with bench_rig.rig(1000) as made:
        report(bench_latency.measure(made, goals), json)


@app.command
def fairness(*, goals: int = 1000, json: bool = False) -> None:
    """Measure the response times to one user's goals and stops, with and without a flood of another user's messages."""
    import bench_fairness
    import bench_rig

    with bench_rig.rig(1000, own=True) as made:
        report(bench_fairness.measure(made, goals), json)


@app.command
def frames(*, cycles: int = 3000, json: bool = False) -> None:
    """Measure the time to send and receive one cycle's frames, by python-can and directly on the socket of the bus."""
    import bench_frames

    report(bench_frames.measure(cycles), json)


@app.command
def peers(*, seconds: float = 15.0, json: bool = False) -> None:
    """Measure the intervals between SYNCs, and those of python-canopen on the same kind of bus."""
    import bench_peers

    report(bench_peers.measure(seconds), json)


@app.command
def outputs(*, pulses: int = 20, tries: int = 10, json: bool = False) -> None:
    """Compare the places where outputs switch by marks and by a client that watches the state; time the switching."""
    import bench_outputs
    import bench_rig

    with bench_rig.rig(1000, own=True, sections=bench_outputs.SECTIONS) as made:
        report(bench_outputs.measure(made, pulses, tries), json)


@app.command
def kinematics(*, json: bool = False) -> None:
    """Compare the speed of the compiled recursion with that of a plain numpy port of the paper's matrices."""
    import bench_kinematics

    report(bench_kinematics.measure(), json)


@app.command
def align(*, parts: int = 200, goals: int = 20, stages: int = 20, json: bool = False) -> None:
    """Align random parts on computed stages of both kinds, with correct and wrong models; time it on a running service.

    Then calibrate the geometry of `stages` stages of each kind by their cameras, and align parts anywhere in the
    travel.
    """
    import bench_align
    import bench_geometry

    results = bench_align.measure(parts, goals) if parts else {}
    results |= {"pixels, rms of a mark's error": bench_geometry.marks(20)}
    report(results | {"geometry by cameras": bench_geometry.measure(stages)}, json)


@app.command
def start(*, json: bool = False) -> None:
    """Measure the time that a service on simulated drives takes to start, and the memory of its processes."""
    import bench_start

    report(bench_start.measure(), json)


@app.command(name="all")
def everything(*, brief: bool = False, json: bool = False) -> None:
    """Run all benchmarks in less than ten minutes; print a table of results and aims. `brief`: a quick trial."""
    import bench_aims

    bench_aims.main(brief, json)


if __name__ == "__main__":
    interrupt_on_signals()
    app()
