"""Detection of marks in pictures with subpixel accuracy: a search by correlation, then a fit of the mark's shape.

The model of the picture around a mark is b(R'(p - p0) / s) c(p) + g(p), where b is the brightness of the shape. A
Gauss-Newton iteration fits the position p0, the rotation R, the size s and the blur of the edges, together with the
contrast c and the ground g, which both have a linear gradient. Uneven light, rotation and focus therefore do not bias
the position. The search uses normalised correlation (Lewis 1995, Fast Normalized Cross-Correlation).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from trirail.alignment.rigid_motion import Floats
from trirail.alignment.shapes import MarkShape, brightness

MIN_CORRELATION = 0.5
"""Least correlation of the picture with the shape at the position of a mark."""
MIN_EXPLAINED_SHARE = 0.8
"""Least fraction of the variation of the picture that the fitted mark must explain."""
MIN_CONTRAST_SHARE = 0.02
"""Least contrast of a mark, as a fraction of the range of brightness in the picture."""
MAX_FIT_SHIFT = 0.5
"""Greatest distance between the position from the search and the fitted position, in nominal sizes."""
SIZE_RANGE = (0.7, 1.4)
"""Permitted range of the fitted size, in nominal sizes."""
WINDOW_MARGIN = 0.3
"""Width of the surroundings of a mark that are included in the fit, in nominal sizes."""
INITIAL_BLUR_PX = 1.2
MAX_ITERATIONS = 25


class DetectedMark(NamedTuple):
    """Position and properties of a mark in a picture."""

    u: float
    """Column; 0 is the middle of the first pixel."""
    v: float
    """Row; 0 is the middle of the first pixel."""
    turn: float
    """Angle of the mark in the picture, positive from u to v [rad]; 0 for a disc."""
    size: float
    """Fitted size divided by the nominal size."""
    contrast: float
    """Brightness of the mark minus brightness of the ground; negative for a dark mark."""
    fit: float
    """Fraction of the variation of the picture that the model explains; 1 is a perfect fit."""


def find(picture: NDArray[np.generic], shape: MarkShape, turn: float = 0.0) -> DetectedMark | None:
    """Return the mark that is most similar to a shape; None if there is no similar mark.

    Parameters
    ----------
    picture
        Grey picture, (rows, columns).
    shape
        Shape of the mark, in pixels.
    turn
        Approximate angle of the mark [rad]. The error may be about 15° for a cross, and 20° for a corner.
    """
    grey = np.asarray(picture, float)
    if grey.ndim != 2 or min(grey.shape) < shape.size * (1.0 + 2.0 * WINDOW_MARGIN):
        return None
    start = _search(grey, shape, turn)
    return None if start is None else fit_at(grey, shape, start, turn)


def _window_offset(shape: MarkShape, turn: float) -> tuple[float, float]:
    """Return the offset u, v from the origin of the shape to the middle of the window for the fit [pixel]."""
    if shape.kind != "corner":
        return 0.0, 0.0
    half = shape.size / 2.0
    c, s = math.cos(turn), math.sin(turn)
    # If the window were centred at the tip of a corner, three quarters of it would show ground without information. The
    # window is therefore shifted into the corner.
    return 0.3 * half * (c - s), 0.3 * half * (s + c)


def _render(shape: MarkShape, u: Floats, v: Floats, x: Floats) -> Floats:
    """Return the brightness of the shape at pixels, for x = (u0, v0, size, blur, turn)."""
    c, s = math.cos(x[4]), math.sin(x[4])
    du, dv = u - x[0], v - x[1]
    size = x[2]
    return brightness(shape, (c * du + s * dv) / size, (c * dv - s * du) / size, max(float(x[3]), 0.2) / size)


def _search(grey: Floats, shape: MarkShape, turn: float) -> tuple[float, float] | None:
    """Return the pixel u, v at which the correlation with the shape is greatest; None if it is too small everywhere."""
    side = 2 * math.ceil(shape.size * (0.5 + WINDOW_MARGIN)) + 1
    half = side // 2
    v, u = np.mgrid[-half : half + 1, -half : half + 1].astype(float)
    mu, mv = _window_offset(shape, turn)
    template = _render(shape, u + mu, v + mv, np.array([0.0, 0.0, 1.0, INITIAL_BLUR_PX, turn]))
    template -= template.mean()
    rows, columns = grey.shape
    if side > min(rows, columns):
        return None
    # Zero padding to the full size is necessary, because the convolution by FFT is circular.
    full = (rows + side - 1, columns + side - 1)
    flat = grey - grey.mean()
    product = np.fft.irfft2(np.fft.rfft2(flat, full) * np.fft.rfft2(template[::-1, ::-1], full), full)
    valid = product[side - 1 : rows, side - 1 : columns]
    sums, squares = _window_sums(flat, side), _window_sums(flat * flat, side)
    spread = np.sqrt(np.maximum(squares - sums * sums / side**2, 0.0) * (template**2).sum())
    # The floor prevents high correlations that are due to rounding errors in nearly uniform windows.
    floor = 1e-3 * spread.max() + 1e-9
    correlation = np.abs(valid) / np.maximum(spread, floor)
    best = np.unravel_index(int(correlation.argmax()), correlation.shape)
    if correlation[best] < MIN_CORRELATION:
        return None
    return float(best[1] + half - mu), float(best[0] + half - mv)


def _window_sums(values: Floats, side: int) -> Floats:
    """Return the sum over each square window with a side of `side` pixels."""
    total = np.pad(values.cumsum(0).cumsum(1), ((1, 0), (1, 0)))
    return np.asarray(total[side:, side:] - total[:-side, side:] - total[side:, :-side] + total[:-side, :-side])


def fit_at(grey: Floats, shape: MarkShape, start: tuple[float, float], turn: float) -> DetectedMark | None:
    """Fit a mark, starting from a pixel u, v and an angle [rad]. Return None if the result does not match the shape."""
    half = shape.size * (0.5 + WINDOW_MARGIN)
    mu, mv = _window_offset(shape, turn)
    rows, columns = grey.shape
    top, left = max(0, math.floor(start[1] + mv - half)), max(0, math.floor(start[0] + mu - half))
    bottom, right = min(rows, math.ceil(start[1] + mv + half) + 1), min(columns, math.ceil(start[0] + mu + half) + 1)
    v, u = np.mgrid[top:bottom, left:right].astype(float)
    window = grey[top:bottom, left:right].ravel()
    plane = np.stack([np.ones(u.size), (u - start[0]).ravel() / half, (v - start[1]).ravel() / half], axis=1)
    x = np.array([start[0], start[1], 1.0, INITIAL_BLUR_PX, turn])
    steps = np.array([1e-3, 1e-3, 1e-4, 1e-3, 1e-4])
    free = 4 if shape.kind == "disc" else 5  # the angle of a disc is not defined
    max_change = np.array([2.0, 2.0, 0.1, 0.5, 0.1])
    for _ in range(MAX_ITERATIONS):
        # The model is linear in contrast and ground. They are solved exactly for each estimate of the other parameters.
        design = np.hstack([_render(shape, u, v, x).reshape(-1, 1) * plane, plane])
        linear = np.linalg.lstsq(design, window, rcond=None)[0]
        contrast = plane @ linear[:3]
        derivatives = []
        for k in range(free):
            step = np.zeros(5)
            step[k] = steps[k]
            difference = _render(shape, u, v, x + step) - _render(shape, u, v, x - step)
            derivatives.append(contrast * difference.ravel() / (2.0 * steps[k]))
        residual = window - design @ linear
        change = np.linalg.lstsq(np.column_stack([*derivatives, design]), residual, rcond=None)[0][:free]
        change = np.clip(change, -max_change[:free], max_change[:free])
        x[:free] += change
        x[3] = min(max(x[3], 0.25), shape.size)
        if abs(change[:2]).max() < 1e-4:
            break
    design = np.hstack([_render(shape, u, v, x).reshape(-1, 1) * plane, plane])
    linear = np.linalg.lstsq(design, window, rcond=None)[0]
    ground = plane @ np.linalg.lstsq(plane, window, rcond=None)[0]
    fit = 1.0 - float(((window - design @ linear) ** 2).sum() / max(float(((window - ground) ** 2).sum()), 1e-12))
    is_far = math.hypot(x[0] - start[0], x[1] - start[1]) > MAX_FIT_SHIFT * shape.size
    is_faint = abs(linear[0]) < MIN_CONTRAST_SHARE * np.ptp(grey)
    if fit < MIN_EXPLAINED_SHARE or is_far or is_faint or not SIZE_RANGE[0] < x[2] < SIZE_RANGE[1]:
        return None
    return DetectedMark(float(x[0]), float(x[1]), float(x[4]) if free == 5 else 0.0, float(x[2]), float(linear[0]), fit)
