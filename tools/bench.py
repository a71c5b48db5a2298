"""Measurements: `python tools/bench.py loop`, `planning`, `recorder` or `kinematics`, with --json for programs."""

from __future__ import annotations

import bench_kinematics
import bench_loop
import bench_planning
import bench_recorder
from cyclopts import App

app = App(help="Speed, as ratios within one run: the machines this runs on are not alike.")


@app.command
def loop(*, seconds: float = 30.0, json: bool = False) -> None:
    """Run the whole service on simulated drives and time its loop, beside cyclictest where that is installed."""
    bench_loop.main(seconds, json)


@app.command
def recorder(*, seconds: float = 60.0, json: bool = False) -> None:
    """Run the whole service on simulated drives, moving, and measure what its recorder takes, watched and not."""
    bench_recorder.main(seconds, json)


@app.command
def kinematics(*, json: bool = False) -> None:
    """Time the recursion against a straightforward numpy port of the paper's matrices."""
    bench_kinematics.main(json)


@app.command
def planning(*, json: bool = False) -> None:
    """Time what a goal costs the loop in a cycle."""
    bench_planning.main(json)


if __name__ == "__main__":
    app()
