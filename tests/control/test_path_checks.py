"""A check plans as a goal would, and nothing moves: beside goals, stops, and a planner that dies or says nothing."""

from __future__ import annotations

import itertools

import pytest
from control.test_plan_requests import Meddler
from control_rig import ControlRig, expected_duration
from trirail.wire.goals import Goal, MoveGoal, PoseGoal, TrajectoryGoal, TrajectoryPoint
from trirail.wire.kinds.named import NamedGoal
from trirail.wire.marks import Mark, StopAt
from trirail.wire.messages import GoalReply
from trirail.wire.packed_trajectory import packed
from trirail.wire.packets import Accepted, Checked, CheckRequest, Disturbance, PlannerLost, Refused
from trirail.wire.vocabulary import Mode

TICKETS = itertools.count(1000)
FAR = PoseGoal(0.3, 0.0, 0.0)
NEAR = PoseGoal(0.05, 0.0, 0.0)


@pytest.fixture
def rig() -> ControlRig:
    return ControlRig()


def post(rig: ControlRig, goal: Goal) -> int:
    ticket = next(TICKETS)
    rig.cycle(CheckRequest(ticket, "bob", goal))
    return ticket


def answer_to(rig: ControlRig, ticket: int) -> Checked | Refused:
    found = [answer for answer in rig.answers if isinstance(answer, Checked | Refused) and answer.ticket == ticket]
    assert len(found) == 1, rig.answers
    return found[0]


def answered(rig: ControlRig, ticket: int) -> bool:
    return any(isinstance(answer, Checked | Refused) and answer.ticket == ticket for answer in rig.answers)


def check(rig: ControlRig, goal: Goal) -> Checked | Refused:
    ticket = post(rig, goal)
    rig.until(lambda: answered(rig, ticket), 20)
    return answer_to(rig, ticket)


def reply(rig: ControlRig, goal: Goal) -> GoalReply:
    found = check(rig, goal)
    assert isinstance(found, Checked), found
    return found.reply


def code(rig: ControlRig, goal: Goal) -> str:
    found = check(rig, goal)
    assert isinstance(found, Refused), found
    return found.code


def test_a_check_says_what_the_goal_would_be_told_and_nothing_moves(rig: ControlRig) -> None:
    rig.enable()
    rig.notices.clear()
    begin = rig.rows[-1]
    checked, refused = reply(rig, NEAR), check(rig, FAR)
    assert (rig.notices, rig.rows[-1], rig.mode) == ([], begin, Mode.HOLDING)
    accepted = rig.send("g1", NEAR)
    assert isinstance(accepted, Accepted)
    assert checked.duration == accepted.reply.duration
    rig.until(rig.holds)
    rig.goal("g2", 0.0, 0.0, 0.0)
    rig.until(rig.holds)
    told = rig.send("g3", FAR)
    assert isinstance(refused, Refused)
    assert isinstance(told, Refused)
    assert (refused.code, refused.message, refused.limit) == (told.code, told.message, told.limit)


@pytest.mark.parametrize("mode", ["disabled", "fault"])
def test_a_robot_without_power_checks_too(rig: ControlRig, mode: str) -> None:
    if mode == "fault":
        rig.enable()
        rig.command("quick_stop")
    rig.until(lambda: rig.mode == mode)
    assert reply(rig, NEAR).duration is not None
    assert code(rig, FAR) == "out_of_workspace"
    assert rig.mode == mode


def test_an_id_is_no_goals_and_may_be_used_again(rig: ControlRig) -> None:
    rig.enable()
    named = PoseGoal(0.05, 0.0, 0.0, id="g1")
    assert (reply(rig, named).id, reply(rig, named).id, reply(rig, NEAR).id) == ("g1", "g1", "")
    assert isinstance(rig.send("g1", named), Accepted)


def test_each_kind_with_a_path_is_checked(rig: ControlRig) -> None:
    rig.enable()
    points = tuple(TrajectoryPoint(t, 0.01 * t, 0.0, 0.0) for t in (0.0, 1.0, 2.0))
    assert reply(rig, packed(TrajectoryGoal(points))).duration == pytest.approx(2.0, abs=0.01)
    assert code(rig, packed(TrajectoryGoal(points[1:]))) == "wrong_start"
    assert reply(rig, MoveGoal(0.01, 0.0, 0.0)).duration is not None
    assert code(rig, MoveGoal(0.01, 0.0, 0.0, frame="nowhere")) == "unknown_frame"
    assert code(rig, NamedGoal("nowhere")) == "unknown_pose"
    assert code(rig, PoseGoal(0.05, 0.0, 0.0, marks=(Mark("valve", after_start=0.0),))) == "unknown_output"
    assert code(rig, PoseGoal(0.05, 0.0, 0.0, stop_at=StopAt("probe"))) == "unknown_output"


def test_during_a_motion_a_check_begins_at_its_end(rig: ControlRig) -> None:
    rig.enable()
    rig.goal("g1", 0.05, 0.0, 0.0)
    rig.cycles(100)
    duration = reply(rig, PoseGoal(0.0, 0.0, 0.0)).duration
    assert rig.mode is Mode.MOVING
    assert reply(rig, MoveGoal(-0.05, 0.0, 0.0)).duration == duration
    rig.until(rig.holds)
    assert rig.outcomes() == [("g1", "done")]
    assert expected_duration(rig.goal("g2", 0.0, 0.0, 0.0)) == duration


def test_a_goal_overtakes_a_check_which_is_answered_behind_it(rig: ControlRig) -> None:
    meddler = Meddler(rig)
    rig.control._checks._port = meddler
    rig.enable()
    meddler.delays = [200, 5, 5]
    ticket = post(rig, NEAR)
    meddler.waiting.clear()  # as the planner does with a request that a newer one overtakes
    rig.post("g1", PoseGoal(0.02, 0.0, 0.0))
    rig.until(lambda: rig.mode is Mode.MOVING, 10)
    assert not answered(rig, ticket)
    rig.until(lambda: answered(rig, ticket), 10)
    assert isinstance(answer_to(rig, ticket), Checked)
    rig.until(rig.holds)
    assert rig.outcomes() == [("g1", "done")]


def test_a_check_that_arrives_behind_a_goal_waits_until_that_is_planned(rig: ControlRig) -> None:
    meddler = Meddler(rig)
    rig.control._checks._port = meddler
    rig.enable()
    meddler.delays = [20, 1]
    rig.post("g1", PoseGoal(0.02, 0.0, 0.0))
    ticket = post(rig, NEAR)
    assert [request.number > 0 for request in meddler.asked] == [True]
    rig.until(lambda: answered(rig, ticket), 30)
    assert rig.mode is Mode.MOVING
    assert isinstance(answer_to(rig, ticket), Checked)


def test_a_stop_of_the_goal_before_it_frees_the_planner_for_a_check(rig: ControlRig) -> None:
    meddler = Meddler(rig)
    rig.control._checks._port = meddler
    rig.enable()
    meddler.delays = [2000, 1]
    rig.post("g1", PoseGoal(0.02, 0.0, 0.0))
    ticket = post(rig, NEAR)
    assert rig.control.steady_state() is not None
    rig.order("stop")
    rig.until(lambda: answered(rig, ticket), 10)
    assert isinstance(answer_to(rig, ticket), Checked)


def test_several_checks_are_answered_in_their_order(rig: ControlRig) -> None:
    tickets = [post(rig, goal) for goal in (NEAR, FAR, NEAR)]
    rig.until(lambda: answered(rig, tickets[-1]), 20)
    assert [type(answer_to(rig, ticket)) for ticket in tickets] == [Checked, Refused, Checked]


def test_a_lost_planner_and_a_lost_gateway_end_checks(rig: ControlRig) -> None:
    meddler = Meddler(rig)
    rig.control._checks._port = meddler
    meddler.change = lambda _: [PlannerLost("the planner has died")]
    assert code(rig, NEAR) == "planner_lost"
    meddler.change = lambda _: []
    tickets = [post(rig, NEAR), post(rig, NEAR)]
    rig.control.handle(Disturbance("GATEWAY_LOST", "the gateway has died"), 0)
    rig.cycle()
    assert [getattr(answer_to(rig, ticket), "code", "") for ticket in tickets] == ["busy", "busy"]
    meddler.change = lambda answer: [answer]
    assert reply(rig, NEAR).duration is not None


def test_an_answer_comes_once_and_a_late_one_is_ignored(rig: ControlRig) -> None:
    meddler = Meddler(rig)
    rig.control._checks._port = meddler
    meddler.change = lambda answer: [answer, answer]
    first, second = post(rig, NEAR), post(rig, FAR)
    rig.cycles(20)
    assert isinstance(answer_to(rig, first), Checked)
    assert isinstance(answer_to(rig, second), Refused)
