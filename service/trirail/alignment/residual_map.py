"""Map of the errors that remain after a calibration of the geometry, from the same looks.

A look shows the platform's pose by its marks, without any leg: the rigid motion from their places on the platform to
where the cameras see them. trirail.kinematics.correction_fit makes the map of these poses.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from trirail.alignment.images import locate_pixels
from trirail.alignment.rigid_motion import Floats, fit_rigid_motion, rotation_matrix
from trirail.alignment.stage_model import StageLook, StageState
from trirail.errors import KinematicsError
from trirail.kinematics import correction_fit
from trirail.kinematics.calibration import CalibrationError
from trirail.kinematics.correction import Correction
from trirail.kinematics.geometry import Geometry, Room

MIN_MARKS = 2
CELLS = (2, 2, 2)
"""Cells of the map: 30 to 60 looks determine no more."""
MAX_LEFT_SHARE = 0.8
"""Share of the errors at held-out looks that a map may leave to be offered."""


class ResidualMap(NamedTuple):
    """A correction map, and how well it predicts looks that were held out of it."""

    correction: Correction
    looks: int
    before: tuple[float, float]
    """Pose errors without the map, root mean square: of x and y [m], of phi [rad]."""
    after: tuple[float, float]
    """Pose errors at each look by maps that were made without it, root mean square."""

    @property
    def helps(self) -> bool:
        """True if the errors at held-out looks are clearly smaller with the map, in position or angle."""
        place, angle = (after / max(before, 1e-15) for before, after in zip(self.before, self.after, strict=True))
        return min(place, angle) < MAX_LEFT_SHARE and max(place, angle) <= 1.0


def fit_residual_map(
    geometry: Geometry, room: Room, state: StageState, view_of: Mapping[str, str], looks: Sequence[StageLook]
) -> ResidualMap | None:
    """Return the map of a calibrated stage, None if the looks are too few for one or do not cover the travel."""
    complete = [look for look in looks if len(look.marks) >= MIN_MARKS]
    if not complete:
        return None
    poses = np.array([_pose(state, view_of, look) for look in complete])
    sliders = np.array([look.sliders for look in complete]) * (1.0 + state.scales)
    try:
        fit = correction_fit.fit(geometry, poses, sliders, room, CELLS)
    except (CalibrationError, KinematicsError):
        return None
    return ResidualMap(fit.correction, len(complete), _rms(fit.before), _rms(fit.predicted))


def _pose(state: StageState, view_of: Mapping[str, str], look: StageLook) -> Floats:
    """Return the platform's pose by the marks alone, (3,) [m, rad]."""
    places = np.array([state.places[name] for name in look.marks])
    seen = [locate_pixels(state.views[view_of[name]], np.array([pixel]))[0] for name, pixel in look.marks.items()]
    motion = fit_rigid_motion(places, np.array(seen))
    at = motion.centroid + motion.shift - rotation_matrix(motion.turn) @ motion.centroid
    return np.array([*at, motion.turn])


def _rms(errors: Floats) -> tuple[float, float]:
    squares = (errors**2).mean(axis=0)
    return float(np.sqrt(squares[:2].mean())), float(np.sqrt(squares[2]))
