"""Random cameras, parts and errors, and an ideal stage, for the tests of alignment."""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Mapping, Sequence
from typing import TypeVar

import numpy as np
from trirail.alignment.camera_calibration import to_base_frame
from trirail.alignment.images import CameraView, Lens, Pair, project_points
from trirail.alignment.procedure import LOOK, AlignmentRequest, Observation, StageMotion
from trirail.alignment.rigid_motion import rotation_matrix
from trirail.kinematics.geometry import Geometry
from trirail.kinematics.robot import forward, inverse
from trirail_drivers.interface import Triple

T = TypeVar("T")
FOCUS = 2.6e5
"""About 3.8 µm a pixel."""
FIELD = (9344.0, 7000.0)
"""Columns and rows of a picture that holds a stage's travel."""


def camera(rng: np.random.Generator, at: Pair, lens: Lens = "affine") -> CameraView:
    """Return a camera above a point: any turn, mirrored or not, scale within 20 %, skewed by a few per cent."""
    mirror = np.diag([1.0, rng.choice([-1.0, 1.0])])
    matrix = FOCUS * rng.uniform(0.8, 1.2) * rotation_matrix(rng.uniform(-math.pi, math.pi)) @ mirror
    matrix = matrix @ (np.eye(2) + rng.uniform(-0.02, 0.02, (2, 2)))
    bend = {
        "affine": (0.0, 0.0),
        "perspective": tuple(rng.uniform(-4.0, 4.0, 2)),
        "radial": (rng.uniform(-2e-8, 2e-8), 0.0),
    }
    (a, b), (c, d) = matrix.tolist()
    pixel = (float(rng.uniform(900, 1100)), float(rng.uniform(700, 900)))
    return CameraView(at, pixel, ((a, b), (c, d)), lens, bend[lens], (1000.0, 800.0))


def part_at(part: Mapping[str, Pair], error: Triple) -> dict[str, Pair]:
    """Return the places of a part's marks on the table when the part lies away by x, y [m] and phi [rad]."""
    return {name: (float(x), float(y)) for name, (x, y) in ((n, to_base_frame(q, error)) for n, q in part.items())}


class Stage:
    """An ideal stage with a part on it, seen by cameras."""

    def __init__(
        self,
        views: Mapping[str, CameraView],
        part: Mapping[str, Pair],
        rng: np.random.Generator,
        noise: float | Mapping[str, float] = 0.0,
        moved: Callable[[Triple], Triple] = lambda by: by,
    ) -> None:
        self.views, self.part, self._rng, self._moved = dict(views), dict(part), rng, moved
        self._noise = noise if isinstance(noise, Mapping) else dict.fromkeys(part, noise)
        self.pose: Triple = (0.0, 0.0, 0.0)
        self.way = 0.0
        """The longest of the motions that were made about a point [m]."""
        self.motions = 0

    def reseed(self, seed: int) -> None:
        """Give the looks from now on other noise."""
        self._rng = np.random.default_rng(seed)

    def end_noise(self) -> None:
        """Give the looks from now on no noise."""
        self._noise = dict.fromkeys(self.part, 0.0)

    @property
    def true_pose(self) -> Triple:
        """Where the table is."""
        return self.pose

    def look(self) -> dict[str, Pair]:
        seen = {
            name: project_points(self.views[name], to_base_frame(q, self.true_pose)[None])[0]
            for name, q in self.part.items()
        }
        noisy = {name: (at + self._noise[name] * self._rng.standard_normal(2)).tolist() for name, at in seen.items()}
        return {name: (u, v) for name, (u, v) in noisy.items()}

    def go(self, motion: StageMotion) -> None:
        self.motions += 1
        if motion.tool is None:
            self.pose = motion.by
            return
        x, y, turn = self._moved(motion.by)
        self.way = max(self.way, math.hypot(x, y))
        phi = self.pose[2] + turn
        at = to_base_frame(motion.tool, self.pose) + np.array([x, y]) - rotation_matrix(phi) @ motion.tool
        self.pose = (float(at[0]), float(at[1]), phi)

    def drive(self, wishes: Generator[AlignmentRequest, Observation, T]) -> T:
        marks: Mapping[str, Pair] = {}
        try:
            wish = next(wishes)
            while True:
                if wish == LOOK:
                    marks = self.look()
                elif isinstance(wish, StageMotion):
                    self.go(wish)
                wish = wishes.send(Observation(marks, self.pose, float(self.motions)))
        except StopIteration as end:
            return end.value  # type: ignore[no-any-return]


class BuiltStage(Stage):
    """A stage whose legs and encoder scales differ from its configuration, below cameras with pictures of a field."""

    def __init__(
        self,
        configured: Geometry,
        built: Geometry,
        scales: Sequence[float],
        views: Mapping[str, CameraView],
        part: Mapping[str, Pair],
        rng: np.random.Generator,
        noise: float = 0.0,
        field: Pair = FIELD,
    ) -> None:
        super().__init__(views, part, rng, noise)
        self.configured, self.built, self.scales, self.field = configured, built, np.array(scales), field

    @property
    def true_pose(self) -> Triple:
        sliders = inverse(self.configured, self.pose).position * (1.0 + self.scales)
        x, y, phi = forward(self.built, sliders, near=self.pose).tolist()
        return x, y, phi

    def look(self) -> dict[str, Pair]:
        columns, rows = self.field
        return {n: (u, v) for n, (u, v) in super().look().items() if 0.0 <= u < columns and 0.0 <= v < rows}


def wide_camera(rng: np.random.Generator, at: Pair, lens: Lens = "radial", field: Pair = FIELD) -> CameraView:
    """Return a camera that sees the whole travel, its long side along y: mirrored or not, with a lens that bends."""
    mirror = np.diag([1.0, rng.choice([-1.0, 1.0])])
    matrix = FOCUS * rotation_matrix(math.pi / 2.0 + rng.uniform(-0.05, 0.05)) @ mirror
    matrix = matrix @ (np.eye(2) + rng.uniform(-0.01, 0.01, (2, 2)))
    bend = {
        "affine": (0.0, 0.0),
        "perspective": tuple(rng.uniform(-0.3, 0.3, 2)),
        "radial": (rng.uniform(-2e-10, 2e-10), 0.0),
    }
    (a, b), (c, d) = matrix.tolist()
    (u, v), (axis_u, axis_v) = (np.array(field) / 2.0 + rng.uniform(-100.0, 100.0, (2, 2))).tolist()
    return CameraView(at, (u, v), ((a, b), (c, d)), lens, bend[lens], (axis_u, axis_v))
