"""Model of everything that a look depends on: legs, encoder scales, cameras and marks, with its derivatives.

If the sliders read m, leg i is at (1 + k_i) m_i. Forward kinematics give the platform's pose (t, phi). A mark at q on
the platform is at w = t + R(phi) q, and its camera shows it at the pixel u(w) (trirail.alignment.images).

Pixels alone do not determine everything, wherever the stage looks. Three kinds of change are invisible:

- the base frame moves with the rails and the cameras, or the platform's frame with its edges or pivots and the marks;
- all lengths grow by one factor, because a pixel has no size of its own;
- two parameters of a leg compensate each other exactly, such as the rail angle and the encoder scale of a 3-PPR leg.

The model therefore uses the frames in which the corrections to the configured legs are least (root mean square, with
0.2 mm counted as much as 0.5 mrad or 500 ppm of scale). The unit of length is the mean of the three encoders. The third
kind of change keeps the configured values.
"""

from __future__ import annotations

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
"""Standard deviations above which drawings and data sheets are as good as the looks."""
INVISIBLE = 1e-9
"""Singular value, as a share of the greatest one, below which no look shows a change."""
LENS_NUMBERS = {"affine": 0, "perspective": 2, "radial": 3}
"""Number of parameters of a lens in addition to its affine map: g of a perspective; k and the centre of a radial
lens."""


class StageLook(NamedTuple):
    """Marks that were seen, and the readings of the sliders."""

    sliders: tuple[float, float, float]
    """Positions according to the configured encoder scales, A, B, C [m]."""
    pose: tuple[float, float, float]
    """Pose according to the configured geometry: x, y [m], phi [rad]."""
    marks: Marks


class StageState(NamedTuple):
    """Values of the model's unknowns."""

    corrections: Floats
    """Corrections to the parameters of legs A, B, C, (3, 5) [m, rad]."""
    scales: Floats
    """Relative errors k of the encoders' scales, (3,)."""
    views: dict[str, CameraView]
    places: dict[str, Pair]
    """Positions of the marks in the platform's frame [m]."""


class StageModel:
    """Pixels of marks as a function of the unknowns: corrections of the legs in a basis, views and mark positions.

    Parameters
    ----------
    start
        Configured geometry, without a correction map.
    samples
        Poses in the stage's travel, (N, 3) [m, rad], from which the invisible changes are determined.
    views, places
        First estimates of the cameras and of the positions of the marks on the platform.
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
        """Orthonormal basis of the visible corrections in units of `doubts`, (18, K)."""
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
        """Number of unknowns that belong to the legs and encoders. They come first."""
        return int(self.basis.shape[1])

    def view_unknowns(self, name: str) -> slice:
        """Return the slice of the unknowns that belongs to a view: b, M by rows, lens."""
        at = self._view_at[name]
        return slice(at, at + 6 + LENS_NUMBERS[self.views[name].lens])

    def mark_unknowns(self, name: str) -> slice:
        """Return the slice of the unknowns that is the position of a mark."""
        return slice(self._mark_at[name], self._mark_at[name] + 2)

    def initial(self) -> Floats:
        """Return the unknowns of the configured stage and the first estimates, (size,)."""
        unknowns = np.zeros(self.size)
        for name, view in self.views.items():
            lens = {"affine": (), "perspective": view.bend, "radial": (view.bend[0], *view.centre)}[view.lens]
            unknowns[self.view_unknowns(name)] = (*view.pixel, *view.matrix[0], *view.matrix[1], *lens)
        for name, place in self.places.items():
            unknowns[self.mark_unknowns(name)] = place
        return unknowns

    def state(self, unknowns: Floats) -> StageState:
        """Convert the unknowns to values for legs, views and marks."""
        legs = (self.doubts * (self.basis @ unknowns[: self.legs])).reshape(3, 6)
        views = {name: self._view(name, unknowns) for name in self.views}
        places = {name: _pair(unknowns[self.mark_unknowns(name)]) for name in self.places}
        return StageState(legs[:, :5], legs[:, 5], views, places)

    def geometry(self, unknowns: Floats) -> Geometry:
        """Return the geometry for given unknowns. Raises KinematicsError if it is impossible."""
        return corrected(self.start, self.state(unknowns).corrections)

    def poses(self, unknowns: Floats, looks: Sequence[StageLook]) -> Floats:
        """Return the poses of the platform at looks, (L, 3) [m, rad]. Raises KinematicsError."""
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
        """Return the derivatives of the computed pixels with respect to the unknowns, (n, 2, size). Raises
        KinematicsError.
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
    """Return the look and the name of each observed mark. The residuals have this order."""
    return [(number, name) for number, look in enumerate(looks) for name in look.marks]


def _groups(looks: Sequence[StageLook]) -> list[tuple[NDArray[np.int64], NDArray[np.int64], str, Floats]]:
    """Return the rows, looks and pixels of each mark."""
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
    """Return the pose changes caused by corrections of legs and encoder scales, (N, 3, 18): leg by leg, scale last."""
    by_legs = pose_derivatives(geometry, start, poses)
    J1, J2 = jacobians(geometry, poses)
    by_scales = np.linalg.solve(J2, J1) * sliders[:, None, :]
    return np.concatenate([by_legs, by_scales[..., None]], axis=3).reshape(len(poses), 3, 18)


def _visible(rows: Floats, poses: Floats, doubts: Floats) -> tuple[Floats, Floats]:
    """Return orthonormal bases of the corrections that looks can determine, and of those that change no pose at all.

    `rows` are the pose changes for corrections in units of `doubts`, (N, 3, 18).
    """
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    zero, one = np.zeros(len(poses)), np.ones(len(poses))
    frames = np.stack(
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
    moved, frames = rows.reshape(-1, rows.shape[2]), frames.reshape(-1, 6)
    unit = np.abs(moved).max()
    null = _null_space(np.concatenate([moved / unit, frames], axis=1))[:, : rows.shape[2]]
    held = _null_space(moved / unit)
    # The common scale is exactly the mean of the three encoders.
    common = np.zeros(rows.shape[2])
    common[5::6] = 1.0 / doubts[5::6]
    null = np.concatenate([null, common[None] / np.linalg.norm(common)])
    _, values, directions = np.linalg.svd(null, full_matrices=True)
    rank = int((values > 1e-6).sum())
    return directions[rank:].T, held


def _null_space(matrix: Floats) -> Floats:
    """Return an orthonormal basis of the vectors that a matrix maps to zero, in rows."""
    _, values, directions = np.linalg.svd(np.linalg.qr(matrix, mode="r"))
    values = np.append(values, np.zeros(len(directions) - len(values)))
    return np.asarray(directions[values <= INVISIBLE * values[0]])


def carry(poses: Floats, place: Floats) -> tuple[Floats, Floats]:
    """Return the positions of a mark in the base frame, (n, 2) [m], and their derivatives with respect to phi."""
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    arm = np.stack([c * place[0] - s * place[1], s * place[0] + c * place[1]], axis=1)
    return poses[:, :2] + arm, np.stack([-arm[:, 1], arm[:, 0]], axis=1)


def _projection_derivatives(view: CameraView, points: Floats) -> tuple[Floats, Floats]:
    """Return the derivatives of pixels by the view's b, M by rows and lens, (n, 2, 6 ...), and by the points."""
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
