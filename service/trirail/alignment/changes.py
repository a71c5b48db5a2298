"""Whether a camera stands as it was calibrated: two calibrations of it compared, of whatever part.

A camera that was shifted shows a mark elsewhere, as a part does that lies elsewhere: no look tells them apart. A turn
of the stage does, for it moves a mark about the centre by where the mark really is.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np

from trirail.alignment.camera_calibration import CameraCalibration, placed
from trirail.alignment.images import Pair, pixels, places
from trirail.alignment.rigid import Floats

SURE = 5.0
"""Standard deviations from which on a change is one."""


class ViewChange(msgspec.Struct, frozen=True):
    """How a view is now, beside how it was."""

    view: str
    shift: Pair
    """How far from their places it has marks appear in the calibration that was kept, x, y [m]."""
    shift_deviation: Pair
    """Its standard deviations [m]."""
    turn: float
    """By what angle the picture has turned, from u to v [rad]."""
    scale: float
    """By what share it has become larger."""
    deviation: float
    """Standard deviation of the turn, and of the scale."""

    @property
    def is_shifted(self) -> bool:
        """Whether it has been shifted, for sure."""
        return any(abs(way) > SURE * deviation for way, deviation in zip(self.shift, self.shift_deviation, strict=True))

    @property
    def is_changed(self) -> bool:
        """Whether it has been shifted, turned, or brought nearer or farther, for sure."""
        return self.is_shifted or max(abs(self.turn), abs(self.scale)) > SURE * self.deviation


def view_changes(kept: CameraCalibration, now: CameraCalibration) -> list[ViewChange]:
    """Return how the views of a calibration differ from what they were, of those that are in both."""
    return [
        _change(kept, now, view)
        for view in sorted(kept.views.keys() & now.views.keys())
        if any(mark.view == view for mark in kept.marks.values()) and any(m.view == view for m in now.marks.values())
    ]


def _change(kept: CameraCalibration, now: CameraCalibration, view: str) -> ViewChange:
    before, after = kept.views[view], now.views[view]
    at = np.array([placed(mark.place, now.poses[0]) for mark in now.marks.values() if mark.view == view])
    shift = (places(before, pixels(after, at)) - at).mean(axis=0)
    deviation = np.hypot(_of_places(kept, view), _of_places(now, view))
    # Both maps are complex numbers but for mirror and skew: the ratio of these is the turn and the scale.
    ratio = np.array(after.matrix) @ np.linalg.inv(np.array(before.matrix))
    turning = complex(ratio[0, 0] + ratio[1, 1], ratio[1, 0] - ratio[0, 1]) / 2.0
    of_map = math.hypot(*(_of_map(each, view) for each in (kept, now)))
    return ViewChange(
        view,
        (float(shift[0]), float(shift[1])),
        (float(deviation[0]), float(deviation[1])),
        math.atan2(turning.imag, turning.real),
        abs(turning) - 1.0,
        of_map,
    )


def _of_places(found: CameraCalibration, view: str) -> Floats:
    """Return the standard deviations of where a view's marks are, of the worst, (2,) [m]."""
    return np.asarray(np.max([mark.deviation for mark in found.marks.values() if mark.view == view], axis=0))


def _of_map(found: CameraCalibration, view: str) -> float:
    """Return the standard deviation of a view's turn or scale, as a share of its scale."""
    variances = np.diag(np.array(found.covariances[view]))[2:6]
    return float(np.sqrt(variances.sum() / 2.0)) / found.views[view].scale / math.sqrt(2.0)
