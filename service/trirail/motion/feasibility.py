"""A motion held against the limits of sliders and platform: how many times too fast, or where out of reach."""

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
from trirail.motion.limits import COORDINATES, Bounds, Violation
from trirail.motion.path_sampling import survey
from trirail.motion.paths import Path, advance, constant, falls, reached, value
from trirail.motion.runs import STILL

PLANNED = (0.98, 0.98, 0.93)
"""Share of the sliders' limits of velocity, acceleration and jerk that plans make use of: the rest is for what lies
between the moments that are looked at, where jerk varies most."""
LAWS = (0.99, 0.99, 0.98)
"""Share of the same that changes of a path's rate make use of, on top of what the path itself does."""
PLATFORM_PLANNED = (0.995, 0.98, 0.957)
"""Share of the platform's limits of velocity, acceleration and jerk that plans make use of: between what is looked at
its rates vary less than the sliders' do, and a change of rate adds no velocity."""
PLATFORM_LAWS = (0.997, 0.99, 0.985)
"""Share of the same that changes of a path's rate make use of: the room in which a robot at its limits can brake."""
ROUNDED = 1.0 + 1e-6
"""How many times more than its share a path or law may take, by rounding."""
SUBJECTS = ("a slider", *(f"the platform's {name}" for name in (*COORDINATES, "centre in x", "centre in y")))
"""What the rows of Sampled.worst are of. The centre has its own where a path is that of another point: limits hold for
both."""
GAP = 0.005
"""Between moments at which a path is looked at, besides its knots [s]: where its rate changes as well, an acceleration
between two moments was once 1.4 % more than at either, 20 ms apart."""
FEWEST, MOST = 16, 64
"""Such moments, however short or long the path."""
KNOTS_A_PART = 48
"""Knots of a path that is planned which are looked at together: each part has at least FEWEST moments of its own."""
POWERS = 1.0 / np.arange(1.0, 4.0)
LONGEST = 600.0
"""No path is looked at for longer [s]."""


class Sampled(NamedTuple):
    """What was found along a path."""

    worst: Array
    """Velocity, acceleration and jerk (6, 3) of SUBJECTS, as shares of what plans use."""
    within_limits: bool
    """Whether sliders and platform can bear it, with what is kept for changes of rate, and its time never falls."""
    leaves_at: float
    """When it is out of reach [s]; not a number where it never is."""

    @property
    def excess(self) -> float:
        """How many times too fast it is."""
        return excess(self.worst)

    @property
    def fits(self) -> bool:
        """Whether a path can be planned so."""
        return math.isnan(self.leaves_at) and self.excess <= 1.0


def excess(worst: Array) -> float:
    """Return how many times too fast a motion is, from its shares of the limits.

    The same path k times slower has k times less velocity, k² less acceleration and k³ less jerk.
    """
    return float((worst**POWERS).max())


def fastest(worst: Array) -> str:
    """Name what a motion is too fast for."""
    return SUBJECTS[int((worst**POWERS).max(axis=1).argmax())]


def parts(path: Path, law: Path, first: float, until: float, knots: int) -> list[tuple[float, float]]:
    """Return times of a law between which a path is looked at part by part, each with at most so many of its knots."""
    at = np.zeros((3, 1))
    value(law.knots, law.pieces, first, at)
    begin = int(np.searchsorted(path.knots, at[0, 0], side="right"))
    value(law.knots, law.pieces, until, at)
    end = int(np.searchsorted(path.knots, at[0, 0]))
    between = path.knots[begin + knots - 1 : end : knots].tolist()
    times = [first, *(reached(law.knots, law.pieces, s, until) for s in between), until]
    return list(pairwise(times))


class Checker:
    """Looks at paths of one robot."""

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
        planned = each * [PLANNED, *[PLATFORM_PLANNED] * 5]
        self.slider_limits = planned[0]
        """Velocity, acceleration and jerk that plans make use of, of the slider that may have most."""
        self.each_slider_limits = self.slider_limits[:, None] / self._shares
        """Likewise of each slider (3, 3)."""
        self.platform_limits = planned[1:4]
        """Likewise of the platform in x, y and phi (3, 3)."""
        self.centre_limits = planned[4:]
        """Likewise of the platform's centre in x and y, on a path of another point (2, 3)."""
        self.law_limits = each[1:4] * PLATFORM_LAWS
        """What changes of rate make use of, of the platform (3, 3)."""
        self._planned = planned * ROUNDED
        self._laws = each * [LAWS, *[PLATFORM_LAWS] * 5] / planned
        self._legs = geometry.packed()
        self._bounds = bounds
        self._period = period
        self._box = np.array([platform.x, platform.y, platform.phi, *slider.positions, *[slider.passive] * 3]).T.copy()

    def sample(self, path: Path, law: Path, first: float, until: float, pose: Sequence[float]) -> Sampled:
        """Sample a path under a law from one time of the law to another [s], from near a pose on.

        It gives a sign of life: each loop of the planner's looks at a path in each of its turns.
        """
        self._beat()
        until = max(first, min(until, first + LONGEST))
        # A path from standstill may begin with an acceleration: the step into it counts, as the one at the end does.
        if first == 0.0 and law.pieces[0, 0, 0] == 0.0 and not path.pieces[0, :, 1].any():
            first = -self._period
        even = min(max(FEWEST, int((until - first) / GAP)), MOST)
        worst, start = np.zeros((len(SUBJECTS), 3)), np.array(pose, dtype=np.float64)
        leaves_at = survey(
            self._legs, *path, *law[:2], first, until, even, self._period, start, self._box, self._shares, worst
        )
        worst /= self._planned
        within_limits = math.isnan(leaves_at) and self.bears(worst) and not falls(*law[:2])
        return Sampled(worst, within_limits, leaves_at)

    def bears(self, worst: Array) -> bool:
        """Whether sliders and platform can bear a motion of such shares, with what is kept for changes of rate."""
        return bool((worst <= self._laws).all())

    def whole(self, path: Path, pose: Sequence[float]) -> Array:
        """Return Sampled.worst of a whole path. Raises RefusedError where it leaves the workspace."""
        law, worst = constant(1.0), np.zeros((len(SUBJECTS), 3))
        for first, until in parts(path, law, 0.0, path.duration, KNOTS_A_PART):
            found = self.sample(path, law, first, until, pose)
            if not math.isnan(found.leaves_at):
                raise self.refusal(path, found.leaves_at, pose)
            np.maximum(worst, found.worst, out=worst)
        return worst

    def refusal(self, path: Path, time: float, pose: Sequence[float]) -> RefusedError:
        """Say what is out of reach at a time along a path, and where on it that is."""
        where = f"the path leads out of the workspace after {max(0.0, time) / path.duration:.0%} of its time"
        rows = self._rows(path, time, pose)
        if rows is None:
            return RefusedError(RefusalCode.SINGULAR, f"{where}: the robot is singular there")
        violation = self._beyond(*rows)
        if violation is None:
            return RefusedError(RefusalCode.OUT_OF_WORKSPACE, where)
        return RefusedError(
            RefusalCode.OUT_OF_WORKSPACE,
            f"{where}: {violation}",
            slider=violation.what if violation.what in LEGS else None,
            value=violation.value,
            limit=violation.limit,
        )

    def bound(self, path: Path, time: float, pose: Sequence[float]) -> str:
        """Name the limit that a path meets at a time along it, where it is out of reach."""
        rows = self._rows(path, time, pose)
        violation = self._beyond(*rows) if rows is not None else None
        return violation.bound if violation is not None else "the workspace"

    def stands_beyond(self, pose: Sequence[float]) -> str | None:
        """Name the limit beyond which the robot would be at a pose; None where it can stand there."""
        motion, rows = np.array((pose, STILL, STILL)), np.zeros((6, 3))
        if inverse_into(self._legs, motion, rows):
            return "the workspace"
        violation = self._beyond(motion, rows)
        return violation.bound if violation is not None else None

    def _rows(self, path: Path, time: float, pose: Sequence[float]) -> tuple[Array, Array] | None:
        """Return the platform's motion and the sliders' at a time along a path; None where the robot is singular."""
        rows, near, law = np.zeros((6, 3)), np.array(pose, dtype=np.float64), constant(1.0)
        motion = np.zeros((3, 3))
        if advance(self._legs, *path, *law[:2], time, near, motion) or inverse_into(self._legs, motion, rows):
            return None
        return motion, rows

    def _beyond(self, motion: Array, rows: Array) -> Violation | None:
        """Return which position is beyond its limit."""
        still = rows[0].tolist(), STILL, STILL, rows[3].tolist()
        return self._bounds.pose(motion[0].tolist()) or self._bounds.setpoint(still)
