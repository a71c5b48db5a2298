"""Calibration of cameras from moves of the stage: where each shows what, and where marks are on the table.

A mark at q on the table is in the base frame at w = t + R(phi) q, with the platform at (t, phi). The unknowns of a view
are its map and its marks' places; a mark's turn about the stage's centre tells q, its way tells the map. Gauss-Newton,
from the solution that is linear in b, M and M q for small phi.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import msgspec
import numpy as np

from trirail.alignment.images import CameraView, Lens, Pair, Points, pixels, project
from trirail.alignment.rigid import Floats, turned
from trirail.errors import AlignmentError, AlignmentFault

Marks = Mapping[str, Pair]
"""The pixels (u, v) of marks by their names; one that was not found is missing."""
ROUNDS = 30
CONVERGED = 1e-12
STILL = 3.0
"""Marks that move less than so many pixels over all moves have not moved."""
WORST_CONDITION = 1e6
"""Of the normal equations' scaled matrix, beyond which the moves do not tell all of the unknowns."""


class Sight(NamedTuple):
    """What cameras showed with the platform at a pose."""

    pose: tuple[float, float, float]
    """x, y [m], phi [rad], measured."""
    marks: Marks


class MarkFit(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A mark of the calibration's part."""

    view: str
    """The name of the view that shows it."""
    place: Pair
    """In the platform's frame, from the stage's centre [m]."""
    deviation: Pair
    """Standard deviations of that [m]."""


class CameraCalibration(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What was found; a file keeps it."""

    views: dict[str, CameraView]
    marks: dict[str, MarkFit]
    noise: float
    """Standard deviation of a mark's u or v, from the residuals [pixel]."""
    residuals: tuple[dict[str, Pair], ...]
    """Seen less computed, of each look and mark [pixel]."""
    poses: tuple[tuple[float, float, float], ...]
    """Where the platform was at each look: x, y [m], phi [rad]."""
    covariances: dict[str, tuple[tuple[float, ...], ...]]
    """Of each view's unknowns: b [pixel], M by rows [pixel/m], the lens's bend, and its marks' places [m]."""
    confirmed: bool = False
    """Whether a correction has gone where it should with it: until then corrections are bounded."""

    @property
    def reach(self) -> float:
        """How far a mark went from its place at the first look, at most [m]."""
        return max(
            float(np.linalg.norm(placed(mark.place, pose) - placed(mark.place, self.poses[0])))
            for mark in self.marks.values()
            for pose in self.poses
        )


def placed(place: Pair, pose: Sequence[float]) -> Floats:
    """Return where a point of the platform is in the base frame, (2,) [m]."""
    return np.asarray(pose[:2] + turned(pose[2]) @ place)


def calibrate(
    sights: Sequence[Sight],
    views: Mapping[str, str] | None = None,
    lens: Lens = "affine",
    centre: Pair = (0.0, 0.0),
) -> CameraCalibration:
    """Return the calibration that looks from several poses tell.

    `views` names the view of each mark: marks of one name are seen by one camera that stands still. Without it every
    mark has a view of its own, as with two cameras, or one that is moved to each. `centre` is a radial lens's [pixel].
    Raises AlignmentError: too few looks, marks that stand still, moves that do not tell it all.
    """
    names = sorted({name for sight in sights for name in sight.marks})
    of = dict(views) if views is not None else {name: name for name in names}
    if unknown := [name for name in names if name not in of]:
        raise AlignmentError(AlignmentFault.MISSING, f"marks without a view: {', '.join(unknown)}; name one for each")
    if len(names) < 1:
        raise AlignmentError(AlignmentFault.MISSING, "no mark was seen in any look: see to light, focus and threshold")
    fits = {
        view: _Fit(
            sights,
            [name for name in names if of[name] == view],
            CameraView((0, 0), (0, 0), ((1, 0), (0, 1)), lens, centre=centre),
            view,
        )
        for view in sorted({of[name] for name in names})
    }
    squares = sum(fit.squares for fit in fits.values())
    freedom = sum(fit.freedom for fit in fits.values())
    noise = float(np.sqrt(squares / freedom))
    marks, covariances = {}, {}
    for name, fit in fits.items():
        covariance = fit.inverse * noise**2
        covariances[name] = tuple(map(tuple, covariance.tolist()))
        deviations = np.sqrt(np.diag(covariance))[fit.first_place :].reshape(-1, 2)
        for mark, place, deviation in zip(fit.names, fit.places, deviations, strict=True):
            marks[mark] = MarkFit(name, _pair(place), _pair(deviation))
    found = {name: fit.view for name, fit in fits.items()}
    residuals = tuple(
        {
            name: _pair(seen - pixels(found[of[name]], placed(marks[name].place, sight.pose)[None])[0])
            for name, seen in sight.marks.items()
        }
        for sight in sights
    )
    poses = tuple((float(x), float(y), float(phi)) for (x, y, phi), _ in sights)
    return CameraCalibration(found, marks, noise, residuals, poses, covariances)


class _Fit:
    """One view's unknowns: b, M by rows, bend, and a place for each mark; the point o is the first mark's first."""

    def __init__(self, sights: Sequence[Sight], names: Sequence[str], lens: CameraView, view: str) -> None:
        self.names, self._lens, self._name = names, lens, view
        bends = {"affine": 0, "perspective": 2, "radial": 1}[lens.lens]
        self.first_place = 6 + bends
        rows = [
            (names.index(name), sight.pose, seen)
            for sight in sights
            for name, seen in sight.marks.items()
            if name in names
        ]
        self._which = np.array([which for which, _, _ in rows])
        poses = np.array([pose for _, pose, _ in rows])
        self._t, self._phi = poses[:, :2], poses[:, 2]
        self._seen = np.array([seen for _, _, seen in rows], float)
        self._first = poses[0]
        self.freedom = self._seen.size - self.first_place - 2 * len(names)
        self._check()
        x, scales = self._start(), self._scales()
        for _ in range(ROUNDS):
            jacobian, residuals = self._jacobian(x) * scales, self._seen - self._computed(x)
            step, _, _, singular = np.linalg.lstsq(jacobian, residuals.ravel(), rcond=None)
            if singular[-1] * WORST_CONDITION < singular[0]:
                self._refuse_moves()
            x = x + scales * step
            if np.abs(step).max() < CONVERGED * max(1.0, np.abs(x / scales).max()):
                break
        self.squares = float(((self._seen - self._computed(x)) ** 2).sum())
        jacobian = self._jacobian(x) * scales
        self.inverse = np.linalg.inv(jacobian.T @ jacobian) * np.outer(scales, scales)
        self.places = x[self.first_place :].reshape(-1, 2)
        bend = np.append(x[6 : self.first_place], (0.0, 0.0))[:2]
        matrix = (_pair(x[2:4]), _pair(x[4:6]))
        origin = _pair(self._origin(self.places[0]))
        self.view = CameraView(origin, _pair(x[:2]), matrix, lens.lens, _pair(bend), lens.centre)

    def _check(self) -> None:
        if self.freedom < 1:
            need = -(-(self.first_place + 2 * len(self.names) + 1) // (2 * len(self.names)))
            raise AlignmentError(
                AlignmentFault.MOVES,
                f"{len(self._seen)} marks seen in view {self._name}: at least {need} looks are wanted for each mark",
            )
        spread = max(np.ptp(self._seen[self._which == n], axis=0).max() for n in range(len(self.names)))
        if spread < STILL:
            raise AlignmentError(
                AlignmentFault.STILL,
                f"the marks of view {self._name} have moved by {spread:.2f} pixels over all moves: "
                "is it a picture of this stage, and a new one at each look?",
                value=float(spread),
                limit=STILL,
            )

    def _refuse_moves(self) -> None:
        raise AlignmentError(
            AlignmentFault.MOVES,
            f"these moves do not tell the map of view {self._name}: move along x, along y and turn, each both ways",
        )

    def _origin(self, place: Points) -> Points:
        return np.asarray(self._first[:2] + turned(self._first[2]) @ place)

    def _start(self) -> Floats:
        """Return unknowns near the solution: u = b_i + M (t - t0) + (sin phi - sin phi0) M J q_i is linear."""
        n = len(self.names)
        design = np.zeros((len(self._seen), 2 + 2 * n))
        design[:, :2] = self._t - self._first[:2]
        design[np.arange(len(self._seen)), 2 + self._which] = 1.0
        design[np.arange(len(self._seen)), 2 + n + self._which] = np.sin(self._phi - self._first[2])
        scales = np.maximum(np.abs(design).max(axis=0), 1e-300)
        solution, _, rank, _ = np.linalg.lstsq(design / scales, self._seen, rcond=1e-9)
        solution = solution / scales[:, None]
        matrix = solution[:2].T
        if rank < design.shape[1] or abs(np.linalg.det(matrix)) < 1e-12 * (matrix**2).sum():
            self._refuse_moves()
        arms = np.linalg.solve(matrix, solution[2 + n :].T).T  # R(phi0) J q
        arms = arms @ np.array([[0.0, -1.0], [1.0, 0.0]])  # J' of each: row vectors times J
        places = arms @ turned(self._first[2])
        return np.concatenate([solution[2], matrix.ravel(), np.zeros(self.first_place - 6), places.ravel()])

    def _scales(self) -> Floats:
        """Return what each unknown is to be counted in, so that all are about as well determined."""
        across = max(float(np.ptp(self._seen, axis=0).max()), 1.0)
        way = max(float(np.ptp(self._t, axis=0).max()), 1e-9)
        turn = max(float(np.ptp(self._phi)), 1e-9)
        bend = {"affine": [], "perspective": [1.0 / way] * 2, "radial": [1.0 / across**2]}[self._lens.lens]
        places = [way / turn] * (2 * len(self.names))
        return np.array([across] * 2 + [across / way] * 4 + bend + places)

    def _computed(self, x: Points) -> Points:
        places = x[self.first_place :].reshape(-1, 2)
        q = places[self._which]
        c, s = np.cos(self._phi), np.sin(self._phi)
        at = self._t + np.stack([c * q[:, 0] - s * q[:, 1], s * q[:, 0] + c * q[:, 1]], axis=1)
        bend = x[6 : self.first_place]
        return project(at, self._origin(places[0]), x[:2], x[2:6].reshape(2, 2), bend, self._lens)

    def _jacobian(self, x: Floats) -> Floats:
        """Return the derivatives by a complex step, exact to the last digit."""
        step = 1e-20
        columns = [self._computed(x + 1j * step * axis).imag.ravel() / step for axis in np.eye(len(x))]
        return np.stack(columns, axis=1)


def _pair(values: Points) -> Pair:
    return float(values[0]), float(values[1])
