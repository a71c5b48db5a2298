"""Finds marks in pictures to a small part of a pixel: a search by correlation, then a fit of the mark itself.

The picture around a mark is b(R'(p - p0) / s) c(p) + g(p): place p0, turn, size s and blur of the edges are fitted
together with contrast c and ground g, which both have an even slope, by Gauss-Newton; so light, turn and focus do not
move the place. The search is by normalised correlation (Lewis 1995, Fast Normalized Cross-Correlation).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from trirail.alignment.rigid import Floats
from trirail.alignment.shapes import MarkShape, brightness

LIKE = 0.5
"""Correlation from which on a place is taken for the mark."""
FITS = 0.8
"""Share of the picture's variation that the fitted mark must explain."""
FAINT = 0.02
"""Contrast, as a share of the picture's range of brightness, below which a mark is none."""
AWAY = 0.5
"""How far the fit may lead from what was searched, in sizes of the mark."""
SIZES = (0.7, 1.4)
"""How large the mark may be, in nominal sizes."""
MARGIN = 0.3
"""What is fitted of the picture around a mark, in its sizes."""
START_BLUR = 1.2
ROUNDS = 25


class FoundMark(NamedTuple):
    """Where a mark is in a picture."""

    u: float
    """Column, 0 in the middle of the first pixel."""
    v: float
    """Row."""
    turn: float
    """Of the mark in the picture, from u to v [rad]; 0 for a disc."""
    size: float
    """In nominal sizes."""
    contrast: float
    """Its brightness less the ground's; negative for a dark mark."""
    fit: float
    """Share of the picture's variation that it explains, up to 1."""


def find(picture: NDArray[np.generic], shape: MarkShape, turn: float = 0.0) -> FoundMark | None:
    """Return where the mark is that looks most like a shape in pixels, turned by about `turn` [rad]; None for none.

    `picture` is grey, (rows, columns). A cross is found within about 15° of its turn, a corner within 20°.
    """
    grey = np.asarray(picture, float)
    if grey.ndim != 2 or min(grey.shape) < shape.size * (1.0 + 2.0 * MARGIN):
        return None
    near = _search(grey, shape, turn)
    return None if near is None else _fit(grey, shape, near, turn)


def _middle(shape: MarkShape, turn: float) -> tuple[float, float]:
    """Return where the middle of what is looked at lies from the shape's point."""
    if shape.kind != "corner":
        return 0.0, 0.0
    half = shape.size / 2.0
    c, s = math.cos(turn), math.sin(turn)
    # Twice as much of the ground as of the mark says nothing: the window is about the tip.
    return 0.3 * half * (c - s), 0.3 * half * (s + c)


def _drawn(shape: MarkShape, u: Floats, v: Floats, x: Floats) -> Floats:
    """Return the shape at pixels, for x = (u0, v0, size, blur, turn)."""
    c, s = math.cos(x[4]), math.sin(x[4])
    du, dv = u - x[0], v - x[1]
    size = x[2]
    return brightness(shape, (c * du + s * dv) / size, (c * dv - s * du) / size, max(float(x[3]), 0.2) / size)


def _search(grey: Floats, shape: MarkShape, turn: float) -> tuple[float, float] | None:
    side = 2 * math.ceil(shape.size * (0.5 + MARGIN)) + 1
    half = side // 2
    v, u = np.mgrid[-half : half + 1, -half : half + 1].astype(float)
    mu, mv = _middle(shape, turn)
    template = _drawn(shape, u + mu, v + mv, np.array([0.0, 0.0, 1.0, START_BLUR, turn]))
    template -= template.mean()
    rows, columns = grey.shape
    if side > min(rows, columns):
        return None
    full = (rows + side - 1, columns + side - 1)
    flat = grey - grey.mean()
    product = np.fft.irfft2(np.fft.rfft2(flat, full) * np.fft.rfft2(template[::-1, ::-1], full), full)
    valid = product[side - 1 : rows, side - 1 : columns]
    sums, squares = _box(flat, side), _box(flat * flat, side)
    spread = np.sqrt(np.maximum(squares - sums * sums / side**2, 0.0) * (template**2).sum())
    floor = 1e-3 * spread.max() + 1e-9
    like = np.abs(valid) / np.maximum(spread, floor)
    best = np.unravel_index(int(like.argmax()), like.shape)
    if like[best] < LIKE:
        return None
    return float(best[1] + half - mu), float(best[0] + half - mv)


def _box(values: Floats, side: int) -> Floats:
    """Return the sums over squares of so many pixels a side."""
    total = np.pad(values.cumsum(0).cumsum(1), ((1, 0), (1, 0)))
    return np.asarray(total[side:, side:] - total[:-side, side:] - total[side:, :-side] + total[:-side, :-side])


def _fit(grey: Floats, shape: MarkShape, near: tuple[float, float], turn: float) -> FoundMark | None:
    half = shape.size * (0.5 + MARGIN)
    mu, mv = _middle(shape, turn)
    rows, columns = grey.shape
    top, left = max(0, math.floor(near[1] + mv - half)), max(0, math.floor(near[0] + mu - half))
    bottom, right = min(rows, math.ceil(near[1] + mv + half) + 1), min(columns, math.ceil(near[0] + mu + half) + 1)
    v, u = np.mgrid[top:bottom, left:right].astype(float)
    window = grey[top:bottom, left:right].ravel()
    plane = np.stack([np.ones(u.size), (u - near[0]).ravel() / half, (v - near[1]).ravel() / half], axis=1)
    x = np.array([near[0], near[1], 1.0, START_BLUR, turn])
    steps = np.array([1e-3, 1e-3, 1e-4, 1e-3, 1e-4])
    free = 4 if shape.kind == "disc" else 5
    most = np.array([2.0, 2.0, 0.1, 0.5, 0.1])
    for _ in range(ROUNDS):
        design = np.hstack([_drawn(shape, u, v, x).reshape(-1, 1) * plane, plane])
        linear = np.linalg.lstsq(design, window, rcond=None)[0]
        contrast = plane @ linear[:3]
        slopes = []
        for k in range(free):
            step = np.zeros(5)
            step[k] = steps[k]
            change = _drawn(shape, u, v, x + step) - _drawn(shape, u, v, x - step)
            slopes.append(contrast * change.ravel() / (2.0 * steps[k]))
        rest = window - design @ linear
        change_of = np.linalg.lstsq(np.column_stack([*slopes, design]), rest, rcond=None)[0][:free]
        change_of = np.clip(change_of, -most[:free], most[:free])
        x[:free] += change_of
        x[3] = min(max(x[3], 0.25), shape.size)
        if abs(change_of[:2]).max() < 1e-4:
            break
    design = np.hstack([_drawn(shape, u, v, x).reshape(-1, 1) * plane, plane])
    linear = np.linalg.lstsq(design, window, rcond=None)[0]
    ground = plane @ np.linalg.lstsq(plane, window, rcond=None)[0]
    fit = 1.0 - float(((window - design @ linear) ** 2).sum() / max(float(((window - ground) ** 2).sum()), 1e-12))
    far = math.hypot(x[0] - near[0], x[1] - near[1]) > AWAY * shape.size
    faint = abs(linear[0]) < FAINT * np.ptp(grey)
    if fit < FITS or far or faint or not SIZES[0] < x[2] < SIZES[1]:
        return None
    return FoundMark(float(x[0]), float(x[1]), float(x[4]) if free == 5 else 0.0, float(x[2]), float(linear[0]), fit)
