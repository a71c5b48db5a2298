"""Goals that are appended or cancelled while the rate changes: what follows a blend keeps every limit."""

from __future__ import annotations

import pytest
from control.sessions import Session, assert_within_limits
from trirail.wire.goals import Goal, PoseGoal, SlidersGoal
from trirail.wire.packets import CommandRequest
from trirail.wire.vocabulary import Command, Stop


@pytest.mark.parametrize("instant", [240, 270, 300, 330])
@pytest.mark.parametrize("goal", [PoseGoal(0.1, 0.05, 0.2), PoseGoal(0.0, 0.0, 0.0), SlidersGoal((0.05, -0.03, 0.08))])
def test_a_goal_appended_while_the_robot_brakes_for_override_zero_breaks_no_limit(goal: Goal, instant: int) -> None:
    """The robot may still brake when it passes from one path to the other."""
    session = Session()
    session.post("g1", PoseGoal(0.1, 0.0, 0.0, blend=0.05))
    session.cycles(instant)
    session.order(Command.OVERRIDE, 0.0)
    session.cycles(2)
    session.post("g2", goal)
    session.cycles(400)
    assert session.control.fault is None
    session.order(Command.OVERRIDE, 1.0)
    session.until(lambda: len(session.ended) == 2)
    assert_within_limits(session.config, session.records)
    assert set(session.ended.values()) <= {"done", "preempted"}


def test_a_goal_cancelled_while_the_robot_brakes_for_a_pause_breaks_no_limit() -> None:
    """The robot then brakes on the path before, of which this was a part that it would have left."""
    session = Session()
    session.post("g1", PoseGoal(0.1, 0.0, 0.0, blend=0.03))
    session.cycles(4)
    session.post("g2", PoseGoal(0.15, 0.0, 0.0))
    session.cycles(5)
    (run,) = session.control.schedule.runs
    session.until(lambda: run.law_state.s > run.seams[0].s - 0.04)
    session.order(Command.PAUSE)
    session.cycles(3)
    session.cycle(CommandRequest(99, "ann", Command.STOP, Stop("g2")))
    session.until(session.holds)
    assert session.control.fault is None
    session.order(Command.RESUME)
    session.until(lambda: len(session.ended) == 2)
    assert session.ended == {"g2": "stopped", "g1": "done"}
    assert_within_limits(session.config, session.records)
