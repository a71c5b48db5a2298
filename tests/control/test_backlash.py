"""Backlash: taken up wherever a slider turns back, within its own share of the limits, and only where it moves."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from conftest import Rig
from control_rig import CONFIG
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from trirail.config import Config
from trirail.control.backlash import MIN_REVERSAL_M, add_offset, backlash, taking_up
from trirail.motion.backlash_reserve import NO_BACKLASH, SHARE, planned_limits, reserve_for_backlash
from trirail.wire.goals import SlidersGoal
from trirail.wire.vocabulary import Mode

Array = NDArray[np.float64]

PERIOD = CONFIG.period
SLIDER = CONFIG.limits.slider
WIDTHS = st.tuples(*[st.floats(1e-6, 5e-4)] * 3)


def with_backlash(width: float, config: Config = CONFIG) -> Config:
    told = msgspec.structs.replace(config.correction, backlash=(width,) * 3)
    return msgspec.structs.replace(config, correction=told)


def ways(seed: int, cycles: int) -> Array:
    """Places of three sliders that turn back again and again, and stand at the end (cycles, 3)."""
    random = np.random.default_rng(seed)
    t = np.arange(cycles)[:, None, None] * PERIOD
    waves = random.uniform(1e-5, 2e-2, (4, 3)) * np.sin(random.uniform(0.2, 20.0, (4, 3)) * t + random.uniform(0, 6, 3))
    places: Array = waves.sum(axis=1)
    places[-300:] = places[-300]
    return places


class Play:
    """A slider with play behind its motor: what add_offset has to make up for, written down independently."""

    def __init__(self, widths: Array) -> None:
        self._half = widths / 2.0
        self.place = np.zeros(3)

    def follow(self, motor: Array) -> None:
        self.place = np.clip(self.place, motor - self._half, motor + self._half)


@given(widths=WIDTHS, seed=st.integers(0, 10_000))
def test_a_slider_with_play_is_where_it_was_told_to_be(widths: tuple[float, float, float], seed: int) -> None:
    taken = reserve_for_backlash(widths, SLIDER)
    kept, play = backlash(taken, PERIOD), Play(np.array(widths))
    rows, settled = np.zeros((6, 3)), 0
    places = ways(seed, 1500)
    play.place = places[0].copy()
    offsets, rates, changes = (np.zeros_like(places) for _ in range(3))
    for n, place in enumerate(places):
        rows[:] = 0.0
        rows[0] = place
        add_offset(kept, rows)
        kept[0] = kept[1]
        play.follow(rows[0])
        offsets[n], rates[n], changes[n] = rows[0] - place, rows[1], rows[2]
        if not taking_up(kept):
            known = kept[0]["heading"] != 0.0
            assert (np.abs(play.place - place)[known] <= MIN_REVERSAL_M + 1e-12).all()
            settled += 1
    assert settled > 0
    assert not taking_up(kept)
    assert np.abs(offsets[-1]) == pytest.approx(np.array(widths) / 2.0, abs=1e-15)
    # Its rates are those of the offset, and no more than the limits keep for it.
    assert np.abs(rates).max() <= taken.velocity * (1.0 + 1e-9) <= SHARE * SLIDER.velocities[0] * (1.0 + 1e-9)
    assert np.abs(changes).max() <= taken.acceleration * (1.0 + 1e-9) <= SHARE * SLIDER.accelerations[0] * (1.0 + 1e-9)
    assert np.abs(np.diff(changes, axis=0)).max() / PERIOD <= taken.jerk * (1.0 + 1e-9)
    assert taken.jerk <= SHARE * SLIDER.jerks[0] * (1.0 + 1e-9)
    drift = np.diff(offsets, axis=0) - PERIOD * (rates[1:] + rates[:-1]) / 2.0
    assert np.abs(drift).max() <= taken.jerk * PERIOD**3


def test_what_is_tried_twice_begins_from_the_same() -> None:
    """A setpoint that the gate refuses has not been."""
    kept = backlash(reserve_for_backlash((5e-5,) * 3, SLIDER), PERIOD)
    first, second = np.zeros((6, 3)), np.zeros((6, 3))
    for place in (0.0, 1e-3):
        first[:], second[:] = 0.0, 0.0
        first[0] = second[0] = place
        add_offset(kept, first)
        add_offset(kept, second)
        assert first.tolist() == second.tolist()
        kept[0] = kept[1]


def test_without_backlash_nothing_is_taken_from_the_limits() -> None:
    assert reserve_for_backlash((0.0, 0.0, 0.0), SLIDER) is NO_BACKLASH
    assert planned_limits(CONFIG.limits, (0.0, 0.0, 0.0)) is CONFIG.limits


@given(widths=st.tuples(*[st.floats(0.0, 1e-3)] * 3))
def test_motion_and_take_up_together_stay_within_the_limits(widths: tuple[float, float, float]) -> None:
    taken, less = reserve_for_backlash(widths, SLIDER), planned_limits(CONFIG.limits, widths).slider
    assert less.velocities[0] + taken.velocity <= SLIDER.velocities[0] * (1.0 + 1e-12)
    assert less.accelerations[0] + taken.acceleration <= SLIDER.accelerations[0] * (1.0 + 1e-12)
    assert less.jerks[0] + taken.jerk <= SLIDER.jerks[0] * (1.0 + 1e-12)
    assert less.positions[0][0] - max(widths) / 2.0 >= SLIDER.positions[0][0] - 1e-15
    assert less.positions[0][1] + max(widths) / 2.0 <= SLIDER.positions[0][1] + 1e-15


@pytest.mark.parametrize("width", [5e-5, 5e-4])
def test_sliders_that_go_to_and_fro_break_no_limit(width: float) -> None:
    """At full speed, to the ends of their travel, by the setpoints that are written."""
    rig = Rig(with_backlash(width))
    rig.enable()
    low, high = SLIDER.position
    for number, place in enumerate((0.01, -0.01, 0.05, -0.02, 0.02, 0.0, 1e-6, 0.0)):
        rig.send(f"g{number}", SlidersGoal((place, -place, place / 2.0)))
        rig.until(rig.holds)
        assert rig.outcomes()[-1] == (f"g{number}", "done")
    assert rig.control.fault is None
    rows = rig.setpoints()
    assert (rows[:, 0] >= low).all()
    assert (rows[:, 0] <= high).all()
    assert np.abs(rows[:, 1]).max() <= SLIDER.velocity
    assert np.abs(rows[:, 2]).max() <= SLIDER.acceleration
    assert np.abs(np.diff(rows[:, 2], axis=0)).max() / PERIOD <= SLIDER.jerks[0] * (1.0 + 1e-3)
    rig.bus.shutdown()


def moving(width: float) -> Rig:
    """A robot of which every slider has gone up, and backlash been taken up."""
    rig = Rig(with_backlash(width))
    rig.enable()
    rig.send("up", SlidersGoal((0.01, 0.01, 0.01)))
    rig.until(rig.holds)
    return rig


def test_a_goal_is_not_done_before_backlash_is_taken_up() -> None:
    rig = moving(2e-4)
    rig.send("back", SlidersGoal((0.00999, 0.00999, 0.00999)))
    while rig.mode is Mode.MOVING:
        rig.cycle()
        assert rig.mode is Mode.MOVING or not taking_up(rig.control.measured.backlash)
    assert rig.outcomes()[-1] == ("back", "done")
    record = rig.control.measured.record[0]
    assert record["backlash"] == pytest.approx([-1e-4] * 3, abs=1e-12)
    assert record["position"] - record["backlash"] == pytest.approx([0.00999] * 3, abs=1e-6)
    rig.bus.shutdown()


def test_nothing_moves_on_enable_where_it_was_being_taken_up() -> None:
    """The drives lost their power in the middle of it."""
    rig = moving(2e-4)
    rig.post("back", SlidersGoal((0.0, 0.0, 0.0)))
    rig.until(lambda: taking_up(rig.control.measured.backlash))
    rig.cycles(5)
    rig.command("quick_stop")
    rig.until(lambda: not rig.control.measured.powered)
    rig.command("reset")
    rig.enable()
    begun = len(rig.rows)
    rig.cycles(300)
    rows = rig.setpoints()[begun:]
    assert (rows[:, 0] == rows[0, 0]).all()
    assert not rows[:, 1:3].any()
    rig.bus.shutdown()
