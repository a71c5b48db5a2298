"""Standstill: where the mode says that the robot stands, nothing that happens inside the control moves it."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable

import msgspec
import numpy as np
import pytest
from control.sessions import Session, assert_within_limits
from control.test_backlash import with_backlash
from control.test_stop import PROMPT, braking
from trirail.motion.paths import constant_law
from trirail.wire.goals import PoseGoal
from trirail.wire.packets import CommandDone, CommandRequest, GoalRequest, PlannerLost, Request
from trirail.wire.vocabulary import AcquireLease, Command, CommandContent, Mode, Override, Stop

QUEUE = (
    PoseGoal(0.1, 0.0, 0.0, blend=0.02),
    PoseGoal(0.1, 0.05, 0.3, blend=0.02),
    PoseGoal(0.0, 0.05, 0.0),
)
"""Three blended goals."""
LAST_INSTANT = 1300
"""Cycles in which the whole queue has ended."""
INSTANTS = range(0, LAST_INSTANT, 20)
DELAYS = (0, 1, 2, 3, 5, 8, 20, 60, 100, 150, 300)
"""Cycles from the first event to the second."""
SAME_POSE = 1e-12
"""Rounding of a pose from cycle to cycle [m, rad]."""


class QueueSession(Session):
    """A robot on its way through a queue; each cycle is checked against the mode that it is published with."""

    def __init__(self, expiring: tuple[int, int] | None = None, backlash: float = 0.0) -> None:
        """`expiring`: number of a goal that may begin only until a cycle."""
        self.tickets = 10**6
        self.pause_ticket = -1
        self.paused_at: list[float] | None = None
        self.stopping = 0
        super().__init__(with_backlash(backlash))
        for number, goal in enumerate(QUEUE):
            expires = expiring is not None and number == expiring[0]
            valid_for = expiring[1] * self.config.period if expiring is not None and expires else None
            self.post(f"g{number}", msgspec.structs.replace(goal, valid_for=valid_for))
        self.cycles(20)

    def cycle(self, request: Request | None = None) -> None:
        moves = isinstance(request, GoalRequest) or (
            isinstance(request, CommandRequest) and request.name is Command.RESUME
        )
        if moves:
            self.pause_ticket, self.paused_at = -1, None
        super().cycle(request)
        self.check()

    def check(self) -> None:
        """Check that the pose changes only in a mode that says so, and not at all after a confirmed pause."""
        control, motion = self.control, self.control.schedule.motion
        assert control.fault is None
        changed = np.abs(motion[0, 0] - motion[1, 0]).max() > SAME_POSE
        if self.mode is Mode.STOPPING:
            self.stopping += 1
            assert self.stopping <= braking(self.config) + PROMPT
        else:
            self.stopping = 0
        if len(self.kept) > 1 and self.kept[-1]["mode"][0] == self.kept[-2]["mode"][0] and self.mode is Mode.HOLDING:
            assert not changed
            assert not motion[0, 1:].any()
        answered = any(
            isinstance(answer, CommandDone) and answer.ticket == self.pause_ticket for answer in self.answers
        )
        if answered and self.paused_at is None:
            self.paused_at = motion[0, 0].tolist()
        if self.paused_at is not None:
            assert np.abs(motion[0, 0] - self.paused_at).max() <= SAME_POSE

    def send_command(self, name: Command, content: CommandContent | None = None, user: str = "ann") -> None:
        """Send a command in this cycle."""
        self.tickets += 1
        self.cycle(CommandRequest(self.tickets, user, name, content or name.content()))


def pause(session: QueueSession) -> None:
    session.pause_ticket = session.tickets + 1
    session.paused_at = None
    session.send_command(Command.PAUSE)


def preempt(session: QueueSession) -> None:
    session.tickets += 1
    session.post(f"p{session.tickets}", PoseGoal(-0.03, 0.02, 0.1))


def follow(session: QueueSession) -> None:
    """Send a goal that waits behind the queue."""
    session.tickets += 1
    session.post(f"q{session.tickets}", PoseGoal(-0.03, 0.02, 0.1, blend=0.01))


def expire(session: QueueSession) -> None:
    """Let the time run out in which the goals that wait may begin."""
    goals = session.control.ledger.goals
    for number in range(1, len(goals)):
        goals[number] = goals[number]._replace(expires=session.control.modes.cycle)
    session.cycle()


def reach_blend(session: QueueSession) -> None:
    """Go on until the next goal of the queue begins, or nothing moves any more."""
    waiting = len(session.control.ledger.goals)
    for _ in range(400):
        if len(session.control.ledger.goals) != waiting:
            break
        session.cycle()


def lose_lease(session: QueueSession) -> None:
    session.send_command(Command.ACQUIRE, AcquireLease("other", 0.5), "bob")


def lose_planner(session: QueueSession) -> None:
    follow(session)
    session.control.decide([(PlannerLost("the planner has died"), round(session.now * 1e9))])
    session.cycle()


def delay_planner(session: QueueSession) -> None:
    session.planner.delay = 60
    follow(session)


def cancel(number: int) -> Callable[[QueueSession], None]:
    return lambda session: session.send_command(Command.STOP, Stop(f"g{number}"))


def override(percent: float) -> Callable[[QueueSession], None]:
    return lambda session: session.send_command(Command.OVERRIDE, Override(percent))


EVENTS: dict[str, Callable[[QueueSession], None]] = {
    "pause": pause,
    "resume": lambda session: session.send_command(Command.RESUME),
    "cancel the first": cancel(0),
    "cancel the second": cancel(1),
    "cancel the third": cancel(2),
    "expiry": expire,
    "preempt": preempt,
    "follow": follow,
    "blend reached": reach_blend,
    "override 0": override(0.0),
    "override 30": override(30.0),
    "override 150": override(150.0),
    "stop": lambda session: session.send_command(Command.STOP),
    "lease lost": lose_lease,
    "planner lost": lose_planner,
    "planner late": delay_planner,
}
PAIRS = [(first, second) for first in EVENTS for second in EVENTS]


def run_pair(first: str, second: str, instant: int, delay: int, backlash: float = 0.0) -> None:
    """Run a queue with two events, and on until everything has ended; each cycle checks itself."""
    session = QueueSession(backlash=backlash)
    session.cycles(instant)
    EVENTS[first](session)
    session.cycles(delay)
    EVENTS[second](session)
    session.cycles(200)
    end(session)


def end(session: QueueSession) -> None:
    """Bring every goal to its end: each has exactly one."""
    session.planner.delay = 1
    session.send_command(Command.RELEASE, None, "bob")
    session.send_command(Command.OVERRIDE, Override(100.0))
    session.send_command(Command.RESUME)
    session.until(lambda: session.mode is Mode.HOLDING and not session.control.ledger.goals, 6000)
    outcomes = Counter(goal for goal, _ in session.outcomes())
    assert set(outcomes.values()) == {1}
    assert {f"g{number}" for number in range(len(QUEUE))} <= set(outcomes)
    assert_within_limits(session.config, session.records)


@pytest.mark.generated(*range(240))
def test_no_two_events_move_a_robot_that_is_paused_or_holds(seed: int) -> None:
    chance = random.Random(seed)
    first, second = PAIRS[seed % len(PAIRS)] if seed < len(PAIRS) else chance.choice(PAIRS)
    run_pair(first, second, chance.choice(INSTANTS), chance.choice(DELAYS), chance.choice((0.0, 2e-4)))


@pytest.mark.parametrize("second", ["cancel the second", "cancel the third", "expiry", "stop", "override 150"])
@pytest.mark.parametrize("delay", [0, 10, 300])
def test_a_pause_outlives_what_happens_to_the_goals_that_wait(second: str, delay: int) -> None:
    run_pair("pause", second, 100, delay)


def test_a_paused_robot_stays_where_it_is_when_a_waiting_goal_is_not_valid_any_more() -> None:
    session = QueueSession(expiring=(1, 400))
    session.cycles(60)
    pause(session)
    session.cycles(800)
    assert session.paused_at is not None
    assert session.ended == {"g1": "expired", "g2": "stopped"}
    session.send_command(Command.RESUME)
    session.until(lambda: session.mode is Mode.HOLDING, 3000)
    assert session.ended["g0"] == "done"
    assert session.control.commanded.pose == pytest.approx((0.1, 0.0, 0.0), abs=1e-9)


# ---------------------------------------------------------------------- the last gate


def paused_session() -> Session:
    """Return a session whose robot is paused on its way."""
    session = Session()
    session.post("g", QUEUE[0])
    session.cycles(150)
    session.order(Command.PAUSE)
    session.until(session.holds)
    session.cycle()
    return session


def assert_refused(session: Session, words: str) -> None:
    """Run the next cycle: it sends the setpoints of the one before, and faults."""
    before = session.control.setpoints.rows[0]
    session.cycle()
    assert session.mode is Mode.FAULT
    assert words in str(session.control.fault)
    assert session.control.setpoints.rows[0] == before


@pytest.mark.parametrize("rate", [1.0, 1e-3, 1e-7])
def test_the_last_gate_refuses_motion_of_a_paused_robot(rate: float) -> None:
    session = paused_session()
    (run,) = session.control.schedule.runs
    run.change_law(constant_law(rate, run.law_state.s), rate)
    assert_refused(session, "while the mode is holding")


@pytest.mark.parametrize("axis", range(3))
def test_the_last_gate_refuses_a_velocity_of_a_robot_that_holds(axis: int) -> None:
    """Without a path: drives would get it as their feed-forward."""
    session = Session()
    session.cycles(5)
    session.control.schedule.motion[0, 1, axis] = 1e-6
    assert_refused(session, "while the mode is holding")


@pytest.mark.parametrize("rate", [1.0, 0.5])
def test_the_last_gate_refuses_a_stop_that_is_undone(rate: float) -> None:
    session = Session()
    session.post("g", QUEUE[0])
    session.cycles(200)
    session.order(Command.STOP)
    session.cycles(20)
    assert session.mode is Mode.STOPPING
    (run,) = session.control.schedule.runs
    session.control.modes._planner.discard_rate_change()
    run.target = rate
    assert_refused(session, "while the mode is stopping")
