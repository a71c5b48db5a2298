"""The planner beside the control: late, twice, for another motion, garbage, or never; no stop waits for it."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import msgspec
import numpy as np
import pytest
from control.test_control import assert_within_limits
from control.test_stop import PROMPT, STEP, braking, confirmed_after, play
from control_rig import CONFIG, ControlRig, expected_duration
from hypothesis import example, given, settings
from hypothesis import strategies as st
from trirail.control.goal_queue import MAX_PASSES
from trirail.motion.feasibility import SampleResult
from trirail.motion.motion_planner import MotionPlanner, revision
from trirail.motion.packing import unpack_run
from trirail.motion.paths import Path
from trirail.motion.runs import nominal_motion
from trirail.motion.time_scaling import TimeScaling
from trirail.wire.goals import Goal, PoseGoal, TrackGoal, TrajectoryGoal, TrajectoryPoint, VelocityGoal
from trirail.wire.packets import Accepted, CommandRequest, GoalRequest, PlannerLost, Refused
from trirail.wire.plan_packets import (
    PackedPath,
    PathExtension,
    PlanAnswer,
    PlanRequest,
    PreemptingMotion,
    decode_plan_answer,
    decode_plan_request,
    encode,
)
from trirail.wire.sizes import MAX_PART, MAX_POINTS, MAX_SHARED
from trirail.wire.vocabulary import Command, Mode, Override, Stop

PERIOD = CONFIG.period
BUSY = round(0.5 / PERIOD)
"""Cycles for which the planner may say nothing before everyone is told."""
SILENT = round(8.0 / PERIOD)
"""Cycles that a goal waits for it."""
LEADS = (0.003, 0.012, 0.048)
"""How long before a motion from motion is to begin it is asked for, at the first, second and third time [s]."""


Said = PlanAnswer | PlannerLost


class Meddler:
    """In the place of a robot's planner: its answers can be changed, held back and repeated, as LocalPlanner else."""

    def __init__(self, rig: ControlRig) -> None:
        rig.planner = rig.control._planner._port = self  # type: ignore[assignment]
        self.planner = MotionPlanner(rig.config)
        self.asked: list[PlanRequest] = []
        self.waiting: list[tuple[int, Said]] = []
        self.turns = 0
        self.delays: list[int] = []
        """Cycles to each answer, the last one for all that follow."""
        self.change: Callable[[PlanAnswer], Sequence[Said]] = lambda answer: [answer]

    def request_plan(self, request: PlanRequest) -> None:
        delay = self.delays.pop(0) if len(self.delays) > 1 else (self.delays or [1])[0]
        self.asked.append(request)
        for answer in self.change(self.planner.plan(request)):
            self.waiting.append((self.turns + delay, answer))

    def answers(self) -> list[Said]:
        self.turns += 1
        due = [answer for turn, answer in self.waiting if turn <= self.turns]
        self.waiting = [(turn, answer) for turn, answer in self.waiting if turn > self.turns]
        return due


@pytest.fixture
def rig() -> ControlRig:
    return ControlRig()


@pytest.fixture
def meddler(rig: ControlRig) -> Meddler:
    """Of an enabled robot."""
    made = Meddler(rig)
    rig.enable()
    return made


def moving(rig: ControlRig) -> None:
    rig.goal("g1", 0.08, 0.0, 0.0)
    rig.cycles(200)


def code(rig: ControlRig) -> str:
    refused = rig.answers[-1]
    assert isinstance(refused, Refused), refused
    return refused.code


def test_a_goal_from_rest_begins_when_its_motion_comes(rig: ControlRig, meddler: Meddler) -> None:
    meddler.delays = [100]
    sent = len(rig.rows)
    rig.post("g1", PoseGoal(0.05, 0.0, 0.0))
    rig.until(lambda: rig.mode is Mode.MOVING)
    assert len(rig.rows) - sent == 101
    rig.until(rig.holds)
    assert rig.outcomes() == [("g1", "done")]


def test_a_motion_from_motion_that_comes_too_late_is_asked_for_anew_with_more_time(
    rig: ControlRig, meddler: Meddler
) -> None:
    moving(rig)
    meddler.asked.clear()
    meddler.delays = [round(LEADS[0] / PERIOD) + 1, round(LEADS[1] / PERIOD) + 1, 5]
    rig.post("g2", PoseGoal(0.0, 0.05, 0.0))
    rig.until(lambda: ("g1", "preempted") in rig.outcomes())
    assert [request.lead for request in meddler.asked] == [round(lead / PERIOD) for lead in LEADS]
    rig.until(rig.holds)
    assert rig.outcomes() == [("g1", "preempted"), ("g2", "done")]
    assert rig.control.commanded.pose == pytest.approx((0.0, 0.05, 0.0))
    assert_within_limits(rig)


def test_goals_that_have_not_begun_end_in_the_cycle_of_a_stop() -> None:
    for name in (name for name in Command if name.stops):
        rig = ControlRig(delay=20)
        rig.enable()
        for number in range(2):
            rig.post(f"g{number}", PoseGoal(0.05, 0.0, 0.0))
        rig.order(name)
        outcome = "faulted" if name is Command.QUICK_STOP else "stopped"
        assert rig.outcomes() == [("g0", outcome), ("g1", outcome)]
        rig.cycles(50)
        assert [answer.code for answer in rig.answers if isinstance(answer, Refused)] == [outcome, outcome]
        assert not any(isinstance(answer, Accepted) for answer in rig.answers)


@pytest.mark.parametrize("name", [name for name in Command if name.stops])
@pytest.mark.parametrize("goals", [1, 3])
def test_goals_that_come_in_the_cycle_of_a_stop_never_begin(rig: ControlRig, name: Command, goals: int) -> None:
    """Also before a pause: what has not begun does not wait for resume."""
    rig.enable()
    sent = [f"g{number}" for number in range(goals)]
    for number, each in enumerate(sent):
        rig.more.append(GoalRequest(900 + number, "ann", each, PoseGoal(0.05, 0.0, 0.0), round(rig.now * 1e9)))
    rig.order(name)
    rig.cycles(50)
    outcome = "faulted" if name is Command.QUICK_STOP else "stopped"
    assert rig.outcomes() == [(each, outcome) for each in sent]
    assert not rig.setpoints()[:, 1].any()


@pytest.mark.generated(0, 1, 2)
def test_a_user_who_floods_the_queue_delays_each_goal_of_another_by_one_goal(
    rig: ControlRig, meddler: Meddler, seed: int
) -> None:
    chance = random.Random(seed)
    out = PoseGoal(5.0, 0.0, 0.0)  # it is refused
    meddler.delays = [chance.randrange(1, 6)]
    for number in range(300):
        rig.cycle(GoalRequest(9000 + number, "eve", f"e{number}", out, round(rig.now * 1e9)))
    for number in range(10):
        answered = len(rig.answers)
        for late in range(chance.randrange(3)):
            ticket = 10_000 + 10 * number + late
            rig.more.append(GoalRequest(ticket, "eve", f"e{ticket}", out, round(rig.now * 1e9)))
        rig.send(f"a{number}", out)
        assert len(rig.answers) - answered <= 2


def test_a_planner_that_is_always_late_is_asked_three_times(rig: ControlRig, meddler: Meddler) -> None:
    moving(rig)
    meddler.asked.clear()
    meddler.delays = [20, 60, 150]
    rig.post("g2", PoseGoal(0.0, 0.05, 0.0))
    rig.until(lambda: isinstance(rig.answers[-1], Refused))
    assert (code(rig), len(meddler.asked)) == ("no_plan", 3)
    rig.until(rig.holds)
    assert rig.outcomes() == [("g2", "rejected"), ("g1", "done")]
    assert rig.control.commanded.pose == pytest.approx((0.08, 0.0, 0.0))


@pytest.mark.parametrize("in_motion", [False, True])
def test_a_planner_that_says_nothing_costs_a_goal_and_what_is_under_way_goes_on(
    rig: ControlRig, meddler: Meddler, in_motion: bool
) -> None:
    if in_motion:
        moving(rig)
    meddler.change = lambda _: []
    sent = len(rig.rows)
    rig.post("lost", PoseGoal(0.0, 0.05, 0.0))
    rig.until(lambda: isinstance(rig.answers[-1], Refused), SILENT + 10)
    assert code(rig) == "expired"
    assert SILENT <= len(rig.rows) - sent <= SILENT + 3
    rig.until(rig.holds)
    assert dict(rig.outcomes()) == {"lost": "expired"} | ({"g1": "done"} if in_motion else {})
    meddler.change = lambda answer: [answer]
    assert isinstance(rig.goal("next", 0.0, 0.0, 0.0), Accepted)


@settings(max_examples=25)
@given(
    in_motion=st.booleans(),
    delays=st.lists(st.integers(1, 2 * BUSY), min_size=1, max_size=4),
    valid_for=st.one_of(st.none(), st.floats(0.01, 2.0)),
)
def test_a_goal_waits_its_own_time_for_a_planner_that_is_busy(
    in_motion: bool, delays: list[int], valid_for: float | None
) -> None:
    """Whatever each answer takes: it begins, or is refused when its own time is over, and either is said with why."""
    rig = ControlRig()
    busy = Meddler(rig)
    rig.enable()
    if in_motion:
        moving(rig)
    busy.asked.clear()
    busy.delays = list(delays)
    sent = len(rig.rows)
    answered = len(rig.answers)
    rig.post("g2", PoseGoal(0.0, 0.05, 0.0, valid_for=valid_for))
    rig.until(lambda: len(rig.answers) > answered, SILENT + 10)
    waited, answer = len(rig.rows) - sent, rig.answers[-1]
    longest = max([*delays, 1][: len(busy.asked)])
    told = [notice.message for notice in rig.notices if "the planner is busy" in notice.message]
    if isinstance(answer, Accepted):
        assert valid_for is None or waited <= valid_for / PERIOD + 2
        return
    assert isinstance(answer, Refused)
    if answer.code == "expired":
        assert valid_for is not None
        assert waited >= valid_for / PERIOD
        assert f"within its valid_for of {valid_for:g} s" in answer.message
    else:
        assert (answer.code, len(busy.asked)) == ("no_plan", 3)
    assert not told or longest > BUSY


def test_a_planner_that_has_died_is_said_at_once(rig: ControlRig, meddler: Meddler) -> None:
    moving(rig)
    meddler.change = lambda _: [PlannerLost("the planner has died")]
    rig.post("lost", PoseGoal(0.0, 0.05, 0.0))
    rig.cycles(2)
    assert code(rig) == "planner_lost"
    rig.until(rig.holds)
    assert rig.outcomes() == [("lost", "rejected"), ("g1", "done")]


def test_a_planner_that_dies_while_nobody_waits_for_it_any_more_costs_no_goal(
    rig: ControlRig, meddler: Meddler
) -> None:
    meddler.change = lambda _: []
    rig.post("g1", PoseGoal(0.05, 0.0, 0.0))
    rig.cycle(CommandRequest(99, "ann", Command.STOP, Stop("g1")))
    assert rig.outcomes() == [("g1", "stopped")]
    meddler.waiting.append((0, PlannerLost("the planner has died")))
    rig.cycles(2)
    meddler.change = lambda answer: [answer]
    assert isinstance(rig.goal("g2", 0.05, 0.0, 0.0), Accepted)


def test_a_goal_that_comes_while_a_trajectory_dwells_is_planned_from_where_it_goes_on(
    rig: ControlRig, meddler: Meddler
) -> None:
    """The robot stands, and the motion does not: its goal begins when it is told to, not as from rest."""
    still = {"velocity": (0.0, 0.0, 0.0), "acceleration": (0.0, 0.0, 0.0)}
    rows = (0.0, 0.0), (0.3, 0.01), (0.5, 0.01), (0.8, 0.02)
    rig.send("g1", TrajectoryGoal(tuple(TrajectoryPoint(t, x, 0.0, 0.0, **still) for t, x in rows)))
    schedule = rig.control.schedule
    rig.until(lambda: schedule.runs[0].law_state.s > 0.5 - 1.5 * PERIOD)
    assert rig.control.commanded.at_rest
    meddler.asked.clear()
    meddler.delays = [2]
    assert isinstance(rig.goal("g2", 0.0, 0.05, 0.0), Accepted)
    assert len(meddler.asked) == 1
    rig.until(rig.holds)
    assert rig.outcomes() == [("g1", "preempted"), ("g2", "done")]
    assert_within_limits(rig)


def test_a_goal_that_follows_another_waits_and_stops_nothing(rig: ControlRig) -> None:
    rig.enable()
    first = rig.send("g1", PoseGoal(0.05, 0.0, 0.0, blend=0.01))
    second = rig.send("g2", PoseGoal(0.0, 0.05, 0.0))
    assert isinstance(first, Accepted)
    assert isinstance(second, Accepted)
    assert (first.reply.queued, first.reply.stops_first, second.reply.queued, second.reply.stops_first) == (
        False,
        False,
        True,
        False,
    )
    left = expected_duration(first)
    assert left < expected_duration(second)
    begun = len(rig.rows)
    rig.until(rig.holds)
    dwell = CONFIG.limits.in_position.dwell
    assert (len(rig.rows) - begun) * PERIOD == pytest.approx(expected_duration(second) + dwell, abs=0.01)


def test_an_answer_that_comes_twice_is_taken_once(rig: ControlRig, meddler: Meddler) -> None:
    meddler.change = lambda answer: [answer, answer]
    for number, x in enumerate([0.05, -0.03, 0.02]):
        assert isinstance(rig.goal(f"g{number}", x, 0.0, 0.0), Accepted)
        rig.cycles(100)
    rig.until(rig.holds)
    assert rig.outcomes() == [("g0", "preempted"), ("g1", "preempted"), ("g2", "done")]
    assert_within_limits(rig)


def test_an_answer_for_another_motion_is_left_aside(rig: ControlRig, meddler: Meddler) -> None:
    moving(rig)
    meddler.change = lambda answer: [msgspec.structs.replace(answer, version=answer.version - 1)]
    rig.post("g2", PoseGoal(0.0, 0.05, 0.0))
    rig.until(lambda: len(rig.outcomes()) == 2, SILENT + 10)
    assert dict(rig.outcomes()) == {"g2": "expired", "g1": "done"}
    assert code(rig) == "expired"


def test_an_override_while_a_goal_is_planned_has_it_planned_from_the_new_motion(
    rig: ControlRig, meddler: Meddler
) -> None:
    moving(rig)
    meddler.delays = [2]
    rig.post("g2", PoseGoal(0.0, 0.05, 0.0))
    rig.order("override", 0.5)
    rig.until(rig.holds)
    assert rig.outcomes() == [("g1", "preempted"), ("g2", "done")]
    assert meddler.asked[-1].version > meddler.asked[-2].version
    assert_within_limits(rig)


@pytest.mark.parametrize("every", [5, 33])
@pytest.mark.parametrize("blend", [None, 0.01])
def test_a_goal_waits_until_the_override_is_lowered_no_more(
    rig: ControlRig, meddler: Meddler, every: int, blend: float | None
) -> None:
    rig.send("g1", PoseGoal(0.08, 0.0, 0.0, blend=blend))
    rig.cycles(150)
    meddler.delays = [10]
    rig.post("g2", PoseGoal(0.0, 0.05, 0.0))
    for percent in range(95, 45, -5):
        rig.order("override", percent / 100)
        rig.cycles(every - 1)
    rig.until(rig.holds)
    assert [outcome for _, outcome in rig.outcomes()] == ["preempted" if blend is None else "done", "done"]
    assert_within_limits(rig)


def test_a_jog_goes_on_while_the_override_is_lowered(rig: ControlRig, meddler: Meddler) -> None:
    meddler.delays = [10]
    for number in range(40):
        rig.post("j1", VelocityGoal(0.05, 0.0, 0.0, timeout=0.3))
        rig.cycles(20)
        rig.order("override", 1.0 - 0.02 * number)
        rig.cycles(10)
    assert (rig.mode, rig.outcomes()) == (Mode.MOVING, [])


@pytest.mark.parametrize("overtaken", [False, True])
def test_a_goal_during_whose_planning_the_override_is_changed_for_ever_is_refused_with_the_reason(
    rig: ControlRig, meddler: Meddler, monkeypatch: pytest.MonkeyPatch, overtaken: bool
) -> None:
    """The planner answers too late, or not at all because each request is overtaken by the next."""
    monkeypatch.setattr("trirail.control.plan_requests.PLANNING_TIMEOUT_S", 1.0)
    rig.send("g1", PoseGoal(0.12, 0.0, 0.0, speed=0.02))
    rig.cycles(200)
    meddler.asked.clear()
    meddler.delays = [30]
    if overtaken:
        meddler.change = lambda _: []
    rig.post("g2", PoseGoal(0.0, 0.05, 0.0))
    answered = len(rig.answers)
    for number in range(60):
        rig.order("override", 1.0 - 0.002 * number)
        rig.cycles(24)
    (refused,) = [answer for answer in rig.answers[answered:] if isinstance(answer, Refused)]
    assert refused.code == "no_plan"
    assert "no plan was ready within 1 s while the motion was changing" in refused.message
    assert len(meddler.asked) > 10
    assert not any("the planner is busy" in notice.message for notice in rig.notices)
    assert dict(rig.outcomes()) == {"g2": "rejected"}
    meddler.change = lambda answer: [answer]
    rig.order("override", 1.0)
    assert isinstance(rig.send("g3", PoseGoal(0.0, 0.05, 0.0), within=500), Accepted)


def test_a_motion_that_begins_elsewhere_is_never_begun(rig: ControlRig, meddler: Meddler) -> None:
    """It has the right number and the right version: where the robot is to be then it does not begin."""
    moving(rig)

    def elsewhere(answer: PlanAnswer) -> list[PlanAnswer]:
        assert isinstance(answer, PreemptingMotion)
        pieces = np.frombuffer(answer.run.path.pieces).copy()
        pieces[0] += 1e-5
        path = msgspec.structs.replace(answer.run.path, pieces=pieces.tobytes())
        return [msgspec.structs.replace(answer, run=msgspec.structs.replace(answer.run, path=path))]

    meddler.change = elsewhere
    rig.post("g2", PoseGoal(0.0, 0.05, 0.0))
    rig.until(rig.holds)
    assert rig.outcomes() == [("g2", "rejected"), ("g1", "done")]
    assert rig.control.fault is None


@pytest.mark.parametrize("coordinate", range(3))
@pytest.mark.parametrize("power", range(3))
def test_a_continuation_that_begins_elsewhere_is_never_appended(
    rig: ControlRig, meddler: Meddler, coordinate: int, power: int
) -> None:
    """A goal that is to follow the one under way: beside its end in position, velocity or acceleration."""

    def elsewhere(answer: PlanAnswer) -> list[PlanAnswer]:
        assert isinstance(answer, PathExtension)
        pieces = np.frombuffer(answer.path.pieces).copy()
        pieces[6 * coordinate + power] += (1e-6, 1e-4, 1e-2)[power]
        return [msgspec.structs.replace(answer, path=msgspec.structs.replace(answer.path, pieces=pieces.tobytes()))]

    rig.send("g1", PoseGoal(0.08, 0.0, 0.0, blend=0.01))
    rig.cycles(100)
    meddler.change = elsewhere
    rig.post("g2", PoseGoal(0.0, 0.05, 0.0))
    rig.until(rig.holds)
    assert rig.outcomes() == [("g2", "rejected"), ("g1", "done")]
    assert rig.control.fault is None


GARBAGE = [
    PackedPath(b"", b""),
    PackedPath(b"123", b"45"),
    PackedPath(np.array([0.0, 1.0]).tobytes(), np.zeros(17).tobytes()),
    PackedPath(np.array([0.0, 1.0]).tobytes(), np.full(18, math.nan).tobytes()),
    PackedPath(np.array([1.0, 0.0]).tobytes(), np.zeros(18).tobytes()),
    PackedPath(np.array([0.0, 1.0]).tobytes(), np.zeros(18).tobytes()),  # a path, that lies elsewhere
]


@pytest.mark.parametrize("place", ["path", "law"])
@pytest.mark.parametrize("garbage", GARBAGE)
@pytest.mark.parametrize("prepared", [False, True])
def test_garbage_is_refused_and_the_motion_goes_on(
    rig: ControlRig, meddler: Meddler, garbage: PackedPath, place: str, prepared: bool
) -> None:
    moving(rig)

    def spoilt(answer: PlanAnswer) -> list[PlanAnswer]:
        assert isinstance(answer, PreemptingMotion)
        spoilt = msgspec.structs.replace(answer, run=msgspec.structs.replace(answer.run, **{place: garbage}))
        if prepared:
            rig.control.prepare(spoilt)
        return [spoilt]

    meddler.change = spoilt
    rig.post("g2", PoseGoal(0.0, 0.05, 0.0))
    rig.until(rig.holds)
    assert rig.outcomes() == [("g2", "rejected"), ("g1", "done")]
    assert code(rig) in ("planner_lost", "no_plan")
    assert rig.control.fault is None


def test_an_error_while_an_answer_is_prepared_stops_the_robot_only_once_it_is_handled(
    rig: ControlRig, meddler: Meddler, monkeypatch: pytest.MonkeyPatch
) -> None:
    moving(rig)

    def fail(*_: object) -> None:
        raise RuntimeError("no memory")

    def prepared(answer: PlanAnswer) -> list[PlanAnswer]:
        rig.control.prepare(answer)
        assert rig.mode is Mode.MOVING
        return [answer]

    meddler.change = prepared
    monkeypatch.setattr("trirail.control.plan_requests.unpack_run", fail)
    rig.post("g2", PoseGoal(0.0, 0.05, 0.0))
    rig.until(lambda: rig.mode is Mode.FAULT)
    assert "no memory" in str(rig.control.fault)


def test_a_prepared_answer_is_unpacked_once(rig: ControlRig, meddler: Meddler, monkeypatch: pytest.MonkeyPatch) -> None:
    moving(rig)
    unpacked: list[object] = []

    def noting(*given: Any) -> Any:
        unpacked.append(given)
        return unpack_run(*given)

    def prepared(answer: PlanAnswer) -> list[PlanAnswer]:
        rig.control.prepare(answer)
        return [answer]

    meddler.change = prepared
    monkeypatch.setattr("trirail.control.plan_requests.unpack_run", noting)
    rig.post("g2", PoseGoal(0.0, 0.05, 0.0))
    rig.until(rig.holds)
    assert len(unpacked) == 1


def test_a_jog_whose_dead_man_is_over_before_it_is_planned_does_not_begin(rig: ControlRig, meddler: Meddler) -> None:
    meddler.delays = [300]
    rig.post("j1", VelocityGoal(0.05, 0.0, 0.0, timeout=0.2))
    rig.cycles(400)
    assert rig.outcomes() == [("j1", "expired")]
    assert not rig.setpoints()[-400:, 1].any()


def answers_more_than(rig: ControlRig, before: int) -> bool:
    return len(rig.answers) > before


def test_a_goal_may_begin_for_as_long_as_it_is_valid_and_not_a_cycle_longer(rig: ControlRig, meddler: Meddler) -> None:
    valid = 100  # cycles
    begun: list[int] = []
    refused: list[int] = []
    for number, delay in enumerate(range(valid - 5, valid + 5)):
        meddler.delays = [delay]
        goal = PoseGoal(0.001 * (1 + number % 2), 0.0, 0.0, valid_for=valid * PERIOD)
        rig.cycle(GoalRequest(900 + number, "ann", f"g{number}", goal, round((rig.now + PERIOD) * 1e9)))
        sent, answered = rig.control.cycles, len(rig.answers)
        rig.until(partial(answers_more_than, rig, answered))
        (begun if isinstance(rig.answers[-1], Accepted) else refused).append(rig.control.cycles - sent)
        rig.until(rig.holds)
    assert max(begun) == valid
    assert set(refused) == {valid + 1}


def test_a_jog_is_over_in_time_though_its_renewals_are_never_answered(rig: ControlRig, meddler: Meddler) -> None:
    jog = VelocityGoal(0.05, 0.0, 0.0, timeout=0.1)
    rig.send("j1", jog)
    meddler.change = lambda _: []
    for _ in range(10):
        rig.post("j1", jog)
        rig.cycles(20)
    rig.cycles(round(0.1 / PERIOD) + braking(CONFIG) + PROMPT)
    assert rig.control.commanded.at_rest
    rig.cycles(SILENT)
    assert rig.mode is Mode.HOLDING


@pytest.mark.parametrize("every", [10, 33])
@pytest.mark.parametrize("delay", [4, 12, 19])
def test_a_jog_goes_on_and_turns_round_though_its_renewals_come_faster_than_plans(
    rig: ControlRig, meddler: Meddler, every: int, delay: int
) -> None:
    meddler.delays = [delay]
    for number in range(60):
        rig.post("j1", VelocityGoal(0.03 if number < 40 else -0.03, 0.0, 0.0, timeout=0.1))
        rig.cycles(every - 1)
    assert rig.outcomes() == []
    assert rig.control.commanded.velocity[0] == pytest.approx(-0.03)
    rig.until(rig.holds)
    assert rig.outcomes() == [("j1", "done")]
    answered = [answer.ticket for answer in rig.answers if isinstance(answer, Accepted)]
    assert len(set(answered)) == len(answered) == 60


@pytest.mark.parametrize("goal", [VelocityGoal(0.05, 0.0, 0.0, timeout=0.2), TrackGoal(0.05, 0.0, 0.0)])
def test_renewals_that_came_before_the_goal_began_are_all_replaced_by_a_newer_one(
    rig: ControlRig, meddler: Meddler, goal: Goal
) -> None:
    meddler.delays = [60]
    for _ in range(5):
        rig.post("r1", goal)
        rig.cycles(10)
    rig.until(lambda: rig.mode is Mode.MOVING)
    rig.cycle()  # the planner has the first renewal
    rig.post("r1", goal)
    assert len([answer for answer in rig.answers if isinstance(answer, Accepted)]) == 4
    rig.cycles(130)
    assert len(meddler.asked) == 3


@settings(max_examples=30)
@given(st.integers(1, 190), st.integers(0, 12), st.integers(1, 90))
@example(140, 12, 10)
def test_a_jog_whose_first_plan_takes_long_lasts_from_its_newest_renewal(delay: int, renewals: int, every: int) -> None:
    rig, timeout = ControlRig(), 200
    Meddler(rig).delays = [delay, 2]
    rig.enable()
    for number in range(renewals + 1):
        rig.cycles(every - 1 if number else 0)
        rig.post("j1", VelocityGoal(0.01, 0.0, 0.0, timeout=timeout * PERIOD))
    speeds = [rig.control.commanded.velocity[0]]
    for _ in range(timeout - 1):
        rig.cycle()
        speeds.append(rig.control.commanded.velocity[0])
    assert speeds[-1] > 0.0
    assert min(np.diff(speeds)) > -1e-9  # it does not brake yet
    rig.cycles(braking(CONFIG) + PROMPT)
    assert rig.outcomes() == [("j1", "done")]


@pytest.mark.parametrize("goal", [VelocityGoal(0.05, 0.0, 0.0, timeout=0.2), TrackGoal(0.05, 0.0, 0.0)])
def test_a_goal_that_is_renewed_does_not_wait_as_long_as_the_planning_before_it_took(
    rig: ControlRig, meddler: Meddler, goal: Goal
) -> None:
    meddler.delays = [300, 2]
    rig.post("g1", PoseGoal(0.08, 0.0, 0.0))
    rig.cycles(400)
    assert isinstance(rig.send("r1", goal, within=200), Accepted)
    assert ("g1", "preempted") in rig.outcomes()


VALID = st.none() | st.integers(1, 200).map(lambda cycles: cycles * PERIOD)
SENT = st.tuples(
    st.sampled_from(["ann", "eve"]),
    st.builds(PoseGoal, st.just(0.02), st.just(0.0), st.just(0.0), valid_for=VALID, blend=st.sampled_from([None, 0.01]))
    | st.builds(VelocityGoal, st.just(0.01), st.just(0.0), st.just(0.0), valid_for=VALID, timeout=st.just(0.1)),
)


@settings(max_examples=40)
@given(st.lists(SENT, min_size=1, max_size=4), st.lists(st.integers(1, 250), min_size=1), st.sampled_from([0.0, 1.0]))
@example([("ann", PoseGoal(0.02, 0.0, 0.0, valid_for=0.05))], [200], 1.0)
@example([("ann", VelocityGoal(0.02, 0.0, 0.0, timeout=0.05))], [200], 1.0)
@example([("ann", PoseGoal(0.02, 0.0, 0.0, valid_for=0.05))], [1], 0.0)
def test_the_queue_decides_nothing_before_the_cycle_that_it_has_named(
    sent: list[tuple[str, Goal]], delays: list[int], rate: float
) -> None:
    """Until then compiled code runs the cycles, unless something is received."""
    rig = ControlRig()
    meddler = Meddler(rig)
    meddler.delays = delays
    rig.enable()
    rig.command("override", rate)
    queue = rig.control.goal_queue

    def decided() -> tuple[int, list[object]]:
        return len(rig.answers), [end for end in rig.outcomes() if end[1] == "expired"]

    for number, (user, goal) in enumerate(sent):
        rig.cycle(GoalRequest(9000 + number, user, f"g{number}", goal, round((rig.now + 0.5 * PERIOD) * 1e9)))
        for _ in range(100):
            cycle = rig.control.modes.cycle
            received = any(turn <= meddler.turns + 1 for turn, _ in meddler.waiting)
            due, before = queue.due(cycle), decided()
            rig.cycle()
            assert received or due <= cycle or decided() == before


class Silent(ControlRig):
    """A robot whose planner is as a test wants it to be from some time on."""

    def spoil(self, how: str) -> None:
        if how == "frozen":
            self.planner.delay = 10**9
        elif how == "killed":
            self.planner.request_plan = lambda request: None  # type: ignore[method-assign]
        elif how == "late":
            self.planner.delay = 40


@pytest.mark.parametrize("how", ["frozen", "killed", "late"])
@settings(max_examples=15)
@given(st.lists(STEP, min_size=1, max_size=5), st.lists(STEP, max_size=8))
def test_a_stop_is_confirmed_in_time_whatever_the_planner_does(
    how: str, before: list[tuple[object, int]], after: list[tuple[object, int]]
) -> None:
    rig = Silent()
    rig.command("enable")
    play(rig, before)
    rig.spoil(how)
    play(rig, after)
    assert confirmed_after(rig, "stop", braking(CONFIG) + PROMPT + 5000) <= braking(CONFIG) + PROMPT
    assert rig.control.commanded.at_rest


def test_a_stop_behind_a_flood_of_goals_is_confirmed_in_time(rig: ControlRig, meddler: Meddler) -> None:
    moving(rig)
    for number in range(200):
        rig.post(f"f{number}", PoseGoal(0.05, 0.001 * number - 0.1, 0.0))
    assert confirmed_after(rig, "stop", braking(CONFIG) + PROMPT) <= braking(CONFIG) + PROMPT
    counted = [goal for goal, _ in rig.outcomes()]
    assert len(counted) == len(set(counted)) == 201


def wave(points: int, seconds: float) -> TrajectoryGoal:
    """A trajectory there and back, with as many points as there may be."""
    times = np.linspace(0.0, seconds, points)
    x = 0.02 * (1.0 - np.cos(2.0 * np.pi * times / seconds)) ** 2 / 4.0
    return TrajectoryGoal(tuple(TrajectoryPoint(float(t), float(x), 0.0, 0.0) for t, x in zip(times, x, strict=True)))


@pytest.mark.parametrize("wait", [50, 200, 350, 600])
def test_a_stop_on_the_longest_path_is_confirmed_in_time(rig: ControlRig, wait: int) -> None:
    rig.enable()
    assert isinstance(rig.send("g1", wave(MAX_POINTS, 1.0)), Accepted)
    rig.cycles(wait)
    assert confirmed_after(rig, "stop", braking(CONFIG) + PROMPT + 500) <= braking(CONFIG) + PROMPT
    assert_within_limits(rig)


def at_rate(rate_hz: int) -> ControlRig:
    """A robot with another period, and a bus that is fast enough for that, enabled."""
    loop = msgspec.structs.replace(CONFIG.loop, rate_hz=rate_hz)
    rig = ControlRig(
        msgspec.structs.replace(CONFIG, loop=loop, can=msgspec.structs.replace(CONFIG.can, bitrate=8_000_000))
    )
    rig.enable()
    return rig


@pytest.mark.parametrize(("rate_hz", "most"), [(4000, 8), (1000, 24), (200, 120)])
def test_no_cycle_looks_at_more_of_the_longest_path_than_it_has_time_for(
    monkeypatch: pytest.MonkeyPatch, rate_hz: int, most: int
) -> None:
    """However many points a path has, a change of rate looks at a bounded part of it in each cycle [knots]."""
    rig = at_rate(rate_hz)
    rig.send("g1", wave(MAX_POINTS, 1.2))
    looked: list[int] = []
    sample = TimeScaling.sample

    def counted(self: TimeScaling, path: Path, law: Path, first: float, until: float, pose: Any) -> SampleResult:
        begin, end = (nominal_motion(law, time).pose[0] for time in (first, until))
        looked.append(int(((path.knots > begin) & (path.knots < end)).sum()))
        return sample(self, path, law, first, until, pose)

    monkeypatch.setattr(TimeScaling, "sample", counted)
    for name, value in (("override", 2.0), ("override", 0.3), ("pause", None), ("resume", None), ("stop", None)):
        rig.order(name, value)
        for _ in range(60):
            before = len(looked)
            rig.cycle()
            assert len(looked) - before <= 1
    assert len(looked) > 5
    assert most // 2 < max(looked) <= most


def test_at_a_slow_rate_an_answer_has_two_cycles_to_come_in() -> None:
    """The first lead of 3 ms is less than a cycle of 5 ms, and what is asked in one cycle is answered in the next."""
    rig = at_rate(200)
    made = Meddler(rig)
    rig.goal("g1", 0.08, 0.0, 0.0)
    rig.cycles(40)
    assert isinstance(rig.goal("g2", 0.0, 0.05, 0.0), Accepted)
    assert [request.lead for request in made.asked[1:]] == [2]


def test_a_goal_waits_for_a_change_of_rate_for_a_dozen_cycles_and_no_longer(rig: ControlRig, meddler: Meddler) -> None:
    """To find out how fast the rest of the longest path can be taken needs more than that."""
    rig.send("g1", wave(MAX_POINTS, 1.2))
    rig.cycles(100)
    meddler.asked.clear()
    rig.order("override", 2.0)
    rig.post("g2", PoseGoal(0.0, 0.05, 0.0))
    change = rig.control._planner._change
    rig.cycles(9)
    assert not meddler.asked
    rig.cycles(3)
    assert len(meddler.asked) == 1
    assert change is not None
    assert not change.applied
    rig.until(rig.holds)
    assert rig.outcomes() == [("g1", "preempted"), ("g2", "done")]
    assert_within_limits(rig)


def test_the_planner_is_a_function_of_the_request() -> None:
    """Asked in any order, by any number of planners, through the wire: the same answer to the last bit."""
    rig = ControlRig()
    planner = Meddler(rig)
    rig.command("enable")
    goals: list[Goal] = [
        PoseGoal(0.05, 0.02, 0.3, blend=0.01),
        PoseGoal(-0.05, 0.03, 0.0, blend=0.01),
        VelocityGoal(0.1, 0.0, 0.0, timeout=0.3),
        PoseGoal(0.0, 0.0, 0.0),
    ]
    for number, goal in enumerate(goals):
        rig.post(f"g{number}", goal)
        rig.cycles(120)
    requests = planner.asked
    answers = [encode(planner.planner.plan(request)) for request in requests]
    for request, answer in reversed(list(zip(requests, answers, strict=True))):
        again = MotionPlanner(CONFIG).plan(decode_plan_request(encode(request)))
        assert encode(again) == answer
        assert decode_plan_answer(answer) == again


def test_warming_up_plans_each_motion_from_the_one_before(monkeypatch: pytest.MonkeyPatch) -> None:
    answers: list[PlanAnswer] = []
    plain = MotionPlanner.plan

    def noted(self: MotionPlanner, request: PlanRequest) -> PlanAnswer:
        answers.append(plain(self, request))
        return answers[-1]

    monkeypatch.setattr(MotionPlanner, "plan", noted)
    MotionPlanner(CONFIG).warm_up()
    begins = [answer.first for answer in answers if isinstance(answer, PreemptingMotion)]
    assert begins == [None, 2, 2, 2]


def test_a_planner_with_other_limits_plans_nothing(rig: ControlRig, meddler: Meddler) -> None:
    limits = msgspec.structs.replace(CONFIG.limits.slider, velocity=CONFIG.limits.slider.velocities[0] / 2.0)
    other = msgspec.structs.replace(CONFIG, limits=msgspec.structs.replace(CONFIG.limits, slider=limits))
    assert revision(other) != revision(CONFIG)
    meddler.planner = MotionPlanner(other)
    rig.post("g1", PoseGoal(0.05, 0.0, 0.0))
    rig.until(lambda: bool(rig.outcomes()))
    assert code(rig) == "internal"


def test_the_largest_goal_on_the_longest_motion_fits_a_packet(rig: ControlRig, meddler: Meddler) -> None:
    rig.send("g1", wave(MAX_POINTS, 3.0))
    rig.cycles(100)
    rig.post("g2", wave(MAX_POINTS, 3.0))
    answers = [encode(meddler.planner.plan(request)) for request in meddler.asked]
    assert max(len(encode(request)) for request in meddler.asked) < MAX_SHARED
    assert max(map(len, answers)) < MAX_SHARED - 1000  # it goes to the recorder, in a ControlInput


@pytest.mark.parametrize("points", [MAX_PART, MAX_POINTS])
def test_a_goal_of_another_user_waits_for_no_planning_longer_than_that_of_one_message(
    rig: ControlRig, meddler: Meddler, points: int
) -> None:
    meddler.delays = [300, 1]
    rig.post("g1", wave(points, 3.0))
    rig.cycle(GoalRequest(9001, "eve", "g2", PoseGoal(0.05, 0.0, 0.0), round(rig.now * 1e9)))
    waited = rig.until(lambda: any(isinstance(answer, Accepted) and answer.reply.id == "g2" for answer in rig.answers))
    assert waited >= 290 if points == MAX_PART else waited <= 5
    rig.until(rig.holds)
    assert rig.outcomes() == [("g1", "preempted" if points == MAX_PART else "rejected"), ("g2", "done")]


def test_a_trajectory_that_is_long_is_planned_after_so_many_goals_of_others(rig: ControlRig, meddler: Meddler) -> None:
    meddler.delays = [50]
    out = PoseGoal(5.0, 0.0, 0.0)  # it is refused
    rig.post("g1", wave(MAX_POINTS, 3.0))
    for number in range(3 * MAX_PASSES):
        rig.cycle(GoalRequest(9000 + number, "eve", f"f{number}", out, round(rig.now * 1e9)))
        rig.cycles(30)
    rig.until(lambda: rig.mode is Mode.MOVING)
    begins = [request for request in meddler.asked if not isinstance(request.goal, PoseGoal)]
    assert len(begins) == 1 + MAX_PASSES
    rig.until(rig.holds)
    assert ("g1", "done") in rig.outcomes()


def test_an_override_that_never_ends_changing_keeps_no_goal_for_ever(rig: ControlRig, meddler: Meddler) -> None:
    moving(rig)
    rig.post("g2", PoseGoal(0.0, 0.05, 0.0))
    for number in range(300):
        rig.cycle(CommandRequest(5000 + number, "eve", Command.OVERRIDE, Override(50.0 + 50.0 * (number % 2))))
    assert "g2" in dict(rig.outcomes()) or rig.control.ledger.goal is not None
    rig.command("override", 1.0)
    rig.until(rig.holds)
    ends = [goal for goal, _ in rig.outcomes()]
    assert sorted(map(str, ends)) == ["g1", "g2"]


@settings(max_examples=60)
@given(st.lists(STEP, min_size=1, max_size=8))
def test_every_answer_is_the_same_when_it_is_read_from_a_recording(steps: list[tuple[object, int]]) -> None:
    """A recording carries it as JSON, which knows no infinity: not even at override zero is there one."""
    rig = ControlRig()
    planner = Meddler(rig)
    rig.command("enable")
    rig.command("override", 0.0)
    rig.post("first", PoseGoal(0.01, 0.0, 0.0))
    rig.cycles(5)
    play(rig, steps)
    answers = [planner.planner.plan(request) for request in planner.asked]
    assert any(isinstance(answer, PreemptingMotion) and answer.reply.duration is None for answer in answers)
    for answer in answers:
        assert msgspec.json.decode(msgspec.json.encode(answer), type=PlanAnswer) == answer
