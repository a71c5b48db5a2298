"""Computation of the misalignment of a part from the pixels of its marks and the pixels of their targets."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np

from trirail.alignment.camera_calibration import CameraCalibration, Marks
from trirail.alignment.images import CameraView, locate_pixels, projection_jacobians
from trirail.alignment.rigid_motion import Floats, RigidMotion, find_swap, fit_rigid_motion, worst_distance_error
from trirail.errors import AlignmentError, AlignmentFault

MIN_MARKS = 2
"""Least number of marks that determine the position and the angle of a part."""
DEFAULT_DISTANCE_ERROR = 1000e-6
"""Default of the greatest relative error of a distance between two marks, equivalent to 100 µm over 100 mm."""


SAME_PLACE_M = 1e-6
"""Distance of two targets below which they belong to a single mark [m]."""


class Misalignment(NamedTuple):
    """Positions of the observed marks, and the rigid motion that moves the marks to their targets."""

    names: tuple[str, ...]
    """Names of the observed marks that have a target."""
    positions: Floats
    """Positions of the marks `names` in the base frame, (n, 2) [m]."""
    targets: Floats
    """Targets of the marks `names` in the base frame, (n, 2) [m]."""
    motion: RigidMotion
    """Motion that aligns the part."""
    distance: float
    """Relative error of the distance between two marks, for the pair with the greatest error."""

    @property
    def distances(self) -> Floats:
        """Distances that the marks travel in the motion that aligns the part, (n,) [m]."""
        return np.asarray(np.linalg.norm(self.motion.displacements(self.positions), axis=1))

    @property
    def worst(self) -> float:
        """Greatest of `distances` [m]."""
        return float(self.distances.max())

    @property
    def arm(self) -> float:
        """Greatest distance of a mark from the centroid of the marks [m]."""
        return float(np.linalg.norm(self.positions - self.motion.centroid, axis=1).max())

    def deviations(self, noise_share: float = 1.0) -> tuple[float, float]:
        """Return the root mean square errors of `worst` [m] and of the rotation [rad].

        `noise_share` is the noise of the look, divided by the noise of the calibration.
        """
        arms = self.positions - self.motion.centroid
        jacobians = np.zeros((len(arms), 2, 3))
        jacobians[:, :, :2] = np.eye(2)
        jacobians[:, 0, 2], jacobians[:, 1, 2] = -arms[:, 1], arms[:, 0]
        covariance = self.motion.covariance
        variances = np.einsum("nai,ij,naj->n", jacobians, covariance, jacobians)
        return noise_share * float(np.sqrt(variances.max())), noise_share * float(np.sqrt(covariance[2, 2]))


def measure_misalignment(
    calibration: CameraCalibration, marks: Marks, targets: Marks, distance: float = DEFAULT_DISTANCE_ERROR
) -> Misalignment:
    """Compute the misalignment of a part.

    Each mark is weighted by the inverse covariance of its position, which follows from the noise of its view.

    Parameters
    ----------
    calibration
        Calibration of the cameras.
    marks, targets
        Pixels of the observed marks and of their targets.
    distance
        Greatest permitted relative error of the distance between two marks.

    Raises
    ------
    AlignmentError
        Fewer than two marks were found, a target has no calibrated mark, two targets are at the same place, a distance
        between marks is wrong, or marks are swapped.
    """
    check_targets_known(calibration, targets)
    names = tuple(sorted(set(marks) & set(targets)))
    if len(names) < MIN_MARKS:
        absent = ", ".join(sorted(set(targets) - set(marks)))
        reason = f"not found: {absent}; check light and focus" if absent else "give targets for more marks"
        text = f"{len(names)} marks found, at least {MIN_MARKS} are needed; {reason}"
        raise AlignmentError(AlignmentFault.MISSING, text, value=float(len(names)), limit=float(MIN_MARKS))
    shown_by = [calibration.marks[name].view for name in names]
    views = [calibration.views[view] for view in shown_by]
    at = _locate_marks(views, [marks[name] for name in names])
    to = _locate_marks(views, [targets[name] for name in names])
    for (one, place), (other, beside) in itertools.combinations(zip(names, to, strict=True), 2):
        if np.linalg.norm(place - beside) < SAME_PLACE_M:
            text = (
                f"marks {one} and {other} have their targets at the same place; check that each name has its own mark"
            )
            raise AlignmentError(AlignmentFault.MISSING, text)
    # Check for swapped marks before the check of distances, which may also fail but would not name the cause.
    order = find_swap(at, to)
    if order is not None:
        moved = ", ".join(name for n, name in enumerate(names) if order[n] != n)
        raise AlignmentError(
            AlignmentFault.SWAPPED,
            f"marks {moved} are swapped, or the part is rotated too far to tell them apart; "
            "check the names of the marks and the part",
        )
    error = worst_distance_error(at, to)
    if abs(error) > distance:
        text = (
            f"distance between marks: {error * 1e6:+.0f} ppm exceeds the limit of {distance * 1e6:.0f} ppm; check for "
            "another part, a mistaken mark, a camera that was moved since its calibration, and heat"
        )
        raise AlignmentError(AlignmentFault.DISTANCE, text, value=error, limit=distance)
    noises = [calibration.noise_of(view) for view in shown_by]
    weights = np.stack([_inverse_covariance(*each) for each in zip(views, at, noises, strict=True)])
    return Misalignment(names, at, to, fit_rigid_motion(at, to, weights), error)


def check_targets_known(calibration: CameraCalibration, targets: Marks) -> None:
    """Raise AlignmentError if a target belongs to a mark that is not in the calibration."""
    if unknown := sorted(set(targets) - set(calibration.marks)):
        raise AlignmentError(
            AlignmentFault.MISSING,
            f"marks not in the calibration: {', '.join(unknown)}; calibrate again with these marks",
        )


def _locate_marks(views: list[CameraView], seen: list[tuple[float, float]]) -> Floats:
    return np.concatenate([locate_pixels(view, np.array([pixel])) for view, pixel in zip(views, seen, strict=True)])


def _inverse_covariance(view: CameraView, position: Floats, noise: float) -> Floats:
    jacobian = projection_jacobians(view, position[None])[0]
    return np.asarray(jacobian.T @ jacobian / max(noise, 1e-6) ** 2)
