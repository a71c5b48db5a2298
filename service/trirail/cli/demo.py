"""`trirail demo`: the whole service with simulated drives, commanded by a client in the same way as by a user."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from rich.progress import MofNCompleteColumn, Progress, TextColumn

from trirail.cli.config_commands import shipped_file
from trirail.cli.terminal import out, percentiles, plain, print_line
from trirail.client import own_service
from trirail.client.client import Result, Robot
from trirail.config import Config, load
from trirail.errors import ConfigError, RefusedError
from trirail.processes.operating_system import Signals
from trirail.wire.state import State

GOAL_TIMEOUT_S = 15.0


class DemoMove(NamedTuple):
    """One goal of the tour: its name, x, y [m], phi [rad] and speed."""

    name: str
    x: float
    y: float
    phi: float
    speed: float = 1.0


CENTRE = (0.0, 0.0, 0.0)
ALIGNMENT = (
    DemoMove("1 mm along x", 0.001, 0.0, 0.0),
    DemoMove("1 mm along y", 0.001, 0.001, 0.0),
    DemoMove("1° to the left", 0.001, 0.001, math.radians(1.0)),
    DemoMove("a part that lies askew", -0.0012, 0.0008, math.radians(-0.35)),
    DemoMove("30 µm and 15 arcsec further", -0.00117, 0.00083, math.radians(-0.35 + 15.0 / 3600.0)),
    DemoMove("4 mm and 3°", 0.004, -0.003, math.radians(3.0)),
    DemoMove("the other way", -0.003, 0.004, math.radians(-2.5)),
    DemoMove("back to the centre", *CENTRE),
)
"""Goals for stages whose travel is a few millimetres."""
STAGE_RANGE_M = 0.02
"""Largest |x| of a stage's table for which the stage gets the goals in `ALIGNMENT` [m]."""
TOUR = (
    DemoMove("paper: rotation by 30°", 0.0, 0.0, math.pi / 6, 0.18),
    DemoMove("back to the centre", *CENTRE),
    DemoMove("paper: 50 mm along x", 0.05, 0.0, 0.0, 0.13),
    DemoMove("back to the centre", *CENTRE),
    DemoMove("paper: 50 mm along y", 0.0, 0.05, 0.0, 0.13),
    DemoMove("back to the centre", *CENTRE),
    DemoMove("tour: right, turned left", 0.06, 0.02, 0.35),
    DemoMove("tour: top", 0.0, 0.07, -0.4),
    DemoMove("tour: left, turned right", -0.06, 0.02, -0.7),
    DemoMove("tour: bottom left", -0.04, -0.05, 0.2),
    DemoMove("tour: bottom right, slowly", 0.04, -0.05, -0.2, 0.5),
    DemoMove("tour: home", *CENTRE),
)


class _Row(NamedTuple):
    stage: DemoMove
    result: Result
    seconds: float


def tour(config: Config) -> tuple[DemoMove, ...]:
    """Return the goals for a robot: the paper's goals and a round trip, or the goals of an alignment stage."""
    return ALIGNMENT if max(map(abs, config.limits.platform.x)) <= STAGE_RANGE_M else TOUR


def run(name: str = "sim", *, stay: bool, record: Path | None) -> int:
    """Run the demo on a shipped configuration; return 0 if every goal is `done` and the service ended normally."""
    file = shipped_file(name)
    config = load(file)
    if config.can.interface != "simulated":
        raise ConfigError(f"{file.name} has drives on {config.can.interface}: a demo moves only simulated drives")
    stamp = time.strftime("%Y%m%d-%H%M%S")
    recording = record or Path(config.telemetry.directory) / f"demo-{stamp}.rrd"
    locator = config.zenoh.listen[0]
    out.print(
        f"[bold]trirail demo[/]: starting the service on {file.name}, simulated drives at {config.loop.rate_hz} Hz",
        soft_wrap=True,
    )
    with contextlib.ExitStack() as stack:
        with out.status("starting the service") as status:
            show_progress = lambda words: status.update(f"starting the service: {plain(words)}")  # noqa: E731
            service = stack.enter_context(own_service.service(file, recording, show_progress))
        with Robot(config.robot.name, locator, user="demo") as robot:
            robot.enable()
            rows = list(_tour(robot, tour(config)))
            state = robot.state()
            if stay and all(row.result.outcome == "done" for row in rows):
                _report(rows, state, recording)
                _stay()
            robot.disable()
        code = own_service.end(service)
    if not stay:
        _report(rows, state, recording)
    if code:
        out.print(f"[bold red]the service ended with exit code {code}[/]")
    return 0 if code == 0 and all(row.result.outcome == "done" for row in rows) else 1


def run_align(record: Path | None) -> int:
    """Run the alignment demo; return 0 if every part was aligned."""
    from trirail.cli import demo_align

    file = shipped_file("uvw")
    stamp = time.strftime("%Y%m%d-%H%M%S")
    return demo_align.run(file, record or Path(load(file).telemetry.directory) / f"align-{stamp}.rrd")


def _tour(robot: Robot, stages: Sequence[DemoMove]) -> Iterator[_Row]:
    columns = TextColumn("{task.description:28}"), MofNCompleteColumn(), TextColumn("{task.fields[note]}")
    with Progress(*columns, console=out) as progress:
        task = progress.add_task("the tour", total=len(stages), note="")
        for number, stage in enumerate(stages, 1):
            began = time.monotonic()
            try:
                goal = robot.move_to(x=stage.x, y=stage.y, phi=stage.phi, speed=stage.speed, id=f"tour-{number}")
            except RefusedError as error:
                result = Result("", "rejected", str(error))
            else:
                for state in robot.states(2.0):
                    x, y, phi = state.pose
                    pose = f"x {x * 1e3:8.3f} mm  y {y * 1e3:8.3f} mm  φ {math.degrees(phi):8.3f}°"
                    progress.update(task, description=stage.name, note=pose)
                    if goal.result or time.monotonic() - began > GOAL_TIMEOUT_S:
                        break
                result = goal.result or Result(goal.id, "unknown", f"no end within {GOAL_TIMEOUT_S:g} s")
            progress.advance(task)
            seconds = time.monotonic() - began
            colour = "green" if result.outcome == "done" else "red"
            progress.console.print(
                f"  [{colour}]{result.outcome:9}[/] {stage.name:28} {seconds:5.2f} s"
                + ("" if result.outcome == "done" else f"  {plain(result.message)}"),
                soft_wrap=True,
            )
            yield _Row(stage, result, seconds)


def _report(rows: list[_Row], state: State, recording: Path) -> None:
    done = sum(row.result.outcome == "done" for row in rows)
    loop = state.loop
    error = max(state.sliders.following_error_max)
    out.print()
    out.print(f"[bold]goals[/]            {done} of {len(rows)} done")
    out.print(f"[bold]following error[/]  {error * 1e6:.0f} µm at most")
    out.print(f"[bold]loop[/]             {loop.cycles} cycles at {loop.rate_hz} Hz, {loop.overruns} missed")
    out.print(f"[bold]lateness[/]         {percentiles(loop.lateness_us)}")
    out.print(f"[bold]cycle time[/]       {percentiles(loop.cycle_us)}")
    for lack in loop.lacking:
        out.print(f"[bold yellow]without[/]          {plain(lack)}", soft_wrap=True)
    out.print(f"[bold]recording[/]        {plain(str(recording))}", soft_wrap=True)
    out.print(f"[bold]look at it[/]       .venv/bin/trirail view {plain(str(recording))}", soft_wrap=True)


def _stay() -> None:
    out.print()
    print_line("The service stays up, enabled. In another terminal: trirail goto 0.03 0.02 0.2 --wait")
    out.print("Live view: trirail view, or in the browser: trirail view --web")
    out.print("Ctrl-C ends it.")
    with Signals() as ends:
        ends.first()
