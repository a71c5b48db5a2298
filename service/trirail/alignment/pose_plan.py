"""Selection of the poses at which looks determine the geometry of a stage most accurately.

The information matrix of a set of looks is A = sum J' J, where J contains the derivatives of the pixels with respect to
the unknowns, divided by the standard deviation of a pixel. The mean variance of the computed pixels of marks over the
travel is trace(Q A^-1), where Q is the mean of J' J over all candidates. The poses should minimise this variance
(I-optimal or V-optimal design; Atkinson, Donev and Tobias, Optimum Experimental Designs, 2007, 10.6). This criterion
does not depend on the choice of frames, because pixels do not, and it corresponds to the accuracy of alignments over
the whole travel. The selection is greedy: the next pose is always the candidate that lowers the mean variance most.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from trirail.alignment.images import Pair, project_points
from trirail.alignment.rigid_motion import Floats
from trirail.alignment.stage_model import StageLook, StageModel, StageState, carry

FIELD_MARGIN = 0.03
"""Width of the border of a picture in which no mark is planned, as a fraction of the picture's size. The margin is
necessary because the first estimate does not include the distortion of the lens."""
WEAK_PRIOR = 1e-6
"""Information about each unknown before the first look, relative to the information in all candidates."""


class Candidate(NamedTuple):
    """Pose that can be selected, with the marks that the cameras see at this pose."""

    look: StageLook
    jacobian: Floats
    """Derivatives of the pixels of the marks with respect to the unknowns, (2 times number of marks, size)."""


def find_candidates(
    model: StageModel,
    unknowns: Floats,
    poses: Floats,
    sliders: Floats,
    fields: Mapping[str, Pair],
) -> list[Candidate]:
    """Return the poses at which at least one mark is inside its picture.

    `fields` are the sizes of the pictures of each view, columns and rows [pixel].
    """
    state = model.state(unknowns)
    shown = {name: _projected(model, state, name, poses) for name in state.places}
    sizes = {name: np.array(fields[model.view_of[name]]) for name in shown}
    inside = {
        name: np.all((at > FIELD_MARGIN * sizes[name]) & (at < (1.0 - FIELD_MARGIN) * sizes[name]), axis=1)
        for name, at in shown.items()
    }
    looks = []
    for number, (pose, reading) in enumerate(zip(poses.tolist(), sliders.tolist(), strict=True)):
        marks = {name: _pair(at[number]) for name, at in shown.items() if bool(np.take(inside[name], number))}
        if marks:
            looks.append(StageLook(tuple(reading), tuple(pose), marks))
    if not looks:
        return []
    jacobians = np.split(model.jacobian(unknowns, looks), np.cumsum([len(look.marks) for look in looks])[:-1])
    return [Candidate(look, J.reshape(-1, model.size)) for look, J in zip(looks, jacobians, strict=True)]


def _projected(model: StageModel, state: StageState, name: str, poses: Floats) -> Floats:
    """Return the pixel coordinates (N, 2) at which the mark `name` appears at each of N poses."""
    at, _ = carry(poses, np.array(state.places[name]))
    return np.asarray(project_points(state.views[model.view_of[name]], at))


def _pair(values: Floats) -> Pair:
    return float(values[0]), float(values[1])


def choose_poses(
    model: StageModel,
    unknowns: Floats,
    earlier: Sequence[StageLook],
    candidates: Sequence[Candidate],
    count: int,
    noise: float,
) -> list[StageLook]:
    """Select `count` candidates one after the other. Each lowers the mean variance over all candidates most.

    No candidate is selected again before all have been: looks at one pose tell nothing about errors at other poses, and
    would predict each other when looks are held out of the fit.
    """
    every = np.concatenate([each.jacobian for each in candidates])
    scales = np.maximum(np.linalg.norm(every, axis=0), 1e-300)
    jacobians = [each.jacobian / scales / noise for each in candidates]
    Q = sum(J.T @ J for J in jacobians) / len(jacobians)
    A = WEAK_PRIOR * len(candidates) / noise**2 * np.eye(model.size)
    A[: model.legs, : model.legs] += np.diag(1.0 / scales[: model.legs] ** 2)
    if earlier:
        J = model.jacobian(unknowns, earlier).reshape(-1, model.size) / scales / noise
        A += J.T @ J
    covariance = np.linalg.inv(A)
    chosen: list[StageLook] = []
    left: set[int] = set()
    for _ in range(count):
        left = left or set(range(len(candidates)))
        best, most = -1, -math.inf
        spread = covariance @ Q @ covariance
        for number in sorted(left):
            J = jacobians[number]
            core = np.eye(len(J)) + J @ covariance @ J.T
            gain = float(np.trace(np.linalg.solve(core, J @ spread @ J.T)))
            if gain > most:
                best, most = number, gain
        left.remove(best)
        chosen.append(candidates[best].look)
        J = jacobians[best]
        P = covariance @ J.T
        covariance = covariance - P @ np.linalg.solve(np.eye(len(J)) + J @ P, P.T)
        covariance = (covariance + covariance.T) / 2.0
    return chosen
