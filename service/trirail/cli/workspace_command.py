"""`trirail workspace`: what the service permits and what the robot itself reaches, measured and drawn."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from trirail.cli import notation, terminal
from trirail.cli.math_commands import robot_of
from trirail.cli.options import DEFAULT, Flag, Offline

if TYPE_CHECKING:
    from trirail.config import Config
    from trirail.kinematics.geometry import Geometry
    from trirail.workspace.workspace import Extent

STEPS = (1, 2, 5, 10, 15, 20, 30, 45)
"""From one slice to the next, if no angles are asked for [°]."""
CM2 = 1e4
"""Areas are shown in cm²: a stage has some, a large robot a thousand."""
SLICES = 8
"""So many of them at most."""


def workspace(
    *,
    plot: Path | None = None,
    phi: notation.Angles = (),
    deg: Annotated[bool, Flag] = False,
    offline: Offline = DEFAULT,
) -> int:
    """Measure the workspace: what the service permits, and what the robot itself reaches.

    The robot's own reach ends where sliders or platform edges do, and at the singularity margin. The service
    permits what of it lies in the window of limits.platform.

    Parameters
    ----------
    plot
        Picture to draw: slices over phi with the conditioning as colour. Its suffix is its format: .png, .svg, .pdf.
    phi
        Angles of the slices [rad]; round numbers of degrees if absent.
    deg
        Angles without a unit are in degrees.
    """
    from trirail.workspace.workspace import area, extent, permitted, reachable

    config, robot = robot_of(offline)
    limits = config.limits
    service, reach = extent(robot, limits, permitted), extent(robot, limits, reachable)
    angles = [notation.radians(angle, deg) for angle in phi] or _round_angles(*service.phi)
    slices = [(angle, permitted(robot, limits, angle), reachable(robot, limits, angle)) for angle in angles]
    at_zero = area(permitted(robot, limits, 0.0)), area(reachable(robot, limits, 0.0))
    if plot:
        _draw(plot, config, robot, angles, reach, service)
    if offline.json:
        terminal.json(
            {
                "robot": config.robot.name,
                "permitted": _measures(service, at_zero[0]),
                "reachable": _measures(reach, at_zero[1]),
                "slices": [
                    {
                        "phi": angle,
                        "permitted": {"area": area(inside), "polygon": inside.tolist()},
                        "reachable": {"area": area(whole), "polygon": whole.tolist()},
                    }
                    for angle, inside, whole in slices
                ],
            }
        )
        return 0
    _print_extents(service, reach, at_zero)
    terminal.say("")
    _print_slices([(angle, area(inside), area(whole)) for angle, inside, whole in slices])
    if plot:
        terminal.say("")
        terminal.say(f"drawn to {plot}")
    return 0


def _round_angles(low: float, high: float) -> list[float]:
    """Return the multiples [rad] of a round number of degrees in a range, few enough to look at together."""
    for step in STEPS:
        first, last = math.ceil(math.degrees(low) / step), math.floor(math.degrees(high) / step)
        if last - first < SLICES:
            break
    return [math.radians(step * k) for k in range(first, last + 1)]


def _draw(file: Path, config: Config, robot: Geometry, angles: list[float], reach: Extent, service: Extent) -> None:
    with terminal.drawing(file):
        from trirail.workspace import plots

        plots.draw(file, f"Workspace of robot {config.robot.name}", robot, config.limits, angles, reach, service)


def _measures(extent: Extent, area_at_zero: float) -> dict[str, object]:
    return {
        "x": extent.x,
        "y": extent.y,
        "phi": extent.phi,
        "area_at_zero": area_at_zero,
        "best": {"phi": extent.best_phi, "area": extent.best_area},
        "volume": extent.volume,
    }


def _print_extents(service: Extent, reach: Extent, at_zero: tuple[float, float]) -> None:
    table = terminal.table("", "the service permits", "the robot reaches", "")
    both = service, reach
    table.add_row("x", *(_range(each.x, 1e3) for each in both), "mm")
    table.add_row("y", *(_range(each.y, 1e3) for each in both), "mm")
    table.add_row("φ", *(_range(each.phi, math.degrees(1.0)) for each in both), "°")
    table.add_row("area at φ = 0", *(notation.number(each * CM2, 3) for each in at_zero), "cm²")
    table.add_row("greatest area", *(notation.number(each.best_area * CM2, 3) for each in both), "cm²")
    table.add_row("  at φ =", *(notation.number(math.degrees(each.best_phi), 2) for each in both), "°")
    table.add_row("volume", *(notation.number(each.volume * CM2, 3) for each in both), "cm² rad")
    terminal.out.print(table)


def _print_slices(slices: list[tuple[float, float, float]]) -> None:
    table = terminal.table("slice at φ [°]", "permitted [cm²]", "reached [cm²]")
    for angle, inside, whole in slices:
        table.add_row(
            notation.number(math.degrees(angle), 2), *(notation.number(each * CM2, 3) for each in (inside, whole))
        )
    terminal.out.print(table)


def _range(ends: tuple[float, float], scale: float) -> str:
    return " to ".join(notation.number(end * scale, 2) for end in ends)
