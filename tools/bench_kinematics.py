"""Speed of the kinematics: the compiled recursion compared with a plain numpy port of the paper's matrices."""

from __future__ import annotations

import math
import timeit
from collections.abc import Callable

import numpy as np
from trirail.kinematics.arrays import Array
from trirail.kinematics.closure import inverse_batch
from trirail.kinematics.geometry import Geometry
from trirail.kinematics.robot import forward_into, inverse, inverse_into, warm_up

L0 = 0.3
POSE = np.array([0.02, -0.01, 0.15])
VELOCITY = np.array([0.1, 0.05, 0.2])
ACCELERATION = np.array([0.5, -0.3, 1.0])
BATCH = 200_000

U3 = np.array([0.0, 0.0, 1.0])
U3_TILDE = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
THETA_1 = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
THETA_2 = 0.5 * np.array([[1.0, -math.sqrt(3), 0.0], [math.sqrt(3), 1.0, 0.0], [0.0, 0.0, 2.0]])
ALPHA = (math.pi / 3, math.pi, -math.pi / 3)
R_00 = L0 * np.array([[0.0, -1.0, 0.0], [math.sqrt(3) / 2, 0.5, 0.0], [-math.sqrt(3) / 2, 0.5, 0.0]])
R_3 = 0.5 * L0 * np.array([0.0, 1.0, -math.sqrt(3) / 3])


def numpy_port(pose: Array, velocity: Array, acceleration: Array) -> Array:
    """Return the output of inverse_into, (6, 3), for the symmetric robot, from equations (2) to (19) of the paper."""
    out = np.empty((6, 3))
    phi, omega, epsilon = pose[2], velocity[2], acceleration[2]
    centre = np.array([pose[0], pose[1], 0.0])
    for i, alpha in enumerate(ALPHA):
        q_10 = THETA_1 @ _theta(alpha)
        q_32 = THETA_1 @ THETA_2
        q_20 = _theta(phi) @ THETA_1.T @ q_10
        q_30 = q_32 @ q_20
        directions = np.stack([q_10.T @ U3, q_30.T @ U3], axis=1)[:2]

        gap = centre - R_00[i] - L0 / math.sqrt(3) * q_10.T @ U3 - q_30.T @ R_3
        lambda_10, lambda_32 = np.linalg.solve(directions, gap[:2])

        arm = lambda_32 * q_32.T @ U3 + q_32.T @ R_3
        turning = q_20.T @ U3_TILDE @ arm
        v_10, v_32 = np.linalg.solve(directions, velocity[:2] - omega * turning[:2])

        centripetal = omega**2 * q_20.T @ U3_TILDE @ U3_TILDE @ arm
        coriolis = 2.0 * omega * v_32 * q_20.T @ U3_TILDE @ q_32.T @ U3
        right = acceleration[:2] - (centripetal + epsilon * turning + coriolis)[:2]
        gamma_10, gamma_32 = np.linalg.solve(directions, right)
        out[:, i] = lambda_10, v_10, gamma_10, lambda_32, v_32, gamma_32
    return out


def _theta(angle: float) -> Array:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def measure() -> dict[str, float]:
    """Return the time per call [µs], the ratios to the numpy port, and the poses per second [1e6/s] on this core."""
    warm_up()
    geometry = Geometry.symmetric(L0)
    legs, motion, out = geometry.packed(), np.stack([POSE, VELOCITY, ACCELERATION]), np.empty((6, 3))
    sliders, pose = inverse(geometry, POSE).position, np.zeros(3)
    motions = np.random.default_rng(0).uniform(-0.1, 0.1, (3, BATCH, 3))
    outs = np.empty((6, BATCH, 3))

    inverse_into(legs, motion, out)
    if not np.allclose(out, numpy_port(*motion), rtol=1e-12, atol=1e-13):
        raise SystemExit("the numpy port and the recursion differ")

    port = _seconds(lambda: numpy_port(*motion))
    into = _seconds(lambda: inverse_into(legs, motion, out))
    single = _seconds(lambda: inverse(geometry, POSE, VELOCITY, ACCELERATION))
    back = _seconds(lambda: forward_into(legs, sliders, pose, pose))
    batch = _seconds(lambda: inverse_batch(legs, motions, outs)) / BATCH
    return {
        "numpy_port_us": port * 1e6,
        "inverse_into_us": into * 1e6,
        "inverse_into_ratio": port / into,
        "inverse_us": single * 1e6,
        "inverse_ratio": port / single,
        "forward_into_us": back * 1e6,
        "batch_us": batch * 1e6,
        "batch_million_poses_per_s": 1e-6 / batch,
    }


def _seconds(call: Callable[[], object]) -> float:
    """Return the shortest time of a call [s] in five runs, each of which takes at least a fifth of a second."""
    timer = timeit.Timer(call)
    number, _ = timer.autorange()
    return min(timer.repeat(repeat=5, number=number)) / number
