"""Distances of the tests that move one slider: they stay within the limits, for every position and travel."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from trirail.commissioning.moves import (
    MIN_TEST_DISTANCE_M,
    ROOM_SHARE,
    TEST_DISTANCE_M,
    choose_distance,
)

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
