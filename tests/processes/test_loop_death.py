"""What is said in the place of a loop that has died: each goal that it had ends once, numbered after its last event."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rigs import Clock
from trirail.processes.heartbeats import Heartbeats
from trirail.processes.loop_death import LoopDeath
from trirail.wire.goals import PoseGoal
from trirail.wire.messages import Event
from trirail.wire.packets import ControlInput, EventReport, GoalRequest, Status


def alive() -> None:
    """Return that the loop has not ended."""


def request(goal_id: str) -> GoalRequest:
    return GoalRequest(1, "ann", goal_id, PoseGoal(0.0, 0.0, 0.0), 0)


def ended(seq: int, goal_id: str) -> EventReport:
    return EventReport(Event("goal", "info", "", id=goal_id, outcome="done", seq=seq, t=0.0, cycle=1, time=0.0))


@pytest.mark.parametrize(
    ("silent", "said"), [(0.02, "the loop has died"), (0.8, "the loop was frozen and has been killed")]
)
def test_the_goal_under_way_is_faulted(silent: float, said: str) -> None:
    clock = Clock()
    words = LoopDeath(0.001, alive, clock)
    clock.now += 60.0
    words.record_activity()
    words.follow(ended(7, "before"))
    words.follow(ControlInput(1, 3, 0, request("g-1")))
    clock.now += silent
    reason = f"{said}: the drives stop by their own watchdogs"
    assert str(words.reason) == reason
    events = words.events(250)
    assert [(event.seq, event.kind, event.message) for event in events] == [
        (8, "fault", reason),
        (9, "goal", f"goal g-1 faulted: {reason}"),
        (10, "mode", f"fault: {reason}"),
    ]
    assert (events[1].id, events[1].outcome, events[1].user, events[1].t) == ("g-1", "faulted", "ann", 0.25)


def test_a_slow_loop_is_not_taken_for_frozen() -> None:
    clock = Clock()
    words = LoopDeath(1.0, alive, clock)
    words.record_activity()
    clock.now += 1.0
    assert "has died" in str(words.reason)


@given(st.integers(1, 5000), st.integers(0, 5000))
def test_an_end_as_it_should_be_is_told_of_only_where_its_last_cycles_are_missing(cycle: int, missing: int) -> None:
    heartbeats = Heartbeats.create()
    words = LoopDeath(0.001, heartbeats.last_cycle)
    words.record_activity()
    words.follow(request("g-1"))
    assert words.reason is not None
    assert words.missing_cycles(cycle) == []
    heartbeats.record_end(cycle + missing)
    assert words.reason is None
    assert words.events(cycle) == []
    told = [(event.seq, event.level, event.cycle, event.params) for event in words.missing_cycles(cycle)]
    lacks = {"lost": 0.0, "skipped": 0.0, "absent": float(missing)}
    assert told == ([(1, "warning", cycle + missing + 1, lacks)] if missing else [])


def test_a_loop_that_never_turned_says_by_itself_why() -> None:
    assert LoopDeath(0.001, alive).events(0) == []


IDS = st.sampled_from("abcd")


@given(st.lists(st.tuples(st.sampled_from(["asked", "under way", "ended"]), IDS)))
def test_every_goal_ends_once(history: list[tuple[str, str]]) -> None:
    words = LoopDeath(0.001, alive)
    words.record_activity()
    begun: set[str] = set()
    over: set[str] = set()
    for what, name in history:
        if what == "ended":
            words.follow(ended(1, name))
            over.add(name)
        else:
            words.follow(request(name) if what == "asked" else Status(name, 1.0, None))
            begun.add(name)
    assert {name for name in "abcd" if words.is_open(name)} == begun - over
    said = [event.id for event in words.events(1) if event.outcome]
    assert sorted(filter(None, said)) == sorted(begun - over)
