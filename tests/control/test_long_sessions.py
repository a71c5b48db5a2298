"""Long random sessions, with a late planner, a map, backlash and weak sliders: limits, endings and progress."""

from __future__ import annotations

import itertools
import random
from collections import Counter

import msgspec
import numpy as np
import pytest
from control.sessions import Session, assert_within_limits
from control_rig import CONFIG
from generated import thinned
from numpy.typing import NDArray
from trirail.config import Config, corrected_geometry, geometry
from trirail.config.as_built import AsBuilt, geometry_of
from trirail.kinematics.robot import inverse
from trirail.wire.goals import Goal, PoseGoal, SlidersGoal, TrackGoal, TrajectoryGoal, TrajectoryPoint, VelocityGoal
from trirail.wire.packets import CommandRequest
from trirail.wire.vocabulary import Command, Mode, Stop

GOALS, GOALS_EXPLORED = 250, 20_000
KINDS = ("pose", "pose", "pose", "sliders", "velocity", "track", "trajectory")
ORDERS = ("stop", "pause", "resume", "override", "cancel", "disable", "quick_stop")
WEIGHTS = (6, 7, 9, 12, 3, 1, 1)
RATES = (0.0, 0.1, 0.3, 0.5, 1.0, 1.0, 1.6, 2.0)
DELAYS = (1, 1, 1, 2, 5, 20, 80)
"""Cycles that the planner thinks about a goal."""
WAITS = (0, 0, 1, 3, 10, 30, 76, 150, 400)
"""Cycles from one thing to the next."""
WINDOW = 1500
"""Cycles in which a goal that is under way at some rate makes progress."""


def a_map() -> AsBuilt:
    """A robot whose platform is up to 50 µm and 0.1 mrad beside where it should be, everywhere otherwise."""
    platform = CONFIG.limits.platform
    low, high = np.transpose([platform.x, platform.y, platform.phi])
    nodes = np.random.default_rng(5).uniform(-1.0, 1.0, (5, 5, 5, 3)) * (50e-6, 50e-6, 1e-4)
    told = {
        "made": "2026-01-01",
        "geometry": geometry_of(geometry(CONFIG.geometry)),
        "low": (low - 1e-3).tolist(),
        "high": (high + 1e-3).tolist(),
        "nodes": nodes.tolist(),
    }
    return msgspec.convert(told, AsBuilt)


def robots() -> dict[str, Config]:
    """What sessions are run with."""
    limits = CONFIG.limits
    weak = msgspec.structs.replace(limits.slider, velocity=0.25, acceleration=2.5, jerk=60.0)
    weak_limits = msgspec.structs.replace(limits, slider=weak)
    uneven = msgspec.structs.replace(CONFIG.correction, backlash=(40e-6, 0.0, 15e-6))
    mapped = msgspec.structs.replace(CONFIG.correction, as_built=a_map(), backlash=(20e-6,) * 3)
    return {
        "as it is": CONFIG,
        "weak sliders": msgspec.structs.replace(CONFIG, limits=weak_limits),
        "backlash": msgspec.structs.replace(CONFIG, correction=uneven),
        "map and backlash": msgspec.structs.replace(CONFIG, correction=mapped),
    }


def random_goal(chance: random.Random, session: Session) -> Goal:
    """A goal of any kind, reachable or not."""
    pose = chance.uniform(-0.16, 0.16), chance.uniform(-0.16, 0.16), chance.uniform(-1.0, 0.8)
    if chance.random() < 0.7:
        pose = pose[0] / 3.0, pose[1] / 3.0, pose[2] / 2.0
    match chance.choice(KINDS):
        case "pose":
            blend, tool = chance.choice((None, None, 0.0, 0.01)), chance.choice((None, None, (0.03, -0.02)))
            return PoseGoal(*pose, speed=chance.choice((1.0, 1.0, 0.3)), blend=blend, tool=tool)
        case "sliders":
            return SlidersGoal(tuple(inverse(corrected_geometry(session.config), np.array(pose)).position.tolist()))
        case "velocity":
            return VelocityGoal(pose[0], pose[1], 2.0 * pose[2], timeout=0.05)
        case "track":
            return TrackGoal(*pose, velocity=(pose[1], pose[0], pose[2]), timeout=0.05)
        case _:
            x, y, phi = session.control.commanded.pose
            u, v, psi = (value + chance.uniform(-0.01, 0.01) for value in (x, y, phi))
            points = TrajectoryPoint(0.0, x, y, phi), TrajectoryPoint(0.3, u, v, psi)
            return TrajectoryGoal(points, stretch=chance.random() < 0.5)


def meddle(chance: random.Random, session: Session, goal: str) -> None:
    """Send a command at random; bring the robot back where it has been taken out of service."""
    if session.mode is Mode.FAULT:
        session.order(Command.RESET)
        session.cycles(3)
    elif session.mode is Mode.DISABLED:
        session.order(Command.ENABLE)
        session.cycles(3)
    else:
        (what,) = chance.choices(ORDERS, WEIGHTS)
        if what == "cancel":
            session.cycle(CommandRequest(10**9 + len(session.answers), "ann", Command.STOP, Stop(goal)))
        else:
            session.order(Command(what), chance.choice(RATES) if what == "override" else None)


class Progress:
    """Watches that a goal that is under way gets nearer to its end, and never farther from it."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._seen: tuple[object, float, float, int] = None, 0.0, 0.0, 0

    def look(self, cycle: int) -> None:
        control, (goal, ends, best, since) = self._session.control, self._seen
        under_way, (now, _) = control.ledger.goal, control.schedule.progress
        runs = control.schedule.runs
        end = runs[0].goal_span.end if runs else 0.0  # another one where a goal is to blend with it, or is no more
        waits = control.override == 0.0 or control.state.paused or len(runs) != 1 or now >= 1.0
        if waits or under_way is not goal or under_way is None or under_way.kind.renewed or end != ends:
            self._seen = under_way, end, now, cycle
            return
        assert now >= best - 1e-9, (cycle, under_way.id, best, now)
        if now > best + 1e-4:
            self._seen = goal, end, now, cycle
        else:
            assert cycle - since < WINDOW, (cycle, under_way.id, now)


@pytest.mark.timeout(3600)
@pytest.mark.generated(1, 2)
@pytest.mark.parametrize("robot", thinned(robots(), every=3))
@pytest.mark.long
def test_a_long_session_keeps_every_limit_and_ends_every_goal_once(
    robot: str, seed: int, request: pytest.FixtureRequest
) -> None:
    chance, config = random.Random(seed), robots()[robot]
    session = Session(config)
    progress = Progress(session)
    cycles = itertools.count(1)
    number = GOALS if request.config.getoption("explore") is None else GOALS_EXPLORED
    last: list[NDArray[np.void]] = []
    outcomes: Counter[str | None] = Counter()
    for k in range(number):
        session.planner.delay = chance.choice(DELAYS)
        session.post(f"g{k}", random_goal(chance, session))
        for _ in range(chance.choice(WAITS)):
            session.cycle()
            progress.look(next(cycles))
        if chance.random() < 0.4:
            meddle(chance, session, f"g{chance.randrange(max(0, k - 3), k + 1)}")
        if len(session.kept) > 5000 or k == number - 1:
            session.kept[:0] = last
            assert_within_limits(config, session.records)
            last = session.kept[-1:]
            session.kept.clear()
            outcomes.update(said.id for said in session.notices if said.kind == "goal")
            said = {notice.message for notice in session.notices if notice.kind == "fault"}
            assert said <= {"quick_stop by ann"}
            session.notices.clear()
    session.order(Command.OVERRIDE, 1.0)
    session.order(Command.STOP)
    session.until(lambda: session.mode in (Mode.HOLDING, Mode.DISABLED, Mode.FAULT), 3000)
    session.until(lambda: session.control.goal_queue.idle, 1000)
    outcomes.update(said.id for said in session.notices if said.kind == "goal")
    assert set(outcomes.values()) == {1}
    assert len(outcomes) == number
