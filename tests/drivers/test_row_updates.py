"""What every cycle does to a drive's row, against drives of which it is known when they sampled what they say.

Python and compiled cycles share these functions, so a comparison of the two does not show a mistake in them.
"""

from __future__ import annotations

import math
from typing import Literal, cast

import numpy as np
from control_rig import CONFIG
from hypothesis import assume, given
from hypothesis import strategies as st
from trirail_drivers.bus.can_frame import DATA_AT
from trirail_drivers.cia402 import process_data
from trirail_drivers.driver.axis import Axis
from trirail_drivers.driver.row_updates import (
    accept_answer,
    accept_counts,
    accept_statusword,
    accept_turns,
    answered_sync,
    count_sync,
    due_setpoint,
    end_reading,
    is_far,
    outputs_pending,
    put_outputs,
    put_setpoint,
    scale_setpoint,
    turns_back,
    unanswered,
)
from trirail_drivers.driver.scaling import Scale

Arrival = Literal["before the read", "after the read", "after the next SYNC", "never"]
"""When the answer to a SYNC arrives."""


def made(counts_per_metre: float = 1e6, offset: float = 0.01) -> Axis:
    return Axis("A", 1, Scale(counts_per_metre, offset), CONFIG.drives)


def run(arrivals: list[Arrival]) -> Axis:
    """Answer each SYNC when it is said; check that each answer is taken for that to its own SYNC."""
    axis, overdue, came, answered = made(), False, False, 0
    for number, arrival in enumerate(arrivals, 1):
        count_sync(axis)
        assert axis.syncs == axis.command_age == number
        if overdue:
            axis.answer()
            assert axis.sampled == number - 1
            answered = number - 1
        if arrival == "before the read":
            axis.answer()
        assert axis.came == (came or overdue or arrival == "before the read")
        end_reading(axis)
        assert axis.between
        assert not axis.came
        if arrival == "after the read":
            axis.answer()
        if arrival in ("before the read", "after the read"):
            assert (axis.sampled, axis.age) == (number, 0)
            assert axis.prompt == (arrival == "before the read")
            answered = number
        overdue, came = arrival == "after the next SYNC", arrival == "after the read"
        assert axis.sampled == answered
    return axis


def lost(arrivals: list[Arrival]) -> int:
    """How many SYNCs before the last one that was answered were not."""
    answered = [number for number, arrival in enumerate(arrivals) if arrival != "never"]
    return arrivals[: answered[-1]].count("never") if answered else 0


@given(st.lists(st.sampled_from(["before the read", "never"])))
def test_a_quick_drive_answers_the_newest_sync_whatever_got_lost(arrivals: list[Arrival]) -> None:
    """Once it has answered: before, nothing tells a quick drive from one whose answer is overdue."""
    axis = run(["before the read", *arrivals])
    assert (axis.late, axis.lost) == (0, lost(["before the read", *arrivals]))


@given(st.lists(st.sampled_from(["after the read", "after the next SYNC", "never"])))
def test_a_drive_as_on_a_real_bus_answers_its_own_sync_also_when_the_answer_is_overdue(arrivals: list[Arrival]) -> None:
    axis = run([*arrivals, "after the read"])
    assert (axis.late, axis.lost) == (0, lost([*arrivals, "after the read"]))


EDGES = [edge * 1e-6 for edge in (-(2**31) - 1, -(2**31), 2**31 - 1, 2**31)]
ENTRIES = (process_data.TARGET_POSITION, process_data.VELOCITY_OFFSET, process_data.CONTROLWORD)


@given(
    entries=st.permutations(ENTRIES).flatmap(lambda order: st.sampled_from([order[:2], order[:1]])),
    position=st.floats(-3000.0, 3000.0) | st.sampled_from(EDGES),
    velocity=st.floats(-3000.0, 3000.0) | st.sampled_from(EDGES),
    controlword=st.integers(0, 0xFFFF),
)
def test_a_setpoint_is_in_its_frame_as_struct_packs_it_or_is_refused_whole(
    entries: list[int], position: float, velocity: float, controlword: int
) -> None:
    assume(process_data.TARGET_POSITION in entries)
    axis, pdo = made(offset=0.25), process_data.SetpointPdo(0x301, tuple(entries))
    axis.position_at, axis.velocity_at, axis.controlword_at = map(pdo.offset, range(3))
    axis.velocity_per_metre, axis.velocity_step, axis.velocity_bytes = 2e6, 2.0, 4
    axis.controlword, axis.target, axis.offset = controlword, 1.0, 2
    counts, speed = round((position - 0.25) * 1e6), round(velocity * 1e6)
    within = range(-(1 << 31), 1 << 31)
    fits = counts in within and (speed in within or not pdo.has_velocity)
    assert scale_setpoint(axis, position, velocity) == fits
    frame, data = pdo.frame(), np.zeros(8, np.uint8)
    if not fits:
        assert (axis.target, axis.offset) == (1.0, 2)
        return
    assert axis.offset == (speed if pdo.has_velocity else 0)
    put_setpoint(axis, data)
    pdo.fill(frame, counts, speed if pdo.has_velocity else 0, controlword)
    assert data.tobytes() == bytes(frame.packed[DATA_AT:]).ljust(8, b"\0")


@given(sampled_ago=st.integers(0, 9), syncs=st.integers(9, 30), length=st.integers(1, 6))
def test_a_position_is_compared_with_what_was_commanded_at_its_sync(sampled_ago: int, syncs: int, length: int) -> None:
    axis, commanded = made(), np.full(length, np.nan)
    for number in range(syncs + 1):
        commanded[number % length] = number
    axis.syncs, axis.sampled = syncs, syncs - sampled_ago
    assert due_setpoint(axis, commanded) == syncs - min(sampled_ago, length - 1)


@given(wanted=st.integers(0, 0xFFFF_FFFF), kept=st.integers(0, 0xFFFF_FFFF))
def test_outputs_leave_the_ones_that_nobody_uses_as_they_were(wanted: int, kept: int) -> None:
    axis, data = made(), np.zeros(4, np.uint8)
    axis.outputs, axis.outputs_kept = wanted, kept
    assert not outputs_pending(axis)
    axis.has_outputs = True
    assert outputs_pending(axis) == (wanted != 0)
    axis.outputs_sent = wanted
    assert not outputs_pending(axis)
    put_outputs(axis, data)
    assert data.tobytes() == (wanted | kept).to_bytes(4, "little")


@given(before=st.integers(1, 0xFFFF), after=st.integers(0, 0xFFFF))
def test_the_newest_statusword_is_kept_with_its_time(before: int, after: int) -> None:
    axis = made()
    accept_statusword(axis, before, 1.0)
    accept_statusword(axis, after, 2.0)
    assert (axis.statusword, axis.status_heard) == (after, 2.0)


@given(before=st.integers(1, 5), after=st.integers(1, 5))
def test_an_answer_is_late_once_where_it_comes_later_in_its_cycle_than_the_one_before(before: int, after: int) -> None:
    prompt, overdue = cast(list[Arrival], ["before the read"]), cast(list[Arrival], ["after the read"])
    axis = run(prompt * before + overdue * after)
    assert (axis.late, axis.lost) == (1, 0)


def test_a_second_answer_to_a_sync_is_not_late() -> None:
    axis = run(["before the read"])
    assert answered_sync(axis) == 1
    axis.answer()
    assert (axis.sampled, axis.late, axis.lost) == (1, 0, 0)


NEAR = st.integers(-3, 3) | st.integers(-(2**31), 2**31 - 1)


@given(newest=NEAR, step=NEAR, counts=NEAR, far_apart=st.integers(0, 5))
def test_a_second_position_turns_back_against_the_last_step_and_is_far_beyond_a_distance(
    newest: int, step: int, counts: int, far_apart: int
) -> None:
    axis = made()
    axis.newest, axis.step, axis.far_apart = newest, step, far_apart
    assert turns_back(axis, counts) == ((counts - newest) * step < 0)
    assert is_far(axis, counts) == (counts not in range(newest - far_apart, newest + far_apart + 1))


@given(prompt=st.booleans(), sampled=st.integers(0, 9), more=st.integers(1, 9))
def test_an_answer_that_is_not_due_yet_is_not_missing(prompt: bool, sampled: int, more: int) -> None:
    axis = made()
    axis.prompt, axis.sampled, axis.syncs = prompt, sampled, sampled + more
    assert unanswered(axis) == (more if prompt else more - 1)


def test_an_answer_to_the_sync_before_is_not_prompt() -> None:
    axis = made()
    count_sync(axis)
    count_sync(axis)
    accept_answer(axis, 1)
    assert (axis.came, axis.sampled, axis.prompt) == (True, 1, False)


@given(st.lists(st.integers(-(2**31), 2**31 - 1), min_size=1), st.floats(0.5, 1e4))
def test_positions_are_kept_with_the_last_step_and_since_when_the_slider_stands(
    positions: list[int], still: float
) -> None:
    axis = made(-2e5, 0.3)
    axis.still, axis.stands_since = still, math.inf
    stands_at, since, steps, before = axis.stands_at, math.inf, [axis.step], axis.newest
    for now, counts in enumerate(positions):
        accept_counts(axis, counts, float(now))
        if abs(counts - stands_at) > still:
            stands_at, since = counts, float(now)
        since = min(since, float(now))
        steps += [counts - before] if counts != before else []
        before = counts
        assert (axis.newest, axis.actual, axis.position) == (counts, counts, counts / -2e5 + 0.3)
        assert (axis.stands_at, axis.stands_since, axis.step) == (stands_at, since, steps[-1])


def test_a_slider_that_moved_just_as_far_as_allowed_still_stands() -> None:
    axis = made()
    axis.still, axis.stands_since = 10.0, math.inf
    for now, counts in enumerate((0, 10, -10, 11)):
        accept_counts(axis, counts, float(now))
        assert axis.stands_since == (0.0 if counts != 11 else 3.0)


def test_turns_become_metres() -> None:
    axis = made(25.0, -0.1)
    accept_turns(axis, 5.0)
    assert axis.position == 0.1
