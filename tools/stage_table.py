"""Kinematics of a stage at some poses, compared with 60-digit arithmetic and with small-angle equations.

python tools/stage_table.py [CONFIG] [--pose X Y PHI] [--velocity VX VY W] [--json]

Lengths and angles may have units, such as 1mm and 5arcsec. Each row is for one pose and velocity of the platform. It
contains the positions of the sliders and cross slides, and the velocities of the sliders. It also contains the maximum
difference between these values and 60-digit arithmetic, including the pose that the forward kinematics return, and the
maximum error of the slider positions by the small-angle equations that most programs use.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Sequence
from decimal import Decimal, localcontext
from pathlib import Path
from typing import NamedTuple

import exact
import numpy as np
from trirail import config
from trirail.cli.notation import numbers
from trirail.errors import TrirailError
from trirail.kinematics.arrays import Array
from trirail.kinematics.geometry import Geometry
from trirail.kinematics.leg import AnyLeg
from trirail.kinematics.robot import forward, inverse, jacobians
from trirail.wire.units import ANGLE, ANGULAR_VELOCITY, LENGTH, VELOCITY, Dimension, quantity

STAGE = config.SIM.with_name("uvw-ppr.toml")
DEGREE = math.pi / 180.0
POSES = tuple(
    (x / 1e3, y / 1e3, degrees * DEGREE)
    for x, y, degrees in (
        (0, 0, 0),
        (0, 0, 0.1),
        (0, 0, 1),
        (1, -0.8, 1),
        (1, 2, 1),
        (0, 0, 5),
        (3, -2, 5),
        (-3, 2, -5),
    )
)
"""Poses in the guide to the kinds of stages, and some others [m, m, rad]."""
PLATFORM = 0.01, -0.005, 0.1
"""Velocity of the platform [m/s, m/s, rad/s]."""
STEP = Decimal("1e-20")
"""Step of the difference quotient for the 60-digit velocity [s]. The error of the quotient is of the order of 1e-40."""


class StageRow(NamedTuple):
    """Row for one pose; each list has one number for each coordinate or slider."""

    pose: list[float]
    """Pose of the platform [m, m, rad]."""
    sliders: list[float]
    """Positions of the sliders [m]."""
    passive: list[float]
    """Positions of the cross slides [m]."""
    velocity: list[float]
    """Velocities of the sliders [m/s]."""
    difference: float
    """Maximum difference from 60-digit arithmetic in positions [m], velocities [m/s] and the pose [m, rad]."""
    small_angles: float
    """Maximum error of the slider positions by the small-angle equations [m]."""


def rows(robot: Geometry, poses: Sequence[Sequence[float]], velocity: Sequence[float]) -> list[StageRow]:
    """Return the table of a stage. Raises KinematicsError."""
    zero = np.zeros(3)
    j1, j2 = jacobians(robot, zero)
    per_pose = np.linalg.solve(j1, j2)
    at_zero = inverse(robot, zero).position
    table = []
    for pose in poses:
        motion = inverse(robot, pose, velocity)
        true, rates = _true(robot, pose, velocity)
        back = forward(robot, true[0], near=pose)
        differences = (
            motion.position - true[0],
            motion.passive_position - true[1],
            motion.velocity - rates[0],
            motion.passive_velocity - rates[1],
            back - np.array(pose),
        )
        table.append(
            StageRow(
                list(pose),
                motion.position.tolist(),
                motion.passive_position.tolist(),
                motion.velocity.tolist(),
                float(np.abs(differences).max()),
                float(np.abs(at_zero + per_pose @ pose - true[0]).max()),
            )
        )
    return table


def _true(robot: Geometry, pose: Sequence[float], velocity: Sequence[float]) -> tuple[Array, Array]:
    """Return the positions of sliders and cross slides, (2, 3) [m], and their velocities [m/s], with 60 digits."""
    with localcontext() as context:
        context.prec = exact.DIGITS
        after, before = (
            [Decimal(at) + sign * STEP * Decimal(rate) for at, rate in zip(pose, velocity, strict=True)]
            for sign in (1, -1)
        )
        places = [_exact(leg, pose) for leg in robot.each]
        rates = [
            [(b - a) / (2 * STEP) for a, b in zip(_exact(leg, before), _exact(leg, after), strict=True)]
            for leg in robot.each
        ]
    return np.array(places, dtype=np.float64).T, np.array(rates, dtype=np.float64).T


def _exact(leg: AnyLeg, pose: Sequence[float | Decimal]) -> tuple[Decimal, Decimal]:
    held, angle, turns = leg.crossing
    return exact.travels(leg.anchor, leg.rail_angle, leg.home, held, angle, bool(turns), pose)


def show(robot: Geometry, velocity: Sequence[float], table: Sequence[StageRow]) -> None:
    """Print the table as text."""
    a, b, c = robot.labels
    vx, vy, w = velocity
    print(f"{robot.kind}, platform at {vx * 1e3:g} mm/s, {vy * 1e3:g} mm/s, {w / DEGREE:.4g} °/s\n")
    names = [*(f"{name} [mm]" for name in (a, b, c)), *(f"s {name} [mm]" for name in (a, b, c))]
    names += [f"v {name} [mm/s]" for name in (a, b, c)]
    print(
        f"{'x, y [mm], φ [°]':>20}" + "".join(f"{name:>12}" for name in names) + f"{'60 digits':>12}{'small [µm]':>12}"
    )
    for row in table:
        x, y, phi = row.pose
        pose = f"{x * 1e3:g}, {y * 1e3:g}, {phi / DEGREE:.6g}"
        values = "".join(f"{value * 1e3 + 0.0:12.6f}" for value in (*row.sliders, *row.passive, *row.velocity))
        print(f"{pose:>20}{values}{row.difference:12.1e}{row.small_angles * 1e6:12.3f}")
    print("\n60 digits: the greatest difference from them of all in a row, and of the pose that comes back [SI].")
    print("small: how far a slider is wrong by the equations for small angles.")


def _three(words: Sequence[str], along: Dimension, turning: Dimension) -> list[float]:
    x, y, phi = words
    return [quantity(x, along), quantity(y, along), quantity(phi, turning)]


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table; return the exit code."""
    parser = argparse.ArgumentParser(description="A stage in numbers, of either kind.")
    parser.add_argument("config", nargs="?", type=Path, default=STAGE, help="its geometry (%(default)s)")
    parser.add_argument("--pose", nargs=3, action="append", metavar=("X", "Y", "PHI"), help="instead of the usual ones")
    parser.add_argument("--velocity", nargs=3, metavar=("VX", "VY", "W"), help="of the platform")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of words")
    options = parser.parse_args(numbers(sys.argv[1:] if arguments is None else arguments))
    try:
        robot = config.geometry(config.load(options.config).geometry)
        poses = [_three(each, LENGTH, ANGLE) for each in options.pose or ()] or POSES
        velocity = _three(options.velocity, VELOCITY, ANGULAR_VELOCITY) if options.velocity else PLATFORM
        table = rows(robot, poses, velocity)
    except (TrirailError, ValueError) as error:
        print(f"stage_table: {error}", file=sys.stderr)
        return 1
    if options.json:
        print(json.dumps({"kind": robot.kind, "velocity": list(velocity), "rows": [row._asdict() for row in table]}))
    else:
        show(robot, velocity, table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
