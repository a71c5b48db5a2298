"""Laws of time along a path: constant rates, and rate changes within the limits of sliders and platform."""

from __future__ import annotations

import math
from collections.abc import Sequence

from ruckig import ControlInterface, InputParameter, Ruckig, Trajectory

from trirail.kinematics.geometry import Geometry
from trirail.motion.feasibility import Checker, SampleResult
from trirail.motion.paths import Path, constant_law, law_falls
from trirail.motion.ruckig_call import try_solve
from trirail.motion.runs import LawState, Run, arrival_time, law_from_ruckig

FINE_RATIO, COARSE_RATIO = 0.88, 0.6
CHANGE_SHARES = (*(FINE_RATIO**k for k in range(12)), *(FINE_RATIO**11 * COARSE_RATIO**k for k in range(1, 9)))
"""Shares of the quickest rate change, tried in turn. The smaller the share, the longer the stop. The steps are
therefore fine for quick stops, and coarse where a robot with weak sliders needs any stop at all."""


class TimeScaling:
    """Laws of time for the paths of one robot."""

    def __init__(self, geometry: Geometry, checker: Checker, period: float) -> None:
        self._legs = geometry.packed()
        self._checker = checker
        self._period = period
        self._ruckig = Ruckig(1)
        velocity, acceleration, jerk = checker.law_limits.T
        # Derivatives of the rate [1/s, 1/s²] at which a motion at full speed reaches the platform's limits.
        self._change = float((acceleration / velocity).min())
        self._change_jerk = float((jerk / velocity).min())

    def start_run(self, path: Path, rate: float, pose: Sequence[float]) -> Run:
        """Return the run of a path at a rate, or at the greatest rate that the limits allow."""
        rate = self.possible_rate(path, rate, pose)
        return Run(self._legs, path, constant_law(rate), rate)

    def possible_rate(self, path: Path, rate: float, pose: Sequence[float]) -> float:
        """Return `rate`, or the greatest rate at which the whole path fits the limits if that is lower."""
        return (
            rate if rate <= 1.0 else greatest_rate(rate, self.sample(path, constant_law(1.0), 0.0, path.duration, pose))
        )

    def stop(self, run: Run, pose: Sequence[float], shares: Sequence[float]) -> Path | None:
        """Return the first law that stops a run within the limits, trying the shares in turn; None if no share fits."""
        for share in shares:
            law = self.ramp(run.law_state, 0.0, share)
            if (
                law is not None
                and self.sample(run.path, law, 0.0, self.last_new_time(run, law, 0.0), pose).within_limits
            ):
                return law
        return None

    def last_new_time(self, run: Run, law: Path, rate: float) -> float:
        """Return the time up to which a law to a rate must be sampled [s]; the motion does not change after it."""
        return min(arrival_time(law, rate, run.path.duration), float(law.knots[-2]) + self._period)

    def sample(self, path: Path, law: Path, first: float, until: float, pose: Sequence[float]) -> SampleResult:
        """Sample a path under a law; see Checker.sample."""
        return self._checker.sample(path, law, first, until, pose)

    def ramp(self, at: LawState, rate: float, share: float) -> Path | None:
        """Return the law from a state to a rate, at a share of the quickest change; None if there is none.

        A falling rate needs enough jerk to level out before it becomes negative, so there may be no law for a small
        share.
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
    """Return `rate`, or the greatest rate that a path allows if that is lower, given its samples at the nominal rate.

    Every path fits at rate 1. A higher rate uses the part of the limits that the path leaves free.
    """
    return (
        min(rate, max(1.0, 1.0 / result.slowdown_factor))
        if math.isnan(result.leaves_at) and result.slowdown_factor > 0.0
        else 1.0
    )
