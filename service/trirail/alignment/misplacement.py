"""How a part lies away from where its marks should be, from what cameras show."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trirail.alignment.camera_calibration import CameraCalibration, Marks
from trirail.alignment.images import CameraView, places, slopes
from trirail.alignment.rigid import Floats, RigidError, distance_error, rigid_error, swapped
from trirail.errors import AlignmentError, AlignmentFault

FEWEST = 2
"""Marks that tell a part's place and angle."""
DISTANCE = 1000e-6
"""The greatest error of a distance between marks where none is given [1]: 100 µm over 100 mm."""


class Misplacement(NamedTuple):
    """Marks that were seen, and the rigid error that they tell."""

    names: tuple[str, ...]
    """Of the marks that were seen and have a target."""
    at: Floats
    """Where they are, (n, 2) [m]."""
    to: Floats
    """Where they should be, (n, 2) [m]."""
    error: RigidError
    distance: float
    """By how much the worst distance of two marks is too long, as a share of it."""

    @property
    def distances(self) -> Floats:
        """How far each mark has to go by the motion that aligns the part, (n,) [m]."""
        return np.asarray(np.linalg.norm(self.error.displacements(self.at), axis=1))

    @property
    def worst(self) -> float:
        """The greatest of these [m]."""
        return float(self.distances.max())


def misplacement(
    calibration: CameraCalibration, marks: Marks, targets: Marks, distance: float = DISTANCE
) -> Misplacement:
    """Return how a part lies away from where its marks should be: pixels of both.

    Each mark counts by the inverse of its place's covariance, from the calibration's noise. Raises AlignmentError for
    fewer than two marks, a mark without a view, marks whose distance is wrong by more than `distance` (a share), and
    marks that are swapped.
    """
    if unknown := sorted(set(targets) - set(calibration.marks)):
        raise AlignmentError(AlignmentFault.MISSING, f"not in the calibration: {', '.join(unknown)}; calibrate with it")
    names = tuple(sorted(set(marks) & set(targets)))
    if len(names) < FEWEST:
        absent = ", ".join(sorted(set(targets) - set(marks)))
        text = f"{len(names)} of the marks seen, {FEWEST} are wanted; not found: {absent}: see to light and focus"
        raise AlignmentError(AlignmentFault.MISSING, text, value=float(len(names)), limit=float(FEWEST))
    views = [calibration.views[calibration.marks[name].view] for name in names]
    at = _places(views, [marks[name] for name in names])
    to = _places(views, [targets[name] for name in names])
    order = swapped(at, to)
    if order is not None:
        moved = ", ".join(name for n, name in enumerate(names) if order[n] != n)
        raise AlignmentError(AlignmentFault.SWAPPED, f"the marks {moved} are swapped, or the part is turned about")
    wrong = distance_error(at, to)
    if abs(wrong) > distance:
        text = (
            f"marks are {wrong * 1e6:+.0f} ppm from their distance, {distance * 1e6:.0f} ppm are allowed: "
            "another part, a mark that was mistaken, a camera that was moved since its calibration, or heat"
        )
        raise AlignmentError(AlignmentFault.DISTANCE, text, value=wrong, limit=distance)
    weights = np.stack([_weight(view, place, calibration.noise) for view, place in zip(views, at, strict=True)])
    return Misplacement(names, at, to, rigid_error(at, to, weights), wrong)


def _places(views: list[CameraView], seen: list[tuple[float, float]]) -> Floats:
    return np.concatenate([places(view, np.array([pixel])) for view, pixel in zip(views, seen, strict=True)])


def _weight(view: CameraView, place: Floats, noise: float) -> Floats:
    slope = slopes(view, place[None])[0]
    return np.asarray(slope.T @ slope / max(noise, 1e-6) ** 2)
