"""The goals of a client: a refusal concerns its own call alone, and every handle of an accepted goal ends."""

from __future__ import annotations

import asyncio
import itertools
import time
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from msgspec import structs
from trirail.client import goal as goal_module
from trirail.client.goal import AsyncGoalHandle, OpenGoals, Result
from trirail.errors import RefusalCode, RefusedError, ServiceError, WaitTimeoutError
from trirail.wire.marks import Switch
from trirail.wire.messages import GoalReply

IDS = ("g1", "g2")


async def no_command(*_: object) -> Any:
    raise AssertionError("nothing was to be commanded")


def handle(goal_id: str) -> AsyncGoalHandle:
    return AsyncGoalHandle(goal_id, no_command, no_command, no_command)


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


def test_a_goal_whose_reply_comes_after_the_restart_of_the_service_is_over() -> None:
    async def wait() -> None:
        goals: OpenGoals = OpenGoals()
        goals.lose_others("r1")
        old, new = (goals.open(handle(name)) for name in IDS)
        goals.lose_others("r2")
        goals.accept(old, structs.replace(reply("g1"), run="r1"))
        with pytest.raises(ServiceError, match="started again: the end of goal g1 is unknown"):
            await old.wait(60.0)
        goals.accept(new, structs.replace(reply("g2"), run="r3"))  # of which no event has arrived yet
        with pytest.raises(WaitTimeoutError):
            await new.wait(0.0)

    asyncio.run(wait())


STEPS = ["open", "accept", "refuse", "end", "restart"]


@given(st.lists(st.tuples(st.sampled_from(STEPS), st.integers(0, 7)), max_size=40))
def test_every_handle_of_an_accepted_call_ends(steps: list[tuple[str, int]]) -> None:
    """Calls of several threads with few ids, answered in any order; the end of a goal may come before its answer.

    An answer may also come after the first event of the next run of the service. A service that starts again does not
    report the ends of earlier goals.
    """
    goals: OpenGoals = OpenGoals()
    under_way: list[tuple[AsyncGoalHandle, str]] = []
    accepted: list[AsyncGoalHandle] = []
    run = 0
    goals.lose_others("r0")
    for step, number in steps:
        if step == "open":
            under_way.append((goals.open(handle(IDS[number % 2])), f"r{run}"))
        elif step == "end":
            goals.end(Result(IDS[number % 2], "done", ""))
        elif step == "restart":
            run += 1
            goals.lose_others(f"r{run}")
            assert all(ended(each) for each in accepted)
        elif under_way:
            call, of_run = under_way.pop(number % len(under_way))
            if step == "accept":
                goals.accept(call, structs.replace(reply(call.id), run=of_run))
                accepted.append(call)
                assert ended(call) or of_run == f"r{run}"
            else:
                goals.refuse(call.id)
    for each, goal_id in itertools.product(accepted, IDS):
        if not ended(each) and each.id == goal_id:
            goals.end(Result(goal_id, "done", ""))
            assert each.result is not None
    for call, _ in under_way:
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


# ---------------------------------------------------------------------- a service that does not answer


@pytest.fixture
def hurried(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(goal_module, "CHECK_PERIOD_S", 0.01)
    monkeypatch.setattr(goal_module, "SILENT_AFTER_S", 0.5)


async def hangs() -> None:
    await asyncio.Event().wait()


@pytest.mark.usefixtures("hurried")
@pytest.mark.parametrize("error", [ServiceError("no robot answers"), RefusedError(RefusalCode.NOT_ALLOWED, "no")])
@pytest.mark.long
def test_a_wait_ends_if_the_service_is_silent_and_not_if_it_refuses(error: Exception) -> None:
    checks: list[None] = []

    async def check() -> None:
        checks.append(None)
        raise error

    async def wait() -> None:
        goal = AsyncGoalHandle("g1", no_command, check, no_command)
        if isinstance(error, ServiceError):
            with pytest.raises(ServiceError, match="the end of goal g1 is unknown: no robot answers"):
                await goal.wait()
        with pytest.raises(WaitTimeoutError):
            await goal.wait(0.3 if isinstance(error, ServiceError) else 0.8)
        assert len(checks) > 1
        goal.end(Result("g1", "done", ""))
        assert (await goal.wait()).outcome == "done"

    asyncio.run(wait())


def test_time_in_which_the_program_was_suspended_does_not_count_as_silence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(goal_module, "CHECK_PERIOD_S", 0.01)
    suspended, checks = [0.0], list[None]()
    clock = SimpleNamespace(monotonic=lambda: time.monotonic() + suspended[0])
    monkeypatch.setattr(goal_module, "time", clock)

    async def check() -> None:
        checks.append(None)
        if len(checks) == 1:
            suspended[0] = 1000.0
            raise ServiceError("no robot answers")

    async def wait() -> None:
        goal = AsyncGoalHandle("g1", no_command, check, no_command)
        with pytest.raises(WaitTimeoutError):
            await goal.wait(0.2)
        assert len(checks) > 1
        goal.end(Result("g1", "done", ""))

    asyncio.run(wait())


@pytest.mark.usefixtures("hurried")
@pytest.mark.parametrize("waiting", [False, True], ids=["missed before the wait", "missed during the wait"])
def test_a_wait_ends_if_the_end_may_have_been_missed_and_not_while_the_goal_is_in_progress(waiting: bool) -> None:
    present = True
    asked = asyncio.Event()

    async def is_present() -> bool:
        asked.set()
        return present

    async def check() -> None:
        pass

    async def wait() -> None:
        nonlocal present
        goals = OpenGoals()
        goals.accept(goal := goals.open(AsyncGoalHandle("g1", no_command, check, is_present)), reply("g1"))
        waits = asyncio.ensure_future(goal.wait())
        goals.miss(2, 1003)
        await asked.wait()
        await asyncio.sleep(0)
        present = False
        asked.clear()
        if waiting:
            goals.miss(1005, 2006)
        else:
            waits.cancel()
            goals.miss(1005, 2006)
            waits = asyncio.ensure_future(goal.wait())
        with pytest.raises(ServiceError, match="goal g1 is unknown: the client has missed events 1005 to 2006"):
            await waits
        present = True  # it was queued
        waits = asyncio.ensure_future(goal.wait())
        asked.clear()
        await asked.wait()
        goals.end(Result("g1", "done", ""))
        assert (await waits).outcome == "done"

    asyncio.run(wait())


@pytest.mark.usefixtures("hurried")
@given(st.lists(st.booleans(), max_size=12))
@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_wait_goes_on_while_the_service_answers_now_and_then(answers: list[bool]) -> None:
    async def wait() -> Result:
        left = iter(answers)

        async def check() -> None:
            if (answer := next(left, None)) is None:
                goal.end(Result("g1", "done", ""))
                await hangs()
            if not answer:
                raise ServiceError("no robot answers")

        goal = AsyncGoalHandle("g1", no_command, check, no_command)
        return await goal.wait()

    silent_s = 0.01 * max((len(list(run)) for answer, run in itertools.groupby(answers) if not answer), default=0)
    assume(silent_s < 0.1)  # far from the limit, however busy the machine is
    assert asyncio.run(wait()).outcome == "done"
