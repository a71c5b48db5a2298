"""What is made of the drives' answers: where none of a slider can be so soon is not taken for its place."""

from __future__ import annotations

import pytest
from conftest import CONFIG
from hypothesis import given
from hypothesis import strategies as st

from drivers.interface import Feedback, PowerState
from service.config import geometry
from service.kinematics import forward, inverse
from service.measured import Measured

PERIOD = CONFIG.period
ROBOT = geometry(CONFIG.geometry)
STEP = CONFIG.limits.slider.velocity * PERIOD
ON = (PowerState.OPERATION_ENABLED,) * 3
Triple = tuple[float, float, float]


def standing(position: Triple) -> Measured:
    measured = Measured(ROBOT.packed(), PERIOD, STEP)
    measured.start(Feedback(position, ON, None))
    measured.take(Feedback(position, ON, None))
    return measured


PLACES = st.tuples(*[st.floats(-0.03, 0.03)] * 2, st.floats(-0.2, 0.2))
SHARES = st.floats(-1.98, 1.98) | st.floats(2.02, 60.0) | st.floats(-60.0, -2.02)
"""Of the way that a slider goes in a cycle at most."""


@given(place=PLACES, shares=st.tuples(SHARES, SHARES, SHARES))
def test_only_a_slider_that_goes_twice_as_far_as_one_can_has_jumped(place: Triple, shares: Triple) -> None:
    a, b, c = inverse(ROBOT, place).position.tolist()
    measured = standing((a, b, c))
    before = measured.pose
    moved = (a + shares[0] * STEP, b + shares[1] * STEP, c + shares[2] * STEP)
    measured.take(Feedback(moved, ON, None))
    assert measured.jumps == tuple(abs(share) > 2.0 for share in shares)
    if any(measured.jumps):
        assert measured.pose == before
    else:
        assert measured.pose == pytest.approx(forward(ROBOT, moved, near=before), abs=1e-9)
    assert measured.velocity == pytest.approx([share * STEP / PERIOD for share in shares], abs=1e-9)
