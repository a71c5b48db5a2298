"""Differences between two calibrations of the same cameras, with any part, which show whether a camera was moved.

A single look cannot tell a shifted camera from a shifted part, because both show the marks in other places. A rotation
of the stage can: it moves a mark about the stage's centre by an amount that depends on the real position of the mark.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np

from trirail.alignment.camera_calibration import CameraCalibration, to_base_frame
from trirail.alignment.images import Pair, locate_pixels, project_points
from trirail.alignment.rigid_motion import Floats

SIGNIFICANT_DEVIATIONS = 5.0
"""Standard deviations above which a difference counts as a change."""


class ViewChange(msgspec.Struct, frozen=True):
    """Change of a view between a saved calibration and the current one."""

    view: str
    shift: Pair
    """Displacement of the marks according to the saved calibration, x, y [m]."""
    shift_deviation: Pair
    """Standard deviations of `shift` [m]."""
    turn: float
    """Rotation of the picture, positive from u to v [rad]."""
    scale: float
    """Relative change of the scale."""
    deviation: float
    """Standard deviation of `turn` and of `scale`."""

    @property
    def is_shifted(self) -> bool:
        """True if the view has been shifted significantly."""
        return any(
            abs(shift) > SIGNIFICANT_DEVIATIONS * deviation
            for shift, deviation in zip(self.shift, self.shift_deviation, strict=True)
        )

    @property
    def is_changed(self) -> bool:
        """True if the view has been shifted, turned or scaled significantly."""
        return self.is_shifted or max(abs(self.turn), abs(self.scale)) > SIGNIFICANT_DEVIATIONS * self.deviation


def compare_views(saved: CameraCalibration, current: CameraCalibration) -> list[ViewChange]:
    """Return the changes of the views that have marks in both calibrations."""
    return [
        _compare_view(saved, current, view)
        for view in sorted(saved.views.keys() & current.views.keys())
        if any(mark.view == view for mark in saved.marks.values())
        and any(mark.view == view for mark in current.marks.values())
    ]


def _compare_view(saved: CameraCalibration, current: CameraCalibration, view: str) -> ViewChange:
    before, after = saved.views[view], current.views[view]
    at = np.array([to_base_frame(mark.place, current.poses[0]) for mark in current.marks.values() if mark.view == view])
    shift = (locate_pixels(before, project_points(after, at)) - at).mean(axis=0)
    deviation = np.hypot(_place_deviations(saved, view), _place_deviations(current, view))
    # Apart from mirror and skew, both maps are complex numbers: their ratio is the turn and the scale.
    ratio = np.array(after.matrix) @ np.linalg.inv(np.array(before.matrix))
    rotation = complex(ratio[0, 0] + ratio[1, 1], ratio[1, 0] - ratio[0, 1]) / 2.0
    map_deviation = math.hypot(*(_map_deviation(each, view) for each in (saved, current)))
    return ViewChange(
        view,
        (float(shift[0]), float(shift[1])),
        (float(deviation[0]), float(deviation[1])),
        math.atan2(rotation.imag, rotation.real),
        abs(rotation) - 1.0,
        map_deviation,
    )


def _place_deviations(calibration: CameraCalibration, view: str) -> Floats:
    """Return the greatest standard deviations of the mark positions in a view, (2,) [m]."""
    return np.asarray(np.max([mark.deviation for mark in calibration.marks.values() if mark.view == view], axis=0))


def _map_deviation(calibration: CameraCalibration, view: str) -> float:
    """Return the standard deviation of a view's turn, which is that of its relative scale."""
    # Entries 2 to 5 of the unknowns are M by rows.
    variances = np.diag(np.array(calibration.covariances[view]))[2:6]
    return float(np.sqrt(variances.sum() / 2.0)) / calibration.views[view].scale / math.sqrt(2.0)
