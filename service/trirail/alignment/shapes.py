"""Shapes of marks, for detection and simulation: crosses, discs, corners and codes with edges blurred by a lens.

The origin of a shape's frame is its middle; that of a corner is the tip. The brightness is 1 inside and 0 outside;
across an edge it follows the logistic function nearest to a Gaussian's integral.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np

from trirail.alignment.rigid_motion import Floats

MarkKind = Literal["cross", "disc", "corner", "code"]
LOGISTIC_SLOPE = 1.702
"""1 / (1 + exp(-1.702 x)) is within 0.01 of the Gaussian's integral."""


class MarkShape(NamedTuple):
    """Shape of a mark, in metres on a part or in pixels in a picture."""

    kind: MarkKind
    size: float
    """Diameter of a disc, length of a cross's bars, or side of a corner's square or of a code with its border."""
    width: float = 0.0
    """Width of a cross's bars; 0 means a fifth of their length."""
    cells: tuple[tuple[int, ...], ...] = ()
    """Rows of a code's cells with its border, in the direction of v: 1 for ink, 0 for ground."""

    @property
    def bar_width(self) -> float:
        """Width of a cross's bars, with the default applied."""
        return self.width or self.size / 5.0


def brightness(shape: MarkShape, x: Floats, y: Floats, blur: float) -> Floats:
    """Return the brightness of a shape at points of its frame; `blur` is the standard deviation of its edges."""
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
    # Union of both bars, smooth also where their edges meet.
    return np.asarray(1.0 - (1.0 - horizontal) * (1.0 - vertical))


def _code_brightness(shape: MarkShape, x: Floats, y: Floats, blur: float) -> Floats:
    cells = np.array(shape.cells, float)
    edges = shape.size * (np.arange(len(cells) + 1) / len(cells) - 0.5)
    # Differences of steps, which add up to one step over cells of the same kind: no seam between them.
    along, down = (-np.diff(_blurred_step(at[..., None] - edges, blur), axis=-1) for at in (x, y))
    return np.asarray(np.einsum("...i,ij,...j->...", down, cells, along))


def _blurred_step(depth: Floats, blur: float) -> Floats:
    return np.asarray(0.5 + 0.5 * np.tanh(0.5 * LOGISTIC_SLOPE * depth / blur))
