"""Small, slow, jerk-limited ways: of one slider, and of the platform around a square."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from ruckig import InputParameter, Ruckig, Trajectory

from trirail.config import Config, SliderLimits, geometry
from trirail.kinematics.arrays import Array
from trirail.kinematics.robot import forward, inverse
from trirail.motion.ruckig_call import solved
from trirail.quantities import beyond

DISTANCE = 0.001
"""How far a slider, or the platform along a side of the square, is moved [m]."""
VELOCITY = 0.005
"""Greatest velocity [m/s]."""
ACCELERATION = 0.05
"""Greatest acceleration [m/s²]."""
JERK = 1.0
"""Greatest jerk [m/s³]."""

STILL = 1e-9
"""Who goes less far stays where they are [m]."""


class SlowMove(NamedTuple):
    """A motion of the three sliders from where they stand, a row for each cycle."""

    position: Array
    """How far each slider is from where it began, (N, 3) [m]."""
    velocity: Array
    """Their velocities, (N, 3) [m/s]."""


def profile(distance: float, limits: SliderLimits, period: float) -> tuple[Array, Array]:
    """Return positions [m] and velocities [m/s] from rest to rest, (N,) each, the last one at `distance` [m].

    Never faster than the constants above, nor than the configured `limits`.
    """
    request = InputParameter(1)
    request.target_position = [distance]
    request.max_velocity = [min(VELOCITY, *limits.velocities)]
    request.max_acceleration = [min(ACCELERATION, *limits.accelerations)]
    request.max_jerk = [min(JERK, *limits.jerks)]
    trajectory = Trajectory(1)
    if not solved(Ruckig(1), request, trajectory):
        raise ValueError(f"Ruckig finds no motion over {distance} m")
    times = np.arange(1, math.ceil(trajectory.duration / period) + 1) * period
    rows = np.array([trajectory.at_time(min(time, trajectory.duration))[:2] for time in times])
    return rows[:, 0, 0], rows[:, 1, 0]


def together(ways: Array, limits: SliderLimits, period: float) -> SlowMove:
    """Return the way of all three over `ways` (3,) [m], on a straight line between them."""
    longest = float(np.abs(ways).max())
    along, rate = profile(max(longest, STILL), limits, period)
    shares = ways / max(longest, STILL)
    return SlowMove(along[:, None] * shares, rate[:, None] * shares)


def of_slider(index: int, distance: float, limits: SliderLimits, period: float) -> SlowMove:
    """Return the way of one slider over `distance` [m]; the others stand."""
    along, rate = profile(distance, limits, period)
    position, velocity = np.zeros((len(along), 3)), np.zeros((len(along), 3))
    position[:, index], velocity[:, index] = along, rate
    return SlowMove(position, velocity)


def square(config: Config, sliders: tuple[float, float, float]) -> tuple[SlowMove, Array]:
    """Return the sliders' way for a square of the platform from where it stands, and its poses, (N, 3).

    Along x, along y, and back, `DISTANCE` each. Raises KinematicsError where the sliders belong to no pose, ValueError
    where the way leaves a limit.
    """
    robot = geometry(config.geometry)
    start = forward(robot, sliders)
    along, rate = profile(DISTANCE, config.limits.slider, config.period)
    sides = [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, -1.0, 0.0)]
    poses, rates, corner = [], [], np.array(start)
    for side in np.array(sides):
        poses.append(corner + along[:, None] * side)
        rates.append(rate[:, None] * side)
        corner = corner + DISTANCE * side
    path = np.concatenate(poses)
    motion = inverse(robot, path, np.concatenate(rates))
    platform, slider = config.limits.platform, config.limits.slider
    for name, unit, values, (low, high) in (
        ("platform x", "m", path[:, 0], platform.x),
        ("platform y", "m", path[:, 1], platform.y),
        ("platform φ", "rad", path[:, 2], platform.phi),
        *(
            (f"slider {name}", "m", motion.position[:, i], ends)
            for i, (name, ends) in enumerate(zip(robot.labels, slider.positions, strict=True))
        ),
        ("a passive joint", "m", motion.passive_position, slider.passive),
    ):
        for value, limit, outside in (
            (values.min(), low, values.min() < low),
            (values.max(), high, values.max() > high),
        ):
            if outside:
                raise ValueError(beyond(name, float(value), limit, unit))
    return SlowMove(motion.position - np.array(sliders), motion.velocity), path
