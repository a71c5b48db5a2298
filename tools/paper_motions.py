"""The paper's three motions by equation (5): of the platform, and of the sliders, computed and from exact tables."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from trirail.errors import ServiceError
from trirail.kinematics.arrays import Array
from trirail.kinematics.geometry import LEGS, Geometry
from trirail.kinematics.robot import inverse

L0 = 0.3
"""Distance between the centre and a vertex of the fixed triangle [m]."""
DURATION = 3.0
"""Duration of each motion [s]."""
TABLES = Path(__file__).resolve().parents[1] / "tests" / "data"
"""Folder with the solutions of the loop equations (11) for the three examples, with 50 digits."""


class Example(NamedTuple):
    """Motion of the platform by equation (5), from the central configuration to twice the `amplitude`."""

    name: str
    title: str
    amplitude: tuple[float, float, float]  # x* [m], y* [m], phi* [rad]


class Quantity(NamedTuple):
    """Quantity of the sliders in a figure."""

    name: str
    column: str  # in the tables, followed by the name of a slider
    symbol: str
    unit: str


class Curves(NamedTuple):
    """Motion of the three sliders over time: t, (N,) [s], and the other fields, (N, 3) [m], [m/s], [m/s²]."""

    t: Array
    position: Array  # lambda_10
    velocity: Array  # v_10
    acceleration: Array  # gamma_10

    def values_of(self, quantity: Quantity) -> Array:
        """Return the values of a quantity, (N, 3)."""
        return self[1 + QUANTITIES.index(quantity)]


EXAMPLES = (
    Example("rotation", "Rotation", (0.0, 0.0, math.pi / 12)),
    Example("translation_x", "Motion along x", (0.025, 0.0, 0.0)),
    Example("translation_y", "Motion along y", (0.0, 0.025, 0.0)),
)
QUANTITIES = (  # in the order of the fields of Curves
    Quantity("displacement", "lambda10", r"\lambda_{10}", "m"),
    Quantity("velocity", "v10", "v_{10}", "m/s"),
    Quantity("acceleration", "gamma10", r"\gamma_{10}", "m/s²"),
)


def platform(example: Example, t: Array) -> tuple[Array, Array, Array]:
    """Return the pose, velocity and acceleration of the platform by equation (5) at times t, (N,) [s]; each (N, 3)."""
    w = math.pi / 3.0
    return (
        np.outer(1.0 - np.cos(w * t), example.amplitude),
        np.outer(w * np.sin(w * t), example.amplitude),
        np.outer(w * w * np.cos(w * t), example.amplitude),
    )


def computed(example: Example, t: Array) -> Curves:
    """Return the motion of the sliders at times t, (N,) [s], by equation (5) and the inverse kinematics."""
    motion = inverse(Geometry.symmetric(L0), *platform(example, t))
    return Curves(t, motion.position, motion.velocity, motion.acceleration)


def tabulated(example: Example) -> Curves:
    """Return the exact motion of the sliders from its table. Raises ServiceError if the table cannot be read."""
    path = TABLES / f"paper_{example.name}.csv"
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
    except OSError as error:
        raise ServiceError(f"{path}: {error.strerror}") from error
    columns = [[f"{quantity.column}_{leg}" for leg in LEGS] for quantity in QUANTITIES]
    position, velocity, acceleration = (
        np.array([[float(row[key]) for key in keys] for row in rows]) for keys in columns
    )
    return Curves(np.array([float(row["t"]) for row in rows]), position, velocity, acceleration)


def figures() -> Iterator[tuple[int, Example, Quantity]]:
    """Yield the number, the example and the quantity of each figure of the paper."""
    pairs = ((example, quantity) for example in EXAMPLES for quantity in QUANTITIES)
    for number, (example, quantity) in enumerate(pairs, start=3):
        yield number, example, quantity


def greatest_difference(curves: Curves, reference: Curves, quantity: Quantity) -> float:
    """Return the maximum difference of a quantity between two motions at the same times, in the quantity's unit."""
    return float(np.max(np.abs(curves.values_of(quantity) - reference.values_of(quantity))))
