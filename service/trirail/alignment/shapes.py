"""Shapes of marks for detection and simulation: crosses, discs, corners and codes, with blurred edges.

The origin of the frame of a shape is its middle; for a corner, the origin is the tip. The brightness is 1 inside and 0
outside. Across an edge, the brightness follows the logistic function that is closest to the integral of a Gaussian.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np

from trirail.alignment.rigid_motion import Floats

MarkKind = Literal["cross", "disc", "corner", "code"]
LOGISTIC_SLOPE = 1.702
"""Slope with which 1 / (1 + exp(-slope x)) differs from the integral of a Gaussian by less than 0.01."""


class MarkShape(NamedTuple):
    """Shape of a mark, in metres on a part or in pixels in a picture."""

    kind: MarkKind
    size: float
    """Diameter of a disc, length of the bars of a cross, side of the square of a corner, or side of a code with its
    border."""
    width: float = 0.0
    """Width of the bars of a cross; 0 means a fifth of their length."""
    cells: tuple[tuple[int, ...], ...] = ()
    """Rows of the cells of a code, including the border, in the direction of v. Ink is 1 and ground is 0."""

    @property
    def bar_width(self) -> float:
        """Width of the bars of a cross, with the default applied."""
        return self.width or self.size / 5.0


def brightness(shape: MarkShape, x: Floats, y: Floats, blur: float) -> Floats:
    """Return the brightness of a shape at points in its frame. `blur` is the standard deviation of blurred edges."""
    half = shape.size / 2.0
    if shape.kind == "disc":
        return _blurred_step(half - np.hypot(x, y), blur)
    if shape.kind == "corner":
        along = _blurred_step(x, blur) * _blurred_step(shape.size - x, blur)
        return np.asarray(along * _blurred_step(y, blur) * _blurred_step(shape.size - y, blur))
    if shape.kind == "code":
        return _code_brightness(shape, x, y, blur)
    across, up = np.abs(x), np.abs(y)
    horizontal = _blurred_step(half - across, blur) * _blurred_step(shape.bar_width / 2.0 - up, blur)
    vertical = _blurred_step(half - up, blur) * _blurred_step(shape.bar_width / 2.0 - across, blur)
    # The union of both bars is smooth, including the points at which their edges meet.
    return np.asarray(1.0 - (1.0 - horizontal) * (1.0 - vertical))


def _code_brightness(shape: MarkShape, x: Floats, y: Floats, blur: float) -> Floats:
    cells = np.array(shape.cells, float)
    edges = shape.size * (np.arange(len(cells) + 1) / len(cells) - 0.5)
    # Each cell is a difference of two steps. The steps between neighbouring cells with ink cancel, without a visible
    # line.
    along, down = (-np.diff(_blurred_step(at[..., None] - edges, blur), axis=-1) for at in (x, y))
    return np.asarray(np.einsum("...i,ij,...j->...", down, cells, along))


def _blurred_step(depth: Floats, blur: float) -> Floats:
    return np.asarray(0.5 + 0.5 * np.tanh(0.5 * LOGISTIC_SLOPE * depth / blur))
