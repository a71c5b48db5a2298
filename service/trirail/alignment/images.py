"""Projection of the plane of the table into a picture: an affine map, optionally with perspective or radial distortion.

    s = M (w - o)                         affine, M in pixel/m: scale, rotation, skew and mirroring
    s = M (w - o) / (1 + g . (w - o))     perspective, g in 1/m
    u = b + s                             b is the pixel of the point o
    u = e + d (1 + k |d|²), d = b + s - e   radial, about the pixel e, k in 1/pixel²

w is a point in the base frame [m], and u is its pixel. See Hartley and Zisserman, Multiple View Geometry, 2nd ed., 2.4
and 7.4.
"""

from __future__ import annotations

from typing import Any, Literal, get_args

import msgspec
import numpy as np
from numpy.typing import NDArray

Lens = Literal["affine", "perspective", "radial"]
"""Kind of lens, which selects one of the maps in the description of this module."""
LENSES: tuple[Lens, ...] = get_args(Lens)
Pair = tuple[float, float]
Points = NDArray[Any]
"""Pixels, or points in the base frame [m], (n, 2). The values are complex if a derivative is computed by a complex
step."""
NEWTON_ITERATIONS = 20


class CameraView(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Projection of a camera in a fixed position. The view shows one or more marks."""

    origin: Pair
    """Point o of the table's plane [m]."""
    pixel: Pair
    """Pixel b of the point o."""
    matrix: tuple[Pair, Pair]
    """M [pixel/m]."""
    lens: Lens = "affine"
    bend: Pair = (0.0, 0.0)
    """Distortion: g for perspective [1/m], (k, 0) for a radial lens [1/pixel²]."""
    centre: Pair = (0.0, 0.0)
    """Pixel e on the axis of a radial lens, usually the middle of the picture."""

    @property
    def mirrored(self) -> bool:
        """True if the picture is a mirror image of the table seen from above. This is usual, because v points down."""
        (a, b), (c, d) = self.matrix
        return a * d - b * c < 0.0

    @property
    def scale(self) -> float:
        """Scale of the map, averaged geometrically over directions [pixel/m]."""
        (a, b), (c, d) = self.matrix
        return float(abs(a * d - b * c) ** 0.5)


def project_with(
    points: Points, origin: Points, pixel: Points, matrix: Points, bend: Points, view: CameraView
) -> Points:
    """Return the pixels (n, 2) of points (n, 2) [m], for given parameters and the lens and centre of `view`.

    The result is an analytic function of all parameters. Derivatives can therefore be computed by complex steps.
    """
    away = points - origin
    seen = away @ matrix.T
    if view.lens == "perspective":
        seen = seen / (1.0 + away @ bend)[:, None]
    if view.lens != "radial":
        return np.asarray(pixel + seen)
    centre = np.asarray(view.centre)
    ideal = pixel + seen - centre
    # Compute |ideal|² as a sum of squares. np.abs and np.linalg.norm are not analytic, and complex steps would fail.
    return np.asarray(centre + ideal * (1.0 + bend[0] * (ideal * ideal).sum(axis=1))[:, None])


def project_points(view: CameraView, points: Points) -> Points:
    """Return the pixels (n, 2) of points (n, 2) in the plane of the table [m]."""
    return np.asarray(project_with(np.asarray(points, float), *_parameters(view), view))


def locate_pixels(view: CameraView, seen: Points) -> Points:
    """Return the points (n, 2) in the plane of the table [m] that appear at given pixels (n, 2)."""
    origin, pixel, matrix, bend = _parameters(view)
    seen = np.asarray(seen, float)
    if view.lens == "radial":
        seen = _undistort(seen - view.centre, bend[0]) + view.centre
    away = np.linalg.solve(matrix, (seen - pixel).T).T
    if view.lens == "perspective":
        away = away / (1.0 - away @ bend)[:, None]
    return np.asarray(origin + away)


def projection_jacobians(view: CameraView, points: Points) -> NDArray[np.float64]:
    """Return the derivatives of the pixels with respect to the points, (n, 2, 2) [pixel/m]."""
    origin, pixel, matrix, bend = _parameters(view)
    step = 1e-20
    columns: list[Points] = [
        project_with(points + 1j * step * axis, origin, pixel, matrix, bend, view).imag / step for axis in np.eye(2)
    ]
    return np.stack(columns, axis=2)


def _undistort(distorted: Points, k: float) -> Points:
    """Return d for given values of d (1 + k |d|²), by Newton's method for the length of d."""
    length = np.linalg.norm(distorted, axis=1)
    d = length.copy()
    for _ in range(NEWTON_ITERATIONS):
        d -= (d * (1.0 + k * d * d) - length) / (1.0 + 3.0 * k * d * d)
    return np.asarray(distorted * np.divide(d, length, out=np.ones_like(d), where=length > 0.0)[:, None])


def _parameters(view: CameraView) -> tuple[Points, Points, Points, Points]:
    return np.array(view.origin), np.array(view.pixel), np.array(view.matrix), np.array(view.bend)
