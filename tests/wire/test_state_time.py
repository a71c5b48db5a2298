"""Times in a state: the wall-clock time is that of its own cycle, and setpoints are timed from their deadline."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from control_rig import CONFIG
from hypothesis import given
from hypothesis import strategies as st
from trirail.processes.publications import StateMaker
from trirail.wire.packets import Welcome
from trirail.wire.records import DTYPE, Part
from trirail.wire.state import State


def test_a_state_has_the_wall_clock_time_of_its_cycle() -> None:
    offset_ns = 1_700_000_000_000_000_000
    maker, rows = StateMaker(CONFIG, lambda: offset_ns), np.zeros(2, DTYPE)
    rows["cycle"], rows["deadline_ns"] = (10, 30), (5_010_000_000, 5_030_000_000)
    times = []
    for row in rows:
        maker.records(row[None])
        times.append(maker.newest().time)
    assert times == [1_700_000_005.01, 1_700_000_005.03]
    offset_ns += 3_600_000_000_000  # the clock is set
    assert maker.newest().time == 1_700_003_605.03


@given(st.tuples(st.booleans(), st.booleans(), st.booleans()))
def test_a_state_says_which_positions_are_known(homed: tuple[bool, bool, bool]) -> None:
    maker, rows = StateMaker(CONFIG), np.zeros(1, DTYPE)
    rows["homed"] = homed
    maker.records(rows)
    assert maker.newest().sliders.homed == homed
    encoded = msgspec.to_builtins(maker.newest())
    del encoded["sliders"]["homed"]
    assert msgspec.convert(encoded, State).sliders.homed == (True, True, True)  # as earlier versions send it


@given(st.lists(st.tuples(st.integers(0, 10**6), st.integers(0, 10**6)), min_size=1, max_size=40))
def test_setpoints_are_timed_from_the_deadline_to_the_last_one(times: list[tuple[int, int]]) -> None:
    """Time after the setpoints, for the record and decisions, does not count."""
    maker = StateMaker(CONFIG)
    maker.update(Welcome((), 0.75))
    rows = np.zeros(len(times), DTYPE)
    rows["cycle"] = np.arange(len(times)) + 1
    for row, (late, part) in zip(rows, times, strict=True):
        row["lateness_ns"], row["parts_ns"][: Part.WRITE + 1] = late, part
        row["parts_ns"][Part.WRITE + 1 :] = 10**7
    maker.records(rows)
    loop = maker.newest().loop
    worst = max(late + 6 * part for late, part in times)
    assert loop.setpoints_us.max == pytest.approx(worst / 1e3, abs=0.1)
    assert loop.setpoint_budget_us == pytest.approx(250.0)


@pytest.mark.parametrize("homing", [False, True])
def test_no_jump_of_what_is_known_counts_as_a_motion(homing: bool) -> None:
    """Neither the begin of a gateway that is restarted during a motion, nor the end of homing, which sets the pose."""
    maker, rows = StateMaker(CONFIG), np.zeros(200, DTYPE)
    rows["cycle"] = np.arange(200)
    rows["pose"][:, 0] = 0.2 * CONFIG.period * np.arange(200)  # 0.2 m/s
    if homing:
        rows["homed"][100:], rows["pose"][:100] = True, 0.5
    states = []
    for start in range(0, 200, 20):
        maker.records(rows[start : start + 20])
        states.append(maker.newest())
    velocities = [0.0] * 6 + [0.2] * 4 if homing else [0.0] + [0.2] * 9
    assert [state.velocity[0] for state in states] == pytest.approx(velocities)
    assert [state.acceleration[0] for state in states] == pytest.approx([0.0] * 10, abs=1e-9)
