"""Sessions on a grid of instants and delays: time along the path never falls, every limit holds, nothing faults."""

from __future__ import annotations

import random
from functools import cache

import numpy as np
import pytest
from control.sessions import Session, assert_within_limits
from control_rig import CONFIG
from trirail.config import corrected_geometry
from trirail.control.modes import ModeEvent
from trirail.motion.feasibility import Checker
from trirail.motion.limits import Bounds
from trirail.motion.paths import constant_law
from trirail.motion.time_scaling import CHANGE_SHARES, TimeScaling
from trirail.wire.event_codes import EventCode, coded
from trirail.wire.goals import Goal, PoseGoal, SlidersGoal
from trirail.wire.packets import CommandRequest
from trirail.wire.vocabulary import Command, Mode, Stop

PATHS: tuple[Goal, ...] = (PoseGoal(0.1, 0.0, 0.0), PoseGoal(0.05, -0.08, 0.5), SlidersGoal((0.05, -0.03, 0.08)))
EVENTS = ("pause", "resume", "override", "stop", "preempt", "cancel")
RATES = (0.0, 0.2, 0.5, 1.0, 1.7)
BEFORE = (1.0, 1.0, 0.2, 1.5)
"""Overrides at which a path is begun."""
DELAYS = (0, 1, 2, 4, 8, 16, 32, 60, 76, 100, 150, 200, 300, 400)
"""Cycles from one event to the next."""
EVERY = 20
"""Cycles between the instants of a motion at which the first event comes."""
OTHERS: tuple[Goal, ...] = (PoseGoal(-0.05, 0.03, 0.2), PoseGoal(0.1, 0.02, 0.0), SlidersGoal((0.0, 0.03, 0.02)))
SAMPLE = 150
"""Sessions of the grid that are tried each time; there are half a million."""
ROBOT = corrected_geometry(CONFIG)
SCALING = TimeScaling(
    ROBOT, Checker(ROBOT, CONFIG.limits, Bounds(CONFIG.limits, CONFIG.period), CONFIG.period), CONFIG.period
)
STANDS = (Mode.HOLDING, Mode.DISABLED, Mode.FAULT)


def stands(session: Session) -> bool:
    return session.mode in STANDS


@cache
def cycles_of(path: int) -> int:
    """How many cycles a path takes from rest."""
    session = Session()
    session.post("g", PATHS[path])
    return session.until(lambda: "g" in session.ended, 2000)


def happen(session: Session, event: str, chance: random.Random) -> None:
    """Let an event come in the next cycle."""
    match event:
        case "override":
            session.order(Command.OVERRIDE, chance.choice(RATES))
        case "preempt":
            session.post(f"p{len(session.kept)}", chance.choice(OTHERS))
        case "cancel":
            session.cycle(CommandRequest(10**6 + len(session.kept), "ann", Command.STOP, Stop("g")))
        case _:
            session.order(Command(event))


def go_through(seed: int, path: int, instant: int, first: str, delay: int, second: str) -> None:
    """Run a session of two events, and on until everything stands; all that must hold of it."""
    chance = random.Random(seed)
    session = Session()
    session.order(Command.OVERRIDE, chance.choice(BEFORE))
    session.post("g", PATHS[path])
    session.cycles(instant)
    happen(session, first, chance)
    session.cycles(delay)
    happen(session, second, chance)
    session.cycles(500)
    session.order(Command.OVERRIDE, 1.0)
    session.order(Command.RESUME)
    session.until(lambda: session.mode is Mode.HOLDING and not session.control.state.paused, 6000)
    assert session.control.fault is None
    assert_within_limits(session.config, session.records)
    assert session.ended
    assert set(session.ended.values()) <= {"done", "stopped", "preempted", "rejected"}


@pytest.mark.generated(*range(SAMPLE))
def test_two_events_at_any_instants_break_no_limit_and_turn_no_time_back(seed: int) -> None:
    chance = random.Random(seed)
    path = chance.randrange(len(PATHS))
    instant = EVERY * chance.randrange(1 + cycles_of(path) // EVERY)
    go_through(seed, path, instant, chance.choice(EVENTS), chance.choice(DELAYS), chance.choice(EVENTS))


@pytest.mark.parametrize(
    ("instant", "first", "delay", "second"),
    [
        (250, "pause", 76, "resume"),  # undone with less jerk than braking took, the rate went far below zero
        (340, "preempt", 4, "stop"),  # acceleration was greatest between two looks
        (300, "preempt", 4, "pause"),
        (420, "preempt", 16, "pause"),
    ],
)
@pytest.mark.parametrize("path", range(len(PATHS)))
def test_what_once_ran_back_or_beyond_a_limit(path: int, instant: int, first: str, delay: int, second: str) -> None:
    go_through(1, path, instant, first, delay, second)


@pytest.mark.parametrize("delay", DELAYS)
@pytest.mark.parametrize("lower", [0.0, 0.2])
def test_raising_a_rate_that_is_still_falling_goes_on_along_the_path(lower: float, delay: int) -> None:
    """Seen from outside: on a straight line from rest the platform never goes back."""
    session = Session()
    session.post("g", PATHS[0])
    session.cycles(200)
    session.order(Command.OVERRIDE, lower)
    session.cycles(delay)
    session.order(Command.OVERRIDE, 1.0)
    session.until(lambda: "g" in session.ended, 3000)
    assert session.ended == {"g": "done"}
    x = session.records["commanded_pose"][:, 0]
    assert (np.diff(x) >= -1e-12).all()
    assert_within_limits(session.config, session.records)


@pytest.mark.long
@pytest.mark.parametrize("then", ["stop", "disable", "lost"])
@pytest.mark.parametrize("later", [0, 3, 40])
def test_a_queue_that_is_paused_and_then_stopped_has_no_goal_to_pass_on_to(then: str, later: int) -> None:
    """A robot that brakes for a pause is stopped while it does, before it comes by where the next goal begins."""
    for instant in range(100, 420, 20):
        session = Session()
        session.post("g0", PoseGoal(0.1, 0.0, 0.0, blend=0.03))
        session.post("g1", PoseGoal(0.1, 0.05, 0.0))
        session.cycles(instant)
        session.order(Command.PAUSE)
        session.cycles(later)
        if then == "lost":
            session.control.modes.handle_disturbance(ModeEvent.GATEWAY_LOST, coded("gone", EventCode.GATEWAY_LOST))
        else:
            session.order(Command(then))
        session.until(lambda: session.mode in STANDS, 3000)  # noqa: B023 - called at once
        assert session.control.fault is None
        assert_within_limits(session.config, session.records)


def test_the_last_gate_refuses_a_time_along_the_path_that_falls() -> None:
    """Whoever has made such a law, and though nothing else is wrong with what it commands: the robot hardly moves."""
    session = Session()
    session.post("g", PATHS[0])
    session.cycles(30)
    (run,) = session.control.schedule.runs
    run.law = constant_law(-1e-6, run.law_state.s)
    run.time = 0.0
    session.cycle()
    assert session.control.fault is not None
    assert "time along the path would run backwards" in session.control.fault
    before, after = session.records["commanded_position"][-2:]
    assert after.tolist() == before.tolist()


# ---------------------------------------------------------------------- what it must not cost


def quickest(session: Session) -> float:
    """The least time in which the motion under way can be stopped from now on by a law of one share, or ends [s]."""
    (run,) = session.control.schedule.runs
    scaling, pose = SCALING, session.control.commanded.pose
    times = [run.end_time - run.time]
    for share in 0.97 ** np.arange(100.0):
        law = scaling.ramp(run.law_state, 0.0, scaling.full_speed.scaled(float(share)))
        if law is None:
            continue
        until = scaling.last_new_time(run, law, 0.0)
        if scaling.sample(run.path, law, 0.0, until, pose).within_limits:
            times.append(float(law.knots[-2]))
            break
    return min(times)


@pytest.mark.generated(*range(12))
@pytest.mark.parametrize("path", range(len(PATHS)))
def test_a_stop_stands_nearly_as_soon_as_any_law_could(path: int, seed: int) -> None:
    session = Session()
    session.post("g", PATHS[path])
    session.cycles(random.Random(seed).randrange(5, cycles_of(path) - 30))
    least = quickest(session)
    session.order(Command.STOP)
    took = session.until(lambda: stands(session), 2000)
    assert took * session.config.period <= 1.2 * least + len(CHANGE_SHARES) * session.config.period


@pytest.mark.generated(*range(8))
@pytest.mark.parametrize("path", range(len(PATHS)))
def test_a_resume_takes_effect_at_the_latest_when_the_robot_stands(path: int, seed: int) -> None:
    chance = random.Random(seed)
    instant, delay = chance.randrange(5, cycles_of(path) - 30), chance.choice(DELAYS)

    def paused(wait: int | None) -> tuple[int, int]:
        """How many cycles after the pause it stands or is resumed, and how many more it then takes to the end."""
        session = Session()
        session.post("g", PATHS[path])
        session.cycles(instant)
        session.order(Command.PAUSE)
        if wait is None:
            waited = session.until(lambda: stands(session), 2000)
        else:
            session.cycles(wait)
            waited = wait
        if "g" not in session.ended:
            session.order(Command.RESUME)
        left = session.until(lambda: "g" in session.ended, 3000)
        assert session.ended == {"g": "done"}
        return waited, left

    until_standstill, from_rest = paused(None)
    waited, left = paused(min(delay, until_standstill))
    assert waited + left <= until_standstill + from_rest + len(CHANGE_SHARES)
