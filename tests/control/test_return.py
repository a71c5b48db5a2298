"""A robot on a limit or beyond one: it is enabled, every kind of goal leads back inside, and none farther out."""

from __future__ import annotations

import math
import random
from functools import cache

import msgspec
import numpy as np
import pytest
from control_rig import ControlRig, PerfectDrives
from numpy.typing import NDArray
from refusals import refusal
from trirail.config import SIM, Config, corrected_geometry, load
from trirail.errors import KinematicsError
from trirail.kinematics.geometry import Geometry, singular_angles
from trirail.kinematics.robot import inverse
from trirail.motion.feasibility import Checker
from trirail.motion.limits import Bounds
from trirail.motion.paths import constant_law
from trirail.motion.ruckig_call import Kinodynamic, Solver
from trirail.motion.runs import rest
from trirail.wire.goals import (
    Goal,
    MoveGoal,
    PoseGoal,
    SlidersGoal,
    TrackGoal,
    TrajectoryGoal,
    TrajectoryPoint,
    VelocityGoal,
)
from trirail.wire.packets import Accepted, GoalRequest
from trirail.wire.vocabulary import Mode
from trirail_drivers.interface import Feedback, Triple

Array = NDArray[np.float64]

ROBOTS = ("sim", "uvw", "xxy", "uvw-ppr")
COUNTS = (1e5, 4e5, 1e6, 1e7, 1e8)
"""Counts per metre of the sliders' encoders."""
BEYOND = (0.0, 1e-9, 36.4e-9, 1e-6, 1e-4, 1e-3)
"""How far beyond the limit the robot is, as a share of the way to it."""
ROUNDING = 1e-9
"""Excess that the check along a path takes for rounding [m, rad]."""
BACK = 0.9
"""Share of the way to the limit to which the goals lead."""


@cache
def config(name: str, counts: float = 1e8) -> Config:
    """Return a shipped configuration; its windows are as wide as encoders of so few counts need."""
    replace, shipped = msgspec.structs.replace, load(SIM.with_name(f"{name}.toml"))
    windows = shipped.limits.in_position
    sliders: Triple = tuple(max(window, 3.5 / counts) for window in windows.sliders)  # type: ignore[assignment]
    pose: Triple = tuple(max(window, 100.0 / counts) for window in windows.pose)  # type: ignore[assignment]
    wider = replace(windows, sliders=sliders, pose=pose)
    return replace(
        shipped,
        drives=replace(shipped.drives, missed_positions=3),
        limits=replace(shipped.limits, in_position=wider),
    )


class CountingDrives(PerfectDrives):
    """Perfect drives that measure in counts."""

    def __init__(self, position: Triple, counts: float) -> None:
        super().__init__(position)
        self._counts = counts

    def read(self) -> Feedback:
        """Return positions in whole counts."""
        a, b, c = (round(each * self._counts) / self._counts for each in self._position)
        return super().read()._replace(position=(a, b, c))


@cache
def robot_of(name: str) -> Geometry:
    return corrected_geometry(config(name))


def positions(name: str, pose: Array) -> Array:
    """Return the nine limited positions at a pose."""
    motion = inverse(robot_of(name), pose)
    return np.concatenate([pose, motion.position, motion.passive_position])


@cache
def box(name: str) -> Array:
    """Return the limits of the nine positions, low and high: (2, 9)."""
    limits = config(name).limits
    platform, slider = limits.platform, limits.slider
    both: Array = np.array([platform.x, platform.y, platform.phi, *slider.positions, *[slider.passive] * 3]).T
    return both


def excess(name: str, pose: Array) -> Array:
    """Return how far each position is beyond its limits, 0 within them."""
    low, high = box(name)
    at = positions(name, pose)
    beyond: Array = np.maximum(np.maximum(low - at, at - high), 0.0)
    return beyond


def way_to_a_limit(name: str, chance: random.Random) -> tuple[Array, Array]:
    """Return a pose inside, and the way from there to the first limit in a random direction."""
    low, high = box(name)
    half = (high[:3] - low[:3]) / 2.0
    for _ in range(100):
        inside = low[:3] + half + half * [chance.uniform(-0.3, 0.3) for _ in range(3)]
        way = 3.0 * half * [chance.uniform(-1.0, 1.0) for _ in range(3)]
        if excess(name, inside).any():
            continue
        within, beyond = 0.0, 1.0
        for _ in range(60):
            middle = (within + beyond) / 2.0
            try:
                reached = not excess(name, inside + middle * way).any()
            except KinematicsError:
                reached = False
            within, beyond = (middle, beyond) if reached else (within, middle)
        return inside, within * way
    raise AssertionError("nowhere inside")


def goals(name: str, pose: Array, target: Array, kind: str) -> Goal:
    """Return a goal of a kind that leads from a pose to a target."""
    x, y, phi = target.tolist()
    change = target - pose
    limits = config(name).limits.platform
    share = 0.05 / max(np.abs(change) / limits.velocity)
    vx, vy, w = (share * change).tolist()
    slow = 40.0 * float(max(np.abs(change) / limits.velocity)) + 1.0
    match kind:
        case "pose":
            return PoseGoal(x, y, phi)
        case "move":
            return MoveGoal(*change.tolist())
        case "sliders":
            return SlidersGoal(tuple(positions(name, target)[3:6].tolist()))
        case "velocity":
            return VelocityGoal(vx, vy, w, timeout=0.1)
        case "track":
            return TrackGoal(x, y, phi, timeout=0.5)
        case _:
            points = TrajectoryPoint(0.0, *pose.tolist()), TrajectoryPoint(slow, x, y, phi)
            return TrajectoryGoal(points)


KINDS = ("pose", "move", "sliders", "velocity", "track", "trajectory")


@pytest.mark.generated(*range(72))
def test_every_kind_of_goal_leads_back_inside(seed: int) -> None:
    chance = random.Random(seed)
    name, kind = ROBOTS[seed % len(ROBOTS)], KINDS[seed // len(ROBOTS) % len(KINDS)]
    inside, way = way_to_a_limit(name, chance)
    pose = inside + way * (1.0 + chance.choice(BEYOND))
    a, b, c = positions(name, pose)[3:6].tolist()
    counts = chance.choice(COUNTS)
    rig = ControlRig(config(name, counts), CountingDrives((a, b, c), counts))
    rig.enable()
    stands = np.array(rig.control.commanded.pose)
    least = excess(name, stands)
    target = inside + BACK * way
    answer = rig.send("back", goals(name, stands, target, kind))
    assert isinstance(answer, Accepted), answer
    beyond = least
    for _ in range(60_000):
        rig.cycle()
        now = excess(name, np.array(rig.control.commanded.pose))
        assert (now <= beyond + 1e-11).all()
        beyond = np.minimum(now, beyond)
        if rig.mode is Mode.HOLDING:
            break
    assert rig.control.fault is None
    assert rig.outcomes() == [("back", "done")]
    assert np.abs(np.array(rig.control.commanded.pose) - stands).max() > 1e-7
    assert not (excess(name, np.array(rig.control.commanded.pose)) > least).any()


@pytest.mark.generated(*range(24))
def test_no_goal_leads_farther_out(seed: int) -> None:
    chance = random.Random(seed)
    name, kind = ROBOTS[seed % len(ROBOTS)], KINDS[seed // len(ROBOTS) % len(KINDS)]
    inside, way = way_to_a_limit(name, chance)
    pose = inside + way * (1.0 + chance.choice(BEYOND))
    a, b, c = positions(name, pose)[3:6].tolist()
    counts = chance.choice(COUNTS)
    rig = ControlRig(config(name, counts), CountingDrives((a, b, c), counts))
    rig.enable()
    stands = np.array(rig.control.commanded.pose)
    most = np.maximum(excess(name, stands), ROUNDING) + ROUNDING
    rig.cycle(GoalRequest(1, "ann", "out", goals(name, stands, stands + 0.05 * way, kind), round(rig.now * 1e9)))
    for _ in range(1500):
        rig.cycle()
        assert (excess(name, np.array(rig.control.commanded.pose)) <= most).all()
    assert rig.control.fault is None
    assert rig.mode is Mode.HOLDING


@pytest.mark.generated(*range(24))
def test_no_jog_leads_farther_out_however_slow_it_is(seed: int) -> None:
    """Nor is one accepted that would move the robot by no more than rounding."""
    chance = random.Random(seed)
    name, kind = ROBOTS[seed % len(ROBOTS)], seed % 3
    limits = config(name).limits.platform
    high, fastest = (limits.x, limits.y, limits.phi)[kind][1], limits.velocity[kind]
    pose, velocity = np.zeros(3), np.zeros(3)
    pose[kind] = high * (1.0 + chance.choice(BEYOND[-2:]))
    velocity[kind] = fastest * 10.0 ** chance.uniform(-7.0, 0.0)
    a, b, c = positions(name, pose)[3:6].tolist()
    rig = ControlRig(config(name), PerfectDrives((a, b, c)))
    rig.enable()
    stands = np.array(rig.control.commanded.pose)
    x, y, phi = velocity.tolist()
    answer = refusal(rig.send("out", VelocityGoal(x, y, phi, timeout=chance.choice((0.02, 0.1, 1.0)))))
    assert answer.code == "out_of_workspace"
    assert "the jog cannot start: the robot would pass the limit of" in answer.message
    rig.cycles(300)
    assert rig.control.fault is None
    assert rig.control.commanded.pose == pytest.approx(stands, rel=0.0, abs=1e-12)


@pytest.mark.parametrize("name", ROBOTS)
def test_no_way_leads_back_through_a_singular_pose(name: str) -> None:
    """Beyond a singular angle every limit but that of phi may hold."""
    robot = corrected_geometry(config(name))
    angle = min((each for each in singular_angles(robot) if each > 0.0), default=0.0)
    limits = config(name).limits
    anywhere = msgspec.structs.replace(limits.slider, position=((-9.0, 9.0),) * 3, passive=(-9.0, 9.0))
    limits = msgspec.structs.replace(limits, slider=anywhere)
    checker = Checker(robot, limits, Bounds(limits, config(name).period), config(name).period)
    for turn, passes in ((angle - 1e-2, True), (angle + 1e-2, False)):
        begin = rest((0.0, 0.0, turn))
        path = Solver().to_rest(begin, (0.0, 0.0, 0.0), Kinodynamic(*checker.platform_limits.T.tolist()))
        found = checker.sample(path, constant_law(1.0), 0.0, path.duration, begin.pose)
        assert math.isnan(found.leaves_at) is passes
