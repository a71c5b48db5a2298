"""Commands that do not need a service: kinematics and workspace of the robot in a configuration."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from trirail.cli import notation, terminal
from trirail.cli.options import DEFAULT, Flag, Offline
from trirail.errors import KinematicsError
from trirail.wire.units import ANGULAR_ACCELERATION, ANGULAR_VELOCITY

if TYPE_CHECKING:
    from trirail.config import Config, Limits
    from trirail.kinematics.arrays import Array
    from trirail.kinematics.geometry import Geometry
    from trirail.motion.limits import Violation
    from trirail.workspace.workspace import Extent

SLICE_STEPS_DEG = (1, 2, 5, 10, 15, 20, 30, 45)
"""Possible steps between slices if no angles are given [°]."""
CM2 = 1e4
"""Number of cm² in a m². Areas are shown in cm²: a stage has a few of them, a large robot about a thousand."""
MAX_SLICES = 8
"""Maximum number of slices."""


def ik(
    x: notation.Length,
    y: notation.Length,
    phi: notation.Angle,
    /,
    *,
    velocity: notation.PoseVelocity = notation.AT_REST,
    acceleration: notation.PoseAcceleration = notation.AT_REST,
    deg: Annotated[bool, Flag] = False,
    offline: Offline = DEFAULT,
) -> int:
    """Solve the inverse kinematics: the positions and rates of sliders and passive joints at a pose.

    A pose that the robot cannot reach, or that is closer to a singularity than configured, is an error. If only the
    limits of the platform or of the drives, or the travel reserved for backlash, forbid the pose, the command solves it
    and prints a warning.

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
        Angles without a unit are in degrees.
    """
    import numpy as np

    from trirail.kinematics.robot import inverse
    from trirail.motion.backlash_reserve import planned_limits
    from trirail.motion.limits import Bounds
    from trirail.workspace.singularity import conditioning, distance_to_singularity, sensitivity

    config, robot = robot_of(offline)
    pose = np.array([x, y, notation.radians(phi, deg)])
    rates = [*velocity[:2], notation.radians(velocity[2], deg, ANGULAR_VELOCITY)]
    changes = [*acceleration[:2], notation.radians(acceleration[2], deg, ANGULAR_ACCELERATION)]
    motion = inverse(robot, pose, rates, changes)
    _check_reach(config, robot, pose)
    solved = {name: values.tolist() for name, values in motion._asdict().items()}
    sensitivities = sensitivity(robot, pose)
    isotropy, distance = float(conditioning(robot, pose)), float(distance_to_singularity(robot, pose))
    planned = planned_limits(config.limits, config.correction.backlash)
    bounds = Bounds(planned, config.period, labels=robot.labels)
    refused = bounds.pose_violation(pose.tolist()), bounds.setpoint_violation(list(solved.values()))
    warnings = [str(violation) for violation in refused if violation]
    if offline.json:
        derived = {"conditioning": isotropy, "distance_to_singularity": distance, "warnings": warnings}
        terminal.json({"pose": pose.tolist()} | solved | {"sensitivity": sensitivities.tolist()} | derived)
        return 0
    _print_pose(pose)
    _print_joints(robot, solved, sensitivities)
    terminal.print_line(
        f"conditioning {isotropy:.3f} (1 is isotropic), singular {notation.written(distance, '°', 2)} away in φ"
    )
    for warning in warnings:
        terminal.print_error(f"warning: the service would refuse this: {warning}")
    return 0


def fk(a: notation.Length, b: notation.Length, c: notation.Length, /, *, offline: Offline = DEFAULT) -> int:
    """Solve the forward kinematics: the pose that belongs to the given slider positions.

    Slider positions beyond the travel are an error, and so is a pose that the robot cannot reach.

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

    config, robot = robot_of(offline)
    sliders = a, b, c
    beyond = Bounds(config.limits, config.period, labels=robot.labels).setpoint_violation([sliders])
    if beyond:
        raise _out_of_reach([beyond])
    pose = forward(robot, sliders)
    _check_reach(config, robot, pose)
    if offline.json:
        terminal.json({"pose": pose.tolist()})
    else:
        _print_pose(pose)
    return 0


def robot_of(offline: Offline) -> tuple[Config, Geometry]:
    """Load the requested configuration; return it and its robot's geometry. Raises ConfigError if it is invalid."""
    from trirail.config import SIM, corrected_geometry, load

    config = load(offline.config or SIM)
    return config, corrected_geometry(config)


def _check_reach(config: Config, robot: Geometry, pose: Array) -> None:
    """Raise KinematicsError if the robot itself cannot reach a pose; the message lists all violated limits."""
    from trirail.workspace.violations import violations

    exceeded = violations(robot, config.limits, pose)
    if exceeded:
        raise _out_of_reach(exceeded)


def _out_of_reach(violations: list[Violation]) -> KinematicsError:
    first = violations[0]
    message = f"out of reach: {'; '.join(map(str, violations))}"
    return KinematicsError(message, leg=first.axis if first.unit == "m" else "", value=first.value, limit=first.limit)


def _print_pose(pose: Array) -> None:
    values = pose.tolist()
    terminal.print_line(f"{notation.pose(values)} = {notation.written(values[2], 'rad', 6)}")


def _print_joints(robot: Geometry, solved: dict[str, list[float]], sensitivities: Array) -> None:
    table = terminal.table("", *robot.labels, "")
    for title, name, scale, unit in (
        ("slider", "position", 1e3, "mm"),
        ("  velocity", "velocity", 1e3, "mm/s"),
        ("  acceleration", "acceleration", 1.0, "m/s²"),
        ("cross slide", "passive_position", 1e3, "mm"),
        ("  velocity", "passive_velocity", 1e3, "mm/s"),
        ("  acceleration", "passive_acceleration", 1.0, "m/s²"),
    ):
        table.add_row(title, *(notation.number(value * scale, 3) for value in solved[name]), unit)
    columns = sensitivities.T * [[1.0], [1.0], [1e3 * math.radians(1.0)]]
    for axis, unit, values in zip("xyφ", ("mm/mm", "mm/mm", "mm/°"), columns.tolist(), strict=True):
        table.add_row(f"slider per {axis}", *(notation.number(value, 3) for value in values), unit)
    terminal.print_table(table)


def workspace(
    *,
    plot: Path | None = None,
    phi: notation.Angles = (),
    deg: Annotated[bool, Flag] = False,
    offline: Offline = DEFAULT,
) -> int:
    """Measure the workspace that the robot reaches, and the part that the service permits.

    The travel of sliders and platform edges and the singularity margin bound the robot's reach. The service permits
    the part of it within limits.platform and without the
    travel reserved for backlash.

    Parameters
    ----------
    plot
        Picture of slices at several phi to draw, coloured by conditioning. The suffix selects the format: .png, .svg or
        .pdf.
    phi
        Angles of the slices [rad]. If absent, round numbers of degrees.
    deg
        Angles without a unit are in degrees.
    """
    from trirail.motion.backlash_reserve import planned_limits
    from trirail.workspace.workspace import measure_extent, permitted_slice, polygon_area, reachable_slice

    config, robot = robot_of(offline)
    limits, planned = config.limits, planned_limits(config.limits, config.correction.backlash)
    service, reach = measure_extent(robot, planned, permitted_slice), measure_extent(robot, limits, reachable_slice)
    angles = [notation.radians(angle, deg) for angle in phi] or _round_angles(*service.phi)
    slices = [(at, permitted_slice(robot, planned, at), reachable_slice(robot, limits, at)) for at in angles]
    at_zero = polygon_area(permitted_slice(robot, planned, 0.0)), polygon_area(reachable_slice(robot, limits, 0.0))
    if plot:
        _draw(plot, config, robot, planned, angles, reach, service)
    if offline.json:
        terminal.json(
            {
                "robot": config.robot.name,
                "permitted": _measures(service, at_zero[0]),
                "reachable": _measures(reach, at_zero[1]),
                "slices": [
                    {
                        "phi": angle,
                        "permitted": {"area": polygon_area(inside), "polygon": inside.tolist()},
                        "reachable": {"area": polygon_area(whole), "polygon": whole.tolist()},
                    }
                    for angle, inside, whole in slices
                ],
            }
        )
        return 0
    _print_extents(service, reach, at_zero)
    terminal.print_line("")
    _print_slices([(angle, polygon_area(inside), polygon_area(whole)) for angle, inside, whole in slices])
    if plot:
        terminal.print_line("")
        terminal.print_line(f"drawn to {plot}")
    return 0


def _round_angles(low: float, high: float) -> list[float]:
    """Return the multiples [rad] of a round number of degrees in a range, few enough to be viewed together.

    If the range contains no whole degree, return its middle.
    """
    for step in SLICE_STEPS_DEG:
        first, last = math.ceil(math.degrees(low) / step), math.floor(math.degrees(high) / step)
        if last - first < MAX_SLICES:
            break
    return [math.radians(step * k) for k in range(first, last + 1)] or [(low + high) / 2.0]


def _draw(
    file: Path, config: Config, robot: Geometry, planned: Limits, angles: list[float], reach: Extent, service: Extent
) -> None:
    with terminal.drawing(file):
        from trirail.workspace import plots

        title = f"Workspace of robot {config.robot.name}"
        plots.draw_workspace(file, title, robot, config.limits, planned, angles, reach, service)


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
    terminal.print_table(table)


def _print_slices(slices: list[tuple[float, float, float]]) -> None:
    table = terminal.table("slice at φ [°]", "permitted [cm²]", "reached [cm²]")
    for angle, inside, whole in slices:
        table.add_row(
            notation.number(math.degrees(angle), 2), *(notation.number(each * CM2, 3) for each in (inside, whole))
        )
    terminal.print_table(table)


def _range(ends: tuple[float, float], scale: float) -> str:
    return " to ".join(notation.number(end * scale, 2) for end in ends)
