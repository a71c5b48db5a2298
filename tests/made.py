"""Records as a service makes them, of a robot that moves: for the recorder's tests and for trying the view."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from trirail.kinematics.geometry import Geometry
from trirail.kinematics.robot import inverse
from trirail.wire.records import DTYPE
from trirail.wire.vocabulary import MODES, Mode
from trirail_drivers.interface import PowerState

RATE_HZ = 1000
MONOTONIC_NS = 5_000_000_000_000
"""The monotonic clock at cycle 0."""


def bits(records: NDArray[np.void]) -> list[bytes]:
    """Return what records hold to the last bit, field by field: what is between the fields means nothing."""
    return [records[name].tobytes() for name in records.dtype.names or ()]


def records(
    seconds: float, geometry: Geometry | None = None, seed: int = 0, mode: Mode = Mode.MOVING
) -> NDArray[np.void]:
    """Return the records of a smooth tour of the workspace, at 1 kHz."""
    robot = geometry or Geometry.symmetric(0.3)
    n = round(seconds * RATE_HZ)
    t = np.arange(n) / RATE_HZ
    random = np.random.default_rng(seed)
    commanded, velocity, acceleration = _tour(t)
    motion = inverse(robot, commanded, velocity, acceleration)
    # a servo that lags behind acceleration, and counts of 0.1 µm
    error = motion.acceleration * 1.6e-5 + random.normal(0.0, 0.4e-6, (n, 3))

    made: NDArray[Any] = np.zeros(n, DTYPE)
    made["cycle"] = np.arange(n)
    made["deadline_ns"] = MONOTONIC_NS + np.arange(n) * (1_000_000_000 // RATE_HZ)
    made["lateness_ns"] = random.gamma(4.0, 9e3, n)
    late = random.choice(n, max(1, n // 1500), replace=False)
    made["lateness_ns"][late] += random.integers(60_000, 320_000, len(late))
    made["parts_ns"] = random.gamma(40.0, 500.0, (n, 8)) * [0.9, 2.2, 0.3, 1.4, 0.8, 1.8, 0.7, 0.2]
    made["mode"] = MODES.index(mode)
    made["homed"] = True
    made["drive_state"] = PowerState.OPERATION_ENABLED
    made["commanded_pose"] = commanded
    made["commanded_pose_velocity"] = velocity
    made["commanded_pose_acceleration"] = acceleration
    made["commanded_position"] = motion.position
    made["commanded_velocity"] = motion.velocity
    made["commanded_acceleration"] = motion.acceleration
    made["passive_position"] = motion.passive_position
    made["position"] = np.round((motion.position - error) * 1e7) / 1e7
    made["following_error"] = motion.position - made["position"]
    made["velocity"] = motion.velocity + random.normal(0.0, 2e-4, (n, 3))
    made["pose"] = commanded + random.normal(0.0, 1e-6, (n, 3))
    made["progress"] = t % 3.0 / 3.0
    made["remaining"] = 3.0 - t % 3.0
    return made


def _tour(t: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return pose, velocity and acceleration, (N, 3): a three-petalled flower, turning to and fro."""
    size, turn = 0.055, 0.25
    w = 2.0 * math.pi / 5.0
    terms = [  # of each coordinate: amplitude, angular frequency, phase
        [(size, 2.0 * w, 0.0), (size * 0.6, 4.0 * w, 0.0)],
        [(size, 2.0 * w, -math.pi / 2.0), (size * 0.6, 4.0 * w, math.pi / 2.0)],
        [(turn, 3.0 * w, -math.pi / 2.0)],
    ]
    pose = [sum(a * np.cos(f * t + p) for a, f, p in waves) for waves in terms]
    velocity = [sum(-a * f * np.sin(f * t + p) for a, f, p in waves) for waves in terms]
    acceleration = [sum(-a * f * f * np.cos(f * t + p) for a, f, p in waves) for waves in terms]
    return np.stack(pose, axis=1), np.stack(velocity, axis=1), np.stack(acceleration, axis=1)
