"""Vectors and 3 x 3 matrices as tuples. Compiled code keeps tuples in registers, without allocations and loops."""

from __future__ import annotations

import math
from typing import Any

from numpy.typing import NDArray

from trirail.kinematics.arrays import Matrix, Vector
from trirail.kinematics.compiled import inlined

__all__ = [
    "add",
    "copy_vector",
    "cross",
    "dot",
    "plus_u3",
    "product",
    "scale",
    "subtract",
    "times",
    "transposed_times",
    "turned",
]


@inlined
def copy_vector(x: NDArray[Any], out: NDArray[Any]) -> None:
    """Copy x (n,) into `out` (n,). An assignment to `out[:]` would need memory, because the arrays might overlap."""
    for i in range(len(out)):
        out[i] = x[i]


@inlined
def add(x: Vector, y: Vector) -> Vector:
    """Return x + y."""
    return x[0] + y[0], x[1] + y[1], x[2] + y[2]


@inlined
def subtract(x: Vector, y: Vector) -> Vector:
    """Return x - y."""
    return x[0] - y[0], x[1] - y[1], x[2] - y[2]


@inlined
def scale(s: float, x: Vector) -> Vector:
    """Return s x."""
    return s * x[0], s * x[1], s * x[2]


@inlined
def plus_u3(x: Vector, s: float) -> Vector:
    """Return x + s u3, where u3 is the unit vector of the z axis."""
    return x[0], x[1], x[2] + s


@inlined
def dot(x: Vector, y: Vector) -> float:
    """Return xᵀ y."""
    return x[0] * y[0] + x[1] * y[1] + x[2] * y[2]


@inlined
def cross(x: Vector, y: Vector) -> Vector:
    """Return x̃ y, the cross product, where x̃ is the skew-symmetric matrix of x."""
    return x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0]


@inlined
def times(q: Matrix, x: Vector) -> Vector:
    """Return q x."""
    return dot(q[0], x), dot(q[1], x), dot(q[2], x)


@inlined
def transposed_times(q: Matrix, x: Vector) -> Vector:
    """Return qᵀ x."""
    return add(add(scale(x[0], q[0]), scale(x[1], q[1])), scale(x[2], q[2]))


@inlined
def product(a: Matrix, q: Matrix) -> Matrix:
    """Return a q."""
    return transposed_times(q, a[0]), transposed_times(q, a[1]), transposed_times(q, a[2])


@inlined
def turned(phi: float, q: Matrix) -> Matrix:
    """Return q^phi q, with q^phi from (3), which rotates the frame of q by phi [rad] about the z axis."""
    c, s = math.cos(phi), math.sin(phi)
    return add(scale(c, q[0]), scale(s, q[1])), subtract(scale(c, q[1]), scale(s, q[0])), q[2]
