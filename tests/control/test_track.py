"""A track: the platform follows a moving target, and stands when nobody tells of it any more."""

from __future__ import annotations

import itertools
import math
import random
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest
from control.test_control import assert_within_limits, with_sliders_of
from control.test_stop import PROMPT, braking, confirmed_after
from control_rig import CONFIG, ControlRig, expected_duration
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from refusals import refusal
from trirail.wire.goals import PoseGoal, TrackGoal, VelocityGoal
from trirail.wire.packets import Accepted, GoalRequest, Refused
from trirail.wire.vocabulary import Mode

PERIOD = CONFIG.period
STILL = (0.0, 0.0, 0.0)
Vector = tuple[float, float, float]
Target = Callable[[float], tuple[Vector, Vector]]
"""Pose and velocity of a target at a time [s]."""


class Told(NamedTuple):
    """What is told of a target: when it comes, and how old it is then [s]."""

    comes: float
    age: float


def sine(amplitude: float = 0.03, frequency: float = 0.5) -> Target:
    """To and fro along x."""
    w = 2.0 * math.pi * frequency
    return lambda t: ((amplitude * math.sin(w * t), 0.0, 0.0), (amplitude * w * math.cos(w * t), 0.0, 0.0))


def regular(rate: float, seconds: float) -> list[Told]:
    return [Told(n / rate, 0.0) for n in range(round(seconds * rate))]


def disturbed(rate: float, seconds: float, jitter: float, lost: float, seed: int) -> list[Told]:
    """Messages that are each up to twice the jitter late [s], and a share of which is lost."""
    rnd = random.Random(seed)
    sent = [Told(told.comes + (late := rnd.uniform(0.0, 2.0 * jitter)), late) for told in regular(rate, seconds)]
    return sorted(told for n, told in enumerate(sent) if not n or rnd.random() >= lost)


def track(
    rig: ControlRig, target: Target, told: list[Told], until: float | None = None, timeout: float = 0.25
) -> list[Vector]:
    """Tell a robot of a target, from now on; return the commanded poses, less the target's, of every cycle."""
    begins, lags, tickets = rig.now, [], itertools.count(10_000)
    waiting = iter([*told, None])
    following = next(waiting)
    end = until if until is not None else told[-1].comes
    while rig.now - begins < end:
        request = None
        if following is not None and following.comes <= rig.now + PERIOD - begins + 1e-9:
            pose, velocity = target(following.comes - following.age)
            goal, came = TrackGoal(*pose, velocity=velocity, timeout=timeout), begins + following.comes
            request = GoalRequest(next(tickets), "ann", "t1", goal, round(came * 1e9), age=following.age)
            following = next(waiting)
        rig.cycle(request)
        # What is commanded in a cycle is taken up at the SYNC of the next one.
        there, _ = target(rig.now + PERIOD - begins)
        x, y, phi = (at - is_to for at, is_to in zip(rig.control.commanded.pose, there, strict=True))
        lags.append((x, y, phi))
    return lags


def behind(lags: list[Vector], after: float = 1.0) -> float:
    """How far it was behind at most, after a time [m]."""
    found: NDArray[np.float64] = np.abs(np.array(lags)[round(after / PERIOD) :, :2])
    return float(found.max())


# ---------------------------------------------------------------------- how close


@pytest.fixture
def rig() -> ControlRig:
    return ControlRig()


@pytest.mark.parametrize("delay", [1, 3, 5])
@pytest.mark.long
def test_behind_a_sine_it_is_within_half_a_millimetre(rig: ControlRig, delay: int) -> None:
    """Whether the planner answers at once, in time, or so late that it has to be asked for more."""
    rig.enable()
    rig.planner.delay = delay
    assert behind(track(rig, sine(), regular(100.0, 4.0))) < 0.5e-3
    assert_within_limits(rig)


@pytest.mark.generated(0, 1, 2)
def test_with_jitter_and_lost_messages_it_is_within_double_that(rig: ControlRig, seed: int) -> None:
    rig.enable()
    assert behind(track(rig, sine(), disturbed(100.0, 4.0, 0.005, 0.05, seed))) < 1.0e-3
    assert_within_limits(rig)


@pytest.mark.parametrize("rate", [10.0, 50.0, 200.0])
def test_it_follows_at_every_rate(rig: ControlRig, rate: float) -> None:
    """Ten times a second a tenth of a second is extrapolated: half of 0.3 m/s² times that squared is 1.5 mm."""
    rig.enable()
    assert behind(track(rig, sine(), regular(rate, 3.0))) < (4e-3 if rate < 20.0 else 0.6e-3)
    assert rig.outcomes() == []
    assert_within_limits(rig)


def test_all_three_coordinates_are_followed(rig: ControlRig) -> None:
    rig.enable()

    def circle(t: float) -> tuple[Vector, Vector]:
        c, s = math.cos(3.0 * t), math.sin(3.0 * t)
        return (0.02 * c, 0.02 * s, 0.1 * s), (-0.06 * s, 0.06 * c, 0.3 * c)

    lags = np.array(track(rig, circle, regular(100.0, 3.0)))[round(1.0 / PERIOD) :]
    assert np.abs(lags[:, :2]).max() < 0.5e-3
    assert np.abs(lags[:, 2]).max() < 3e-3
    assert_within_limits(rig)


def test_the_reply_says_how_far_it_is_behind(rig: ControlRig) -> None:
    rig.enable()
    rig.post("t1", TrackGoal(0.05, 0.0, 0.0))
    rig.until(lambda: bool(rig.answers) and isinstance(rig.answers[-1], Accepted))
    first = rig.answers[-1]
    assert isinstance(first, Accepted)
    assert first.reply.lag == pytest.approx(0.05)
    assert rig.control.target == (0.05, 0.0, 0.0)
    track(rig, lambda _: ((0.05, 0.0, 0.0), STILL), regular(50.0, 1.0))
    last = rig.answers[-1]
    assert isinstance(last, Accepted)
    assert last.reply.lag == pytest.approx(0.0, abs=1e-9)


# ---------------------------------------------------------------------- what cannot be followed


def test_a_target_that_is_too_fast_is_followed_as_fast_as_may_be(rig: ControlRig) -> None:
    rig.enable()
    track(rig, lambda t: ((-0.1 + 0.5 * t, 0.0, 0.0), (0.5, 0.0, 0.0)), regular(100.0, 0.3))
    rig.until(lambda: rig.mode is Mode.MOVING)
    assert rig.control.commanded.velocity[0] > 0.5 * rig.config.limits.platform.velocity[0]
    rig.until(rig.holds)
    assert rig.outcomes() == [("t1", "done")]
    assert_within_limits(rig)


def test_a_target_beyond_the_border_is_waited_for_there(rig: ControlRig) -> None:
    rig.enable()
    track(rig, lambda _: ((0.2, 0.03, 0.0), STILL), regular(50.0, 2.0))
    assert rig.mode is Mode.MOVING
    assert rig.control.commanded.pose == pytest.approx((0.15, 0.03, 0.0), abs=1e-6)
    track(rig, lambda _: ((0.1, 0.03, 0.0), STILL), regular(50.0, 1.0))
    assert rig.control.commanded.pose == pytest.approx((0.1, 0.03, 0.0), abs=1e-6)
    track(rig, lambda _: ((0.2, 0.03, 0.0), STILL), regular(50.0, 1.0))
    said = [notice.message for notice in rig.notices if notice.level == "warning"]
    assert said == [  # once, however often the target crosses it
        "the target of goal t1 is beyond the limit of platform x (position 150 mm); the robot waits at the limit"
    ]
    assert_within_limits(rig)


def test_a_target_out_of_a_sliders_travel_is_waited_for_too(rig: ControlRig) -> None:
    rig.enable()
    track(rig, lambda _: ((0.14, 0.14, -0.9), STILL), regular(50.0, 3.0))
    assert rig.mode is Mode.MOVING
    assert any("the robot waits at the limit" in notice.message for notice in rig.notices)
    pose = np.array(rig.control.commanded.pose)
    assert pose[0] == pytest.approx(pose[1], abs=1e-3)  # straight on from where it stood
    assert np.linalg.norm(pose[:2]) > 0.02
    assert np.abs([rig.control.commanded.velocity, rig.control.commanded.acceleration]).max() < 1e-9
    assert_within_limits(rig)


SHARE = st.sampled_from([0.05, 0.1, 0.2, 0.5, 0.7, 1.0])


@example((0.1, 0.1, 0.1), (0.0, 0.0235, 0.0), (50.0, 0.25))
@example((0.05, 0.05, 0.05), (0.04, 0.05, -0.3), (10.0, 0.25))
@example((1.0, 0.05, 1.0), (0.04, -0.02, 0.2), (200.0, 0.05))
@given(
    st.tuples(SHARE, SHARE, SHARE),
    st.tuples(st.floats(-0.05, 0.05), st.floats(-0.05, 0.05), st.floats(-0.4, 0.4)),
    st.sampled_from([(10.0, 0.25), (10.0, 1.0), (50.0, 0.06), (50.0, 0.25), (200.0, 0.05)]),
)
@settings(max_examples=30)
def test_a_still_target_is_reached_where_the_sliders_are_slower_than_the_platform(
    shares: Vector, target: Vector, renewals: tuple[float, float]
) -> None:
    config = with_sliders_of(shares)
    rate, timeout = renewals
    asked = ControlRig(config)
    asked.enable()
    needed = expected_duration(asked.send("g1", PoseGoal(*target)))
    assume(needed > 0.02)
    rig = ControlRig(config)
    rig.enable()
    lags = track(rig, lambda _: (target, STILL), regular(rate, 3.0 * needed + 0.3), timeout=timeout)
    assert lags[-1] == pytest.approx(STILL, abs=1e-6)
    assert [answer for answer in rig.answers if isinstance(answer, Refused)] == []
    assert_within_limits(rig)


@pytest.mark.parametrize("timeout", [0.03, 0.05, 0.1])
@pytest.mark.parametrize("speed", [0.05, 0.1, 0.2])
def test_before_the_border_every_report_of_a_target_is_accepted(rig: ControlRig, speed: float, timeout: float) -> None:
    """The robot may have to brake at once, for longer than the time-out of the track."""
    rig.enable()
    told = regular(1.5 / timeout, 0.2 / speed)
    track(rig, lambda t: ((speed * t, 0.0, 0.0), (speed, 0.0, 0.0)), told, timeout=timeout)
    assert [answer for answer in rig.answers if isinstance(answer, Refused)] == []
    rig.until(rig.holds)
    assert rig.control.fault is None
    assert_within_limits(rig)


def test_a_target_that_leaves_through_the_border_and_comes_back(rig: ControlRig) -> None:
    """The platform brakes before the border, and goes on with it when it is back."""
    rig.enable()
    lags = np.array(track(rig, sine(0.18, 0.15), regular(100.0, 4.0)))[:, 0]
    assert rig.outcomes() == []
    assert lags[round(1.667 / PERIOD)] == pytest.approx(-0.03, abs=1e-4)
    assert abs(lags[-1]) < 1e-3
    assert_within_limits(rig)


# ---------------------------------------------------------------------- the dead man, and what ends it


@pytest.mark.parametrize("timeout", [0.03, 0.25, 1.0])
@pytest.mark.parametrize("override", [0.3, 1.0, 2.0])
def test_a_target_of_which_nobody_tells_is_over_in_real_time(rig: ControlRig, override: float, timeout: float) -> None:
    rig.enable()
    rig.command("override", override)
    track(rig, sine(), regular(100.0, 1.03), timeout=timeout)
    last = rig.now
    moved = rig.until(lambda: rig.mode is Mode.STOPPING) * PERIOD
    assert moved + rig.now - last >= 0.0
    assert moved == pytest.approx(timeout, abs=0.012)
    rig.until(rig.holds, round(0.5 / PERIOD))
    assert rig.outcomes() == [("t1", "done")]
    assert "released" in rig.notices[-2].message or "released" in rig.notices[-1].message
    assert refusal(rig.send("t1", TrackGoal(0.0, 0.0, 0.0))).code == "jog_over"
    assert_within_limits(rig)


def test_the_path_itself_ends_at_rest(rig: ControlRig) -> None:
    """Also where it is far from its target: no motion that is taken needs anybody to end it."""
    rig.enable()
    rig.post("t1", TrackGoal(0.14, 0.0, 0.0, velocity=(0.1, 0.1, 0.0), timeout=0.1))
    rig.until(lambda: bool(rig.control.schedule.runs))
    run = rig.control.schedule.runs[-1]
    assert run.path.duration < 0.1 + 2.0 * braking(CONFIG) * PERIOD
    assert run.state(run.path.duration, rig.control.commanded.pose).velocity == pytest.approx(STILL, abs=1e-9)


def test_a_track_that_stands_lasts_as_long_as_it_is_renewed(rig: ControlRig) -> None:
    rig.enable()
    track(rig, lambda _: ((0.01, 0.0, 0.0), STILL), regular(10.0, 3.0), timeout=0.2)
    assert rig.mode is Mode.MOVING
    assert rig.control.commanded.pose == pytest.approx((0.01, 0.0, 0.0), abs=1e-9)
    rig.until(rig.holds, 400)
    assert rig.outcomes() == [("t1", "done")]


def test_nobody_else_renews_it_nor_does_another_kind(rig: ControlRig) -> None:
    rig.enable()
    track(rig, sine(), regular(100.0, 0.5))
    rig.cycle(GoalRequest(900, "bob", "t1", TrackGoal(0.0, 0.0, 0.0), round(rig.now * 1e9)))
    rig.cycle(GoalRequest(901, "ann", "t1", VelocityGoal(0.01, 0.0, 0.0), round(rig.now * 1e9)))
    rig.cycles(10)
    codes = {answer.ticket: answer.code for answer in rig.answers if isinstance(answer, Refused)}
    assert codes == {900: "duplicate_id", 901: "duplicate_id"}
    assert rig.mode is Mode.MOVING


def test_what_is_told_anew_takes_the_place_of_what_waits_whoever_else_does(rig: ControlRig) -> None:
    rig.enable()
    track(rig, sine(), regular(100.0, 0.3))
    rig.planner.delay = 40
    told = TrackGoal(0.02, 0.0, 0.0, timeout=1.0)
    for ticket, user in enumerate(("ann", "ann", "bob", "ann", "ann"), 1):
        rig.cycle(GoalRequest(ticket, user, "t1", told, round(rig.now * 1e9)))
    passed = [answer.ticket for answer in rig.answers if isinstance(answer, Accepted) and answer.ticket < 10]
    assert passed == [1, 2, 4]


def test_a_pose_preempts_it_and_it_preempts_a_pose(rig: ControlRig) -> None:
    rig.enable()
    rig.goal("g1", 0.05, 0.0, 0.0)
    rig.cycles(100)
    track(rig, sine(), regular(100.0, 0.8))
    assert isinstance(rig.goal("g2", 0.0, 0.05, 0.0), Accepted)
    rig.until(rig.holds)
    assert rig.outcomes() == [("g1", "preempted"), ("t1", "preempted"), ("g2", "done")]
    assert_within_limits(rig)


@pytest.mark.parametrize(("age", "when"), [(0.6, "0.60"), (-0.6, "in 0.59")])
def test_a_time_too_far_from_now_is_refused(rig: ControlRig, age: float, when: str) -> None:
    rig.enable()
    rig.cycle(GoalRequest(1, "ann", "t1", TrackGoal(0.01, 0.0, 0.0), round(rig.now * 1e9), age=age))
    answer = refusal(rig.answers[-1])
    assert answer.code == "wrong_time"
    assert when in answer.message
    assert rig.outcomes() == [("t1", "rejected")]


def test_what_has_waited_behind_its_senders_others_is_not_blamed_on_a_clock(rig: ControlRig) -> None:
    rig.enable()
    rig.cycles(2000)
    came = round((rig.now - 1.2) * 1e9)
    rig.cycle(GoalRequest(1, "ann", "t1", TrackGoal(0.01, 0.0, 0.0, timeout=1.0), came, age=0.1))
    assert refusal(rig.answers[-1]).code == "expired"
    rig.cycle(GoalRequest(2, "ann", "t2", TrackGoal(0.01, 0.0, 0.0, timeout=2.0), came, age=0.1))
    answer = refusal(rig.answers[-1])
    assert answer.code == "busy"
    assert "has waited 1.2" in answer.message


def test_what_is_refused_hundreds_of_times_is_told_once(rig: ControlRig) -> None:
    rig.enable()
    track(rig, sine(), regular(100.0, 0.3))
    rig.command("stop")
    before = len(rig.notices)
    track(rig, sine(), regular(100.0, 1.0))
    assert sum(isinstance(answer, Refused) for answer in rig.answers) >= 90
    assert len(rig.notices) - before <= 2


# ---------------------------------------------------------------------- whatever is told


UNIT = st.floats(-1.0, 1.0)
"""Within the box or up to twice as far out; up to twice as fast as the limits allow."""


class Way(NamedTuple):
    """A target that goes on from a pose with a velocity, until it is elsewhere all of a sudden."""

    pose: Vector
    velocity: Vector
    lasts: float


@st.composite
def ways(draw: st.DrawFn) -> list[Way]:
    platform = CONFIG.limits.platform
    sizes = [max(map(abs, span)) for span in (platform.x, platform.y, platform.phi)]

    def way() -> Way:
        x, y, phi = (2.0 * draw(UNIT) ** 3 * size for size in sizes)
        vx, vy, w = (2.0 * draw(UNIT) ** 3 * limit for limit in platform.velocity)
        return Way((x, y, phi), (vx, vy, w), draw(st.floats(0.02, 0.5)))

    return [way() for _ in range(draw(st.integers(1, 4)))]


def jumping(legs: list[Way]) -> tuple[Target, float]:
    """Return the target that goes these ways one after the other, and how long that takes [s]."""

    def target(t: float) -> tuple[Vector, Vector]:
        for leg in legs:
            if t < leg.lasts or leg is legs[-1]:
                x, y, phi = (at + min(t, leg.lasts) * v for at, v in zip(leg.pose, leg.velocity, strict=True))
                return (x, y, phi), leg.velocity
            t -= leg.lasts
        raise AssertionError

    return target, sum(leg.lasts for leg in legs)


@given(
    ways(),
    st.floats(10.0, 200.0),
    st.floats(0.0, 0.01),
    st.floats(0.0, 0.3),
    st.sampled_from([1, 1, 2, 5, 14]),
    st.sampled_from([0.03, 0.5, 1.0, 2.0]),
    st.booleans(),
    st.integers(0, 1000),
)
@settings(max_examples=40)
def test_whatever_is_told_no_limit_is_passed_and_it_stands_at_the_end(
    legs: list[Way], rate: float, jitter: float, lost: float, delay: int, override: float, stop: bool, seed: int
) -> None:
    rig = ControlRig()
    rig.enable()
    rig.command("override", override)
    rig.planner.delay = delay
    target, seconds = jumping(legs)
    track(rig, target, disturbed(rate, seconds, jitter, lost, seed) or [Told(0.0, 0.0)], until=seconds)
    if stop:
        assert confirmed_after(rig, "stop", braking(CONFIG) + PROMPT) <= braking(CONFIG) + PROMPT
    rig.until(rig.holds, round(1.0 / PERIOD))
    assert rig.control.fault is None
    assert rig.control.commanded.at_rest
    assert [name for name, _ in rig.outcomes()] in ([], ["t1"])
    assert_within_limits(rig)
