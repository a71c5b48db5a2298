"""The ledger's books: every goal ends once, every command is answered once, in order, to whom it belongs."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from refusals import refused_as
from trirail.control.ledger import Ledger
from trirail.control.plan_requests import AcceptedPlan
from trirail.errors import RefusalCode, RefusedError
from trirail.wire.event_codes import EventCode, coded
from trirail.wire.goals import Goal, PoseGoal, TrackGoal, VelocityGoal
from trirail.wire.messages import REMEMBERED_IDS, GoalReply
from trirail.wire.packets import Accepted, CommandDone, CommandRequest, GoalRequest, Refused
from trirail.wire.vocabulary import Command

NAMES = list(Command)

POSE = PoseGoal(x=0.0, y=0.0, phi=0.0, blend=0.01)
JOG = VelocityGoal(x=0.01, y=0.0, phi=0.0)
AT_ONCE = AcceptedPlan(GoalReply("", 1.5, slowed=1.2, stops_first=True))
QUEUED = AcceptedPlan(GoalReply("", 2.5, queued=True))


def asked(name: str, goal: Any = POSE, ticket: int = 1, user: str = "ann") -> GoalRequest:
    return GoalRequest(ticket, user, name, goal, 0)


def ended(ledger: Ledger) -> list[tuple[str | None, str | None, str | None]]:
    return [(said.id, said.outcome, said.user) for said in ledger.notices if said.kind == "goal"]


@pytest.fixture
def ledger() -> Ledger:
    """With three goals: one under way, and two that wait."""
    made = Ledger()
    for number, user in enumerate(("ann", "bob", "eve")):
        made.begin(asked(f"g{number}", user=user), AT_ONCE if number == 0 else QUEUED, 100.0, math.inf)
    made.answers.clear()
    return made


def test_an_accepted_goal_is_answered_with_what_was_planned() -> None:
    ledger = Ledger()
    ledger.begin(asked("g", ticket=7), AT_ONCE, 100.0, math.inf)
    assert ledger.answers == [Accepted(7, GoalReply("g", 1.5, slowed=1.2, stops_first=True))]
    assert ledger.goal is not None
    assert ledger.goal[:5] == ("g", "ann", PoseGoal, 0.01, 100.0)
    assert ended(ledger) == []


def test_a_goal_that_does_not_wait_preempts_all_before_it(ledger: Ledger) -> None:
    ledger.begin(asked("now"), AT_ONCE, 100.0, math.inf)
    assert ended(ledger) == [("g0", "preempted", "ann"), ("g1", "preempted", "bob"), ("g2", "preempted", "eve")]
    assert [goal.id for goal in ledger.goals] == ["now"]
    assert {said.message for said in ledger.notices} == {
        f"goal g{n} preempted: preempted by goal now" for n in range(3)
    }


def test_what_is_reached_on_the_way_is_done(ledger: Ledger) -> None:
    ledger.pass_on()
    assert ended(ledger) == [("g0", "done", "ann")]
    assert ledger.notices[0].message == "goal g0 done: passed on the way to goal g1"
    assert [goal.id for goal in ledger.goals] == ["g1", "g2"]


@pytest.mark.parametrize("but", range(5))
def test_goals_end_but_for_the_first_ones(ledger: Ledger, but: int) -> None:
    ledger.end("stopped", coded("stop by ann", EventCode.OTHER), but)
    assert [goal.id for goal in ledger.goals] == ["g0", "g1", "g2"][:but]
    assert ended(ledger) == [("g0", "stopped", "ann"), ("g1", "stopped", "bob"), ("g2", "stopped", "eve")][but:]


@pytest.mark.parametrize(
    ("outcome", "level"), [("done", "info"), ("stopped", "info"), ("faulted", "error"), ("rejected", "warning")]
)
def test_how_a_goal_ended_is_told_by_its_weight(ledger: Ledger, outcome: Any, level: str) -> None:
    ledger.end(outcome, coded("so it is", EventCode.OTHER))
    assert {said.level for said in ledger.notices} == {level}


def test_an_id_is_good_for_one_goal(ledger: Ledger) -> None:
    for name in ("g0", "g2"):
        with refused_as(RefusalCode.DUPLICATE_ID):
            ledger.check_id(asked(name))
    ledger.end("done", coded("arrived", EventCode.ARRIVED))
    with pytest.raises(RefusedError, match="goal id 'g1' has already been used") as refused:
        ledger.check_id(asked("g1"))
    ledger.refuse(asked("g1", ticket=9, user="bob"), refused.value)
    assert ledger.answers == [
        Refused(9, RefusalCode.DUPLICATE_ID, "goal id 'g1' has already been used: give every goal its own id")
    ]
    assert len(ended(ledger)) == 3  # the one that had the id ended once
    assert ledger.notices[-1].message == "goal id 'g1' has already been used: give every goal its own id"
    ledger.check_id(asked("g9"))


def test_ids_of_the_newest_goals_are_remembered() -> None:
    ledger = Ledger()
    for number in range(REMEMBERED_IDS + 1):
        ledger.withdraw(asked(f"g{number}"), "stopped", "stop by ann")
    ledger.check_id(asked("g0"))
    for number in (1, REMEMBERED_IDS):
        with pytest.raises(RefusedError):
            ledger.check_id(asked(f"g{number}"))


def test_a_jog_is_renewed_by_velocities_of_its_id_alone() -> None:
    ledger = Ledger()
    ledger.begin(asked("j", JOG), AT_ONCE, 100.0, math.inf)
    ledger.check_id(asked("j", JOG))
    with pytest.raises(RefusedError):
        ledger.check_id(asked("j"))
    ledger.begin(asked("j", JOG, ticket=2), AT_ONCE, 100.0, math.inf)
    assert [answer.ticket for answer in ledger.answers if isinstance(answer, Accepted)] == [1, 2]
    assert len(ledger.goals) == 1
    ledger.refuse(
        asked("j", JOG, ticket=3), RefusedError(RefusalCode.TOO_FAST, "too fast", slider="A", value=2.0, limit=1.0)
    )
    ledger.withdraw(asked("j", JOG, ticket=4), "stopped", "stop by ann")
    assert ended(ledger) == []  # the jog itself goes on
    assert ledger.answers[-2:] == [
        Refused(3, RefusalCode.TOO_FAST, "too fast", "A", 2.0, 1.0),
        Refused(4, RefusalCode.STOPPED, "goal j stopped before it began: stop by ann"),
    ]
    ledger.end("stopped", coded("stop by ann", EventCode.OTHER))
    assert ended(ledger) == [("j", "stopped", "ann")]


TRACK = TrackGoal(x=0.0, y=0.0, phi=0.0, time=0.0)


@pytest.mark.parametrize(
    ("goal", "released", "reason", "code"),
    [
        (JOG, False, "at the limit of platform x", RefusalCode.AT_LIMIT),
        (JOG, True, "not renewed", RefusalCode.JOG_OVER),
        (TRACK, False, "not renewed", RefusalCode.JOG_OVER),  # its target was beyond the limit, where it waited
    ],
)
def test_a_jog_that_has_not_been_released_ends_at_its_limit(
    goal: Goal, released: bool, reason: str, code: RefusalCode
) -> None:
    ledger = Ledger()
    ledger.begin(asked("j", goal), AcceptedPlan(GoalReply("", 1.0), "platform x"), 100.0, 50.0)
    if released:
        assert ledger.release(50) is None
        assert ledger.release(51) is not None
        assert ledger.release(52) is None
    ledger.end("done", coded("not renewed", EventCode.NOT_RENEWED))
    assert ledger.notices[-1].message == f"goal j done: {reason}"
    with refused_as(code):
        ledger.check_id(asked("j", goal))


def test_a_renewal_that_a_newer_one_has_replaced_is_answered() -> None:
    ledger = Ledger()
    ledger.pass_over(asked("j", JOG, ticket=5))
    assert ledger.answers == [Accepted(5, GoalReply("j", None))]


OF_ENDED = {RefusalCode.DUPLICATE_ID, RefusalCode.AT_LIMIT, RefusalCode.JOG_OVER}


@pytest.mark.parametrize("code", sorted(set(RefusalCode) - OF_ENDED))
def test_a_refused_goal_has_ended(code: RefusalCode) -> None:
    outcome = "expired" if code is RefusalCode.EXPIRED else "rejected"
    ledger = Ledger()
    ledger.refuse(asked("g", ticket=5, user="bob"), RefusedError(code, "it cannot be"))
    assert ledger.answers == [Refused(5, code, "it cannot be")]
    assert ended(ledger) == [("g", outcome, "bob")]
    with pytest.raises(RefusedError):
        ledger.check_id(asked("g"))


def test_a_refused_command_is_answered_and_told() -> None:
    ledger = Ledger()
    ledger.refuse(CommandRequest(6, "bob", Command.RESUME), RefusedError(RefusalCode.NOT_PAUSED, "nothing is paused"))
    assert ledger.answers == [Refused(6, RefusalCode.NOT_PAUSED, "nothing is paused")]
    (said,) = ledger.notices
    assert (said.kind, said.level, said.message, said.user) == (
        "refused", "warning", "resume refused: nothing is paused", "bob",
    )  # fmt: skip


@given(st.lists(st.sampled_from(["", None, "a drive is silent"]), min_size=1, max_size=8), st.integers(1, 5))
def test_each_command_is_answered_once_when_its_verdict_is_there(verdicts: list[str | None], rounds: int) -> None:
    """Those without a verdict wait for one, however long; those with one are not asked about again."""
    ledger = Ledger()
    for ticket, _ in enumerate(verdicts):
        ledger.undertake(CommandRequest(ticket, "ann", NAMES[ticket]), 100 + ticket)
    asked_about: list[tuple[Command, int]] = []

    def verdict(name: Command, since: int) -> str | None:
        asked_about.append((name, since))
        return verdicts[NAMES.index(name)]

    for _ in range(rounds):
        ledger.settle(verdict, "holding", 1)
    assert ledger.answers == [
        Refused(n, RefusalCode.FAILED, f"{NAMES[n]} failed: {said}") if said else CommandDone(n, NAMES[n], "holding", 1)
        for n, said in enumerate(verdicts)
        if said is not None
    ]
    first = [(NAMES[n], 100 + n) for n in range(len(verdicts))]
    waiting = [each for each, said in zip(first, verdicts, strict=True) if said is None]
    assert asked_about == first + waiting * (rounds - 1)
