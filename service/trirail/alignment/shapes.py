"""The marks that are found and drawn: crosses, discs and corners, with edges as soft as a lens makes them.

A shape is drawn in its own frame, from its middle; of a corner that is the tip. Its brightness is 1 inside and 0
outside; across an edge it goes as the logistic function nearest to a Gaussian's integral.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np

from trirail.alignment.rigid import Floats

MarkKind = Literal["cross", "disc", "corner"]
LOGISTIC = 1.702
"""1 / (1 + exp(-1.702 x)) is within 0.01 of the Gaussian's integral."""


class MarkShape(NamedTuple):
    """A mark, in metres on a part or in pixels in a picture."""

    kind: MarkKind
    size: float
    """The diameter of a disc, the length of a cross's bars, the sides of a corner's square."""
    width: float = 0.0
    """Of a cross's bars; a fifth of their length where it is 0."""

    @property
    def bar(self) -> float:
        """The width of a cross's bars."""
        return self.width or self.size / 5.0


def brightness(shape: MarkShape, x: Floats, y: Floats, blur: float) -> Floats:
    """Return how bright a shape is at points of its frame; `blur` is the standard deviation of its edges."""
    half = shape.size / 2.0
    if shape.kind == "disc":
        return _inside(half - np.hypot(x, y), blur)
    if shape.kind == "corner":
        along = _inside(x, blur) * _inside(shape.size - x, blur)
        return np.asarray(along * _inside(y, blur) * _inside(shape.size - y, blur))
    across, up = np.abs(x), np.abs(y)
    lying = _inside(half - across, blur) * _inside(shape.bar / 2.0 - up, blur)
    standing = _inside(half - up, blur) * _inside(shape.bar / 2.0 - across, blur)
    return np.asarray(1.0 - (1.0 - lying) * (1.0 - standing))


def _inside(depth: Floats, blur: float) -> Floats:
    return np.asarray(0.5 + 0.5 * np.tanh(0.5 * LOGISTIC * depth / blur))
