"""Laws under which the progress of a path stops as a straight motion does."""

from __future__ import annotations

import numpy as np
from hypothesis import assume, given
from hypothesis import strategies as st
from motion.test_runs import at, way
from motion.test_time_scaling import SCALING
from trirail.kinematics.arrays import Array
from trirail.motion.paths import Path, law_falls
from trirail.motion.runs import LawState, joined
from trirail.motion.straight_stop import PathProgress
from trirail.motion.time_scaling import Quickness

FAR = (0.1, 0.0, 0.0)
WEIGHTS = np.array([1.0, 2.0, 0.01])
RATES = st.floats(0.1, 2.0)


def bent(curve: float) -> Path:
    """A path of several pieces whose direction changes."""
    path = joined([way(FAR), way(FAR)])
    pieces = path.pieces.copy()
    pieces[:, 1] = curve * pieces[:, 0]
    pieces[:, 1, 4] += curve
    return path._replace(pieces=pieces)


def progress_at(path: Path, law: Path, begin: LawState, time: float) -> Array:
    """Progress and its first two derivatives, by their definition: value and derivatives of a product."""
    s, rate, change = at(law, time)[:, 0]
    first = at(path, begin.s)
    velocity = first[1] * begin.rate
    direction = WEIGHTS * velocity / (WEIGHTS @ velocity**2)
    position, speed, bend = at(path, s) @ direction
    return np.array([position - first[0] @ direction, speed * rate, bend * rate**2 + speed * change])


@given(
    *(st.floats(0.001, 0.9), RATES, st.floats(-0.5, 0.5, allow_subnormal=False), st.floats(-0.3, 0.3)),
    st.floats(0.2, 30.0),
)
def test_the_progress_follows_the_ramp_and_the_law_ends_at_rest(
    share: float, rate: float, change: float, curve: float, quick: float
) -> None:
    path = bent(curve)
    begin = LawState(share * path.duration, rate, change)
    progress = PathProgress(path, begin, WEIGHTS)
    ramp = SCALING.ramp(LawState(0.0, 1.0, progress.change), 0.0, Quickness(quick, quick**2))
    assume(ramp is not None)
    assert ramp is not None
    law = progress.law(ramp)
    if law is None:  # the path ends, or turns
        return
    assert at(law, 0.0)[:, 0].tolist() == list(begin)
    assert at(law, 1e3)[1:, 0].tolist() == [0.0, 0.0]
    for time in law.knots[:-1]:
        wanted = at(ramp, float(time))[:, 0]
        found = progress_at(path, law, begin, float(time))
        scale = np.array([1.0, 1.0, 1.0 + abs(progress.change) + quick])
        assert np.abs(found - wanted).max() <= 1e-6 * scale.max()


@given(st.floats(0.001, 0.2), RATES)
def test_a_path_that_has_just_begun_stops_without_a_law_that_falls(share: float, rate: float) -> None:
    path = way(FAR)
    begin = LawState(share * path.duration, rate, 0.0)
    progress = PathProgress(path, begin, WEIGHTS)
    quick = 2.0 * (progress.change + rate / share)
    ramp = SCALING.ramp(LawState(0.0, 1.0, progress.change), 0.0, Quickness(quick, quick**2))
    assert ramp is not None
    law = progress.law(ramp)
    assert law is not None
    assert not law_falls(law.knots, law.pieces)
    between = np.linspace(0.0, float(law.knots[-2]), 200)
    away = [progress_at(path, law, begin, float(time))[1] - at(ramp, float(time))[1, 0] for time in between]
    assert np.abs(away).max() <= 0.01


def test_where_the_path_ends_or_stands_there_is_no_law() -> None:
    path = way(FAR)
    ramp = SCALING.ramp(LawState(0.0, 1.0, 0.0), 0.0, Quickness(0.1, 0.1))
    assert ramp is not None
    assert PathProgress(path, LawState(0.5 * path.duration, 1.0, 0.0), WEIGHTS).law(ramp) is None  # it ends before
    assert PathProgress(path, LawState(0.0, 1.0, 0.0), WEIGHTS).law(ramp) is None  # it stands
