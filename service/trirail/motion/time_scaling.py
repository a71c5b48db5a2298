"""How time runs along a path: at a rate, and from one rate to another within the limits of sliders and platform."""

from __future__ import annotations

import math
from collections.abc import Sequence

from ruckig import ControlInterface, InputParameter, Ruckig, Trajectory

from trirail.config import PlatformLimits
from trirail.kinematics.geometry import Geometry
from trirail.motion.feasibility import Checker
from trirail.motion.paths import Path, constant
from trirail.motion.ruckig_call import solved
from trirail.motion.runs import Run, arrival, law_from_ruckig
from trirail.motion.steps import Steps

SHARES = tuple(0.6**k for k in range(12))
"""Of the quickest change of rate, tried one after the other."""
FASTEST = 10.0
"""No rate is greater."""


class TimeScaling:
    """Makes the laws of time for the paths of one robot."""

    def __init__(self, geometry: Geometry, platform: PlatformLimits, checker: Checker, period: float) -> None:
        self._legs = geometry.packed()
        self._checker = checker
        self._period = period
        self._ruckig = Ruckig(1)
        # What of a full-speed motion's rate the platform's limits can take away in a second, and change of that.
        self._change = min(a / v for a, v in zip(platform.acceleration, platform.velocity, strict=True))
        self._change_jerk = min(j / v for j, v in zip(platform.jerk, platform.velocity, strict=True))

    def begin(self, path: Path, rate: float, pose: Sequence[float]) -> Steps[Run]:
        """Start a path at a rate, or as near to it as the limits allow."""
        rate = yield from self.possible(path, 0.0, rate, pose)
        return Run(self._legs, path, constant(rate), rate)

    def change(self, run: Run, rate: float, pose: Sequence[float]) -> Steps[None]:
        """Let the time along a path run at another rate: as soon as the limits allow, as fast as they do.

        Until then the old law goes on, as the run does between the steps: at the end of the path it stands too.
        A stop becomes quicker as it goes on: the slower the motion, the more is left of the limits.
        """
        rate = yield from self.possible(run.path, run.at.s, rate, pose)
        while not run.arrived and not rate == run.target == 0.0:
            if (yield from self.try_change(run, rate, pose)):
                break
        while rate == 0.0 and not run.stands:
            yield
            yield from self.try_change(run, rate, pose, sooner=True)

    def try_change(
        self, run: Run, rate: float, pose: Sequence[float], shares: Sequence[float] = SHARES, *, sooner: bool = False
    ) -> Steps[bool]:
        """Do the same at one of some shares of the quickest change, the first that the limits allow, if any.

        With `sooner` only where the run comes to stand sooner than by the law that it has.
        """
        for share in shares:
            law = self._ramp(run, rate, share)
            if sooner and (law is None or float(law.knots[-2]) > run.ends - run.time - self._period):
                return False
            if law is not None:
                until = min(arrival(law, rate, run.path.duration), float(law.knots[-2]) + self._period)
                if self._checker.look(run.path, law, 0.0, until, pose).within_limits:
                    run.change_law(law, rate)
                    return True
            yield
        return False

    def possible(self, path: Path, s: float, rate: float, pose: Sequence[float]) -> Steps[float]:
        """Return the rate, or the greatest at which sliders and platform can take the path from `s` on.

        Every path fits at one: above that there is only what makes it slower than its limits.
        """
        if rate <= 1.0:
            return rate
        found = self._checker.look(path, constant(1.0, s), 0.0, path.duration - s, pose)
        yield
        return min(rate, max(1.0, 1.0 / found.excess)) if math.isnan(found.leaves_at) and found.excess > 0.0 else 1.0

    def _ramp(self, run: Run, rate: float, share: float) -> Path | None:
        """Return the law from the present rate to another, at a share of the quickest change; None without one."""
        at = run.at
        request = InputParameter(1)
        request.control_interface = ControlInterface.Velocity
        request.current_position, request.current_velocity = [at.s], [at.rate]
        request.current_acceleration, request.target_velocity = [at.change], [rate]
        request.max_velocity = [FASTEST]
        request.max_acceleration = [max(share * self._change, abs(at.change))]
        request.max_jerk = [share * self._change_jerk]
        trajectory = Trajectory(1)
        return law_from_ruckig(trajectory, rate) if solved(self._ruckig, request, trajectory) else None
