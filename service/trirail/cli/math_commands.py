"""Commands that need no service: the inverse and forward kinematics of a configuration's robot."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated

from trirail.cli import notation, terminal
from trirail.cli.options import DEFAULT, Flag, Offline
from trirail.errors import KinematicsError
from trirail.wire.units import ANGULAR_ACCELERATION, ANGULAR_VELOCITY

if TYPE_CHECKING:
    from trirail.config import Config
    from trirail.kinematics.arrays import Array
    from trirail.kinematics.geometry import Geometry
    from trirail.motion.limits import Violation


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
        Angles without a unit are in degrees.
    """
    import numpy as np

    from trirail.kinematics.robot import inverse
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
    bounds = Bounds(config.limits, config.period, labels=robot.labels)
    refused = bounds.pose(pose.tolist()), bounds.setpoint(list(solved.values()))
    warnings = [str(violation) for violation in refused if violation]
    if offline.json:
        derived = {"conditioning": isotropy, "distance_to_singularity": distance, "warnings": warnings}
        terminal.json({"pose": pose.tolist()} | solved | {"sensitivity": sensitivities.tolist()} | derived)
        return 0
    _print_pose(pose)
    _print_joints(robot, solved, sensitivities)
    terminal.say(
        f"conditioning {isotropy:.3f} (1 is isotropic), singular {notation.written(distance, '°', 2)} away in φ"
    )
    for warning in warnings:
        terminal.complain(f"warning: the service would refuse this: {warning}")
    return 0


def fk(a: notation.Length, b: notation.Length, c: notation.Length, /, *, offline: Offline = DEFAULT) -> int:
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

    config, robot = robot_of(offline)
    sliders = a, b, c
    beyond = Bounds(config.limits, config.period, labels=robot.labels).setpoint([sliders])
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
    """Load the configuration that is asked for; return it and its robot. Raises ConfigError."""
    from trirail.config import SIM, corrected_geometry, load

    config = load(offline.config or SIM)
    return config, corrected_geometry(config)


def _check_reach(config: Config, robot: Geometry, pose: Array) -> None:
    """Raise KinematicsError if the robot itself cannot be at a pose; it says all that is wrong."""
    from trirail.workspace.violations import violations

    found = violations(robot, config.limits, pose)
    if found:
        raise _out_of_reach(found)


def _out_of_reach(found: list[Violation]) -> KinematicsError:
    first = found[0]
    message = f"out of reach: {'; '.join(map(str, found))}"
    return KinematicsError(message, leg=first.what if first.unit == "m" else "", value=first.value, limit=first.limit)


def _print_pose(pose: Array) -> None:
    values = pose.tolist()
    terminal.say(f"{notation.pose(values)} = {notation.written(values[2], 'rad', 6)}")


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
    terminal.out.print(table)
