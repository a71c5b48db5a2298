"""How a camera shows the table's plane: an affine map about one point of it, bent by a lens where that can be told.

    s = M (w - o)                         affine, M in pixels a metre: scale, turn, skew and mirror
    s = M (w - o) / (1 + g . (w - o))     perspective, g in 1/m
    u = b + s                             b is the pixel of the point o
    u = e + d (1 + k |d|²), d = b + s - e   radial, about the pixel e, k in 1/pixel²

w is a point in the base frame [m]. Hartley and Zisserman, Multiple View Geometry, 2nd ed., 2.4 and 7.4.
"""

from __future__ import annotations

from typing import Any, Literal, get_args

import msgspec
import numpy as np
from numpy.typing import NDArray

Lens = Literal["affine", "perspective", "radial"]
"""Which of the maps above."""
LENSES: tuple[Lens, ...] = get_args(Lens)
Pair = tuple[float, float]
Points = NDArray[Any]
"""Shape (n, 2): pixels, or metres in the base frame; complex where a derivative is taken."""
NEWTON = 20


class CameraView(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A camera at one place, which shows one or more marks."""

    origin: Pair
    """The point o of the table's plane [m]."""
    pixel: Pair
    """Where it is in the picture, b."""
    matrix: tuple[Pair, Pair]
    """M [pixel/m]."""
    lens: Lens = "affine"
    bend: Pair = (0.0, 0.0)
    """g of a perspective [1/m]; (k, 0) of a radial lens [1/pixel²]."""
    centre: Pair = (0.0, 0.0)
    """Of a radial lens: the pixel e on its axis, the middle of the picture for most."""

    @property
    def mirrored(self) -> bool:
        """Whether the picture is a mirror image of the table seen from above; with v downwards it is, as a rule."""
        (a, b), (c, d) = self.matrix
        return a * d - b * c < 0.0

    @property
    def scale(self) -> float:
        """Pixels a metre, as the geometric mean over all directions."""
        (a, b), (c, d) = self.matrix
        return float(abs(a * d - b * c) ** 0.5)


def project(points: Points, origin: Points, pixel: Points, matrix: Points, bend: Points, view: CameraView) -> Points:
    """Return the pixels, shape (n, 2), of points [m], for parameters in place of the view's: lens and centre are its.

    It is analytic in all of them, so that derivatives may be taken by a complex step.
    """
    away = points - origin
    seen = away @ matrix.T
    if view.lens == "perspective":
        seen = seen / (1.0 + away @ bend)[:, None]
    if view.lens != "radial":
        return np.asarray(pixel + seen)
    centre = np.asarray(view.centre)
    ideal = pixel + seen - centre
    return np.asarray(centre + ideal * (1.0 + bend[0] * (ideal * ideal).sum(axis=1))[:, None])


def pixels(view: CameraView, points: Points) -> Points:
    """Return where points of the table's plane [m] are in the picture, shape (n, 2) both."""
    return np.asarray(project(np.asarray(points, float), *_parameters(view), view))


def places(view: CameraView, seen: Points) -> Points:
    """Return the points of the table's plane [m] that are at given pixels, shape (n, 2) both."""
    origin, pixel, matrix, bend = _parameters(view)
    seen = np.asarray(seen, float)
    if view.lens == "radial":
        seen = _straight(seen - view.centre, bend[0]) + view.centre
    away = np.linalg.solve(matrix, (seen - pixel).T).T
    if view.lens == "perspective":
        away = away / (1.0 - away @ bend)[:, None]
    return np.asarray(origin + away)


def slopes(view: CameraView, points: Points) -> NDArray[np.float64]:
    """Return the derivatives of the pixels with respect to the points, shape (n, 2, 2) [pixel/m]."""
    origin, pixel, matrix, bend = _parameters(view)
    step = 1e-20
    columns: list[Points] = [
        project(points + 1j * step * axis, origin, pixel, matrix, bend, view).imag / step for axis in np.eye(2)
    ]
    return np.stack(columns, axis=2)


def _straight(bent: Points, k: float) -> Points:
    """Return d of d (1 + k |d|²), by Newton's method on its length."""
    length = np.linalg.norm(bent, axis=1)
    d = length.copy()
    for _ in range(NEWTON):
        d -= (d * (1.0 + k * d * d) - length) / (1.0 + 3.0 * k * d * d)
    return np.asarray(bent * np.divide(d, length, out=np.ones_like(d), where=length > 0.0)[:, None])


def _parameters(view: CameraView) -> tuple[Points, Points, Points, Points]:
    return np.array(view.origin), np.array(view.pixel), np.array(view.matrix), np.array(view.bend)
