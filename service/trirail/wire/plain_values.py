"""Conversion of numbers and arrays of any library to the types of Python that messages can contain."""

from __future__ import annotations

import contextlib
import math
import operator
import sys
from typing import Any


def plain_value(value: Any) -> Any:
    """Convert a value to a type that messages can contain.

    Raises TypeError if the value cannot be converted, and ValueError if it is not finite.
    """
    numpy = sys.modules.get("numpy")  # a program that uses numpy's numbers has already imported numpy
    if numpy is not None and isinstance(value, (numpy.ndarray, numpy.generic)):
        if value.dtype.kind == "f" and not numpy.isfinite(value).all():
            raise ValueError(f"{value!r} is not finite")
        value = value.tolist()  # numbers, booleans and strings of Python
        if isinstance(value, list | str | bool):
            return value
    for name, convert in (("__index__", operator.index), ("__float__", float)):
        if hasattr(type(value), name):  # float() alone would also accept strings
            with contextlib.suppress(TypeError):
                return finite(convert(value))
    raise TypeError(f"{value!r}, of type {type(value).__name__}, is no number")


def finite(value: float) -> float:
    """Return a number unchanged. Raises ValueError if it is not finite."""
    if not math.isfinite(value):
        raise ValueError(f"{value} is no finite number")
    return value
