"""Rotations and derivatives, by the book."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from trirail.kinematics.arrays import Array


def theta(angle: float) -> Array:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def differences(function: Callable[[float], Array], t: float, h: float = 1e-2) -> tuple[Array, Array]:
    """Return the first and second derivative of a smooth function, by central differences of order 8."""
    first = np.array([1 / 280, -4 / 105, 1 / 5, -4 / 5, 0.0, 4 / 5, -1 / 5, 4 / 105, -1 / 280])
    second = np.array([-1 / 560, 8 / 315, -1 / 5, 8 / 5, -205 / 72, 8 / 5, -1 / 5, 8 / 315, -1 / 560])
    samples = np.array([function(t + k * h) for k in range(-4, 5)])
    return np.tensordot(first, samples, 1) / h, np.tensordot(second, samples, 1) / h**2
