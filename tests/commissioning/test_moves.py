"""Distances of the tests that move one slider: they stay within the limits, for every position and travel."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from trirail.commissioning.moves import (
    MAX_ACCELERATION,
    MAX_VELOCITY,
    MIN_TEST_DISTANCE_M,
    ROOM_SHARE,
    TEST_DISTANCE_M,
    choose_distance,
    plan_square,
)
from trirail.config import SIM, geometry, load
from trirail.kinematics.robot import forward, inverse

LENGTHS = st.floats(1e-6, 0.006)


@given(low=st.floats(-0.1, 0.1), travel=LENGTHS, share=st.floats(0.0, 1.0))
def test_a_distance_stays_within_the_limits_and_can_be_judged(low: float, travel: float, share: float) -> None:
    limits, at = (low, low + travel), low + share * travel
    room = max(limits[1] - at, at - limits[0])
    if ROOM_SHARE * room < MIN_TEST_DISTANCE_M - 1e-12:
        with pytest.raises(ValueError, match="too little"):
            choose_distance(at, limits)
    elif ROOM_SHARE * room > MIN_TEST_DISTANCE_M + 1e-12:
        distance = choose_distance(at, limits)
        assert MIN_TEST_DISTANCE_M <= abs(distance) <= TEST_DISTANCE_M
        assert limits[0] <= at + distance <= limits[1]
        if ROOM_SHARE * room >= TEST_DISTANCE_M:
            assert abs(distance) == TEST_DISTANCE_M, "no distance is shortened without need"


@given(travel=LENGTHS)
def test_a_distance_from_an_unknown_position_is_at_most_half_the_travel(travel: float) -> None:
    try:
        distance = choose_distance(None, (0.0, travel))
    except ValueError:
        assert travel < 2.001 * MIN_TEST_DISTANCE_M / ROOM_SHARE
    else:
        assert 0.0 < distance <= min(TEST_DISTANCE_M, travel / 2.0)


@given(beyond=st.floats(1e-6, 0.1), high=st.floats(0.001, 0.1))
def test_a_slider_outside_its_limits_moves_inwards(beyond: float, high: float) -> None:
    assert choose_distance(high + beyond, (-high, high)) < 0.0
    assert choose_distance(-high - beyond, (-high, high)) > 0.0


ROBOT = load(SIM)


@given(phi=st.floats(-0.75, 0.8), limit=st.floats(0.001, 0.02))
@example(phi=0.797, limit=0.02)
@example(phi=0.0, limit=0.02)
def test_no_slider_exceeds_its_limits_while_the_platform_moves_around_the_square(phi: float, limit: float) -> None:
    """With the platform turned, a slider moves four times faster than the platform."""
    slider = msgspec.structs.replace(ROBOT.limits.slider, velocity=limit)
    robot = msgspec.structs.replace(ROBOT, limits=msgspec.structs.replace(ROBOT.limits, slider=slider))
    start = np.array([-0.03, -0.045, phi])
    kinematics = geometry(robot.geometry)
    a, b, c = inverse(kinematics, start).position.tolist()
    move, path = plan_square(robot, (a, b, c))
    highest = np.abs(move.velocity).max()
    assert highest <= min(MAX_VELOCITY, limit) * 1.001
    speed = np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1) / robot.period
    assert speed.max() <= min(MAX_VELOCITY, limit) * 1.001
    assert max(highest, speed.max()) >= 0.8 * min(MAX_VELOCITY, limit), "no slower than necessary"
    assert np.abs(np.diff(move.velocity, axis=0)).max() / robot.period <= MAX_ACCELERATION * 1.02
    corners = forward(kinematics, np.array([a, b, c]) + move.position)[[len(path) // 2 - 1, -1]]
    assert corners[0, :2] - start[:2] == pytest.approx([TEST_DISTANCE_M] * 2, abs=1e-9)
    assert corners[1] == pytest.approx(start, abs=1e-9)
