"""A camera that is not there: it draws the marks of a part on the table as the robot really stands."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from trirail_drivers.interface import Triple

from trirail.alignment.camera_calibration import placed
from trirail.alignment.images import CameraView, Pair, pixels, slopes
from trirail.alignment.rigid import Floats, turned
from trirail.alignment.shapes import MarkShape, brightness

INSTANTS = 15
"""Into how many instants an exposure is divided."""
BRIGHTEST = 255


class DrawnMark(NamedTuple):
    """A mark of the part on the table."""

    shape: MarkShape
    """In metres."""
    place: Pair
    """In the platform's frame [m]."""


class SimulatedCamera(NamedTuple):
    """What a camera shows, and how badly.

    Light falls off towards the corners by `shade`, a share of it; `noise` is the standard deviation of a pixel's
    brightness, of 255. What is read at a time was exposed for `exposure` seconds, which ended `delay` seconds before.
    """

    view: CameraView
    marks: Mapping[str, DrawnMark]
    columns: int = 640
    rows: int = 480
    ground: float = 60.0
    contrast: float = 120.0
    blur: float = 1.0
    """Standard deviation of an edge [pixel]."""
    noise: float = 0.0
    shade: float = 0.0
    exposure: float = 0.0
    delay: float = 0.0

    def picture(self, pose_at: Callable[[float], Triple], time: float, rng: np.random.Generator) -> NDArray[np.uint8]:
        """Return what is read from it at a time [s], grey, (rows, columns); `pose_at` is where the robot was when."""
        end = time - self.delay
        if self.exposure > 0.0:
            instants = end - self.exposure * (np.arange(INSTANTS) + 0.5) / INSTANTS
        else:
            instants = np.array([end])
        light = sum((self._marks_at(pose_at(float(t))) for t in instants), np.zeros((self.rows, self.columns)))
        shown = (self.ground + self.contrast * light / len(instants)) * self._shading()
        shown = shown + self.noise * rng.standard_normal(shown.shape)
        return np.clip(np.rint(shown), 0, BRIGHTEST).astype(np.uint8)

    def pixels_at(self, pose: Triple) -> dict[str, Pair]:
        """Return where its marks are in the picture with the platform at a pose, exactly; also those outside of it."""
        points = {name: pixels(self.view, placed(mark.place, pose)[None])[0] for name, mark in self.marks.items()}
        return {name: (float(u), float(v)) for name, (u, v) in points.items()}

    def _shading(self) -> Floats:
        v, u = np.mgrid[-1.0 : 1.0 : self.rows * 1j, -1.0 : 1.0 : self.columns * 1j]
        return np.asarray(1.0 - self.shade * (0.25 * (u * u + v * v) + 0.25 * (u + v)))

    def _marks_at(self, pose: Triple) -> Floats:
        light = np.zeros((self.rows, self.columns))
        for mark in self.marks.values():
            at = placed(mark.place, pose)[None]
            (u, v), slope = pixels(self.view, at)[0], slopes(self.view, at)[0]
            reach = 1.5 * mark.shape.size * float(np.abs(slope).max()) + 5.0 * self.blur
            top, bottom = (int(np.clip(v + d, 0, self.rows)) for d in (-reach, reach + 1))
            left, right = (int(np.clip(u + d, 0, self.columns)) for d in (-reach, reach + 1))
            if top >= bottom or left >= right:
                continue
            y, x = np.mgrid[top:bottom, left:right].astype(float)
            own = np.linalg.solve(slope @ turned(pose[2]), np.stack([(x - u).ravel(), (y - v).ravel()]))
            drawn = brightness(mark.shape, own[0], own[1], self.blur / self.view.scale).reshape(x.shape)
            light[top:bottom, left:right] = np.maximum(light[top:bottom, left:right], drawn)
        return light
