"""Laws of the time along a path: constant rates, and changes of the rate within the limits of sliders and platform."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import takewhile
from typing import NamedTuple

import numpy as np
from ruckig import ControlInterface, InputParameter, Ruckig, Trajectory

from trirail.config import Limits
from trirail.kinematics.arrays import Array
from trirail.kinematics.geometry import Geometry
from trirail.kinematics.robot import inverse_into
from trirail.motion.feasibility import PLATFORM_LAW_SHARES, Checker, SampleResult
from trirail.motion.paths import Path, constant_law, law_falls, platform_at_law_time
from trirail.motion.ruckig_call import try_solve
from trirail.motion.rules import RULES
from trirail.motion.runs import LawState, Run, arrival_time, law_from_ruckig
from trirail.motion.straight_stop import PathProgress

FINE_RATIO, COARSE_RATIO = 0.88, 0.6
FIRST_SHARES = (*(FINE_RATIO**k for k in range(4)), *(FINE_RATIO**3 * COARSE_RATIO**k for k in range(1, 16)))
"""Fractions of the quickest change at the present speed, as far as they are quicker than a change at full speed. They
are tried before CHANGE_SHARES, except by RateChange until a change has begun, so that it does not begin later."""
NEGLIGIBLE = 1e-9
"""Velocity of a coordinate that does not limit a stop, as a fraction of the greatest one."""
STRAIGHT_SHARES = (0.99, 0.96, 0.88, 0.7, 0.5)
"""Fractions of the quickest straight stop, which are tried before all other changes to rate 0. The first one leaves a
margin for the approximation by a law. Until a change has begun, only the first one is tried."""
CHANGE_SHARES = (*(FINE_RATIO**k for k in range(12)), *(FINE_RATIO**11 * COARSE_RATIO**k for k in range(1, 9)))
"""Fractions of the quickest change of rate at full speed, which are tried in turn. A smaller fraction gives a longer
stop. The steps between the fractions are fine for quick stops. They are coarse for long stops, which only robots with
low slider limits need."""


class Quickness(NamedTuple):
    """Greatest first and second derivative of the rate of the time along a path during a change [1/s, 1/s²]."""

    change: float
    jerk: float

    def scaled(self, share: float) -> Quickness:
        """Return a fraction of this quickness."""
        return Quickness(share * self.change, share * self.jerk)

    def duration(self, by: float) -> float:
        """Return the duration of a change of the rate by `by`, from a constant rate to a constant rate [s]."""
        change, jerk = self
        return by / change + change / jerk if by * jerk > change**2 else 2.0 * math.sqrt(by / jerk)


class StraightStop(NamedTuple):
    """Stop that is as quick as one of a straight motion from the present velocity and acceleration."""

    share: float
    """Fraction of the limits that it uses."""


Change = Quickness | StraightStop
"""Change of the rate that can be tried."""


def quickest_at(velocity: Array, acceleration: Array, jerk: Array) -> Quickness:
    """Return the quickness with which a motion at these velocities reaches limits of acceleration and jerk, (n,)."""
    return Quickness(float((acceleration / velocity).min()), float((jerk / velocity).min()))


class TimeScaling:
    """Generator of laws for the paths of one robot."""

    def __init__(self, geometry: Geometry, checker: Checker, period: float, rules: int = RULES) -> None:
        self._first_shares = FIRST_SHARES if rules > 1 else ()
        self._straight_stops = tuple(map(StraightStop, STRAIGHT_SHARES)) if rules > 2 else ()
        self._legs = geometry.packed()
        self._checker = checker
        self._period = period
        self._ruckig = Ruckig(1)
        self._limits = checker.law_limits.T
        self.full_speed = quickest_at(*self._limits[:, :3])
        """Quickness with which a motion at full speed reaches the platform's limits."""

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

        `pose` is the present pose of the platform, and `shares` are as in `tries`.
        """
        for change in self.tries(run, 0.0, pose, shares):
            law = self.law(run, run.time, 0.0, change, pose)
            if (
                law is not None
                and self.sample(run.path, law, 0.0, self.last_new_time(run, law, 0.0), pose).within_limits
            ):
                return law
        return None

    def first_tries(self, rate: float) -> Iterator[Change]:
        """Yield the changes of the rate to try in turn if none has begun yet.

        They are few, because any change that begins now is better than a quicker one that is found later.
        """
        yield from self._straight_stops[:1] if rate == 0.0 else ()
        yield from map(self.full_speed.scaled, CHANGE_SHARES)

    def tries(self, run: Run, rate: float, pose: Sequence[float], shares: Sequence[float]) -> Iterator[Change]:
        """Yield the changes of a run's rate to try in turn: first those that are as quick as the present speed allows.

        `shares` are fractions of the quickest change at full speed, which are yielded last.
        """
        yield from self._straight_stops if rate == 0.0 else ()
        full, by = self.full_speed, run.law_state.rate - rate
        present = self._present_speed(run, pose) if by > 0.0 else None
        if present is not None:
            first = map(present.scaled, self._first_shares)
            yield from takewhile(lambda quick: quick.duration(by) < full.duration(by), first)
        yield from map(full.scaled, shares)

    def law(self, run: Run, time: float, rate: float, change: Change, pose: Sequence[float]) -> Path | None:
        """Return a law for a change of a run's rate; None if there is none.

        The change begins at `time` of the present law [s]. `pose` is a pose near the platform's at that time.
        """
        at = run.law_state_at(time)
        if isinstance(change, Quickness):
            return self.ramp(at, rate, change)
        speeds = self._speeds(run, time, pose)
        if speeds is None or not speeds[0].any():
            return None
        velocity = np.maximum(speeds[0], NEGLIGIBLE * speeds[0].max())
        _, greatest, jerk = self._limits
        progress = PathProgress(run.path, at, 1.0 / jerk[3:] ** 2 if run.path.in_sliders else 1.0 / jerk[:3] ** 2)
        quick = quickest_at(velocity, greatest, jerk).scaled(change.share)
        ramp = self.ramp(LawState(0.0, 1.0, progress.change), 0.0, quick)
        if ramp is None or float(ramp.knots[-2]) > run.end_time - time - self._period:  # the motion ends as soon
            return None
        law = progress.law(ramp)
        return None if law is None or law_falls(law.knots, law.pieces) else law

    def last_new_time(self, run: Run, law: Path, rate: float) -> float:
        """Return the time until which a law must be sampled [s]. Later, the rate is constant or the path is over."""
        return min(arrival_time(law, rate, run.path.duration), float(law.knots[-2]) + self._period)

    def sample(
        self, path: Path, law: Path, first: float, until: float, pose: Sequence[float], own: Array | None = None
    ) -> SampleResult:
        """Sample a path under a law; see Checker.sample."""
        return self._checker.sample(path, law, first, until, pose, own)

    def ramp(self, at: LawState, rate: float, quick: Quickness) -> Path | None:
        """Return a law from the state `at` to a rate; None if there is none.

        If the rate is already falling, a change that is not quick may not be enough to prevent the rate from becoming
        negative. In this case, there is no law.
        """
        request = InputParameter(1)
        request.control_interface = ControlInterface.Velocity
        request.current_position, request.current_velocity = [at.s], [at.rate]
        request.current_acceleration, request.target_velocity = [at.change], [rate]
        request.max_acceleration = [max(quick.change, abs(at.change))]
        request.max_jerk = [quick.jerk]
        trajectory = Trajectory(1)
        if not try_solve(self._ruckig, request, trajectory):
            return None
        law = law_from_ruckig(trajectory, rate)
        return None if law_falls(law.knots, law.pieces) else law

    def _present_speed(self, run: Run, pose: Sequence[float]) -> Quickness | None:
        """Return the quickness with which a run at its present rate reaches the limits of sliders and platform.

        It is for the speed that remains when the present acceleration has been ended with the greatest jerk. Return
        None if the robot is singular.
        """
        speeds = self._speeds(run, run.time, pose)
        if speeds is None:
            return None
        _, greatest, jerk = self._limits
        velocity, acceleration = speeds
        speed = velocity + acceleration**2 / (2.0 * jerk)
        # A stop takes at least two periods.
        speed = np.maximum(speed, np.minimum(jerk * self._period, greatest) * self._period) / run.law_state.rate
        return quickest_at(speed, greatest, jerk)

    def _speeds(self, run: Run, time: float, pose: Sequence[float]) -> tuple[Array, Array] | None:
        """Return velocity and acceleration without signs at a time of a run's law; None if the robot is singular.

        Each is for the platform's x, y and phi and for the three sliders (6,).
        """
        motion, rows, near = np.zeros((3, 3)), np.zeros((6, 3)), np.array(pose, dtype=np.float64)
        if platform_at_law_time(self._legs, *run.path, *run.law[:2], time, near, motion) or inverse_into(
            self._legs, motion, rows
        ):
            return None
        velocity, acceleration = (np.abs((motion[k], rows[k])).ravel() for k in (1, 2))
        return velocity, acceleration


def greatest_rate(rate: float, result: SampleResult) -> float:
    """Return the lower of `rate` and the greatest rate that a path allows, given the samples of the path at rate 1.

    Every path fits the limits at rate 1. A higher rate is possible if the path does not use its limits completely.
    """
    return (
        min(rate, max(1.0, 1.0 / result.slowdown_factor))
        if math.isnan(result.leaves_at) and result.slowdown_factor > 0.0
        else 1.0
    )


def stop_duration(limits: Limits, reachable: Array) -> float:
    """Return the longest duration of a stop on a line at constant velocity [s].

    The time along the path slows down, so that all axes stop together: the distance of each axis is its velocity
    times half of the duration. A stop during an acceleration or in a curve can be longer, because the speed still
    rises, or because the path itself uses a part of the limits. `limits` come from backlash_reserve.planned_limits.
    `reachable` (3,) are velocities of the platform that it cannot exceed because of the sliders.
    """
    platform, slider = limits.platform, limits.slider
    velocity, acceleration, jerk = (
        np.array([platform.velocity, platform.acceleration, platform.jerk]).T * PLATFORM_LAW_SHARES
    ).T
    full = quickest_at(np.minimum(velocity, reachable), acceleration, jerk)
    change, change_jerk = quickest_at(*map(np.array, (slider.velocities, slider.accelerations, slider.jerks)))
    most = min(change / full.change, change_jerk / full.jerk)
    share = min(STRAIGHT_SHARES[0], next((share for share in CHANGE_SHARES if share <= most), most))
    return full.scaled(float(share)).duration(1.0)
