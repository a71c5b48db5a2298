"""The goals of a client: a refusal concerns its own call alone, and every handle of an accepted goal ends."""

from __future__ import annotations

import asyncio
import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import structs
from trirail.client.goal import AsyncGoalHandle, OpenGoals, Result
from trirail.errors import ServiceError, WaitTimeoutError
from trirail.wire.marks import Switch
from trirail.wire.messages import GoalReply

IDS = ("g1", "g2")


def handle(goal_id: str) -> AsyncGoalHandle:
    async def command(*_: object) -> None:
        raise AssertionError("nothing was to be commanded")

    return AsyncGoalHandle(goal_id, command)


def reply(goal_id: str) -> GoalReply:
    return GoalReply(goal_id, 1.0)


def test_a_used_id_that_is_refused_leaves_the_first_handle() -> None:
    goals: OpenGoals = OpenGoals()
    first = goals.open(handle("g1"))
    goals.accept(first, reply("g1"))
    goals.open(handle("g1"))
    assert not goals.refuse("g1")
    goals.end(Result("g1", "done", ""))
    assert first.result is not None
    assert repr(first) == "<AsyncGoalHandle g1 done>"


def ended(goal: AsyncGoalHandle) -> bool:
    """Whether a wait for the goal returns at once, or raises an error."""
    return goal._ended.is_set()


def test_a_wait_for_a_goal_of_an_earlier_run_is_over() -> None:
    async def wait() -> None:
        goals: OpenGoals = OpenGoals()
        goals.accept(goal := goals.open(handle("g1")), structs.replace(reply("g1"), run="r1"))
        goals.lose_others("r1")
        with pytest.raises(WaitTimeoutError):
            await goal.wait(0.0)
        goals.lose_others("r2")
        with pytest.raises(ServiceError, match="started again: the end of goal g1 is unknown"):
            await goal.wait()

    asyncio.run(wait())


STEPS = ["open", "accept", "refuse", "end", "restart"]


@given(st.lists(st.tuples(st.sampled_from(STEPS), st.integers(0, 7)), max_size=40))
def test_every_handle_of_an_accepted_call_ends(steps: list[tuple[str, int]]) -> None:
    """Calls of several threads with few ids, answered in any order; the end of a goal may come before its answer.

    A service that starts again does not report the ends of earlier goals.
    """
    goals: OpenGoals = OpenGoals()
    under_way: list[AsyncGoalHandle] = []
    accepted: list[AsyncGoalHandle] = []
    run = 0
    for step, number in steps:
        if step == "open":
            under_way.append(goals.open(handle(IDS[number % 2])))
        elif step == "end":
            goals.end(Result(IDS[number % 2], "done", ""))
        elif step == "restart":
            run += 1
            goals.lose_others(f"r{run}")
            assert all(ended(each) for each in accepted)
        elif under_way:
            call = under_way.pop(number % len(under_way))
            if step == "accept":
                goals.accept(call, structs.replace(reply(call.id), run=f"r{run}"))
                accepted.append(call)
            else:
                goals.refuse(call.id)
    for each, goal_id in itertools.product(accepted, IDS):
        if not ended(each) and each.id == goal_id:
            goals.end(Result(goal_id, "done", ""))
            assert each.result is not None
    for call in under_way:
        goals.refuse(call.id)
    for goal_id in IDS:
        goals.end(Result(goal_id, "done", ""))
    assert not goals
    assert not goals._calls
    assert not goals._accepted


def test_a_restarted_gateway_repeats_switches_that_the_result_has_once() -> None:
    goals: OpenGoals = OpenGoals()
    goal = goals.open(handle("g1"))
    goals.accept(goal, reply("g1"))
    switch = Switch("g1", 0, "gripper", True, 500, 0.5, 1e9, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    later = structs.replace(switch, mark=1, value=False, cycle=600, t=0.6)
    goals.note_switches((switch,))
    goals.note_switches((switch,))  # from a restarted gateway, in an event that is another object
    goals.note_switches((later,))
    goals.end(Result("g1", "stopped", "the gateway has died: controlled stop"))
    assert goal.result is not None
    assert goal.result.marks == (switch, later)
