"""Feasibility of a path: how much it uses of the limits of sliders and platform, and when it leaves the workspace."""

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
from trirail.motion.path_sampling import survey
from trirail.motion.paths import ROUNDING, Path, constant_law, evaluate, law_falls, passing_time, platform_at_law_time
from trirail.motion.runs import ZERO_RATES

SLIDER_PLAN_SHARES = (0.98, 0.98, 0.93)
"""Shares of the sliders' velocity, acceleration and jerk limits that plans use. The rest covers peaks between
samples, which are highest for the jerk."""
SLIDER_LAW_SHARES = (0.99, 0.99, 0.98)
"""Shares of the same limits that a path and a change of its rate may use together."""
PLATFORM_PLAN_SHARES = (0.995, 0.98, 0.957)
"""Shares of the platform's velocity, acceleration and jerk limits that plans use. They are higher than those of the
sliders, because the platform's rates vary less between samples, and because a change of rate adds no velocity."""
PLATFORM_LAW_SHARES = (0.997, 0.99, 0.985)
"""Shares of the same limits that a change of rate may use. The margin allows a robot at its limits to brake."""
ROUNDING_FACTOR = 1.0 + 1e-6
"""Factor by which a share may be exceeded because of rounding."""
SUBJECTS = ("a slider", *(f"the platform's {name}" for name in (*COORDINATES, "centre in x", "centre in y")))
"""Names of the rows of SampleResult.worst. The centre has rows of its own for a path of another point, because the
limits apply to both points."""
SAMPLE_INTERVAL_S = 0.005
"""Interval between the samples of a path, in addition to its knots [s]. With samples 20 ms apart, an acceleration
between two samples was once 1.4 % above both of them while the rate was changing as well."""
MIN_SAMPLES, MAX_SAMPLES = 16, 64
"""Least and greatest number of these samples, for short and long paths."""
KNOTS_PER_PART = 48
"""Number of knots of a planned path that are sampled together. Each part has at least MIN_SAMPLES samples."""
SLOWDOWN_EXPONENTS = 1.0 / np.arange(1.0, 4.0)
"""Exponents that convert excess velocity, acceleration and jerk into a factor of time."""
MAX_SAMPLED_S = 600.0
"""Longest part of a path that is sampled in one call [s]."""


class SampleResult(NamedTuple):
    """Use of the limits by a path, and the time at which the path leaves the workspace."""

    worst: Array
    """Greatest velocity, acceleration and jerk of each of SUBJECTS, (6, 3), as shares of the limits that plans use."""
    within_limits: bool
    """Whether the motion stays within the limits for changes of rate, and the time along the path never decreases."""
    leaves_at: float
    """Time at which the path leaves the workspace [s]; NaN if it never does."""

    @property
    def slowdown_factor(self) -> float:
        """Factor by which the path must be slowed to fit; at most 1 if it fits already."""
        return slowdown_factor(self.worst)

    @property
    def fits(self) -> bool:
        """Whether the path keeps the limits of plans and stays in the workspace."""
        return math.isnan(self.leaves_at) and self.slowdown_factor <= 1.0


def slowdown_factor(worst: Array) -> float:
    """Return the factor by which a motion must be slowed to fit, given its shares (…, 3) of the limits.

    If a path is slowed k times, its velocity is 1/k, its acceleration 1/k² and its jerk 1/k³ of the original.
    """
    return float((worst**SLOWDOWN_EXPONENTS).max())


def most_exceeded(worst: Array) -> str:
    """Return the name of the subject that requires the greatest slowdown."""
    return SUBJECTS[int((worst**SLOWDOWN_EXPONENTS).max(axis=1).argmax())]


def parts(path: Path, law: Path, first: float, until: float, knots: int) -> list[tuple[float, float]]:
    """Divide a law's time [s] into parts with at most `knots` knots of the path each. Return their starts and ends."""
    at = np.zeros((3, 1))
    evaluate(law.knots, law.pieces, first, at)
    begin = int(np.searchsorted(path.knots, at[0, 0], side="right"))
    evaluate(law.knots, law.pieces, until, at)
    end = int(np.searchsorted(path.knots, at[0, 0]))
    between = path.knots[begin + knots - 1 : end : knots].tolist()
    times = [first, *(passing_time(law.knots, law.pieces, s, until) for s in between), until]
    return list(pairwise(times))


def _positions(motion: Array, rows: Array) -> Array:
    """Return the nine positions that have limits: x, y, phi, the sliders and the cross slides."""
    return np.concatenate([motion[0], rows[0], rows[3]])


class Checker:
    """Feasibility checks for the paths of one robot.

    Parameters
    ----------
    geometry : Geometry
        Geometry of the robot as built.
    limits : Limits
        Limits for planning, from backlash_reserve.planned_limits.
    bounds : Bounds
        The same limits, for messages.
    period : float
        Cycle time of the loop [s].
    beat : Callable[[], None]
        Function called once per sampled path as a sign of life.
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
        """Velocity, acceleration and jerk limits (3,) that plans use for the slider with the highest limits."""
        self.each_slider_limits = self.slider_limits[:, None] / self._shares
        """Limits that plans use for each slider; rows are velocity, acceleration, jerk (3, 3)."""
        self.platform_limits = planned[1:4]
        """Limits that plans use for the platform; rows are x, y, phi (3, 3)."""
        self.centre_limits = planned[4:]
        """Limits that plans use for x and y of the platform's centre if the path is that of another point (2, 3)."""
        self.law_limits = each[1:4] * PLATFORM_LAW_SHARES
        """Limits that changes of rate use for the platform; rows are x, y, phi (3, 3)."""
        self._planned = planned * ROUNDING_FACTOR
        self._laws = each * [SLIDER_LAW_SHARES, *[PLATFORM_LAW_SHARES] * 5] / planned
        self._legs = geometry.packed()
        self._bounds = bounds
        self._period = period
        self._box = np.array([platform.x, platform.y, platform.phi, *slider.positions, *[slider.passive] * 3]).T.copy()
        self._tolerance = standing_tolerance(limits, geometry.arm)

    def sample(self, path: Path, law: Path, first: float, until: float, pose: Sequence[float]) -> SampleResult:
        """Sample a path under a law between two times of the law [s].

        `pose` selects the branch of the first sample. Each call gives a sign of life, because every loop of the planner
        samples a path in each iteration.
        """
        self._beat()
        until = max(first, min(until, first + MAX_SAMPLED_S))
        # A path from standstill may begin with an acceleration. The step into it counts, as does the step at the end.
        if first == 0.0 and law.pieces[0, 0, 0] == 0.0 and not path.pieces[0, :, 1].any():
            first = -self._period
        even = min(max(MIN_SAMPLES, int((until - first) / SAMPLE_INTERVAL_S)), MAX_SAMPLES)
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
        worst /= self._planned
        within_limits = math.isnan(leaves_at) and self.keeps_limits(worst) and not law_falls(*law[:2])
        return SampleResult(worst, within_limits, leaves_at)

    def keeps_limits(self, worst: Array) -> bool:
        """Return whether shares (6, 3) of the plan limits stay within the limits for changes of rate."""
        return bool((worst <= self._laws).all())

    def worst_shares(self, path: Path, pose: Sequence[float]) -> Array:
        """Return SampleResult.worst for a whole path.

        Raises
        ------
        RefusedError
            The path leaves the workspace.
        """
        law, worst = constant_law(1.0), np.zeros((len(SUBJECTS), 3))
        for first, until in parts(path, law, 0.0, path.duration, KNOTS_PER_PART):
            result = self.sample(path, law, first, until, pose)
            if not math.isnan(result.leaves_at):
                raise self.refusal(path, result.leaves_at, pose)
            np.maximum(worst, result.worst, out=worst)
        return worst

    def refusal(self, path: Path, time: float, pose: Sequence[float]) -> RefusedError:
        """Return the error that refuses a path because it leaves the workspace at a time along it [s]."""
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
        """Return the name of the limit at which a path leaves the workspace at a time along it [s]."""
        rows = self._rows(path, time, pose)
        violation = self._farther_out(path, rows, pose) if rows is not None else None
        return violation.bound if violation is not None else "the workspace"

    def exceeded_bound(self, pose: Sequence[float]) -> str | None:
        """Return the name of the limit that a pose exceeds; None if the robot can be at that pose."""
        motion, rows = np.array((pose, ZERO_RATES, ZERO_RATES)), np.zeros((6, 3))
        if inverse_into(self._legs, motion, rows):
            return "the workspace"
        violation = self._violation(_positions(motion, rows))
        return violation.bound if violation is not None else None

    def _rows(self, path: Path, time: float, pose: Sequence[float]) -> tuple[Array, Array] | None:
        """Return the platform's motion (3, 3) and the sliders' rows (6, 3) at a time along a path; None if singular."""
        rows, near, law = np.zeros((6, 3)), np.array(pose, dtype=np.float64), constant_law(1.0)
        motion = np.zeros((3, 3))
        if platform_at_law_time(self._legs, *path, *law[:2], time, near, motion) or inverse_into(
            self._legs, motion, rows
        ):
            return None
        return motion, rows

    def _farther_out(self, path: Path, rows: tuple[Array, Array], pose: Sequence[float]) -> Violation | None:
        """Return the first position that is beyond its limit and farther out than it was at the start of the path."""
        begin = self._rows(path, 0.0, pose)
        return self._violation(_positions(*rows), _positions(*begin) if begin is not None else None)

    def _violation(self, positions: Array, begin: Array | None = None) -> Violation | None:
        low, high = self._box if begin is None else (np.minimum(self._box[0], begin), np.maximum(self._box[1], begin))
        beyond = np.flatnonzero((positions < low - ROUNDING) | (positions > high + ROUNDING))
        return self._bounds.position_violation(int(beyond[0]), float(positions[beyond[0]])) if len(beyond) else None
