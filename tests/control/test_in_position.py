"""A goal is done when the robot is measured to be there: windows, dwell, time-out, and every way out of settling."""

from __future__ import annotations

import math
import random
from collections.abc import Callable

import msgspec
import numpy as np
import pytest
from conftest import Rig, changed
from control_rig import CONFIG, ControlRig, expected_duration
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from trirail.config import Config, geometry
from trirail.control.in_position import Settling, monitor
from trirail.control.modes import ModeEvent
from trirail.kinematics.robot import inverse
from trirail.wire.event_codes import EventCode, coded
from trirail.wire.goals import PoseGoal, SlidersGoal, TrajectoryGoal, TrajectoryPoint, VelocityGoal
from trirail.wire.messages import Notice
from trirail.wire.packets import Accepted, CommandDone
from trirail.wire.records import DTYPE
from trirail.wire.vocabulary import Mode
from trirail_drivers.interface import PowerState

PERIOD = CONFIG.period
ROBOT = geometry(CONFIG.geometry)
WINDOWS = CONFIG.limits.in_position
TARGET = (0.006, -0.004, 0.02)
LAG = 0.2
"""How far the servos of the measured example are behind [s]."""


def lagging(config: Config = CONFIG, timeout: float = WINDOWS.timeout) -> Config:
    """Sliders that follow their setpoints with a lag, and may."""
    slider = msgspec.structs.replace(config.limits.slider, following_error=0.1)
    windows = msgspec.structs.replace(config.limits.in_position, timeout=timeout)
    limits = msgspec.structs.replace(config.limits, slider=slider, in_position=windows)
    drives = msgspec.structs.replace(config.drives, following_error=0.1)
    made = msgspec.structs.replace(config, limits=limits, drives=drives)
    return changed(made, time_constant=LAG, feed_forward_gain=0.0)


@pytest.fixture
def behind(robots: Callable[..., Rig]) -> Rig:
    """A robot that lags, enabled."""
    rig = robots(lagging())
    rig.enable()
    return rig


@pytest.fixture
def late(behind: Rig) -> Rig:
    """The same in the cycle in which the path of goal g1 has ended and the goal has not."""
    behind.goal("g1", *TARGET)
    to_the_end_of_the_path(behind)
    return behind


def to_the_end_of_the_path(rig: Rig) -> None:
    rig.until(lambda: rig.control.measured.record["progress"][0] == 1.0)
    assert rig.control.ledger.goal is not None
    assert rig.mode is Mode.MOVING


def ends(rig: Rig) -> list[Notice]:
    return [said for said in rig.notices if said.kind == "goal"]


def away(rig: Rig, target: tuple[float, float, float] = TARGET) -> float:
    """By how many windows the measured robot is off at most: sliders and pose."""
    sliders = inverse(ROBOT, np.array(target)).position
    off = np.abs([rig.control.measured.feedback.position - sliders, np.subtract(rig.control.measured.pose, target)])
    return float((off / (WINDOWS.sliders, WINDOWS.pose)).max())


# ---------------------------------------------------------------------- done, and not before


def test_done_is_not_said_before_the_robot_is_there(late: Rig) -> None:
    """What was measured once: servos 0.2 s behind, done said 1.84 mm too early, and 0.6 s."""
    assert away(late) > 10.0
    inside = 0
    ended = late.control.cycles
    while late.mode is Mode.MOVING:
        assert ends(late) == []
        late.cycle()
        inside = inside + 1 if away(late) <= 1.0 else 0
    dwell = round(WINDOWS.dwell / PERIOD)
    assert inside == dwell
    assert late.outcomes() == [("g1", "done")]
    (said,) = ends(late)
    assert said.settle == pytest.approx((late.control.cycles - dwell + 1 - ended) * PERIOD, abs=1e-9)
    assert said.settle is not None
    assert 0.2 < said.settle < 1.0
    assert said.residual is not None
    position = np.array(late.control.measured.feedback.position)
    assert said.residual.sliders == pytest.approx(inverse(ROBOT, np.array(TARGET)).position - position, abs=1e-9)
    assert said.residual.pose == pytest.approx(np.subtract(TARGET, late.control.measured.pose), abs=1e-9)
    assert said.overshoot == pytest.approx((0.0, 0.0, 0.0), abs=1e-6)  # a lag of first order has none


def test_it_settles_at_once_where_the_drives_follow(rig: Rig) -> None:
    rig.enable()
    answer = rig.goal("g1", *TARGET)
    assert isinstance(answer, Accepted)
    taken = rig.until(rig.holds)
    assert taken <= math.ceil(expected_duration(answer) / PERIOD) + round(WINDOWS.dwell / PERIOD) + 3
    assert ends(rig)[0].settle == pytest.approx(PERIOD)


def test_a_goal_to_where_the_robot_stands_dwells_too(rig: Rig) -> None:
    """The time before the goal does not count: it settles after the end of its path, however short."""
    rig.enable()
    rig.cycles(2 * round(WINDOWS.dwell / PERIOD))
    rig.goal("g1", *rig.control.commanded.pose)
    assert rig.until(rig.holds) >= round(WINDOWS.dwell / PERIOD) - 1
    assert ends(rig)[0].settle == pytest.approx(PERIOD)


def test_what_leaves_its_window_begins_anew(late: Rig) -> None:
    late.until(lambda: away(late) <= 1.0)
    late.cycles(round(WINDOWS.dwell / PERIOD) // 2)
    late.drives[1].servo.position += 3e-4 * CONFIG.drives.B.counts_per_metre  # somebody leans on it
    late.cycle()
    late.cycle()
    assert away(late) > 1.0
    late.cycles(round(WINDOWS.dwell / PERIOD))
    assert late.outcomes() == []
    late.until(late.holds)
    assert late.outcomes() == [("g1", "done")]
    assert away(late) <= 1.0


def test_how_far_a_slider_was_beyond_its_target_is_told(late: Rig) -> None:
    late.cycles(100)
    place = late.control.measured.feedback.position[2]
    target = float(inverse(ROBOT, np.array(TARGET)).position[2])
    beyond = target + math.copysign(5e-4, target - place)  # it came from the other side
    late.drives[2].servo.position = CONFIG.drives.C.counts_per_metre * beyond
    late.until(late.holds)
    overshoot = ends(late)[0].overshoot
    assert overshoot is not None
    assert overshoot[2] == pytest.approx(5e-4, rel=0.05)
    assert overshoot[:2] == pytest.approx((0.0, 0.0), abs=1e-6)


def test_settled_is_told_in_every_cycle(late: Rig) -> None:
    record = late.control.measured.record
    seen = []
    while late.mode is Mode.MOVING:
        late.cycle()
        seen.append(bool(record["settled"][0]))
    assert seen == [False] * (len(seen) - 1) + [True]
    late.cycles(10)
    assert record["settled"]
    late.drives[0].servo.position += 1e-3 * CONFIG.drives.A.counts_per_metre
    late.cycles(3)
    assert not record["settled"]  # it is pushed away while it holds
    assert late.mode is Mode.HOLDING
    late.command("disable")
    assert not record["settled"]


# ---------------------------------------------------------------------- unsettled


def test_unsettled_says_where_the_robot_is_and_holds(robots: Callable[..., Rig]) -> None:
    rig = robots(lagging(timeout=0.1))
    rig.enable()
    rig.goal("g1", *TARGET)
    to_the_end_of_the_path(rig)
    ended = rig.control.cycles
    rig.until(rig.holds)
    assert rig.control.cycles == ended + round(0.1 / PERIOD)
    (said,) = ends(rig)
    assert (said.outcome, said.settle, said.level) == ("unsettled", None, "warning")
    assert said.residual is not None
    missing = inverse(ROBOT, np.array(TARGET)).position - np.array(rig.control.measured.feedback.position)
    assert said.residual.sliders == pytest.approx(missing, abs=1e-9)
    for name, error in zip("ABC", said.residual.sliders, strict=True):
        assert f"slider {name} {error * 1e3:.3f} mm" in said.message
    x, y, phi = said.residual.pose
    assert f"x {x * 1e3:.3f} mm, y {y * 1e3:.3f} mm, phi {phi * 1e3:.3f} mrad" in said.message
    assert all(state is PowerState.OPERATION_ENABLED for state in rig.control.measured.feedback.state)
    rig.goal("g2", 0.0, 0.0, 0.0)  # and takes the next goal
    assert rig.mode is Mode.MOVING


# ---------------------------------------------------------------------- what happens meanwhile


@pytest.mark.parametrize(
    ("what", "outcome", "mode"),
    [
        ("stop", "stopped", Mode.HOLDING),
        ("disable", "stopped", Mode.DISABLED),
        ("quick_stop", "faulted", Mode.FAULT),  # as of a goal in motion: it latches like a fault
        (ModeEvent.GATEWAY_LOST, "stopped", Mode.HOLDING),
        (ModeEvent.LATE, "stopped", Mode.HOLDING),
        (ModeEvent.SHUTDOWN, "stopped", Mode.DISABLED),
        ("fault", "faulted", Mode.FAULT),
    ],
)
def test_what_ends_it(late: Rig, what: str | ModeEvent, outcome: str, mode: Mode) -> None:
    if isinstance(what, ModeEvent):
        late.control.modes.handle_disturbance(what, coded("it happened", EventCode.OTHER))
    elif what == "fault":
        late.drives[0].fail(0x2310)
    else:
        assert isinstance(late.command(what), CommandDone)
        assert late.mode is mode
    late.until(lambda: late.mode is mode)
    late.cycles(1000)
    assert late.outcomes() == [("g1", outcome)]
    assert ends(late)[0].settle is None


def test_a_pause_finds_nothing_to_pause(late: Rig) -> None:
    """The path has ended: it goes on to settle, and the goal ends as it would have."""
    late.order("pause")
    late.until(late.holds)
    assert late.outcomes() == [("g1", "done")]
    assert away(late) <= 1.0
    late.cycles(10)
    assert late.control.ledger.goal is None


def test_resume_and_override_leave_it_settling(late: Rig) -> None:
    late.order("pause")
    late.order("resume")
    late.order("override", 0.0)
    late.until(late.holds)
    assert late.outcomes() == [("g1", "done")]
    assert away(late) <= 1.0


@pytest.mark.parametrize(
    "goal",
    [
        PoseGoal(-0.01, 0.0, 0.0),
        SlidersGoal((0.0, 0.0, 0.0)),
        VelocityGoal(0.01, 0.0, 0.0, timeout=0.05),
        TrajectoryGoal((TrajectoryPoint(0.0, *TARGET), TrajectoryPoint(1.0, 0.0, 0.0, 0.0))),
    ],
)
def test_the_next_goal_preempts_it_at_once(
    late: Rig, goal: PoseGoal | SlidersGoal | VelocityGoal | TrajectoryGoal
) -> None:
    assert isinstance(late.send("g2", goal), Accepted)
    assert late.outcomes() == [("g1", "preempted")]
    assert late.control.ledger.goal is not None
    assert late.control.ledger.goal.id == "g2"
    late.until(late.holds)
    assert late.outcomes() == [("g1", "preempted"), ("g2", "done")]


def test_a_refused_goal_leaves_it_settling(late: Rig) -> None:
    late.goal("g2", 0.5, 0.0, 0.0)
    late.until(late.holds)
    assert late.outcomes() == [("g2", "rejected"), ("g1", "done")]


# ---------------------------------------------------------------------- what does not wait


def test_a_blend_does_not_wait(behind: Rig) -> None:
    for name, goal in (("g1", PoseGoal(0.006, 0.0, 0.0, blend=0.001)), ("g2", PoseGoal(0.006, 0.006, 0.0))):
        assert isinstance(behind.send(name, goal), Accepted)
    behind.until(lambda: bool(behind.outcomes()))
    (said,) = ends(behind)
    assert (said.id, said.outcome, said.settle, said.residual) == ("g1", "done", None, None)
    assert not behind.control.commanded.at_rest
    behind.until(behind.holds)
    assert ends(behind)[1].settle is not None


@pytest.mark.parametrize("later", range(9))
def test_a_goal_that_comes_as_the_path_ends_goes_on_from_a_blend(behind: Rig, later: int) -> None:
    """Neither is the one refused, nor the other preempted, at whatever cycle of the path's last ones it comes."""
    behind.send("g1", PoseGoal(*TARGET, blend=0.001))
    behind.until(lambda: behind.control.measured.record["remaining"][0] <= 5 * PERIOD)
    behind.cycles(later)
    behind.post("g2", PoseGoal(0.0, 0.0, 0.0))
    behind.until(behind.holds)
    assert behind.outcomes() == [("g1", "done"), ("g2", "done")]


def test_a_trajectory_may_ask_not_to_settle(behind: Rig) -> None:
    points = (TrajectoryPoint(0.0, 0.0, 0.0, 0.0), TrajectoryPoint(1.0, *TARGET))
    answer = behind.send("g1", TrajectoryGoal(points, settle=False))
    assert isinstance(answer, Accepted)
    assert behind.until(behind.holds) <= math.ceil(expected_duration(answer) / PERIOD) + 2
    assert away(behind) > 10.0
    (said,) = ends(behind)
    assert (said.outcome, said.settle, said.residual, said.overshoot) == ("done", None, None, None)
    assert behind.control.measured.record["settled"] == 0
    back = tuple(TrajectoryPoint(point.t, *TARGET) for point in points)
    behind.send("g2", TrajectoryGoal(back))
    behind.until(behind.holds)
    assert ends(behind)[1].settle is not None
    assert away(behind) <= 1.0


@pytest.mark.generated(*range(10))
def test_the_robot_rests_after_a_trajectory_that_does_not_settle(seed: int) -> None:
    """Also if a setpoint is exactly at the end of the path, where the path may still have an acceleration."""
    chance = random.Random(seed)
    rate_hz = chance.choice((256, 512, 1000, 1024))
    rig = ControlRig(replace(CONFIG, loop=replace(CONFIG.loop, rate_hz=rate_hz)))
    rig.enable()
    for number in range(6):
        x, y, phi = rig.control.commanded.pose
        end = chance.choice((chance.randrange(2, 9), chance.randrange(256, 600))) / rate_hz
        acceleration = chance.choice((None, (-0.02, 0.0, 0.0)))
        last = TrajectoryPoint(end, x + min(0.003, 0.01 * end**3), y, phi, acceleration=acceleration)
        trajectory = TrajectoryGoal((TrajectoryPoint(0.0, x, y, phi), last), settle=False, stretch=True)
        assert isinstance(rig.send(f"t{number}", trajectory), Accepted)
        rig.until(rig.holds)
        assert rig.control.commanded.at_rest
        assert isinstance(rig.send(f"g{number}", PoseGoal(chance.uniform(-0.01, 0.01), y, phi)), Accepted)
        rig.until(rig.holds)


def test_a_jog_does_not_settle(behind: Rig) -> None:
    behind.send("j1", VelocityGoal(0.02, 0.0, 0.0, timeout=0.1))
    behind.until(behind.holds)
    assert behind.control.measured.record["settled"] == 0
    assert [(said.outcome, said.settle) for said in ends(behind)] == [("done", None)]


# ---------------------------------------------------------------------- the compiled judge

INSIDE = st.sampled_from((0.0, 0.5, 0.999, 1.0, -0.7, -1.0))
ANY = st.sampled_from((0.0, 0.5, 1.0, -1.0, 1.001, -1.001, 30.0, math.nan))


def but_one(shares: tuple[float, ...], index: int, share: float) -> tuple[float, ...]:
    return (*shares[:index], share, *shares[index + 1 :])


OFF = st.builds(but_one, st.tuples(*[INSIDE] * 6), st.integers(0, 5), ANY)
"""Residuals in shares of their windows: one of them alone may be outside."""
Cycle = tuple[tuple[float, ...], bool]


@given(
    cycles=st.lists(st.tuples(OFF, st.sampled_from((True, True, True, False))), min_size=1, max_size=40)
    | st.lists(st.tuples(st.just((0.5,) * 6), st.just(True)), min_size=1, max_size=40),
    dwell=st.integers(1, 3) | st.integers(1, 10),
)
def test_in_position_is_all_inside_in_every_cycle_of_the_dwell(cycles: list[Cycle], dwell: int) -> None:
    """Against the definition, read word by word: residuals in shares of the windows."""
    limits = msgspec.structs.replace(WINDOWS, sliders=(1e-4, 2e-4, 4e-4), pose=(1e-3, 2e-3, 8e-3), dwell=dwell * PERIOD)
    settling, record = Settling(limits, PERIOD), np.zeros(1, DTYPE)
    settling.begin(0)
    inside: list[bool] = []
    for number, (off, known) in enumerate(cycles, 1):
        record["position"], record["pose"] = -np.multiply(off[:3], limits.sliders), -np.multiply(off[3:], limits.pose)
        monitor(record, known, True, settling.monitored)
        inside.append(known and all(abs(share) <= 1.0 for share in off))
        expected = number >= dwell and all(inside[-dwell:])
        assert bool(record["settled"][0]) is expected
        found = settling.result(number)
        assert (found is not None and found.settle is not None) is expected
        if found is not None and found.settle is not None:
            streak = next((n for n, was in enumerate(reversed(inside)) if not was), number)
            assert found.settle == pytest.approx((number + 1 - streak) * PERIOD)


@pytest.mark.parametrize("number", range(6))
def test_a_residual_as_large_as_its_window_is_inside_and_a_larger_one_is_not(number: int) -> None:
    """Each of the sliders' and the pose's by itself, on either side."""
    limits = msgspec.structs.replace(WINDOWS, sliders=(1e-4, 2e-4, 4e-4), pose=(1e-3, 2e-3, 8e-3), dwell=PERIOD)
    settling, record = Settling(limits, PERIOD), np.zeros(1, DTYPE)
    for share, inside in ((1.0, True), (-1.0, True), (1.001, False), (-1.001, False)):
        off = np.array(but_one((0.0,) * 6, number, share))
        record["position"], record["pose"] = -off[:3] * limits.sliders, -off[3:] * limits.pose
        monitor(record, True, True, settling.monitored)
        assert bool(record["settled"][0]) is inside


SPEEDS = st.lists(st.tuples(*[st.sampled_from((0.0, 0.01, -0.02, 5e-10, -5e-10))] * 3), max_size=5)
RESIDUALS = st.lists(st.tuples(*[st.floats(-1e-3, 1e-3)] * 3), min_size=1, max_size=6)


@given(earlier=SPEEDS, motion=SPEEDS, residuals=RESIDUALS)
def test_overshoot_is_beyond_the_target_in_the_direction_of_the_last_motion(
    earlier: list[tuple[float, ...]], motion: list[tuple[float, ...]], residuals: list[tuple[float, ...]]
) -> None:
    """Whatever the motions before it; of a slider that was not moved, both directions are. No cycle of it settles."""
    settling, record = Settling(WINDOWS, PERIOD), np.zeros(1, DTYPE)

    def cycle(stands: bool, speed: tuple[float, ...] = (0.0,) * 3, residual: tuple[float, ...] = (0.0,) * 3) -> None:
        record["commanded_velocity"], record["position"] = speed, -np.array(residual)
        monitor(record, True, stands, settling.monitored)

    for speed in earlier:
        cycle(False, speed)
    cycle(True)
    for speed in motion:
        cycle(False, speed)
        assert (record["settled"][0], settling.monitored["inside"][0]) == (0, 0)
    settling.begin(0)
    for residual in residuals:
        cycle(True, residual=residual)
    found = settling.now(None)
    assert found.residual.sliders == pytest.approx(residuals[-1], abs=1e-15)
    for n in range(3):
        moved = [speed[n] for speed in (motion or earlier) if abs(speed[n]) > 1e-9]
        off = [residual[n] for residual in residuals]
        beyond = [-error * math.copysign(1.0, moved[-1]) for error in off] if moved else [abs(error) for error in off]
        assert found.overshoot[n] == pytest.approx(max(0.0, *beyond), abs=1e-15)
