"""Goals of several users at the planner: each user's in their order, the users by turns."""

from __future__ import annotations

import pytest
from control_rig import ControlRig
from hypothesis import given, settings
from hypothesis import strategies as st
from trirail.wire.goals import PoseGoal
from trirail.wire.packets import Accepted, GoalRequest, Refused


def order(rig: ControlRig, users: list[str]) -> list[str]:
    """Send a goal of each user named, all in one cycle; return whose were answered, in order."""
    answered = len(rig.answers)
    now_ns = round(rig.now * 1e9)
    for number, user in enumerate(users):
        goal = PoseGoal(x=0.001 * number, y=0.0, phi=0.0)
        rig.control.handle(GoalRequest(number, user, f"{rig.control.cycles}-{number}", goal, now_ns), now_ns)

    def answers() -> list[int]:
        return [said.ticket for said in rig.answers[answered:] if isinstance(said, Accepted | Refused)]

    rig.until(lambda: len(answers()) == len(users))
    for user in users:
        own = [ticket for ticket in answers() if users[ticket] == user]
        assert own == sorted(own)
    return [users[ticket] for ticket in answers()]


@pytest.fixture
def rig() -> ControlRig:
    return ControlRig()


def test_who_sends_many_waits_for_himself(rig: ControlRig) -> None:
    rig.enable()
    assert order(rig, ["eve", "eve", "eve", "eve", "ann", "bob", "ann"]) == [
        "eve",
        "ann",
        "bob",
        "eve",
        "ann",
        "eve",
        "eve",
    ]
    assert order(rig, ["eve", "ann"]) == ["eve", "ann"]  # who was served before there was nobody is forgotten
    assert order(rig, ["ann", "eve"]) == ["ann", "eve"]


@settings(max_examples=20)
@given(st.lists(st.sampled_from(["ann", "bob", "eve"]), min_size=1, max_size=12))
def test_nobody_waits_for_more_than_one_goal_of_each_other(users: list[str]) -> None:
    rig = ControlRig()
    rig.enable()
    left = {user: users.count(user) for user in users}
    since: dict[str, list[str]] = {user: [] for user in left}
    for served in order(rig, users):
        left[served] -= 1
        for user, others in since.items():
            if user != served and left[user]:
                others.append(served)
                assert len(others) == len(set(others))
        since[served].clear()
