"""Model of a stage with cameras: the pixels of marks as functions of legs, encoder scales, cameras and marks.

If the reading of slider i is m_i, its real position is (1 + k_i) m_i. The forward kinematics give the pose (t, phi) of
the platform. A mark at q on the platform is at w = t + R(phi) q in the base frame, and appears at the pixel u(w) of its
camera (trirail.alignment.images).

Some changes have no effect on the pixels at any pose, and cannot be determined from looks:

- The base frame moves together with the rails and the cameras, or the platform's frame moves together with the edges or
  pivots and the marks.
- All lengths are multiplied by the same factor, because the real size of a pixel is unknown.
- Two parameters of a leg compensate each other exactly, such as the rail angle and the encoder scale of a 3-PPR leg.

The frames are therefore chosen so that the corrections to the configured legs are as small as possible (root mean
square, with equal weights for 0.2 mm, 0.5 mrad, and 500 ppm of an encoder scale). The unit of length is defined by the
mean of the three encoder scales. Parameters that compensate each other keep their configured values.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from trirail.alignment.camera_calibration import Marks
from trirail.alignment.images import CameraView, Pair, project_points
from trirail.alignment.rigid_motion import Floats
from trirail.kinematics.calibration import corrected, pose_derivatives
from trirail.kinematics.geometry import LEGS, Geometry
from trirail.kinematics.robot import forward, inverse, jacobians

LENGTH_DOUBT_M, ANGLE_DOUBT_RAD, SCALE_DOUBT = 2e-4, 5e-4, 5e-4
"""Standard deviations of the parameters in drawings and data sheets. A fit with greater standard deviations has no
benefit."""
CENTRE_DOUBT_SHARE = 0.1
"""Standard deviation of the centre of a radial lens from the middle of the picture, as a fraction of the distance from
the middle to a corner. Without it, the fit could put the centre of a lens without distortion anywhere, such as 60,000
pixels away, where the small moves of a later calibration no longer determine the map."""
INVISIBLE = 1e-9
"""Singular value, relative to the greatest singular value, below which a change has no effect on any look."""
LENS_NUMBERS = {"affine": 0, "perspective": 2, "radial": 3}
"""Number of parameters of a lens in addition to the affine map: g for perspective, k and the centre for a radial
lens."""


class StageLook(NamedTuple):
    """Pixels of the observed marks, with the readings of the sliders."""

    sliders: tuple[float, float, float]
    """Positions of the sliders A, B, C, computed with the configured encoder scales [m]."""
    pose: tuple[float, float, float]
    """Pose x, y [m], phi [rad], computed with the configured geometry."""
    marks: Marks


class StageState(NamedTuple):
    """Parameters of legs, encoders, cameras and marks, converted from the unknowns of the model."""

    corrections: Floats
    """Corrections to the parameters of legs A, B, C, (3, 5) [m, rad]."""
    scales: Floats
    """Relative errors k of the encoders' scales, (3,)."""
    views: dict[str, CameraView]
    places: dict[str, Pair]
    """Positions of the marks in the platform's frame [m]."""


class StageModel:
    """Model that computes the pixels of marks from a vector of unknowns.

    The unknowns are the visible corrections of legs and encoder scales, the views, and the positions of the marks.

    Parameters
    ----------
    start
        Configured geometry, without a correction map.
    samples
        Poses within the travel of the stage, (N, 3) [m, rad], from which the invisible changes are determined.
    views, places
        First estimates of the cameras and of the positions of the marks on the platform. The first estimate of the
        centre of a radial lens is the middle of the picture.
    view_of
        Name of the view of each mark.
    """

    def __init__(
        self,
        start: Geometry,
        samples: Floats,
        views: Mapping[str, CameraView],
        places: Mapping[str, Pair],
        view_of: Mapping[str, str],
    ) -> None:
        self.start = start
        self.views, self.places, self.view_of = dict(views), dict(places), dict(view_of)
        self.parameters = tuple((leg, name) for leg in LEGS for name in (*start.parameters, "encoder scale"))
        self.doubts = np.array([_doubt(name) for _, name in self.parameters])
        rows = _pose_changes(start, start, samples, inverse(start, samples).position) * self.doubts
        self.basis, self.held = _visible(rows, samples, self.doubts)
        """Orthonormal basis of the visible corrections, in units of `doubts`, (18, K)."""
        self._view_at, self._mark_at, at = {}, {}, self.basis.shape[1]
        for name, view in self.views.items():
            self._view_at[name] = at
            at += 6 + LENS_NUMBERS[view.lens]
        for name in self.places:
            self._mark_at[name] = at
            at += 2
        self.size = at

    @property
    def legs(self) -> int:
        """Number of unknowns of the legs and encoders, which are the first unknowns."""
        return int(self.basis.shape[1])

    def view_unknowns(self, name: str) -> slice:
        """Return the slice of the unknowns for a view: b, M by rows, and the parameters of the lens."""
        at = self._view_at[name]
        return slice(at, at + 6 + LENS_NUMBERS[self.views[name].lens])

    def mark_unknowns(self, name: str) -> slice:
        """Return the slice of the unknowns for the position of a mark."""
        return slice(self._mark_at[name], self._mark_at[name] + 2)

    def expected(self, doubt: float) -> tuple[Floats, Floats]:
        """Return what is known without looks: rows (n, size), and the values (n,) of their products with the unknowns.

        Both are in standard deviations. The corrections of the legs are 0, with the deviations `doubts` times `doubt`.
        The centre of a radial lens is the middle of the picture, which is its first estimate.
        """
        rows, values = [*np.eye(self.legs, self.size) / doubt], [0.0] * self.legs
        for name, view in self.views.items():
            if view.lens == "radial":
                deviation = CENTRE_DOUBT_SHARE * math.hypot(*view.centre)
                rows += [*np.eye(self.size)[self.view_unknowns(name)][-2:] / deviation]
                values += [each / deviation for each in view.centre]
        return np.array(rows).reshape(-1, self.size), np.array(values)

    def initial(self) -> Floats:
        """Return the unknowns (size,) for the configured legs and the first estimates of views and marks."""
        unknowns = np.zeros(self.size)
        for name, view in self.views.items():
            lens = {"affine": (), "perspective": view.bend, "radial": (view.bend[0], *view.centre)}[view.lens]
            unknowns[self.view_unknowns(name)] = (*view.pixel, *view.matrix[0], *view.matrix[1], *lens)
        for name, place in self.places.items():
            unknowns[self.mark_unknowns(name)] = place
        return unknowns

    def state(self, unknowns: Floats) -> StageState:
        """Convert the unknowns to parameters of legs, encoders, views and marks."""
        legs = (self.doubts * (self.basis @ unknowns[: self.legs])).reshape(3, 6)
        views = {name: self._view(name, unknowns) for name in self.views}
        places = {name: _pair(unknowns[self.mark_unknowns(name)]) for name in self.places}
        return StageState(legs[:, :5], legs[:, 5], views, places)

    def geometry(self, unknowns: Floats) -> Geometry:
        """Return the geometry for given unknowns. Raises KinematicsError if the geometry is invalid."""
        return corrected(self.start, self.state(unknowns).corrections)

    def poses(self, unknowns: Floats, looks: Sequence[StageLook]) -> Floats:
        """Return the computed poses of the platform at the looks, (L, 3) [m, rad]. Raises KinematicsError."""
        return _poses(self.geometry(unknowns), self.state(unknowns), looks)

    def residuals(self, unknowns: Floats, looks: Sequence[StageLook]) -> Floats:
        """Return observed minus computed pixels, (n, 2), in the order of `list_marks`. Raises KinematicsError."""
        poses, state = self.poses(unknowns, looks), self.state(unknowns)
        result = np.empty((sum(len(look.marks) for look in looks), 2))
        for rows, at, name, seen in _groups(looks):
            w, _ = carry(poses[at], np.array(state.places[name]))
            result[rows] = seen - project_points(state.views[self.view_of[name]], w)
        return result

    def jacobian(self, unknowns: Floats, looks: Sequence[StageLook]) -> Floats:
        """Return the derivatives of the computed pixels with respect to the unknowns, (n, 2, size).

        Raises KinematicsError if a pose cannot be computed.
        """
        state, geometry = self.state(unknowns), self.geometry(unknowns)
        poses = _poses(geometry, state, looks)
        changes = _pose_changes(geometry, self.start, poses, np.array([look.sliders for look in looks]))
        changes = changes * self.doubts @ self.basis
        result = np.zeros((sum(len(look.marks) for look in looks), 2, self.size))
        for rows, at, name, _ in _groups(looks):
            view = self.view_of[name]
            w, by_phi = carry(poses[at], np.array(state.places[name]))
            by_view, by_w = _projection_derivatives(state.views[view], w)
            by_pose = np.concatenate([by_w, by_w @ by_phi[:, :, None]], axis=2)
            result[rows, :, : self.legs] = by_pose @ changes[at]
            result[rows, :, self.view_unknowns(view)] = by_view
            c, s = np.cos(poses[at, 2]), np.sin(poses[at, 2])
            turn = np.stack([np.stack([c, -s], axis=1), np.stack([s, c], axis=1)], axis=1)
            result[rows, :, self.mark_unknowns(name)] = by_w @ turn
        return result

    def _view(self, name: str, unknowns: Floats) -> CameraView:
        view, values = self.views[name], unknowns[self.view_unknowns(name)].tolist()
        pixel, matrix, lens = (values[0], values[1]), ((values[2], values[3]), (values[4], values[5])), values[6:]
        if view.lens == "perspective":
            return structs.replace(view, pixel=pixel, matrix=matrix, bend=(lens[0], lens[1]))
        if view.lens == "radial":
            return structs.replace(view, pixel=pixel, matrix=matrix, bend=(lens[0], 0.0), centre=(lens[1], lens[2]))
        return structs.replace(view, pixel=pixel, matrix=matrix)


def list_marks(looks: Sequence[StageLook]) -> list[tuple[int, str]]:
    """Return the index of the look and the name of the mark for each observation, in the order of the residuals."""
    return [(number, name) for number, look in enumerate(looks) for name in look.marks]


def _groups(looks: Sequence[StageLook]) -> list[tuple[NDArray[np.int64], NDArray[np.int64], str, Floats]]:
    """Return for each mark the rows of its residuals, the indices of the looks, its name, and the observed pixels."""
    rows_of: dict[str, list[tuple[int, int, Pair]]] = {}
    for row, (look, name) in enumerate(list_marks(looks)):
        rows_of.setdefault(name, []).append((row, look, looks[look].marks[name]))
    return [
        (np.array([r for r, _, _ in each]), np.array([k for _, k, _ in each]), name, np.array([p for *_, p in each]))
        for name, each in rows_of.items()
    ]


def _poses(geometry: Geometry, state: StageState, looks: Sequence[StageLook]) -> Floats:
    sliders = np.array([look.sliders for look in looks]) * (1.0 + state.scales)
    return forward(geometry, sliders, near=np.array([look.pose for look in looks]))


def _doubt(parameter: str) -> float:
    if parameter == "encoder scale":
        return SCALE_DOUBT
    return ANGLE_DOUBT_RAD if parameter.endswith("angle") else LENGTH_DOUBT_M


def _pose_changes(geometry: Geometry, start: Geometry, poses: Floats, sliders: Floats) -> Floats:
    """Return the derivatives of poses with respect to corrections of legs and encoder scales, (N, 3, 18).

    The last axis has six values per leg: five parameters and the encoder scale.
    """
    by_legs = pose_derivatives(geometry, start, poses)
    J1, J2 = jacobians(geometry, poses)
    by_scales = np.linalg.solve(J2, J1) * sliders[:, None, :]
    return np.concatenate([by_legs, by_scales[..., None]], axis=3).reshape(len(poses), 3, 18)


def _visible(rows: Floats, poses: Floats, doubts: Floats) -> tuple[Floats, Floats]:
    """Return orthonormal bases of the corrections that looks can determine, and of the corrections that change no pose.

    `rows` are the derivatives of the poses with respect to corrections in units of `doubts`, (N, 3, 18).
    """
    frames = _frame_changes(poses)
    moved, frames = rows.reshape(-1, rows.shape[2]), frames.reshape(-1, 6)
    unit = np.abs(moved).max()
    null = _null_space(np.concatenate([moved / unit, frames], axis=1))[:, : rows.shape[2]]
    held = _null_space(moved / unit)
    # A common factor of all encoder scales is excluded, because their mean defines the unit of length.
    common = np.zeros(rows.shape[2])
    common[5::6] = 1.0 / doubts[5::6]
    null = np.concatenate([null, common[None] / np.linalg.norm(common)])
    _, values, directions = np.linalg.svd(null, full_matrices=True)
    rank = int((values > 1e-6).sum())
    return directions[rank:].T, held


def _frame_changes(poses: Floats) -> Floats:
    """Return the changes of poses with the base frame and with the platform's frame, (N, 3, 6)."""
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    zero, one = np.zeros(len(poses)), np.ones(len(poses))
    return np.stack(
        [
            np.stack([one, zero, zero], axis=1),
            np.stack([zero, one, zero], axis=1),
            np.stack([-poses[:, 1], poses[:, 0], one], axis=1),
            np.stack([c, s, zero], axis=1),
            np.stack([-s, c, zero], axis=1),
            np.stack([zero, zero, one], axis=1),
        ],
        axis=2,
    )


def mark_displacements(model: StageModel, poses: Floats) -> Floats:
    """Return the displacements of the marks on the table per unit of each leg unknown, (n, legs) [m].

    The rows are x and y of each mark at each of the poses (N, 3) [m, rad]. The part of a displacement that other frames
    or another unit of length would cause is omitted.
    """
    by_legs = _pose_changes(model.start, model.start, poses, inverse(model.start, poses).position)
    length = np.column_stack([poses[:, :2], np.zeros(len(poses))])[..., None]
    changes = np.concatenate([by_legs * model.doubts @ model.basis, _frame_changes(poses), length], axis=2)
    rows = []
    for place in model.places.values():
        _, by_phi = carry(poses, np.array(place))
        rows.append((changes[:, :2] + by_phi[:, :, None] * changes[:, 2:]).reshape(-1, changes.shape[2]))
    moved, frames = np.split(np.concatenate(rows), [model.legs], axis=1)
    frames, values, _ = np.linalg.svd(frames, full_matrices=False)
    frames = frames[:, values > INVISIBLE * values[0]]
    return np.asarray(moved - frames @ (frames.T @ moved))


def _null_space(matrix: Floats) -> Floats:
    """Return an orthonormal basis of the null space of a matrix. Each row is a vector of the basis."""
    _, values, directions = np.linalg.svd(np.linalg.qr(matrix, mode="r"))
    values = np.append(values, np.zeros(len(directions) - len(values)))
    return np.asarray(directions[values <= INVISIBLE * values[0]])


def carry(poses: Floats, place: Floats) -> tuple[Floats, Floats]:
    """Return the positions of a mark in the base frame at poses, (n, 2) [m], and the derivatives by phi."""
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    arm = np.stack([c * place[0] - s * place[1], s * place[0] + c * place[1]], axis=1)
    return poses[:, :2] + arm, np.stack([-arm[:, 1], arm[:, 0]], axis=1)


def _projection_derivatives(view: CameraView, points: Floats) -> tuple[Floats, Floats]:
    """Return the derivatives of pixels with respect to the unknowns of a view, and with respect to the points.

    The unknowns are b, M by rows, and the parameters of the lens, (n, 2, 6 …).
    """
    M, away = np.array(view.matrix), points - view.origin
    n = len(points)
    by_b = np.broadcast_to(np.eye(2), (n, 2, 2))
    by_m = np.zeros((n, 2, 4))
    by_m[:, 0, :2] = by_m[:, 1, 2:] = away
    seen = away @ M.T
    if view.lens == "affine":
        return np.concatenate([by_b, by_m], axis=2), np.broadcast_to(M, (n, 2, 2))
    if view.lens == "perspective":
        g = np.array(view.bend)
        depth = (1.0 + away @ g)[:, None, None]
        by_g = -seen[:, :, None] * away[:, None, :] / depth**2
        by_w = M / depth - seen[:, :, None] * g / depth**2
        return np.concatenate([by_b, by_m / depth, by_g], axis=2), by_w
    d, k = view.pixel + seen - view.centre, view.bend[0]
    square = (d * d).sum(axis=1)[:, None, None]
    bent = np.eye(2) * (1.0 + k * square) + 2.0 * k * d[:, :, None] * d[:, None, :]
    by_k = d[:, :, None] * square
    return np.concatenate([bent, bent @ by_m, by_k, np.eye(2) - bent], axis=2), bent @ M


def _pair(values: Floats) -> Pair:
    return float(values[0]), float(values[1])
