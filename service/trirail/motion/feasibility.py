"""Feasibility of a path: its rates are compared with the limits of the robot, and its poses with the workspace."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from trirail.config import Limits
from trirail.errors import RefusalCode, RefusedError
from trirail.kinematics.arrays import Array
from trirail.kinematics.geometry import LEGS, Geometry
from trirail.kinematics.robot import inverse_into
from trirail.motion.limits import COORDINATES, Bounds, Violation, standing_tolerance
from trirail.motion.path_sampling import MAX_SAMPLES_IN_PIECE, MIN_SAMPLES_IN_PIECE, PIECE_SAMPLE_INTERVAL_S, survey
from trirail.motion.paths import (
    OUTWARD_ROUNDING,
    ROUNDING,
    Path,
    constant_law,
    evaluate,
    law_falls,
    passing_time,
    platform_at_law_time,
)
from trirail.motion.runs import ZERO_RATES

SLIDER_PLAN_SHARES = (0.98, 0.98, 0.93)
"""Fractions of the sliders' velocity, acceleration and jerk limits that planned paths may use. The margin covers peaks
between samples, which are highest for the jerk."""
SLIDER_LAW_SHARES = (0.99, 0.99, 0.98)
"""Fractions of the sliders' limits that a path may use while its rate is changing."""
PLATFORM_PLAN_SHARES = (0.995, 0.98, 0.957)
"""Fractions of the platform's velocity, acceleration and jerk limits that planned paths may use. They are higher than
the fractions for the sliders, because the platform's rates vary less between samples, and because a change of rate adds
no velocity."""
PLATFORM_LAW_SHARES = (0.997, 0.99, 0.985)
"""Fractions of the platform's limits that a path may use while its rate is changing. They are higher than
PLATFORM_PLAN_SHARES, so that a robot at its limits can brake."""
ROUNDING_FACTOR = 1.0 + 1e-6
"""Factor by which the permitted fraction of a limit may be exceeded because of rounding."""
SUBJECTS = ("a slider", *(f"the platform's {name}" for name in (*COORDINATES, "centre in x", "centre in y")))
"""Names of the rows of SampleResult.worst. If a path moves another point than the centre, the limits also apply to the
centre, and the last two rows are used."""
SAMPLE_INTERVAL_S = 0.005
"""Interval of the evenly spaced samples of a path, which are added to samples at its knots [s]. With an interval of
20 ms, an acceleration between two samples was once 1.4 % higher than at both samples, during a change of rate."""
MIN_SAMPLES, MAX_SAMPLES = 16, 64
"""Least and greatest number of evenly spaced samples per call."""
SAMPLES_PER_PART = 240
"""Number of samples in and next to pieces of a path that are taken in one call, besides the evenly spaced samples."""
SLOWDOWN_EXPONENTS = 1.0 / np.arange(1.0, 4.0)
"""Exponents that convert factors of velocity, acceleration and jerk into a factor of time."""


class SampleResult(NamedTuple):
    """Result of sampling a path under a law."""

    worst: Array
    """Greatest velocity, acceleration and jerk of each of SUBJECTS, (6, 3), divided by the limits for planned paths."""
    within_limits: bool
    """Whether the motion stays in the workspace and within the limits for changes of rate, with a law that never lets
    the time along the path decrease."""
    leaves_at: float
    """Time at which the path leaves the workspace [s]; NaN if the path stays in the workspace."""

    @property
    def slowdown_factor(self) -> float:
        """Factor by which the path must be slowed to fit the limits for planned paths; at most 1 if it already fits."""
        return slowdown_factor(self.worst)

    @property
    def fits(self) -> bool:
        """Whether the path stays in the workspace and within the limits for planned paths."""
        return math.isnan(self.leaves_at) and self.slowdown_factor <= 1.0


def slowdown_factor(worst: Array) -> float:
    """Return the factor by which a motion must be slowed to fit its limits.

    `worst` (…, 3) holds velocity, acceleration and jerk, divided by their limits. If a path is slowed by a factor k,
    its velocity is divided by k, its acceleration by k² and its jerk by k³.
    """
    return float((worst**SLOWDOWN_EXPONENTS).max())


def most_exceeded(worst: Array) -> str:
    """Return the name in SUBJECTS of the row that requires the greatest slowdown."""
    return SUBJECTS[int((worst**SLOWDOWN_EXPONENTS).max(axis=1).argmax())]


def parts(path: Path, law: Path, first: float, until: float, samples: int) -> list[tuple[float, float]]:
    """Divide an interval of a law's time into parts, each with at most `samples` samples in and next to pieces.

    A piece is not divided, even if it has more samples. Returns the start and the end of each part [s].
    """
    at = np.zeros((3, 1))
    evaluate(law.knots, law.pieces, first, at)
    begin = max(0, int(np.searchsorted(path.knots, at[0, 0], side="right")) - 1)
    evaluate(law.knots, law.pieces, until, at)
    end = int(np.searchsorted(path.knots, at[0, 0]))
    numbers = np.diff(path.knots[begin : end + 1]) / PIECE_SAMPLE_INTERVAL_S
    totals = np.cumsum(np.clip(numbers, MIN_SAMPLES_IN_PIECE, MAX_SAMPLES_IN_PIECE).astype(np.int64) + 1)
    times, piece = [first], 0
    while True:
        before = totals[piece - 1] if piece else 0
        piece = max(piece + 1, int(np.searchsorted(totals, before + samples, side="right")))
        if piece >= len(totals):
            return list(pairwise([*times, until]))
        times.append(passing_time(law.knots, law.pieces, path.knots[begin + piece], until))


def _positions(motion: Array, rows: Array) -> Array:
    """Return the nine positions that have limits: x, y, phi, three sliders and three cross slides."""
    return np.concatenate([motion[0], rows[0], rows[3]])


class Checker:
    """Feasibility checks for the paths of one robot.

    Parameters
    ----------
    geometry : Geometry
        Geometry of the robot, including the correction.
    limits : Limits
        Limits for planning, from backlash_reserve.planned_limits.
    bounds : Bounds
        The same limits, used to describe violations in messages.
    period : float
        Cycle time of the loop [s].
    beat : Callable[[], None]
        Function that is called once per sampled path, to show that the planner is alive.
    """

    def __init__(
        self,
        geometry: Geometry,
        limits: Limits,
        bounds: Bounds,
        period: float,
        beat: Callable[[], None] = lambda: None,
    ) -> None:
        self._beat = beat
        platform, slider = limits.platform, limits.slider
        x, y, phi = np.array([platform.velocity, platform.acceleration, platform.jerk]).T
        sliders = np.array([slider.velocities, slider.accelerations, slider.jerks])
        most = sliders.max(axis=1)
        self._shares = most[:, None] / sliders
        each = np.array([most, x, y, phi, x, y])
        planned = each * [SLIDER_PLAN_SHARES, *[PLATFORM_PLAN_SHARES] * 5]
        self.slider_limits = planned[0]
        """Velocity, acceleration and jerk limits (3,) for planned paths, each for the slider with the highest limit."""
        self.each_slider_limits = self.slider_limits[:, None] / self._shares
        """Limits of each slider for planned paths; rows are velocity, acceleration, jerk (3, 3)."""
        self.platform_limits = planned[1:4]
        """Limits of the platform for planned paths; rows are x, y, phi (3, 3)."""
        self.centre_limits = planned[4:]
        """Limits of the platform's centre in x and y for planned paths that move another point of the platform (2,
        3)."""
        self.law_limits = np.concatenate([each[1:4] * PLATFORM_LAW_SHARES, sliders.T * SLIDER_LAW_SHARES])
        """Limits during a change of the rate; rows are the platform's x, y, phi, and the sliders (6, 3)."""
        self._planned = planned * ROUNDING_FACTOR
        self._laws = each * [SLIDER_LAW_SHARES, *[PLATFORM_LAW_SHARES] * 5] / planned
        self._legs = geometry.packed()
        self._bounds = bounds
        self._period = period
        self._box = np.array([platform.x, platform.y, platform.phi, *slider.positions, *[slider.passive] * 3]).T.copy()
        self._tolerance = standing_tolerance(limits, geometry.arm)

    def sample(
        self, path: Path, law: Path, first: float, until: float, pose: Sequence[float], own: Array | None = None
    ) -> SampleResult:
        """Sample a path under a law between two times of the law [s].

        `pose` selects the branch of the forward kinematics for the first sample. The motion is also within limits only
        if it keeps `own`, the limits of its goal; see OwnBounds. Each call also calls `beat`, because every loop in the
        planner samples a path in each iteration.
        """
        self._beat()
        until = max(first, until)
        # A path from standstill may begin with an acceleration. The jerk of this step must be included, as at the end.
        if first == 0.0 and law.pieces[0, 0, 0] == 0.0 and not path.pieces[0, :, 1].any():
            first = -self._period
        even = int(min(max(MIN_SAMPLES, (until - first) / SAMPLE_INTERVAL_S), MAX_SAMPLES))
        worst, start = np.zeros((len(SUBJECTS), 3)), np.array(pose, dtype=np.float64)
        leaves_at = survey(
            self._legs,
            *path,
            *law[:2],
            first,
            until,
            even,
            self._period,
            start,
            self._box,
            self._tolerance,
            self._shares,
            worst,
        )
        keeps_own = own is None or bool((worst[1:4] <= own * ROUNDING_FACTOR).all())
        worst /= self._planned
        within_limits = math.isnan(leaves_at) and keeps_own and self.keeps_limits(worst) and not law_falls(*law[:2])
        return SampleResult(worst, within_limits, leaves_at)

    def keeps_limits(self, worst: Array) -> bool:
        """Return whether the greatest rates, as in SampleResult.worst, stay within the limits for changes of rate."""
        return bool((worst <= self._laws).all())

    def worst_shares(self, path: Path, pose: Sequence[float]) -> Array:
        """Return SampleResult.worst for a whole path at full speed.

        Raises
        ------
        RefusedError
            The path leaves the workspace.
        """
        law, worst = constant_law(1.0), np.zeros((len(SUBJECTS), 3))
        for first, until in parts(path, law, 0.0, path.duration, SAMPLES_PER_PART):
            result = self.sample(path, law, first, until, pose)
            if not math.isnan(result.leaves_at):
                raise self.refusal(path, result.leaves_at, pose)
            np.maximum(worst, result.worst, out=worst)
        return worst

    def refusal(self, path: Path, time: float, pose: Sequence[float]) -> RefusedError:
        """Return the error that refuses a path that leaves the workspace at the time `time` along the path [s]."""
        where = f"the path leaves the workspace after {max(0.0, time) / path.duration:.0%} of its duration"
        rows = self._rows(path, time, pose)
        if rows is None:
            return RefusedError(RefusalCode.SINGULAR, f"{where}: the robot is singular there")
        violation = self._farther_out(path, rows, pose)
        if violation is None:
            return RefusedError(RefusalCode.OUT_OF_WORKSPACE, where)
        return RefusedError(
            RefusalCode.OUT_OF_WORKSPACE,
            f"{where}: {violation}",
            slider=violation.axis if violation.axis in LEGS else None,
            value=violation.value,
            limit=violation.limit,
        )

    def bound(self, path: Path, time: float, pose: Sequence[float]) -> str:
        """Return the name of the limit that a path exceeds at the time `time` along the path [s]."""
        rows = self._rows(path, time, pose)
        violation = self._farther_out(path, rows, pose) if rows is not None else None
        return violation.bound if violation is not None else "the workspace"

    def exceeded_bound(self, pose: Sequence[float]) -> str | None:
        """Return the name of the limit that a pose exceeds; None if the pose is in the workspace."""
        motion, rows = np.array((pose, ZERO_RATES, ZERO_RATES)), np.zeros((6, 3))
        if inverse_into(self._legs, motion, rows):
            return "the workspace"
        violation = self._violation(_positions(motion, rows))
        return violation.bound if violation is not None else None

    def _rows(self, path: Path, time: float, pose: Sequence[float]) -> tuple[Array, Array] | None:
        """Return the motion of platform (3, 3) and sliders (6, 3) at a time along a path; None if singular."""
        rows, near, law = np.zeros((6, 3)), np.array(pose, dtype=np.float64), constant_law(1.0)
        motion = np.zeros((3, 3))
        if platform_at_law_time(self._legs, *path, *law[:2], time, near, motion) or inverse_into(
            self._legs, motion, rows
        ):
            return None
        return motion, rows

    def _farther_out(self, path: Path, rows: tuple[Array, Array], pose: Sequence[float]) -> Violation | None:
        """Return the first violation by a position that is farther outside its limit than at the start of the path."""
        begin = self._rows(path, 0.0, pose)
        return self._violation(_positions(*rows), _positions(*begin) if begin is not None else None)

    def _violation(self, positions: Array, begin: Array | None = None) -> Violation | None:
        low, high = self._box[0] - ROUNDING, self._box[1] + ROUNDING
        if begin is not None:
            low, high = np.minimum(low, begin - OUTWARD_ROUNDING), np.maximum(high, begin + OUTWARD_ROUNDING)
        beyond = np.flatnonzero((positions < low) | (positions > high))
        return self._bounds.position_violation(int(beyond[0]), float(positions[beyond[0]])) if len(beyond) else None
