"""Commands that need no service: the mathematics of a configuration's robot."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter
from rich.table import Table
from trirail_drivers.interface import Triple

from trirail.cli import terminal
from trirail.errors import KinematicsError, TrirailError

if TYPE_CHECKING:
    from trirail.config import Config
    from trirail.kinematics.algebra import Array
    from trirail.kinematics.geometry import Geometry
    from trirail.motion.limits import Violation
    from trirail.workspace.workspace import Extent

Flag = Parameter(negative="")

AT_REST: Triple = (0.0, 0.0, 0.0)
STEPS = (1, 2, 5, 10, 15, 20, 30, 45)
"""From one slice to the next, if no angles are asked for [°]."""
SLICES = 8
"""So many of them at most."""


@Parameter(name="*")
@dataclass(frozen=True)
class Offline:
    """Which robot, and how to print."""

    config: Path | None = None
    "Configuration file; the simulated robot if absent."
    json: Annotated[bool, Flag] = False
    "Print one JSON object, in metres and radians, instead of words."


DEFAULT = Offline()


def ik(
    x: float,
    y: float,
    phi: float,
    /,
    *,
    velocity: Annotated[Triple, Flag] = AT_REST,
    acceleration: Annotated[Triple, Flag] = AT_REST,
    deg: Annotated[bool, Flag] = False,
    offline: Offline = DEFAULT,
) -> int:
    """Solve the inverse kinematics: where sliders and passive joints are at a pose, and how they move.

    A pose that the robot cannot reach, or nearer to a singularity than configured, is an error. What only the
    limits of the platform's window or of the drives forbid is solved, with a warning.

    Parameters
    ----------
    x
        Position of the platform's centre [m].
    y
        Position of the platform's centre [m].
    phi
        Angle of the platform [rad].
    velocity
        Velocity of the platform in x, y [m/s] and phi [rad/s].
    acceleration
        Acceleration of the platform in x, y [m/s²] and phi [rad/s²].
    deg
        All angles are in degrees.
    """
    import numpy as np

    from trirail.kinematics.robot import inverse
    from trirail.motion.limits import Bounds
    from trirail.workspace.singularity import conditioning, distance_to_singularity, sensitivity

    config, robot = _load(offline)
    unit = np.array([1.0, 1.0, math.radians(1.0) if deg else 1.0])
    pose = np.array([x, y, phi]) * unit
    motion = inverse(robot, pose, velocity * unit, acceleration * unit)
    _check_reach(config, robot, pose)
    solved = {name: values.tolist() for name, values in motion._asdict().items()}
    sensitivities = sensitivity(robot, pose)
    isotropy, distance = float(conditioning(robot, pose)), float(distance_to_singularity(robot, pose))
    bounds = Bounds(config.limits, config.period)
    refused = bounds.pose(pose.tolist()), bounds.setpoint(list(solved.values()))
    warnings = [str(violation) for violation in refused if violation]
    if offline.json:
        derived = {"conditioning": isotropy, "distance_to_singularity": distance, "warnings": warnings}
        terminal.json({"pose": pose.tolist()} | solved | {"sensitivity": sensitivities.tolist()} | derived)
        return 0
    _print_pose(pose)
    _print_joints(solved, sensitivities)
    terminal.say(f"conditioning {isotropy:.3f} (1 is isotropic), singular {math.degrees(distance):.2f}° away in φ")
    for warning in warnings:
        terminal.complain(f"warning: the service would refuse this: {warning}")
    return 0


def fk(a: float, b: float, c: float, /, *, offline: Offline = DEFAULT) -> int:
    """Solve the forward kinematics: the pose at which the sliders stand as given.

    Sliders beyond their travel, and a pose that the robot cannot reach, are an error.

    Parameters
    ----------
    a
        Position of slider A [m].
    b
        Position of slider B [m].
    c
        Position of slider C [m].
    """
    from trirail.kinematics.robot import forward
    from trirail.motion.limits import Bounds

    config, robot = _load(offline)
    sliders = a, b, c
    beyond = Bounds(config.limits, config.period).setpoint([sliders])
    if beyond:
        raise _out_of_reach([beyond])
    pose = forward(robot, sliders)
    _check_reach(config, robot, pose)
    if offline.json:
        terminal.json({"pose": pose.tolist()})
    else:
        _print_pose(pose)
    return 0


def workspace(
    *,
    plot: Path | None = None,
    phi: Annotated[tuple[float, ...], Parameter(consume_multiple=True, negative="", show_default=False)] = (),
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
        The angles are in degrees.
    """
    from trirail.workspace.workspace import area, extent, permitted, reachable

    config, robot = _load(offline)
    if not all(map(math.isfinite, phi)):
        raise KinematicsError("phi: every angle must be finite")
    limits = config.limits
    service, reach = extent(robot, limits, permitted), extent(robot, limits, reachable)
    angles = [math.radians(angle) if deg else angle for angle in phi] or _round_angles(*service.phi)
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


def _load(offline: Offline) -> tuple[Config, Geometry]:
    from trirail.config import SIM, geometry, load

    config = load(offline.config or SIM)
    return config, geometry(config.geometry)


def _check_reach(config: Config, robot: Geometry, pose: Array) -> None:
    """Raise KinematicsError if the robot itself cannot be at a pose; it says all that is wrong."""
    from trirail.workspace.workspace import violations

    found = violations(robot, config.limits, pose)
    if found:
        raise _out_of_reach(found)


def _out_of_reach(found: list[Violation]) -> KinematicsError:
    first = found[0]
    message = f"out of reach: {'; '.join(map(str, found))}"
    return KinematicsError(message, leg=first.what if first.unit == "m" else "", value=first.value, limit=first.limit)


def _round_angles(low: float, high: float) -> list[float]:
    """Return the multiples [rad] of a round number of degrees in a range, few enough to look at together."""
    for step in STEPS:
        first, last = math.ceil(math.degrees(low) / step), math.floor(math.degrees(high) / step)
        if last - first < SLICES:
            break
    return [math.radians(step * k) for k in range(first, last + 1)]


def _draw(file: Path, config: Config, robot: Geometry, angles: list[float], reach: Extent, service: Extent) -> None:
    try:
        from trirail.workspace import plots
    except ImportError as error:
        raise TrirailError("--plot needs matplotlib: pip install 'trirail[analysis]'") from error
    try:
        plots.draw(file, f"Workspace of robot {config.robot.name}", robot, config.limits, angles, reach, service)
    except (OSError, ValueError) as error:
        raise TrirailError(f"cannot draw to {file}: {error}") from error


def _measures(extent: Extent, area_at_zero: float) -> dict[str, object]:
    return {
        "x": extent.x,
        "y": extent.y,
        "phi": extent.phi,
        "area_at_zero": area_at_zero,
        "best": {"phi": extent.best_phi, "area": extent.best_area},
        "volume": extent.volume,
    }


def _print_pose(pose: Array) -> None:
    x, y, phi = pose.tolist()
    angle = f"{_number(math.degrees(phi), 4)}° = {_number(phi, 6)} rad"
    terminal.say(f"x {_number(x * 1e3, 3)} mm   y {_number(y * 1e3, 3)} mm   φ {angle}")


def _print_joints(solved: dict[str, list[float]], sensitivities: Array) -> None:
    table = _table("", "A", "B", "C", "")
    for title, name, scale, unit in (
        ("slider", "position", 1e3, "mm"),
        ("  velocity", "velocity", 1e3, "mm/s"),
        ("  acceleration", "acceleration", 1.0, "m/s²"),
        ("platform edge", "passive_position", 1e3, "mm"),
        ("  velocity", "passive_velocity", 1e3, "mm/s"),
        ("  acceleration", "passive_acceleration", 1.0, "m/s²"),
    ):
        table.add_row(title, *(_number(value * scale, 3) for value in solved[name]), unit)
    columns = sensitivities.T * [[1.0], [1.0], [1e3 * math.radians(1.0)]]
    for axis, unit, values in zip("xyφ", ("mm/mm", "mm/mm", "mm/°"), columns.tolist(), strict=True):
        table.add_row(f"slider per {axis}", *(_number(value, 3) for value in values), unit)
    terminal.out.print(table)


def _print_extents(service: Extent, reach: Extent, at_zero: tuple[float, float]) -> None:
    table = _table("", "the service permits", "the robot reaches", "")
    both = service, reach
    table.add_row("x", *(_range(each.x, 1e3) for each in both), "mm")
    table.add_row("y", *(_range(each.y, 1e3) for each in both), "mm")
    table.add_row("φ", *(_range(each.phi, math.degrees(1.0)) for each in both), "°")
    table.add_row("area at φ = 0", *(_number(each, 6) for each in at_zero), "m²")
    table.add_row("greatest area", *(_number(each.best_area, 6) for each in both), "m²")
    table.add_row("  at φ =", *(_number(math.degrees(each.best_phi), 2) for each in both), "°")
    table.add_row("volume", *(_number(each.volume, 6) for each in both), "m² rad")
    terminal.out.print(table)


def _print_slices(slices: list[tuple[float, float, float]]) -> None:
    table = _table("slice at φ [°]", "permitted [m²]", "reached [m²]")
    for angle, inside, whole in slices:
        table.add_row(_number(math.degrees(angle), 2), _number(inside, 6), _number(whole, 6))
    terminal.out.print(table)


def _table(first: str, *others: str) -> Table:
    table = Table(box=None, pad_edge=False, padding=(0, 3, 0, 0), header_style="bold")
    table.add_column(first)
    for name in others:
        table.add_column(name, justify="right" if name else "left")
    return table


def _range(ends: tuple[float, float], scale: float) -> str:
    return " to ".join(_number(end * scale, 2) for end in ends)


def _number(value: float, digits: int) -> str:
    """Write a number without the sign of a rounded zero."""
    return f"{round(value, digits) + 0.0:.{digits}f}"
