"""How time runs along a path: at a rate, and from one rate to another within the limits of sliders and platform."""

from __future__ import annotations

import math
from collections.abc import Sequence

from ruckig import ControlInterface, InputParameter, Ruckig, Trajectory

from trirail.kinematics.geometry import Geometry
from trirail.motion.feasibility import Checker, Sampled
from trirail.motion.paths import Path, constant, falls
from trirail.motion.ruckig_call import solved
from trirail.motion.runs import Rate, Run, arrival, law_from_ruckig

FINE, COARSE = 0.88, 0.6
SHARES = (*(FINE**k for k in range(12)), *(FINE**11 * COARSE**k for k in range(1, 9)))
"""Of the quickest change of rate, tried one after the other. To brake takes as long as its share is small: so they are
close together where a stop is quick, and far apart where a robot with weak sliders needs any at all."""


class TimeScaling:
    """Makes the laws of time for the paths of one robot."""

    def __init__(self, geometry: Geometry, checker: Checker, period: float) -> None:
        self._legs = geometry.packed()
        self._checker = checker
        self._period = period
        self._ruckig = Ruckig(1)
        velocity, acceleration, jerk = checker.law_limits.T
        # The change of rate [1/s], and its change [1/s²], at which a motion at full speed meets the platform's limits.
        self._change = float((acceleration / velocity).min())
        self._change_jerk = float((jerk / velocity).min())

    def begin(self, path: Path, rate: float, pose: Sequence[float]) -> Run:
        """Start a path at a rate, or as near to it as the limits allow."""
        rate = self.possible(path, rate, pose)
        return Run(self._legs, path, constant(rate), rate)

    def possible(self, path: Path, rate: float, pose: Sequence[float]) -> float:
        """Return the rate, or the greatest at which sliders and platform can take a whole path."""
        return rate if rate <= 1.0 else greatest(rate, self.sample(path, constant(1.0), 0.0, path.duration, pose))

    def stop(self, run: Run, pose: Sequence[float], shares: Sequence[float]) -> Path | None:
        """Return the law of a stop, from where a run is: the first of some shares of the quickest that fits, if any."""
        for share in shares:
            law = self.ramp(run.at, 0.0, share)
            if law is not None and self.sample(run.path, law, 0.0, self.until(run, law, 0.0), pose).within_limits:
                return law
        return None

    def until(self, run: Run, law: Path, rate: float) -> float:
        """Return until when a law is to be looked at that leads a run to a rate [s]: after that nothing is new."""
        return min(arrival(law, rate, run.path.duration), float(law.knots[-2]) + self._period)

    def sample(self, path: Path, law: Path, first: float, until: float, pose: Sequence[float]) -> Sampled:
        """Sample a path under a law: Checker.sample."""
        return self._checker.sample(path, law, first, until, pose)

    def ramp(self, at: Rate, rate: float, share: float) -> Path | None:
        """Return the law from one rate to another, at a share of the quickest change; None without one.

        A rate that falls needs jerk enough to stop falling before it is zero: at too small a share there is no law.
        """
        request = InputParameter(1)
        request.control_interface = ControlInterface.Velocity
        request.current_position, request.current_velocity = [at.s], [at.rate]
        request.current_acceleration, request.target_velocity = [at.change], [rate]
        request.max_acceleration = [max(share * self._change, abs(at.change))]
        request.max_jerk = [share * self._change_jerk]
        trajectory = Trajectory(1)
        if not solved(self._ruckig, request, trajectory):
            return None
        law = law_from_ruckig(trajectory, rate)
        return None if falls(law.knots, law.pieces) else law


def greatest(rate: float, found: Sampled) -> float:
    """Return the rate, or the greatest one that a path bears that has been looked at at its nominal rate.

    Every path fits at one: above that there is only what makes it slower than its limits.
    """
    return min(rate, max(1.0, 1.0 / found.excess)) if math.isnan(found.leaves_at) and found.excess > 0.0 else 1.0
