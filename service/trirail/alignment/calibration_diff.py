"""Comparison of two calibrations of the same cameras, to detect whether a camera was moved. The parts may differ.

A single look cannot distinguish a shifted camera from a shifted part, because the marks appear at other pixels in both
cases. A calibration can, because it rotates the stage: the displacement of a mark in a rotation depends on the real
distance of the mark from the centre of the stage.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np

from trirail.alignment.camera_calibration import CameraCalibration, to_base_frame
from trirail.alignment.images import CameraView, Pair, locate_pixels, project_points, projection_jacobians
from trirail.alignment.rigid_motion import Floats

SIGNIFICANT_DEVIATIONS = 6.0
"""Number of standard deviations above which a difference is significant. With the default moves, the noise of a view is
known with 12 degrees of freedom from both calibrations: by Student's t distribution, chance exceeds 6 deviations in one
of 16,000 cases, and 5 in one of 3,000."""


class ViewChange(msgspec.Struct, frozen=True):
    """Change of a view between a saved calibration and the current calibration."""

    view: str
    shift: Pair
    """Error of marks located with the saved calibration, averaged over the marks, x, y [m]."""
    shift_deviation: Pair
    """Standard deviations of `shift` [m]."""
    turn: float
    """Rotation of the picture, positive in the direction from u to v [rad]."""
    scale: float
    """Relative change of the scale."""
    deviation: float
    """Standard deviation of `turn` [rad]."""
    scale_deviation: float
    """Standard deviation of `scale`."""

    @property
    def is_shifted(self) -> bool:
        """True if the shift of the view is significant."""
        return any(
            abs(shift) > SIGNIFICANT_DEVIATIONS * deviation
            for shift, deviation in zip(self.shift, self.shift_deviation, strict=True)
        )

    @property
    def is_changed(self) -> bool:
        """True if the shift, the rotation or the change of scale of the view is significant."""
        return (
            self.is_shifted
            or abs(self.turn) > SIGNIFICANT_DEVIATIONS * self.deviation
            or abs(self.scale) > SIGNIFICANT_DEVIATIONS * self.scale_deviation
        )


def compare_views(saved: CameraCalibration, current: CameraCalibration) -> list[ViewChange]:
    """Return the changes of all views that show marks in both calibrations."""
    return [
        _compare_view(saved, current, view)
        for view in sorted(saved.views.keys() & current.views.keys())
        if any(mark.view == view for mark in saved.marks.values())
        and any(mark.view == view for mark in current.marks.values())
    ]


def find_missing_views(saved: CameraCalibration, current: CameraCalibration) -> list[str]:
    """Return the names of the views that show marks in the saved calibration, and none in the current one."""
    before, now = ({mark.view for mark in each.marks.values()} for each in (saved, current))
    return sorted(before - now)


def _compare_view(saved: CameraCalibration, current: CameraCalibration, view: str) -> ViewChange:
    before, after = saved.views[view], current.views[view]
    at = np.array([to_base_frame(mark.place, current.poses[0]) for mark in current.marks.values() if mark.view == view])
    shift = (locate_pixels(before, project_points(after, at)) - at).mean(axis=0)
    deviation = np.hypot(_place_deviations(saved, view), _place_deviations(current, view))
    # Apart from mirroring and skew, each map corresponds to a complex number. The argument of the ratio of both numbers
    # is the rotation, and the absolute value is the scale.
    rotation = _as_number(_matrix_at(after, after.origin) @ np.linalg.inv(_matrix_at(before, after.origin)))
    deviations = [_map_deviations(each, view, after.origin) for each in (saved, current)]
    turn, scale = (math.hypot(*each) for each in zip(*deviations, strict=True))
    return ViewChange(
        view,
        (float(shift[0]), float(shift[1])),
        (float(deviation[0]), float(deviation[1])),
        math.atan2(rotation.imag, rotation.real),
        abs(rotation) - 1.0,
        turn,
        abs(rotation) * scale,
    )


def _place_deviations(calibration: CameraCalibration, view: str) -> Floats:
    """Return the greatest standard deviations of the positions of the marks in a view, in x and y, (2,) [m]."""
    return np.asarray(np.max([mark.deviation for mark in calibration.marks.values() if mark.view == view], axis=0))


def _as_number(matrix: Floats) -> complex:
    """Return the complex number with the rotation and the scale of a matrix (2, 2)."""
    return complex(matrix[0, 0] + matrix[1, 1], matrix[1, 0] - matrix[0, 1]) / 2.0


def _matrix_at(view: CameraView, origin: Pair) -> Floats:
    """Return the matrix M of the same view for another point o, on which M depends in perspective."""
    if view.lens != "perspective":
        return np.array(view.matrix)
    return np.asarray(projection_jacobians(view, np.array([origin]))[0])


def _map_deviations(calibration: CameraCalibration, view: str, origin: Pair) -> tuple[float, float]:
    """Return the standard deviations of the rotation of a view [rad] and of its relative scale.

    A change dM of the matrix rotates and scales the picture by the complex number of dM M^-1. Its real and imaginary
    parts are linear in the unknowns of the map, whose covariance is known.
    """
    own = calibration.views[view]
    # Entries 2 to 5 of the unknowns are the elements of M, row by row; in perspective, entries 6 and 7 are g.
    used = slice(2, 8 if own.lens == "perspective" else 6)
    inverse = np.linalg.inv(_matrix_at(own, origin))
    changes = np.array([_as_number(each @ inverse) for each in _matrix_derivatives(own, origin)])
    covariance = np.array(calibration.covariances[view])[used, used]
    turn, scale = (math.sqrt(max(each @ covariance @ each, 0.0)) for each in (changes.imag, changes.real))
    return turn, scale


def _matrix_derivatives(view: CameraView, origin: Pair) -> list[Floats]:
    """Return the derivatives of _matrix_at with respect to the elements of M and, in perspective, of g."""
    units = np.eye(4).reshape(4, 2, 2)
    if view.lens != "perspective":
        return [*units]
    # The matrix at the distance d from o is M (1 - d g' / w) / w, with w = 1 + g' d.
    d, g = np.subtract(origin, view.origin), np.array(view.bend)
    w, matrix = 1.0 + g @ d, np.array(view.matrix)
    by_g = [
        -matrix @ (d[axis] * (np.eye(2) - 2.0 * np.outer(d, g) / w) + np.outer(d, np.eye(2)[axis])) / w**2
        for axis in range(2)
    ]
    return [*(each @ (np.eye(2) - np.outer(d, g) / w) / w for each in units), *by_g]
