"""Plans of motion: jerk-limited, from any state of motion, and checked along their whole path before they start."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from ruckig import ControlInterface, InputParameter, Result, Ruckig, RuckigError, Synchronization, Trajectory

from service.algebra import Array
from service.config import Limits
from service.errors import RefusedError
from service.geometry import Geometry
from service.kinematics import inverse_into
from service.limits import LEGS, Bounds
from service.motion import STILL, MotionState, Run, end_of, from_ruckig, joined, law_from_ruckig, stretched
from service.paths import Path, advance, constant, survey

SAMPLES = 48
"""Moments at which a path is looked at, besides its knots."""
PLANNED = (0.98, 0.98, 0.93)
"""Share of the sliders' limits of velocity, acceleration and jerk that plans make use of: the rest is for what lies
between the samples, where jerk varies most."""
ATTEMPTS = 4
"""How often a path may be slowed before it is refused."""
IN_MOTION = (1.0, 0.5)
"""Shares of the platform's limits that a plan from motion is tried with."""
HALVINGS = 5
"""How finely a jog's way to a limit is made use of."""
GENTLER = 0.6
LAWS = 12
"""How often a change of rate is tried more gently before the old law is left to go on."""
JERK_SHARES = (1.0, 1.0 - 1e-6, 1.0 - 1e-3)
"""Ruckig finds no solution just where one kind of profile gives way to another, as for a distance of 2 a³ / j²
from rest to rest: there a hair less jerk has one."""
LONGEST = 600.0
"""No path is looked at for longer [s]."""
START = 1e-4
"""How far a trajectory may begin from where the robot stands [m, rad]."""


_TOO_FAST_IN_MOTION = RefusedError(
    "too_fast", "from its present motion the robot cannot take this path within its sliders' limits"
)


class Point(NamedTuple):
    """A point of a timed trajectory: when [s], and where, how fast and how accelerated the platform is."""

    t: float
    pose: Sequence[float]
    velocity: Sequence[float] | None = None
    acceleration: Sequence[float] | None = None


class Planner:
    """Makes paths and laws within the platform's limits and the sliders' bounds."""

    def __init__(self, geometry: Geometry, limits: Limits, bounds: Bounds, period: float) -> None:
        self._legs = geometry.packed()
        self._platform = limits.platform
        self._slider = limits.slider
        self._bounds = bounds
        self._period = period
        platform, slider = limits.platform, limits.slider
        self._box = np.array([platform.x, platform.y, platform.phi, slider.position, slider.passive]).T.copy()
        self._limits = np.array(PLANNED) * [slider.velocity, slider.acceleration, slider.jerk]
        self._powers = 1.0 / np.arange(1.0, 4.0)
        # What of a full-speed motion's rate the platform's limits can take away in a second, and change of that.
        self._change = min(a / v for a, v in zip(platform.acceleration, platform.velocity, strict=True))
        self._change_jerk = min(j / v for j, v in zip(platform.jerk, platform.velocity, strict=True))
        self._three, self._one = Ruckig(3), Ruckig(1)

    # ------------------------------------------------------------------ paths

    def to_pose(self, start: MotionState, target: Sequence[float], speed: float = 1.0) -> Path:
        """Plan to rest at a pose, straight in pose space from rest; at `speed` 0.5 it takes twice as long.

        A path that is too fast for a slider is slowed. Raises RefusedError with slider or coordinate, value and
        limit where it leaves the workspace, or where it cannot be slowed since it starts in motion.
        """
        if violation := self._bounds.pose(target):
            raise RefusedError(
                "out_of_workspace",
                f"the goal is out of the workspace: {violation}",
                value=violation.value,
                limit=violation.limit,
            )
        request = self._request(start)
        request.target_position = list(target)
        return self._feasible(request, start, speed)

    def to_sliders(self, start: MotionState, target: Sequence[float], speed: float = 1.0) -> Path:
        """Plan to rest at slider positions, straight in slider space from rest; as to_pose otherwise."""
        slider = self._slider
        for name, position in zip(LEGS, target, strict=True):
            low, high = slider.position
            if not low <= position <= high:
                limit = low if position < low else high
                text = f"slider {name}: position {position:.6g} m is beyond its limit {limit:.6g} m"
                raise RefusedError("out_of_workspace", text, slider=name, value=position, limit=limit)
        rows = np.zeros((6, 3))
        inverse_into(self._legs, np.array(start), rows)
        request = self._request(MotionState(*rows[:3].tolist()))
        request.max_velocity, request.max_acceleration, request.max_jerk = (
            [limit] * 3 for limit in self._limits.tolist()
        )
        request.target_position = list(target)
        return self._feasible(request, start, speed, in_sliders=True)

    def jog(self, start: MotionState, velocity: Sequence[float], timeout: float) -> Path:
        """Plan to a velocity, held until `timeout` is over or a limit comes near, and to rest.

        Faster than a slider can: as fast as it can. Raises RefusedError where not even braking stays inside.
        """
        share = 1.0
        for _ in range(ATTEMPTS):
            wanted = [share * value for value in velocity]
            low, high, best, excess = 0.0, timeout, None, 0.0
            hold = high
            for _ in range(HALVINGS):
                path = self._jog(start, wanted, hold)
                found = self._look(path, constant(1.0), path.duration, start.pose)
                if isinstance(found, float):
                    low, best, excess = hold, path, found
                    if hold == timeout:
                        break
                else:
                    high = hold
                hold = (low + high) / 2.0
            if best is None:
                share /= 2.0
                continue
            if excess <= 1.0:
                return best
            share /= excess
        path = self._jog(start, STILL, 0.0)
        if self._check(path, start.pose) > 1.0:
            raise _TOO_FAST_IN_MOTION
        return path

    def follow(self, start: MotionState, points: Sequence[Point], stretch: bool) -> Path:
        """Take timed points for a path, quintic between them. Raises RefusedError.

        Velocities that are not given are those between the neighbours, accelerations likewise; both are zero at
        the ends. Too fast is refused, or slowed with `stretch`.
        """
        first = points[0]
        for name, given, stands in zip(("x", "y", "phi"), first.pose, start.pose, strict=True):
            if not start.at_rest or abs(given - stands) > START:
                text = f"the trajectory begins at {name} = {given:.6g}, the robot is at {stands:.6g}: go there first"
                raise RefusedError("wrong_start", text, value=given, limit=stands)
        path = _quintic(points, start.pose)
        excess = self._check(path, start.pose)
        if excess > 1.0:
            if not stretch:
                raise RefusedError(
                    "too_fast",
                    f"the trajectory is {excess:.3g} times too fast for a slider: "
                    'send it slower, or with "stretch": true',
                    value=excess,
                    limit=1.0,
                )
            path = stretched(path, excess)
        return path

    # ------------------------------------------------------------------ laws

    def begin(self, path: Path, rate: float, pose: Sequence[float]) -> Run:
        """Start a path at a rate, or as near to it as the sliders' limits allow."""
        rate = self._possible(path, 0.0, rate, pose)
        return Run(self._legs, path, constant(rate), rate)

    def change_rate(self, run: Run, rate: float, pose: Sequence[float]) -> None:
        """Let the time along a path run at another rate: as soon as the sliders' limits allow, as fast as they do.

        Where nothing gentler than the old law fits, that goes on: to the end of the path, where it stands too.
        """
        at = run.at
        rate = self._possible(run.path, at.s, rate, pose)
        request = InputParameter(1)
        request.control_interface = ControlInterface.Velocity
        request.current_position, request.current_velocity = [at.s], [at.rate]
        request.current_acceleration, request.target_velocity = [at.change], [rate]
        request.max_velocity = [10.0]
        share = 1.0
        for _ in range(LAWS):
            request.max_acceleration = [max(share * self._change, abs(at.change))]
            request.max_jerk = [share * self._change_jerk]
            trajectory = Trajectory(1)
            if _solved(self._one, request, trajectory):
                law = law_from_ruckig(trajectory, rate)
                until = min(end_of(run.path, law, rate), float(law.knots[-2]) + self._period)
                found = self._look(run.path, law, until, pose)
                if isinstance(found, float) and found <= 1.0:
                    run.change_law(law, rate)
                    return
            share *= GENTLER

    def _possible(self, path: Path, s: float, rate: float, pose: Sequence[float]) -> float:
        """Return the rate, or the greatest that the rest of the path allows."""
        if rate <= 1.0:
            return rate
        found = self._look(path, constant(1.0, s), path.duration - s, pose)
        return min(rate, 1.0 / found) if isinstance(found, float) and found > 0.0 else rate

    # ------------------------------------------------------------------ inside

    def _request(self, start: MotionState) -> InputParameter:
        request = InputParameter(3)
        request.current_position = list(start.pose)
        request.current_velocity = list(start.velocity)
        request.current_acceleration = list(start.acceleration)
        request.max_velocity = list(self._platform.velocity)
        request.max_acceleration = list(self._platform.acceleration)
        request.max_jerk = list(self._platform.jerk)
        request.synchronization = Synchronization.Phase
        return request

    def _feasible(self, request: InputParameter, start: MotionState, speed: float, in_sliders: bool = False) -> Path:
        """Solve for a path that no slider is too slow for."""
        full = request.max_velocity, request.max_acceleration, request.max_jerk
        for attempt in range(ATTEMPTS if start.at_rest else len(IN_MOTION)):
            # The same path k times slower has k times the velocity, k² the acceleration and k³ the jerk. From
            # motion there is no same path: lower limits are tried.
            shares = (speed, speed**2, speed**3) if start.at_rest else (speed * IN_MOTION[attempt],) * 3
            request.max_velocity, request.max_acceleration, request.max_jerk = (
                [share * limit for limit in limits] for share, limits in zip(shares, full, strict=True)
            )
            path = self._solve(request, in_sliders)
            excess = self._check(path, start.pose)
            if excess <= 1.0:
                return path
            if start.at_rest:
                speed /= excess * (1.0 + 1e-9)
        raise _TOO_FAST_IN_MOTION

    def _solve(self, request: InputParameter, in_sliders: bool = False) -> Path:
        trajectory = Trajectory(3)
        jerk = request.max_jerk
        for share in JERK_SHARES:
            request.max_jerk = [share * limit for limit in jerk]
            if _solved(self._three, request, trajectory):
                return from_ruckig(trajectory, in_sliders)
        raise RefusedError("no_plan", "no motion leads there from the present one: send the goal again when it holds")

    def _jog(self, start: MotionState, velocity: Sequence[float], hold: float) -> Path:
        ramp = self._to_velocity(start, velocity)
        pose = (ramp.pieces[-1] @ (ramp.knots[-1] - ramp.knots[-2]) ** np.arange(6.0)).tolist()
        if not any(velocity):
            return ramp
        held = np.zeros((1, 3, 6))
        held[0, :, 0], held[0, :, 1] = pose, velocity
        hold = max(hold, self._period)
        end = [value + hold * rate for value, rate in zip(pose, velocity, strict=True)]
        brake = self._to_velocity(MotionState(end, velocity, STILL), STILL)
        return joined([ramp, Path(np.array([0.0, hold]), held), brake])

    def _to_velocity(self, start: MotionState, velocity: Sequence[float]) -> Path:
        request = self._request(start)
        request.control_interface = ControlInterface.Velocity
        request.target_velocity = list(velocity)
        return self._solve(request)

    def _check(self, path: Path, pose: Sequence[float]) -> float:
        """Return how many times too fast a path is for a slider. Raises RefusedError if it leaves the workspace."""
        found = self._look(path, constant(1.0), path.duration, pose)
        if isinstance(found, float):
            return found
        raise found

    def _look(self, path: Path, law: Path, until: float, pose: Sequence[float]) -> float | RefusedError:
        """Survey a path under a law: how many times too fast it is, or why it is out of reach."""
        until = min(until, LONGEST)
        step = self._period
        # A path from standstill may begin with an acceleration: the step into it counts, as the one at the end does.
        from_rest = law.pieces[0, 0, 0] == 0.0 and not path.pieces[0, :, 1].any()
        first = -step if from_rest else 0.0
        even = np.linspace(first, until, SAMPLES)
        # Jerk can be greatest in the short time between a knot of the path and one of the law: look at all of them.
        knots = np.concatenate([law.knots[:-1], np.interp(path.knots, _along(law, even), even)])
        times = np.concatenate([even, knots - step / 2.0, knots, knots + step / 2.0])
        times = np.sort(times[(times >= first) & (times <= until)])
        worst = np.zeros(3)
        start = np.array(pose, dtype=np.float64)
        code = survey(self._legs, *path, *law[:2], times, step, start, self._box, worst)
        if code:
            return self._explain(path, law, float(times[code - 1]), until, pose)
        return float(((worst / self._limits) ** self._powers).max())

    def _explain(self, path: Path, law: Path, time: float, until: float, pose: Sequence[float]) -> RefusedError:
        """Say what is out of reach, and where on the path."""
        where = f"the path leads out of the workspace after {max(0.0, time) / max(until, 1e-9):.0%} of its time"
        rows, near = np.zeros((6, 3)), np.array(pose, dtype=np.float64)
        for moment in (time, time + self._period):
            motion = np.zeros((3, 3))
            if advance(self._legs, *path, *law[:2], moment, near, motion) or inverse_into(self._legs, motion, rows):
                return RefusedError("singular", f"{where}: the robot is singular there")
            still = rows[0].tolist(), STILL, STILL, rows[3].tolist()
            violation = self._bounds.pose(motion[0].tolist()) or self._bounds.setpoint(still, still[0])
            if violation:
                return RefusedError(
                    "out_of_workspace",
                    f"{where}: {violation}",
                    slider=violation.what if violation.what in LEGS else None,
                    value=violation.value,
                    limit=violation.limit,
                )
        return RefusedError("out_of_workspace", where)


def _solved(ruckig: Ruckig, request: InputParameter, trajectory: Trajectory) -> bool:
    """Whether Ruckig has found a trajectory. Some of its failures raise, one (-101) by not being in its own enum."""
    try:
        return ruckig.calculate(request, trajectory) in (Result.Working, Result.Finished)
    except (RuckigError, ValueError):
        return False


def _along(law: Path, times: Array) -> Array:
    """Return the time along the path at many times."""
    k = np.searchsorted(law.knots, times, side="right").clip(1, len(law.knots) - 1) - 1
    since = np.maximum(times - law.knots[k], 0.0)
    a, b, c, d = law.pieces[k, 0, :4].T
    return np.asarray(a + since * (b + since * (c + since * d)))


def _quintic(points: Sequence[Point], start: Sequence[float]) -> Path:
    """Join timed points by quintics that meet position, velocity and acceleration at each."""
    t = np.array([point.t for point in points])
    p = np.array([point.pose for point in points])
    p[0] = start
    v = _filled([point.velocity for point in points], t, p)
    a = _filled([point.acceleration for point in points], t, v)
    h = np.diff(t)[:, None]
    gap = p[1:] - p[:-1] - h * v[:-1] - h**2 / 2.0 * a[:-1]
    speed = v[1:] - v[:-1] - h * a[:-1]
    pull = a[1:] - a[:-1]
    pieces = np.zeros((len(points) - 1, 3, 6))
    pieces[:, :, 0], pieces[:, :, 1], pieces[:, :, 2] = p[:-1], v[:-1], a[:-1] / 2.0
    pieces[:, :, 3] = 10.0 * gap / h**3 - 4.0 * speed / h**2 + pull / (2.0 * h)
    pieces[:, :, 4] = -15.0 * gap / h**4 + 7.0 * speed / h**3 - pull / h**2
    pieces[:, :, 5] = 6.0 * gap / h**5 - 3.0 * speed / h**4 + pull / (2.0 * h**3)
    return Path(t - t[0], pieces)


def _filled(given: Sequence[Sequence[float] | None], t: Array, values: Array) -> Array:
    """Return the derivatives at points, those between their neighbours where none are given, none at the ends."""
    rates = np.zeros_like(values)
    if len(t) > 2:
        rates[1:-1] = (values[2:] - values[:-2]) / (t[2:] - t[:-2])[:, None]
    for row, rate in enumerate(given):
        if rate is not None:
            rates[row] = rate
    return rates
