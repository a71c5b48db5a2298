"""Goals that are appended or cancelled while the rate changes: what follows a blend keeps every limit."""

from __future__ import annotations

import math

import numpy as np
import pytest
from control.sessions import Session, assert_within_limits
from generated import thinned
from trirail.motion.paths import law_falls
from trirail.wire.goal_kind import OwnLimits
from trirail.wire.goals import Goal, PoseGoal, SlidersGoal, VelocityGoal
from trirail.wire.packets import CommandRequest
from trirail.wire.vocabulary import Command, Mode, Stop


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


# ---------------------------------------------------------------------- the override and goals that follow


def long_move(session: Session, cycles: int) -> None:
    """Go across the workspace at full speed, for so many cycles."""
    session.post("s", PoseGoal(-0.11, 0.0, 0.0))
    session.until(lambda: session.holds() and "s" in session.ended)
    session.post("a", PoseGoal(0.11, 0.02, 0.1))
    session.cycles(cycles)


def rate(session: Session) -> float:
    last = session.control.schedule.last
    return last.law_state.rate if last is not None else 0.0


@pytest.mark.parametrize("at", thinned([20, 40, 70, 100, 150, 250]))
@pytest.mark.parametrize("override", [0.01, 0.05, 0.3, 0.8])
def test_a_lower_override_acts_soon(override: float, at: int) -> None:
    """While the robot accelerates, only a slow change fits at first, but not for long."""
    session = Session()
    long_move(session, at)
    session.order(Command.OVERRIDE, override)
    assert session.until(lambda: rate(session) <= override) < 300
    assert session.control.fault is None
    assert_within_limits(session.config, session.records)


OWN_ACCELERATION, OWN_JERK = 0.4, 4.0
"""Of a goal, along x and y [m/s², m/s³]."""
OWN = OwnLimits(
    velocity=(0.1, 0.1, 1.0),
    acceleration=(OWN_ACCELERATION, OWN_ACCELERATION, 5.0),
    jerk=(OWN_JERK, OWN_JERK, 50.0),
)


@pytest.mark.parametrize("blend", [0.0, 0.02])
@pytest.mark.parametrize("wait", [5, 40, 80, 120])
def test_behind_a_motion_above_full_speed_a_goal_keeps_its_own_limits(blend: float, wait: int) -> None:
    session = Session()
    session.order(Command.OVERRIDE, 2.0)
    session.post("a", PoseGoal(0.03, 0.0, 0.0, speed=0.4, blend=blend))
    session.cycles(wait)
    session.post("b", PoseGoal(0.03, 0.08, 0.0, limits=OWN))
    session.until(lambda: "a" in session.ended)
    begun = len(session.records)
    session.until(lambda: "b" in session.ended)
    assert session.ended == {"a": "done", "b": "done"}
    accelerations = session.records["commanded_pose_acceleration"][begun:, 1]
    assert np.abs(accelerations).max() <= OWN_ACCELERATION * 1.001
    assert np.abs(np.diff(accelerations)).max() / session.config.period <= OWN_JERK * 1.01


@pytest.mark.parametrize("wait", [60, 100, 200])
def test_a_goal_with_own_limits_preempts_a_motion_above_full_speed_within_them(wait: int) -> None:
    session = Session()
    session.order(Command.OVERRIDE, 2.0)
    session.post("a", PoseGoal(0.1, 0.0, 0.0, speed=0.2))
    session.cycles(wait)
    session.post("b", PoseGoal(0.1, 0.05, 0.0, limits=OWN))
    session.until(lambda: "a" in session.ended)
    begun = len(session.records)
    session.until(lambda: "b" in session.ended)
    accelerations = session.records["commanded_pose_acceleration"][begun:, :2]
    assert np.abs(accelerations).max() <= OWN_ACCELERATION * 1.001
    assert np.abs(np.diff(accelerations, axis=0)).max() / session.config.period <= OWN_JERK * 1.01


BRAKING_EXCESS = 3.0
"""How far a pause, or a lower override, may exceed the own limits of a goal, whose path may use them completely."""


def own_shares(session: Session, own: OwnLimits, begun: int = 0) -> tuple[float, float, float]:
    """Greatest velocity, acceleration and jerk since a record, divided by the limits of the goal."""
    records = session.records[begun:]
    accelerations = records["commanded_pose_acceleration"]
    jerks = np.diff(accelerations, axis=0) / session.config.period
    rates = (records["commanded_pose_velocity"], own.velocity), (accelerations, own.acceleration), (jerks, own.jerk)
    velocity, acceleration, jerk = (float(np.abs(rate / limit).max()) for rate, limit in rates if limit is not None)
    return velocity, acceleration, jerk


@pytest.mark.generated(*range(12))
def test_a_goal_keeps_its_own_limits_while_its_rate_changes(seed: int) -> None:
    rng = np.random.default_rng(seed)
    session = Session()
    session.post("g", PoseGoal(0.1, 0.02, rng.uniform(-0.1, 0.1), limits=OWN))
    for _ in range(6):
        session.cycles(int(rng.integers(1, 300)))
        if "g" in session.ended:
            break
        command = Command.RESUME if session.control.state.paused else rng.choice([Command.PAUSE, Command.OVERRIDE])
        session.order(Command(command), rng.uniform(0.0, 2.0) if command == Command.OVERRIDE else None)
    velocity, acceleration, jerk = own_shares(session, OWN)
    assert velocity <= 1.001
    assert acceleration <= 1.001 * BRAKING_EXCESS
    assert jerk <= 1.01 * BRAKING_EXCESS


@pytest.mark.parametrize(("acceleration", "jerk", "share"), [(0.02, 0.05, 0.1), (0.02, 0.05, 0.4), (1.0, 10.0, 0.2)])
@pytest.mark.long
def test_where_own_limits_are_used_completely_a_pause_is_soon(acceleration: float, jerk: float, share: float) -> None:
    assert_pauses_soon(acceleration, jerk, share)


@pytest.mark.generated(*range(12))
def test_a_goal_with_own_limits_pauses_soon_wherever_it_is(seed: int) -> None:
    rng = np.random.default_rng(seed)
    assert_pauses_soon(10.0 ** rng.uniform(-1.5, 0.0), 10.0 ** rng.uniform(-1.0, 1.5), rng.uniform(0.02, 0.85))


def assert_pauses_soon(acceleration: float, jerk: float, share: float) -> None:
    """Pause a goal with own limits at a share of its path, and resume it: then it keeps them."""
    own = OwnLimits(velocity=(0.2, 0.2, 1.0), acceleration=(acceleration,) * 2 + (5.0,), jerk=(jerk,) * 2 + (50.0,))
    session = Session()
    session.post("g", PoseGoal(0.1, 0.0, 0.0, limits=own))
    session.until(lambda: bool(session.control.schedule.runs))
    session.until(lambda: session.control.schedule.runs[0].progress >= share, 20_000)
    begun = len(session.records)
    speed = session.records["commanded_pose_velocity"][-1, 0]
    session.order(Command.PAUSE)
    soon = 3.0 * (speed / acceleration + acceleration / jerk) + 0.3
    assert session.until(session.holds, 20_000) * session.config.period <= soon
    assert (
        session.records["commanded_pose_velocity"][begun:, 0].max()
        <= speed + acceleration**2 / jerk + 0.1 * acceleration
    )
    if session.control.state.paused:
        session.order(Command.RESUME)
        resumed = len(session.records)
        session.until(lambda: "g" in session.ended, 20_000)
        assert max(own_shares(session, own, resumed)) <= 1.01


@pytest.mark.parametrize("before", ["moving", "paused"])
def test_a_stop_does_not_wait_for_the_own_limits_of_a_goal(before: str) -> None:
    """A stop is as quick as that of a goal without own limits, even if a slower pause has begun."""

    def needed(limits: OwnLimits | None) -> int:
        session = Session()
        session.post("g", PoseGoal(0.1, 0.0, 0.0, speed=0.4, limits=limits))
        session.cycles(600)
        if before == "paused":
            session.order(Command.PAUSE)
            session.cycles(5)
        session.order(Command.STOP)
        return session.until(session.holds)

    slow = OwnLimits(acceleration=(0.2, 0.2, 2.0), jerk=(1.0, 1.0, 10.0))
    assert needed(slow) <= needed(None) + 20


@pytest.mark.parametrize("passes", [True, False])
@pytest.mark.parametrize("wait", [1, 20, 60])
def test_a_goal_with_own_limits_pauses_while_the_motion_is_still_faster(wait: int, passes: bool) -> None:
    session = Session()
    session.post("a", PoseGoal(0.03, 0.0, 0.0, blend=0.02 if passes else None))
    session.cycles(60)
    session.post("b", PoseGoal(0.03, 0.08, 0.0, limits=OwnLimits(velocity=(0.01, 0.01, 0.1))))
    session.until(lambda: "a" in session.ended)
    session.cycles(wait)
    session.order(Command.PAUSE)
    assert session.until(session.holds) < 400
    assert session.control.state.paused


@pytest.mark.parametrize("how", ["ends", "stopped"])
def test_the_override_acts_again_when_the_goal_that_forbids_it_has_gone(how: str) -> None:
    """A goal with own limits runs at 100 % at most, and so does the motion before it, but not the next goal."""
    session = Session()
    session.order(Command.OVERRIDE, 2.0)
    if how == "ends":
        session.post("a", PoseGoal(0.02, 0.0, 0.0, blend=0.005, limits=OWN))
        session.cycles(5)
        session.post("b", PoseGoal(0.02, 0.1, 0.0, speed=0.2))
        session.until(lambda: "a" in session.ended)
    else:
        session.post("a", PoseGoal(0.1, 0.0, 0.0, speed=0.1, blend=0.0))
        session.cycles(5)
        session.post("b", PoseGoal(0.1, 0.05, 0.0, limits=OWN))
        session.until(lambda: len(session.control.ledger.goals) == 2)
        assert rate(session) == 1.0
        session.cycle(CommandRequest(99, "ann", Command.STOP, Stop("b")))
    session.cycles(300)
    assert rate(session) > 1.5
    session.until(session.holds)
    assert session.control.fault is None


@pytest.mark.parametrize("every", [20, 100, 400])
@pytest.mark.parametrize("override", thinned([0.01, 0.03, 0.05], every=3))
@pytest.mark.long
def test_a_renewed_jog_moves_at_every_override(override: float, every: int) -> None:
    session = Session()
    session.order(Command.OVERRIDE, override)
    for cycle in range(8000):
        if cycle % every == 0:
            session.post("j", VelocityGoal(0.1, 0.0, 0.0, timeout=1.0))
        else:
            session.cycle()
    assert 0.8 * 0.1 * override < session.control.commanded.velocity[0] < 1.001 * 0.1 * override


@pytest.mark.parametrize("override", [1.1, 1.5, 2.0])
@pytest.mark.parametrize("speeds", [(0.5,), (0.3, 1.0)])
def test_corners_are_blended_at_every_override(override: float, speeds: tuple[float, ...]) -> None:
    """A corner that fits at 100 % alone is planned for the override."""
    session = Session()
    session.order(Command.OVERRIDE, override)
    corners = [(0.04, 0.0), (0.04, 0.04), (0.0, 0.04), (0.0, 0.0)]
    for number in range(8):
        x, y = corners[number % 4]
        blend = 0.01 if number < 7 else None
        session.post(f"g{number}", PoseGoal(x, y, 0.0, blend=blend, speed=speeds[number % len(speeds)]))
        session.cycles(15)
    slowest = math.inf
    while session.mode is Mode.MOVING:
        session.cycle()
        last = session.control.schedule.last
        if last is not None and last.remaining > 0.1 and len(session.control.ledger.goals) > 1:
            slowest = min(slowest, math.hypot(*session.control.commanded.velocity[:2]))
    assert slowest > 0.005
    assert set(session.ended.values()) == {"done"}
    assert_within_limits(session.config, session.records)


@pytest.mark.long
def test_goals_that_blend_for_long_do_not_make_the_path_longer() -> None:
    session = Session()
    pieces = []
    for number in range(200):
        x = 0.01 * (number % 2)
        session.post(f"g{number}", PoseGoal(x, 0.0, 0.0, blend=0.002))
        session.cycles(8)
        session.until(lambda: len(session.control.ledger.goals) <= 2)
        last = session.control.schedule.last
        assert last is not None
        pieces.append(len(last.path.pieces))
    assert max(pieces[100:]) <= max(pieces[:20])
    session.until(session.holds)
    assert len(session.ended) == 200
    assert set(session.ended.values()) == {"done"}
    assert_within_limits(session.config, session.records)


@pytest.mark.parametrize("hours", [1e4, 1e5, 1e6])
def test_rounding_after_hours_on_a_path_stops_nothing(hours: float) -> None:
    """The time along the path is given in seconds, so that its last bit is then longer than a picosecond."""
    last = np.nextafter(hours, 0.0)
    knots, pieces = np.array([0.0, 1.0, 1e9]), np.zeros((2, 1, 6))
    pieces[0, 0, 0], pieces[1, 0, 0] = hours, last
    assert hours - last > 1e-12
    assert not law_falls(knots, pieces)
    pieces[1, 0, 0] = hours - 1e-8
    assert law_falls(knots, pieces)


def test_a_jog_that_is_almost_zero_raises_no_warning() -> None:
    session = Session()
    session.post("j", VelocityGoal(1e-200, 1e-220, 0.0))
    session.cycles(100)
    assert session.control.fault is None
