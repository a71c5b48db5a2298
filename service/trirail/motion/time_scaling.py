"""Laws of the time along a path: constant rates, and changes of the rate within the limits of sliders and platform."""

from __future__ import annotations

import math
from collections.abc import Sequence

from ruckig import ControlInterface, InputParameter, Ruckig, Trajectory

from trirail.kinematics.arrays import Array
from trirail.kinematics.geometry import Geometry
from trirail.motion.feasibility import Checker, SampleResult
from trirail.motion.paths import Path, constant_law, law_falls
from trirail.motion.ruckig_call import try_solve
from trirail.motion.runs import LawState, Run, arrival_time, law_from_ruckig

FINE_RATIO, COARSE_RATIO = 0.88, 0.6
CHANGE_SHARES = (*(FINE_RATIO**k for k in range(12)), *(FINE_RATIO**11 * COARSE_RATIO**k for k in range(1, 9)))
"""Fractions of the quickest change of rate, which are tried in turn. A smaller fraction gives a longer stop. The steps
between the fractions are fine for quick stops. They are coarse for long stops, which only robots with low slider limits
need."""


class TimeScaling:
    """Generator of laws for the paths of one robot."""

    def __init__(self, geometry: Geometry, checker: Checker, period: float) -> None:
        self._legs = geometry.packed()
        self._checker = checker
        self._period = period
        self._ruckig = Ruckig(1)
        velocity, acceleration, jerk = checker.law_limits.T
        # First and second derivative of the rate at which a motion at full speed reaches the platform's limits
        # [1/s, 1/s²].
        self._change = float((acceleration / velocity).min())
        self._change_jerk = float((jerk / velocity).min())

    def start_run(self, path: Path, rate: float, pose: Sequence[float]) -> Run:
        """Return a run along a path at a constant rate. A rate that exceeds the limits is lowered."""
        rate = self.possible_rate(path, rate, pose)
        return Run(self._legs, path, constant_law(rate), rate)

    def possible_rate(self, path: Path, rate: float, pose: Sequence[float]) -> float:
        """Return the lower of `rate` and the greatest rate at which the whole path fits the limits."""
        return (
            rate if rate <= 1.0 else greatest_rate(rate, self.sample(path, constant_law(1.0), 0.0, path.duration, pose))
        )

    def stop(self, run: Run, pose: Sequence[float], shares: Sequence[float]) -> Path | None:
        """Return a law that stops a run within the limits; None if there is none.

        `shares` are fractions of the quickest stop, which are tried in turn.
        """
        for share in shares:
            law = self.ramp(run.law_state, 0.0, share)
            if (
                law is not None
                and self.sample(run.path, law, 0.0, self.last_new_time(run, law, 0.0), pose).within_limits
            ):
                return law
        return None

    def last_new_time(self, run: Run, law: Path, rate: float) -> float:
        """Return the time until which a law must be sampled [s]. Later, the rate is constant or the path is over."""
        return min(arrival_time(law, rate, run.path.duration), float(law.knots[-2]) + self._period)

    def sample(
        self, path: Path, law: Path, first: float, until: float, pose: Sequence[float], own: Array | None = None
    ) -> SampleResult:
        """Sample a path under a law; see Checker.sample."""
        return self._checker.sample(path, law, first, until, pose, own)

    def ramp(self, at: LawState, rate: float, share: float) -> Path | None:
        """Return a law from the state `at` to a rate; None if there is none.

        `share` is the fraction of the quickest change. If the rate is already falling, a small fraction may not be
        enough to prevent the rate from becoming negative. In this case, there is no law.
        """
        request = InputParameter(1)
        request.control_interface = ControlInterface.Velocity
        request.current_position, request.current_velocity = [at.s], [at.rate]
        request.current_acceleration, request.target_velocity = [at.change], [rate]
        request.max_acceleration = [max(share * self._change, abs(at.change))]
        request.max_jerk = [share * self._change_jerk]
        trajectory = Trajectory(1)
        if not try_solve(self._ruckig, request, trajectory):
            return None
        law = law_from_ruckig(trajectory, rate)
        return None if law_falls(law.knots, law.pieces) else law


def greatest_rate(rate: float, result: SampleResult) -> float:
    """Return the lower of `rate` and the greatest rate that a path allows, given the samples of the path at rate 1.

    Every path fits the limits at rate 1. A higher rate is possible if the path does not use its limits completely.
    """
    return (
        min(rate, max(1.0, 1.0 / result.slowdown_factor))
        if math.isnan(result.leaves_at) and result.slowdown_factor > 0.0
        else 1.0
    )
