"""Display of the robot's state for people: once, live, or during a jog."""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import msgspec
from rich.live import Live
from rich.table import Table
from trirail_drivers.interface import MissingProtection

from trirail import naming
from trirail.cli import notation
from trirail.cli.terminal import (
    COLOURS,
    SERVICE_TIMEOUT_S,
    budget_share,
    can_redraw,
    end_with_reader,
    json,
    left,
    out,
    percentiles,
    plain,
    print_line,
    print_table,
)
from trirail.errors import ServiceError, TrirailError
from trirail.naming import Labels
from trirail.wire.decoding import converted
from trirail.wire.state import GoalState, Info, State
from trirail.wire.vocabulary import Mode

if TYPE_CHECKING:
    from trirail.client.client import Jog, Robot
    from trirail.config import Limits

NEAR_SHARE = 0.05
"""Share of its range within which a position counts as near a limit. A rate counts as near its limit if it is less than
this share of the limit below it."""
_ALONG = (("x", "mm", "mm/s", 3), ("y", "mm", "mm/s", 3), ("φ", "°", "°/s", 4))


def show(state: State, info: Info) -> None:
    """Print a state, the correction of as-built errors, and the protections that drives lack."""
    grid = table(state, info.robot, info.labels, limits_of(info))
    if info.correction is not None:
        grid.add_row("corrected", plain(notation.correction(info.correction, info.labels)))
    if out.is_terminal:
        out.print(grid)  # long values continue in their own column
    else:
        print_table(grid)
    _missing(info.missing_protections, info.labels)


def watch(robot: Robot, *, json_lines: bool) -> None:
    """Show the state live, or as lines of JSON, until Ctrl-C. Raises ServiceError if the service stops answering."""
    info = robot.info()  # fails immediately without a service, whereas states would only be silent
    limits = limits_of(info)
    with contextlib.suppress(KeyboardInterrupt):
        if json_lines:
            for state in end_with_reader(robot.states(SERVICE_TIMEOUT_S)):
                json(msgspec.to_builtins(state))
        elif not can_redraw():
            _print_once_a_second(robot)
        else:
            with Live(console=out, refresh_per_second=10, transient=False) as live:
                for state in robot.states(SERVICE_TIMEOUT_S):
                    live.update(table(state, robot.name, info.labels, limits))
        raise ServiceError("the service no longer sends its state")


def _print_once_a_second(robot: Robot) -> None:
    """Print the state as a line once a second, where a table cannot be redrawn."""
    due = -math.inf
    for state in end_with_reader(robot.states(SERVICE_TIMEOUT_S)):
        if time.monotonic() >= due:
            due = time.monotonic() + 1.0
            goal = f"  goal {state.goal.id} {state.goal.progress:.0%}" if state.goal else ""
            faults = "".join(f"  {fault}" for fault in state.faults)
            print_line(f"{state.t:.2f} s  {state.mode}  {notation.measured_pose(state)}{goal}{faults}")


@contextlib.contextmanager
def ending(jog: Jog, seconds: float | None) -> Iterator[None]:
    """End a jog after a time, even if no state arrives; without a time, do nothing."""

    def end() -> None:
        with contextlib.suppress(TrirailError):  # the program leaves the context as well, and gets the error
            jog.__exit__()

    if seconds is None:
        yield
        return
    timer = threading.Timer(seconds, end)
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def show_jog(robot: Robot, jog: Jog, labels: Labels, *, show: bool = True) -> None:
    """Show the pose during a jog until the jog ends; without `show`, only wait for the end."""
    # Live writes the codes that hide the cursor even if it is never updated.
    with Live(console=out, refresh_per_second=10, transient=True) if show else contextlib.nullcontext() as live:
        for state in robot.states(SERVICE_TIMEOUT_S):
            if live is not None:
                live.update(table(state, robot.name, labels))
            if jog.error is not None or jog.result is not None:
                return
    raise ServiceError("the service no longer sends its state")


def limits_of(info: Info) -> Limits:
    """Return the limits from a service's information. Raises ServiceError if they cannot be decoded."""
    from trirail.config import Limits  # numba, with the kinematics

    try:
        return converted(info.limits, Limits)
    except msgspec.ValidationError as error:
        raise ServiceError(f"the service has another version, and its limits cannot be read: {error}") from error


def table(state: State, robot: str, labels: Labels, limits: Limits | None = None) -> Table:
    """Return a state as a table: faults, current goal, measured and commanded values, nearby limits, loop."""
    grid = Table.grid(padding=(0, 2))
    grid.add_row("robot", f"[bold]{plain(robot)}[/]  {_mode(state)}  t {state.t:.2f} s")
    for fault in state.faults:
        grid.add_row("fault", f"[bold red]{plain(fault)}[/]")
    colour = "yellow" if state.override != 1.0 else "default"
    grid.add_row("override", f"[{colour}]{notation.written(state.override * 100.0, '%', 0)}[/]")
    if state.lease is not None:
        grid.add_row("lease", f"held by {plain(state.lease)}")
    if state.goal:
        _add_goal(grid, state, state.goal)
    colour = "yellow" if state.measured_pose is None else "default"
    grid.add_row("measured", f"[{colour}]{notation.measured_pose(state, 9)}[/]")
    grid.add_row("commanded", notation.pose(state.commanded.pose, 9))
    _add_sliders(grid, state, labels)
    for words in near_limits(state, limits, labels) if limits else ():
        grid.add_row("[yellow]near[/]", plain(words))
    loop = state.loop
    words = f"{loop.rate_hz} Hz, {loop.cycles} cycles, {loop.overruns} missed"
    grid.add_row("loop", f"{words}, bus {loop.bus_load_measured:.0%} of at most {loop.bus_load:.0%}")
    grid.add_row("lateness", percentiles(loop.lateness_us))
    grid.add_row("cycle", percentiles(loop.cycle_us))
    grid.add_row("setpoints", percentiles(loop.setpoints_us))
    grid.add_row("budget", budget_share(loop.setpoints_us, loop.setpoint_budget_us))
    for lack in loop.lacking:
        grid.add_row("[yellow]without[/]", plain(lack))
    for warning in state.warnings:
        grid.add_row("[yellow]warning[/]", plain(warning))
    return grid


def near_limits(state: State, limits: Limits, labels: Labels) -> Iterator[str]:
    """Yield a line for each measured position, commanded rate or following error that is near or beyond its limit."""
    slider, platform = limits.slider, limits.platform
    measured = zip(labels, state.sliders.position, slider.positions, state.sliders.following_error, strict=True)
    for (name, at, travel, error), homed in zip(measured, state.sliders.homed, strict=True):
        if homed:
            yield from _position(f"slider {name}", at, travel, "mm", 3)
        yield from _rate(f"following error of {name}", error, slider.following_error, "µm", 1)
    for name, rate, most in zip(labels, state.commanded.velocity, slider.velocities, strict=True):
        yield from _rate(f"velocity of slider {name}", rate, most, "mm/s", 2)
    ranges = (platform.x, platform.y, platform.phi)
    pose = state.measured_pose or (None, None, None)
    for (name, unit, per_second, digits), coordinate, rate, ends, most in zip(
        _ALONG, pose, state.commanded.pose_velocity, ranges, platform.velocity, strict=True
    ):
        if coordinate is not None:
            yield from _position(name, coordinate, ends, unit, digits)
        yield from _rate(f"velocity of {name}", rate, most, per_second, 2)


def _position(name: str, at: float, ends: Sequence[float], unit: str, digits: int) -> Iterator[str]:
    low, high = ends
    limit = low if at - low < high - at else high
    if abs(limit - at) <= NEAR_SHARE * (high - low) or not low <= at <= high:
        yield f"{name} {notation.written(at, unit, digits)}, limit {notation.written(limit, unit, digits)}"


def _rate(name: str, at: float, most: float, unit: str, digits: int) -> Iterator[str]:
    if abs(at) >= (1.0 - NEAR_SHARE) * most:
        limit = math.copysign(most, at)
        yield f"{name} {notation.written(at, unit, digits)}, limit {notation.written(limit, unit, digits)}"


def _mode(state: State) -> str:
    colour = COLOURS.get(state.mode, "default")
    paused = "  [yellow]paused[/]" if state.mode == Mode.HOLDING and state.goal else ""
    settled = "  settled" if state.settled else ""
    return f"[{colour}]{plain(state.mode)}[/]{paused}{settled}"


def _add_goal(grid: Table, state: State, goal: GoalState) -> None:
    if goal.lag is not None:
        grid.add_row("goal", f"{plain(goal.id)}  follows its target, {notation.written(goal.lag, 'm', 6)} behind")
    else:
        grid.add_row("goal", f"{plain(goal.id)}  {goal.progress:.0%}, {left(state, goal)}")
    if goal.target is not None:
        grid.add_row("  target", notation.pose(goal.target, 9))
        if (measured := state.measured_pose) is not None:
            remaining = [end - at for end, at in zip(goal.target, measured, strict=True)]
            grid.add_row("  to go", notation.pose(remaining, 9))


def _add_sliders(grid: Table, state: State, labels: Labels) -> None:
    sliders = state.sliders
    for index, name in enumerate(labels):
        written = (
            notation.written(sliders.position[index], "mm", 3, 9) if sliders.homed[index] else "[yellow]not homed[/]",
            f"commanded {notation.written(state.commanded.position[index], 'mm', 3, 9)}",
            f"error {notation.written(sliders.following_error[index], 'µm', 1, 7)}",
            notation.written(sliders.velocity[index], "mm/s", 2, 8),
            sliders.status[index],
        )
        grid.add_row(f"slider {name}", "  ".join(written))
        traffic = msgspec.to_builtins(sliders.traffic[index])
        if counts := [f"{kind.replace('_', ' ')} {count}" for kind, count in traffic.items() if count]:
            grid.add_row("", f"[yellow]{', '.join(counts)}[/]")


def _missing(protections: Sequence[MissingProtection], labels: Labels) -> None:
    """Print the protections that drives lack; drives that lack the same one share a line."""
    drives: dict[str, list[str]] = {}
    for each in protections:
        drives.setdefault(f"{each.object}, {each.means}", []).append(each.drive)
    for what, names in drives.items():
        whose = ", ".join(naming.drive(name, labels) for name in names)
        out.print(f"[yellow]lacking[/]   {whose}: {plain(what)}", soft_wrap=True)
