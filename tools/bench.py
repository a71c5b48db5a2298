"""Measurements: `python tools/bench.py loop`, `latency`, …, each with --json for programs; `all` is `make bench`.

Speed is a ratio within one run, for the machines that this runs on are not alike.
"""

from __future__ import annotations

import os
import signal
import sys

from cyclopts import App

app = App(help="Speed, as ratios within one run: the machines this runs on are not alike.")

# Each command imports what it measures: `frames` runs in an emulated machine too, where an import takes its time.


@app.command
def loop(
    *, seconds: float = 60.0, rates: tuple[int, ...] = (1000, 2000, 4000), runs: int = 5, json: bool = False
) -> None:
    """Run the whole service, goals without pause; time its loop beside cyclictest and the bare loop, at each rate."""
    import bench_loop

    bench_loop.main(seconds, rates, runs, json)


@app.command
def latency(*, goals: int = 100, json: bool = False) -> None:
    """Time from a goal's put to the first setpoint that it changes on the bus, at rest and in motion."""
    import bench_latency

    bench_latency.main(goals, json)


@app.command
def settle(*, goals: int = 100, json: bool = False) -> None:
    """Time from the end of a goal's path until the robot is measured to be there, on simulated drives."""
    import bench_settle

    bench_settle.main(goals, json)


@app.command
def fairness(*, goals: int = 1000, json: bool = False) -> None:
    """Time until one user's goals and stops are answered, quiet and while another floods, and the ratio of the two."""
    import bench_fairness

    bench_fairness.main(goals, json)


@app.command
def fleet(*, gateways: int = 98, seconds: float = 10.0, stops: int = 200, faults: int = 10, json: bool = False) -> None:
    """Two whole services and robots that stand for whole ones behind a router: what is seen when, and what it costs."""
    import bench_fleet

    bench_fleet.main(gateways, seconds, stops, faults, json)


@app.command
def frames(*, cycles: int = 3000, json: bool = False) -> None:
    """Time one cycle's frames by python-can, and on the bus's own socket."""
    import bench_frames

    bench_frames.main(cycles, json)


@app.command
def peers(*, seconds: float = 15.0, json: bool = False) -> None:
    """Measure the intervals of SYNC beside python-canopen's, on the same bus."""
    import bench_peers

    bench_peers.main(seconds, json)


@app.command
def planning(*, json: bool = False) -> None:
    """Time the planning of goals."""
    import bench_planning

    bench_planning.main(json)


@app.command
def kinematics(*, json: bool = False) -> None:
    """Time the recursion against a straightforward numpy port of the paper's matrices."""
    import bench_kinematics

    bench_kinematics.main(json)


@app.command
def recorder(*, seconds: float = 60.0, json: bool = False) -> None:
    """Run the whole service on simulated drives, moving, and measure what its recorder takes, watched and not."""
    import bench_recorder

    bench_recorder.main(seconds, json)


@app.command
def scrape(*, seconds: float = 120.0, json: bool = False) -> None:
    """Lateness with a scrape of the metrics each second: of all cycles, and without those around the scrapes."""
    import bench_scrape

    bench_scrape.main(seconds, json)


@app.command
def start(*, json: bool = False) -> None:
    """Time the start of a service on simulated drives, and weigh its processes."""
    import bench_start

    bench_start.main(json)


@app.command(name="all")
def everything(*, brief: bool = False, json: bool = False) -> None:
    """Run all of these, under ten minutes, and end with one table against the aims; `brief` only for a look."""
    import bench_aims

    bench_aims.main(brief, json)


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(os.EX_TEMPFAIL))  # so that its services end with it
    app()
