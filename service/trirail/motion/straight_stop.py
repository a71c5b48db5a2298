"""Laws under which a path stops as quickly as a straight motion, from any velocity and acceleration.

The progress of a path is its distance in the direction of the present velocity, divided by this velocity. A ramp of the
rate of the progress from 1 to 0 is the stop of a straight motion. The law makes the path follow such a ramp. At the
start of a path, where the velocity is low and the acceleration is not, this is much quicker than a ramp of the law's
own rate.
"""

from __future__ import annotations

import numpy as np

from trirail.kinematics.arrays import Array
from trirail.kinematics.compiled import compiled, inlined
from trirail.motion.paths import LAST_PIECE_S, Path, evaluate, evaluate_path, law_at, passing_time
from trirail.motion.runs import KNOT_TOLERANCE_S, LawState

FIRST_KNOTS, OTHER_KNOTS = 8, 3
"""Numbers of knots of the law in the first piece of the ramp and in every other one. The first piece has more, and most
of them near its start, because the rate of the law varies most there."""
MAX_PATH_KNOTS = 16
"""Greatest number of knots of the path at which the law has knots, too."""
MAX_STEPS = 30
"""Greatest number of Newton steps for a time along a path."""
STEP_S = 1e-9
"""Newton step after which the next one would be below rounding [s]."""


class PathProgress:
    """Progress of a path from a state of its law.

    `weights` (3,) make the coordinates of the path comparable. Their sizes do not matter.
    """

    def __init__(self, path: Path, at: LawState, weights: Array) -> None:
        self._path, self._at = path, at
        self._out = np.zeros((3, 3))
        evaluate(path.knots, path.pieces, at.s, self._out)
        begin, first, second = self._out.copy()
        velocity, acceleration = first * at.rate, second * at.rate**2 + first * at.change
        square = float(weights @ velocity**2)
        self._direction = weights * velocity / square if square > 0.0 else np.zeros(3)
        self._begin = float(self._direction @ begin)
        self.change = float(self._direction @ acceleration)
        """Second derivative of the progress with respect to real time [1/s]."""

    def law(self, ramp: Path) -> Path | None:
        """Return the law under which the progress follows a ramp to rate 0; None if there is none.

        There is none if the path ends before the ramp, or does not advance in the direction of the present velocity.
        """
        room = 2 + FIRST_KNOTS + OTHER_KNOTS * len(ramp.pieces) + MAX_PATH_KNOTS
        knots, pieces = np.zeros(room), np.zeros((room, 1, 6))
        n = _follow(*self._path[:2], self._direction, self._begin, *self._at, *ramp[:2], knots, pieces, self._out)
        return Path(knots[: n + 1], pieces[:n]) if n else None


@inlined
def _component(direction: Array, x: Array) -> float:
    """Return the scalar product of two vectors (3,)."""
    product: float = direction[0] * x[0] + direction[1] * x[1] + direction[2] * x[2]
    return product


@compiled()
def _insert(times: Array, n: int, time: float) -> int:
    """Insert a time into n ascending times, unless it is there. Return the new number of times."""
    k = n
    while k > 0 and times[k - 1] > time:
        k -= 1
    if (k > 0 and time - times[k - 1] <= KNOT_TOLERANCE_S) or (k < n and times[k] - time <= KNOT_TOLERANCE_S):
        return n
    for i in range(n, k, -1):
        times[i] = times[i - 1]
    times[k] = time
    return n + 1


@compiled(
    "i8(f8[::1], f8[:, :, ::1], f8[::1], f8, f8, f8, f8, f8[::1], f8[:, :, ::1], f8[::1], f8[:, :, ::1], f8[:, ::1])"
)
def _follow(
    path_knots: Array,
    path_pieces: Array,
    direction: Array,
    begin: float,
    s: float,
    rate: float,
    change: float,
    ramp_knots: Array,
    ramp_pieces: Array,
    knots: Array,
    pieces: Array,
    out: Array,
) -> int:
    """Write the law under which a path's progress follows a ramp. Return its number of pieces; 0 if there is none.

    The progress is the scalar product of `direction` (3,) and the position, less `begin`. The law has knots in each
    piece of the ramp and where it passes knots of the path, and begins in the state s, rate, change. Its pieces are the
    polynomials of degree 5 between its states at the knots. `out` (3, 3) is overwritten.
    """
    last = len(ramp_pieces) - 1
    end, farthest = ramp_knots[last], ramp_pieces[last, 0, 0]
    n = _insert(knots, 0, 0.0)
    n = _insert(knots, n, end)
    for k in range(last):
        number = FIRST_KNOTS if k == 0 else OTHER_KNOTS
        for i in range(number):
            share = (i / number) ** 2 if k == 0 else i / number
            n = _insert(knots, n, ramp_knots[k] + share * (ramp_knots[k + 1] - ramp_knots[k]))
    first = int(np.searchsorted(path_knots, s))
    for k in range(first, min(first + MAX_PATH_KNOTS, len(path_knots))):
        evaluate_path(path_knots, path_pieces, path_knots[k], out)
        progress = _component(direction, out[0]) - begin
        if progress >= farthest:
            break
        n = _insert(knots, n, passing_time(ramp_knots, ramp_pieces, progress, end))
    for k in range(n - 1):
        progress, speed, acceleration = law_at(ramp_knots, ramp_pieces, knots[k + 1])
        next_s, step, slope = s, 1.0, 1.0
        for _ in range(MAX_STEPS):
            evaluate_path(path_knots, path_pieces, next_s, out)
            slope = _component(direction, out[1])
            if not slope > 0.0:
                return 0
            if abs(step) < STEP_S:
                break
            step = (progress + begin - _component(direction, out[0])) / slope
            next_s += step
        next_rate, next_change = speed / slope, 0.0
        if k == n - 2:
            next_rate = 0.0
        else:
            next_change = (acceleration - _component(direction, out[2]) * next_rate**2) / slope
        span = knots[k + 1] - knots[k]
        miss = next_s - s - span * (rate + span * change / 2.0)
        rate_miss, change_miss = (next_rate - rate - span * change) * span, (next_change - change) * span**2
        p = pieces[k, 0]
        p[0], p[1], p[2] = s, rate, change / 2.0
        p[3] = (10.0 * miss - 4.0 * rate_miss + change_miss / 2.0) / span**3
        p[4] = (-15.0 * miss + 7.0 * rate_miss - change_miss) / span**4
        p[5] = (6.0 * miss - 3.0 * rate_miss + change_miss / 2.0) / span**5
        s, rate, change = next_s, next_rate, next_change
    pieces[n - 1, 0, 0] = s
    knots[n] = end + LAST_PIECE_S
    return n
