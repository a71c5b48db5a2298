"""Map of the errors that remain after a calibration of the geometry, computed from the same looks.

The marks in a look determine the pose of the platform without using the legs: the pose is the rigid motion from the
positions of the marks on the platform to their positions in the base frame, as seen by the cameras. The map is fitted
to these poses by trirail.kinematics.correction_fit.
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
"""Number of cells of the map along x, y and phi. 30 to 60 looks cannot determine a finer map."""
MAX_LEFT_SHARE = 0.8
"""Remaining fraction of the errors in looks that were not used for the fit, above which the map does not help."""


class ResidualMap(NamedTuple):
    """Correction map, with the accuracy of its predictions for looks that were not used for the fit."""

    correction: Correction
    looks: int
    """Number of looks to which the map was fitted."""
    before: tuple[float, float]
    """Root mean square pose errors without the map: of x and y [m], and of phi [rad]."""
    after: tuple[float, float]
    """Root mean square pose errors of x and y [m], and of phi [rad]. For each look, a map fitted without this look is
    used."""

    @property
    def helps(self) -> bool:
        """True if the map clearly reduces the errors of position or angle, and increases neither of them."""
        place, angle = (after / max(before, 1e-15) for before, after in zip(self.before, self.after, strict=True))
        return min(place, angle) < MAX_LEFT_SHARE and max(place, angle) <= 1.0


def fit_residual_map(
    geometry: Geometry, room: Room, state: StageState, view_of: Mapping[str, str], looks: Sequence[StageLook]
) -> ResidualMap | None:
    """Return the map for a calibrated stage; None if there are too few looks, or if they do not cover the travel."""
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
    """Return the pose of the platform that follows from the marks in a look, without the legs, (3,) [m, rad]."""
    places = np.array([state.places[name] for name in look.marks])
    seen = [locate_pixels(state.views[view_of[name]], np.array([pixel]))[0] for name, pixel in look.marks.items()]
    motion = fit_rigid_motion(places, np.array(seen))
    at = motion.centroid + motion.shift - rotation_matrix(motion.turn) @ motion.centroid
    return np.array([*at, motion.turn])


def _rms(errors: Floats) -> tuple[float, float]:
    squares = (errors**2).mean(axis=0)
    return float(np.sqrt(squares[:2].mean())), float(np.sqrt(squares[2]))
