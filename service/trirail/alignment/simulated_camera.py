"""Simulated camera, which renders the marks of a part on the table at the real pose of the robot."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from trirail_drivers.interface import Triple

from trirail.alignment.camera_calibration import to_base_frame
from trirail.alignment.images import CameraView, Pair, project_points, projection_jacobians
from trirail.alignment.rigid_motion import Floats, rotation_matrix
from trirail.alignment.shapes import MarkShape, brightness

EXPOSURE_SAMPLES = 15
MAX_BRIGHTNESS = 255


class DrawnMark(NamedTuple):
    """Mark of a part on the table."""

    shape: MarkShape
    """Shape, in metres."""
    place: Pair
    """Position in the platform's frame [m]."""


class SimulatedCamera(NamedTuple):
    """Camera with its projection, the marks that it can see, and the imperfections of its pictures.

    `shade` is the fraction by which the light decreases towards one corner. `noise` is the standard deviation of the
    brightness of a pixel, on a scale from 0 to 255. Each picture is exposed for `exposure` seconds. The exposure ends
    `delay` seconds before the picture is read.
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
        """Return the grey picture (rows, columns) that is read at a time [s]. `pose_at` returns the pose at a time."""
        end = time - self.delay
        if self.exposure > 0.0:
            instants = end - self.exposure * (np.arange(EXPOSURE_SAMPLES) + 0.5) / EXPOSURE_SAMPLES
        else:
            instants = np.array([end])
        poses = [pose_at(float(t)) for t in instants]  # all before rendering, because `pose_at` may forget old poses
        light = sum((self._render_marks(pose) for pose in poses), np.zeros((self.rows, self.columns)))
        shown = (self.ground + self.contrast * light / len(instants)) * self._shading()
        shown = shown + self.noise * rng.standard_normal(shown.shape)
        return np.clip(np.rint(shown), 0, MAX_BRIGHTNESS).astype(np.uint8)

    def pixels_at(self, pose: Triple) -> dict[str, Pair]:
        """Return the exact pixels of all marks for a pose of the platform, including marks outside the picture."""
        points = {
            name: project_points(self.view, to_base_frame(mark.place, pose)[None])[0]
            for name, mark in self.marks.items()
        }
        return {name: (float(u), float(v)) for name, (u, v) in points.items()}

    def _shading(self) -> Floats:
        v, u = np.mgrid[-1.0 : 1.0 : self.rows * 1j, -1.0 : 1.0 : self.columns * 1j]
        return np.asarray(1.0 - self.shade * (0.25 * (u * u + v * v) + 0.25 * (u + v)))

    def _render_marks(self, pose: Triple) -> Floats:
        light = np.zeros((self.rows, self.columns))
        for mark in self.marks.values():
            at = to_base_frame(mark.place, pose)[None]
            (u, v), jacobian = project_points(self.view, at)[0], projection_jacobians(self.view, at)[0]
            reach = 1.5 * mark.shape.size * float(np.abs(jacobian).max()) + 5.0 * self.blur
            # Only a window around the mark is rendered. At a distance of five blurs from its edges, a mark is
            # invisible.
            top, bottom = (int(np.clip(v + d, 0, self.rows)) for d in (-reach, reach + 1))
            left, right = (int(np.clip(u + d, 0, self.columns)) for d in (-reach, reach + 1))
            if top >= bottom or left >= right:
                continue
            y, x = np.mgrid[top:bottom, left:right].astype(float)
            own = np.linalg.solve(jacobian @ rotation_matrix(pose[2]), np.stack([(x - u).ravel(), (y - v).ravel()]))
            drawn = brightness(mark.shape, own[0], own[1], self.blur / self.view.scale).reshape(x.shape)
            light[top:bottom, left:right] = np.maximum(light[top:bottom, left:right], drawn)
        return light
