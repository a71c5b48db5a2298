"""Comparison of a recorded plan with the plan that another processor or program makes for the same request."""

from __future__ import annotations

import math

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from trirail.motion.marks import SWITCH

ROUNDING = 1e-9
"""Greatest difference of two numbers of a plan that counts as rounding: absolute, in SI units, or relative. Libraries
of linear algebra use other instructions, and so round otherwise, on another processor.
"""


def is_same_plan(one: object, other: object) -> bool:
    """Return whether two answers of the planner, or parts of them, are equal except for rounding."""
    if isinstance(one, Struct) and isinstance(other, Struct):
        fields = zip(one.__struct_fields__, other.__struct_fields__, strict=False)
        values = ((name, getattr(one, name), getattr(other, also)) for name, also in fields)
        same = (_are_same_switches(a, b) if name == "switches" else is_same_plan(a, b) for name, a, b in values)
        return type(one) is type(other) and all(same)
    if isinstance(one, tuple) and isinstance(other, tuple):
        return len(one) == len(other) and all(map(is_same_plan, one, other))
    if isinstance(one, bytes) and isinstance(other, bytes):
        return len(one) == len(other) and _are_close(np.frombuffer(one), np.frombuffer(other))
    if isinstance(one, float) and isinstance(other, float):
        return math.isclose(one, other, rel_tol=ROUNDING, abs_tol=ROUNDING)
    return one == other


def _are_close(one: NDArray[np.float64], other: NDArray[np.float64]) -> bool:
    return np.allclose(one, other, rtol=ROUNDING, atol=ROUNDING, equal_nan=True)


def _are_same_switches(one: bytes, other: bytes) -> bool:
    """Return whether two plans switch the same outputs at the same times except for rounding."""
    if len(one) != len(other):
        return False
    a, b = np.frombuffer(one, SWITCH), np.frombuffer(other, SWITCH)
    same = all(np.array_equal(a[name], b[name]) for name in ("mark", "on"))
    return same and all(_are_close(a[name], b[name]) for name in ("s", "width"))
