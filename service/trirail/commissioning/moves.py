"""Small, slow and jerk-limited motions of one slider, of all three sliders, and of the platform around a square."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from ruckig import InputParameter, Ruckig, Trajectory

from trirail.commissioning.coupling import MAX_BACKLASH_M
from trirail.config import Config, SliderLimits, geometry
from trirail.kinematics.arrays import Array
from trirail.kinematics.robot import Motion, forward, inverse
from trirail.motion.ruckig_call import try_solve
from trirail.quantities import beyond

TEST_DISTANCE_M = 0.001
"""Travel of a single slider, and length of the sides of the platform's square [m]."""
MIN_TEST_DISTANCE_M = MAX_BACKLASH_M
"""Minimum travel of a single slider that can be judged [m]. Play can absorb a shorter one completely."""
ROOM_SHARE = 0.9
"""Fraction of the room up to a limit that a single slider uses. It overshoots, and a measured position has noise."""
MAX_VELOCITY = 0.005
"""Velocity limit of all motions [m/s]."""
MAX_ACCELERATION = 0.05
"""Acceleration limit of all motions [m/s²]."""
MAX_JERK = 1.0
"""Jerk limit of all motions [m/s³]."""

GAIN_POINTS = 11
"""Number of points on each side of the square at which the velocities of the sliders are compared with the platform's.
"""
MIN_DISTANCE_M = 1e-9
"""Minimum travel of a motion that Ruckig can plan [m]."""


class SlowMove(NamedTuple):
    """Motion of the three sliders relative to the start of the motion, with one row for each cycle."""

    position: Array
    """Offsets from the start, (N, 3) [m]."""
    velocity: Array
    """Velocities, (N, 3) [m/s]."""


def choose_distance(position: float | None, limits: tuple[float, float]) -> float:
    """Return the signed test distance of a slider [m], with which it stays within its `limits` [m].

    The slider moves in its positive direction unless the upper limit is near and the lower one is farther away. A
    slider outside its limits moves inwards.

    Parameters
    ----------
    position
        Position of the slider [m]; None if it is unknown, which is assumed to be the middle of the travel.

    Raises
    ------
    ValueError
        If the slider has less room than `MIN_TEST_DISTANCE_M` in both directions.
    """
    low, high = limits
    at = (low + high) / 2.0 if position is None else position
    up, down = high - at, at - low
    direction, available = (1.0, up) if up >= 2.0 * TEST_DISTANCE_M or up >= down else (-1.0, down)
    distance = min(TEST_DISTANCE_M, ROOM_SHARE * available)
    if distance < MIN_TEST_DISTANCE_M:
        raise ValueError(
            f"{available * 1e3:.2f} mm to the farther limit is too little for a test, which needs "
            f"{MIN_TEST_DISTANCE_M / ROOM_SHARE * 1e3:.2f} mm"
        )
    return direction * distance


def plan_profile(distance: float, limits: SliderLimits, period: float, gain: float = 1.0) -> tuple[Array, Array]:
    """Plan a motion from rest to rest over `distance` [m]; return the positions [m] and velocities [m/s], (N,) each.

    The first row is for the first cycle after the start. The limits of this module and the configured `limits` apply to
    sliders that move `gain` times as fast.
    """
    request = InputParameter(1)
    request.target_position = [distance]
    request.max_velocity = [min(MAX_VELOCITY, *limits.velocities) / gain]
    request.max_acceleration = [min(MAX_ACCELERATION, *limits.accelerations) / gain]
    request.max_jerk = [min(MAX_JERK, *limits.jerks) / gain]
    trajectory = Trajectory(1)
    if not try_solve(Ruckig(1), request, trajectory):
        raise ValueError(f"Ruckig finds no motion over {distance} m")
    times = np.arange(1, math.ceil(trajectory.duration / period) + 1) * period
    rows = np.array([trajectory.at_time(min(time, trajectory.duration))[:2] for time in times])
    return rows[:, 0, 0], rows[:, 1, 0]


def plan_joint_move(distances: Array, limits: SliderLimits, period: float) -> SlowMove:
    """Plan a motion of all three sliders over `distances` (3,) [m], on a straight line in slider space."""
    longest = float(np.abs(distances).max())
    along, rate = plan_profile(max(longest, MIN_DISTANCE_M), limits, period)
    shares = distances / max(longest, MIN_DISTANCE_M)
    return SlowMove(along[:, None] * shares, rate[:, None] * shares)


def plan_slider_move(index: int, distance: float, limits: SliderLimits, period: float) -> SlowMove:
    """Plan a motion of the slider `index` over `distance` [m]; the other sliders do not move."""
    along, rate = plan_profile(distance, limits, period)
    position, velocity = np.zeros((len(along), 3)), np.zeros((len(along), 3))
    position[:, index], velocity[:, index] = along, rate
    return SlowMove(position, velocity)


def plan_square(config: Config, sliders: tuple[float, float, float]) -> tuple[SlowMove, Array]:
    """Plan a slider motion that moves the platform around a square; return the motion and the platform's poses.

    The poses are an array (N, 3) [m, m, rad]. The platform starts at the pose that belongs to the slider positions
    `sliders` [m]. It moves by `TEST_DISTANCE_M` along x, along y, back along x, and back along y.

    Raises
    ------
    KinematicsError
        If no pose belongs to the slider positions, or if a pose of the square is out of reach.
    ValueError
        If the motion exceeds a limit.
    """
    robot = geometry(config.geometry)
    start = forward(robot, sliders)
    sides = np.array([(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, -1.0, 0.0)])
    corners = start + TEST_DISTANCE_M * np.vstack([np.zeros(3), np.cumsum(sides[:-1], axis=0)])

    def motion_along(along: Array, rate: Array) -> tuple[Array, Motion]:
        path = np.concatenate([corner + along[:, None] * side for corner, side in zip(corners, sides, strict=True)])
        return path, inverse(robot, path, np.concatenate([rate[:, None] * side for side in sides]))

    points = np.linspace(0.0, TEST_DISTANCE_M, GAIN_POINTS)
    _, at_unit_speed = motion_along(points, np.ones(GAIN_POINTS))
    gain = max(1.0, float(np.abs(at_unit_speed.velocity).max()))
    path, motion = motion_along(*plan_profile(TEST_DISTANCE_M, config.limits.slider, config.period, gain))
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
        for value, limit, is_outside in (
            (values.min(), low, values.min() < low),
            (values.max(), high, values.max() > high),
        ):
            if is_outside:
                raise ValueError(beyond(name, float(value), limit, unit))
    return SlowMove(motion.position - np.array(sliders), motion.velocity), path
