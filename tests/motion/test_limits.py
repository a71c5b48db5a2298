"""No motion beyond a limit of sliders or platform: every kind of goal, at every override, and at the last gate."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from conftest import Rig, changed
from control.test_control import GOAL, PERIOD, ROBOT, assert_within_limits, with_sliders_of
from control_rig import CONFIG, ControlRig, expected_duration
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from refusals import refusal
from trirail.kinematics.robot import inverse
from trirail.motion.limits import Bounds, Violation, gate
from trirail.motion.runs import MotionState, rest
from trirail.wire.goals import Goal, PoseGoal, SlidersGoal, TrajectoryGoal, TrajectoryPoint, VelocityGoal
from trirail.wire.packets import Accepted
from trirail.wire.vocabulary import Mode

LIMITS = CONFIG.limits
PLATFORM = np.array([LIMITS.platform.velocity, LIMITS.platform.acceleration, LIMITS.platform.jerk])
Rows = list[list[float]]
BETWEEN = 1e-3
"""What may lie between the moments at which a path is looked at, beyond a limit itself: what the gate lets through."""
# The code's own margins, written down once more: a test that took them from the code would follow wherever they go.
EDGE = 1e-6
"""How far beyond a limit of position the last gate lets a setpoint through [m, rad]."""
EXCESS = 1e-3
"""How far beyond the limits of velocity, acceleration and jerk of sliders and platform, as a share."""
START = 1e-4
"""How far from where the robot stands a trajectory may begin [m, rad]."""


class Watched(ControlRig):
    """Keeps the platform's commanded motion of every cycle."""

    def __init__(self) -> None:
        super().__init__()
        self.platform: list[MotionState] = []

    def cycle(self, request: object = None) -> None:
        super().cycle(request)  # type: ignore[arg-type]
        self.platform.append(self.control.commanded)

    def used(self) -> NDArray[np.float64]:
        """Greatest velocity, acceleration and jerk (3,) as shares of the platform's limits."""
        motion = np.array(self.platform)
        jerk = np.diff(motion[:, 2], axis=0) / PERIOD
        rates = motion[:, 1], motion[:, 2], jerk
        return np.array([(np.abs(rate) / limit).max() for rate, limit in zip(rates, PLATFORM, strict=True)])


def sliders_at(*pose: float) -> tuple[float, float, float]:
    a, b, c = inverse(ROBOT, np.array(pose)).position.tolist()
    return a, b, c


def points(*rows: tuple[float, float]) -> tuple[TrajectoryPoint, ...]:
    return tuple(TrajectoryPoint(t, x, 0.0, 0.0) for t, x in rows)


KINDS: dict[str, Goal] = {
    "pose": PoseGoal(0.1, 0.02, 0.3),
    "pose at half speed": PoseGoal(0.1, 0.02, 0.3, speed=0.5),
    "sliders": SlidersGoal(sliders_at(0.1, 0.02, 0.3)),
    "jog": VelocityGoal(0.25, 0.08, -0.05, timeout=0.5),
    "trajectory": TrajectoryGoal(points((0.0, 0.0), (0.3, 0.1)), stretch=True),
}


@pytest.fixture
def rig() -> ControlRig:
    return ControlRig()


@pytest.mark.long
@pytest.mark.parametrize("override", [0.3, 1.0, 2.0])
@pytest.mark.parametrize("kind", KINDS)
def test_the_platforms_limits_bind_every_kind_at_every_override(kind: str, override: float) -> None:
    rig = Watched()
    rig.enable()
    rig.command("override", override)
    assert isinstance(rig.send("g1", KINDS[kind]), Accepted)
    rig.until(rig.holds)
    assert (rig.used() <= 1.0 + BETWEEN).all()
    rate = (rig.used() ** (1.0, 1.0 / 2.0, 1.0 / 3.0)).max()
    assert rate >= 0.9 * min(1.0, override * (0.5 if "half" in kind else 1.0))  # nor slower than they must
    assert_within_limits(rig)


def test_an_override_takes_back_a_goals_own_slowness(rig: ControlRig) -> None:
    rig.enable()
    rig.command("override", 2.0)
    rig.goal("g1", 0.1, 0.0, 0.0, speed=0.5)
    taken = rig.until(rig.holds)
    rig.goal("g2", 0.0, 0.0, 0.0)
    assert rig.until(rig.holds) == pytest.approx(taken, abs=2)


STEP = st.tuples(
    st.one_of(
        GOAL,
        GOAL,
        st.builds(
            lambda x, t: TrajectoryGoal(points((0.0, 0.0), (t, x)), stretch=True),
            st.floats(-0.1, 0.1),
            st.floats(0.05, 1.0),
        ),
        st.sampled_from(["stop", "pause", "resume", 0.0, 0.3, 1.0, 2.0]),
    ),
    st.integers(1, 300),
)


TURNED = tuple(inverse(ROBOT, np.array((0.0, 0.0, -0.5))).position.tolist())


@settings(max_examples=40)
@example([(SlidersGoal(TURNED), 167), (PoseGoal(0.0, 0.0, 0.0), 98)])  # 1.2 % between two looks
@given(st.lists(STEP, min_size=2, max_size=10))
def test_no_sequence_takes_the_platform_beyond_its_limits(steps: list[tuple[object, int]]) -> None:
    """Nor while the rate along a path changes."""
    rig = Watched()
    rig.enable()
    for number, (what, wait) in enumerate(steps):
        if isinstance(what, str):
            rig.order(what)
        elif isinstance(what, float):
            rig.order("override", what)
        else:
            rig.post(f"g{number}", what)  # type: ignore[arg-type]
        rig.cycles(wait)
    rig.order("override", 1.0)
    rig.order("stop")
    rig.until(lambda: rig.mode is Mode.HOLDING)
    assert rig.control.fault is None
    assert (rig.used() <= 1.0 + BETWEEN).all()
    assert_within_limits(rig)


# ---------------------------------------------------------------------- what is slowed


SPEED = st.floats(-0.2, 0.2)


@settings(max_examples=50)
@given(st.lists(st.tuples(st.floats(0.002, 0.05), SPEED, SPEED, SPEED), min_size=1, max_size=4))
def test_a_stretched_trajectory_fits_at_its_final_speed(steps: list[tuple[float, float, float, float]]) -> None:
    made = [TrajectoryPoint(0.0, 0.0, 0.0, 0.0)]
    for after, vx, vy, w in steps:
        t, x, y, phi = made[-1].t, made[-1].x, made[-1].y, made[-1].phi
        made.append(TrajectoryPoint(t + after, x + vx * after, y + vy * after, phi + 5.0 * w * after))
    rig = Watched()
    rig.enable()
    rig.send("g1", TrajectoryGoal(tuple(made), stretch=True))
    rig.until(rig.holds, 100_000)
    assert rig.control.fault is None
    assert (rig.used() <= 1.0 + BETWEEN).all()
    assert_within_limits(rig)


def test_a_jerk_too_short_to_be_seen_before_it_is_slowed(rig: ControlRig) -> None:
    rig.enable()
    made = points((0.0, 0.0), (0.05, 0.002), (0.052, 0.0022), (0.1, 0.004))
    assert isinstance(rig.send("g1", TrajectoryGoal(made, stretch=True)), Accepted)
    rig.until(rig.holds)
    assert rig.control.fault is None
    assert_within_limits(rig)


@pytest.mark.parametrize("coordinate", range(3))
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_too_fast_says_for_what_and_what_would_be_right(rig: ControlRig, coordinate: int, sign: float) -> None:
    rig.enable()
    x, y, phi = sign * np.eye(3)[coordinate] * (0.1, 0.1, 0.4)
    made = TrajectoryPoint(0.0, 0.0, 0.0, 0.0), TrajectoryPoint(0.4, x, y, phi)
    answer = refusal(rig.send("g1", TrajectoryGoal(made)))
    assert answer.code == "too_fast"
    assert answer.value is not None
    name = ("x", "y", "phi")[coordinate]
    assert f"times too fast for the platform's {name}: let it last" in answer.message
    peaks = np.array((1.875 / 0.4, 10.0 / math.sqrt(3.0) / 0.4**2, 60.0 / 0.4**3))  # of a quintic from rest to rest
    used = peaks * (0.1, 0.1, 0.4)[coordinate] / PLATFORM[:, coordinate]
    assert answer.value == pytest.approx((used ** (1.0, 1.0 / 2.0, 1.0 / 3.0)).max(), rel=0.01)


# ---------------------------------------------------------------------- the last gate

BOUNDS = Bounds(LIMITS, PERIOD, EDGE)
SLIDER = LIMITS.slider
STANDS = [[0.0] * 3 for _ in range(4)]
HAIR = 1e-6


def at_the_gate(now: Rows, before: Rows, motion: Rows = STANDS, motion_before: Rows = STANDS) -> Violation | None:
    """Hold rows of sliders and platform against the limits, and against those of the cycle before."""
    sliders, sliders_before, platform, platform_before = map(np.array, (now, before, motion, motion_before))
    code = gate(BOUNDS.packed, sliders, sliders_before, platform, platform_before, BOUNDS.last_violation)
    return BOUNDS.violation(code)


def rows(leg: int, **values: float) -> list[list[float]]:
    made = [list(row) for row in STANDS]
    for row, name in enumerate(("position", "velocity", "acceleration", "passive")):
        made[row][leg] = values.get(name, 0.0)
    return made


@pytest.mark.parametrize("leg", range(3))
@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(
    ("quantity", "limit", "slack"),
    [
        ("velocity", SLIDER.velocities[0], SLIDER.velocities[0] * EXCESS),
        ("acceleration", SLIDER.accelerations[0], SLIDER.accelerations[0] * EXCESS),
        ("position", SLIDER.position, EDGE),
        ("passive", SLIDER.passive, EDGE),
    ],
)
def test_the_gates_slack(
    leg: int, sign: float, quantity: str, limit: float | tuple[float, float], slack: float
) -> None:
    edge = sign * limit if isinstance(limit, float) else limit[sign > 0.0]
    inside, beyond = edge + sign * slack * (1.0 - HAIR), edge + sign * slack * (1.0 + HAIR)
    assert BOUNDS.setpoint_violation(rows(leg, **{quantity: inside})) is None
    violation = BOUNDS.setpoint_violation(rows(leg, **{quantity: beyond}))
    assert violation is not None
    assert (violation.axis, violation.value, violation.limit) == ("ABC"[leg], beyond, edge)
    assert BOUNDS.setpoint_violation(rows(leg, **{quantity: math.nan})) is not None


@pytest.mark.parametrize("n", range(3))
@pytest.mark.parametrize("end", range(2))
def test_a_limit_itself_is_within(n: int, end: int) -> None:
    exact = Bounds(LIMITS, PERIOD, 0.0)
    for name, limits in (("position", SLIDER.positions[n]), ("passive", SLIDER.passive)):
        assert exact.setpoint_violation(rows(n, **{name: limits[end]})) is None
        assert exact.setpoint_violation(rows(n, **{name: np.nextafter(limits[end], (-1.0, 1.0)[end])})) is not None
    pose = np.zeros(3)
    limits = (LIMITS.platform.x, LIMITS.platform.y, LIMITS.platform.phi)[n]
    pose[n] = limits[end]
    assert exact.pose_violation(pose) is None
    pose[n] = np.nextafter(limits[end], math.copysign(9.0, end - 0.5))
    assert exact.pose_violation(pose) is not None


@pytest.mark.parametrize("coordinate", range(3))
@pytest.mark.parametrize("end", range(2))
def test_the_controls_own_gate_has_the_slack_of_rounding(rig: ControlRig, coordinate: int, end: int) -> None:
    """Of position: a setpoint that is a micrometre beyond a limit was checked, one that is further was not."""
    limits, gate_of_control = (LIMITS.platform.x, LIMITS.platform.y, LIMITS.platform.phi), rig.control.setpoints._bounds
    for share, refused in ((0.99, False), (1.01, True)):
        pose = np.zeros(3)
        pose[coordinate] = limits[coordinate][end] + (-1.0, 1.0)[end] * share * EDGE
        assert (gate_of_control.pose_violation(pose) is not None) is refused


@pytest.mark.parametrize("leg", range(3))
def test_the_gate_knows_how_far_a_slider_goes_in_a_cycle(leg: int) -> None:
    velocity = SLIDER.velocities[leg]
    before, most = rows(leg, velocity=velocity), velocity * (1.0 + EXCESS) * PERIOD
    assert at_the_gate(rows(leg, velocity=velocity, position=velocity * PERIOD), before) is None
    violation = at_the_gate(rows(leg, velocity=velocity, position=most * (1.0 + HAIR)), before)
    assert violation is not None
    assert (violation.axis, violation.quantity) == ("ABC"[leg], "step in one cycle")


@pytest.mark.parametrize("leg", range(3))
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_gate_knows_jerk_by_what_each_row_tells(leg: int, sign: float) -> None:
    most = sign * SLIDER.jerks[0] * (1.0 + EXCESS)
    for share, refused in ((1.0 - HAIR, False), (1.0 + 1e-4, True)):
        j = share * most
        told = (
            rows(leg, acceleration=j * PERIOD, velocity=j * PERIOD**2 / 2.0, position=j * PERIOD**3 / 6.0),
            rows(leg, velocity=j * PERIOD**2 / 2.0, position=j * PERIOD**3 / 4.0),
            rows(leg, position=j * PERIOD**3 / 4.0 + sign * 1e-9),
        )
        for now in told:
            violation = at_the_gate(now, STANDS)
            assert (violation is not None) is refused
            if violation is not None:
                assert (violation.axis, violation.quantity, violation.limit) == ("ABC"[leg], "jerk", SLIDER.jerk)
    assert at_the_gate(rows(leg, acceleration=math.nan), STANDS) is not None


@example(changes=[(0.0, 1.0)])
@example(changes=[(0.5, 1.0)])
@example(changes=[(0.0, 0.5), (1.0, -0.5)])
@given(changes=st.lists(st.tuples(st.floats(0.0, 1.0), st.floats(-1.0, 1.0)), min_size=1, max_size=8))
def test_the_gate_lets_through_every_motion_whose_acceleration_changes_by_the_jerk_of_a_cycle(
    changes: list[tuple[float, float]],
) -> None:
    """Each change of the acceleration is a jump: its time within the cycle, and its share of all changes."""
    all_changes = max(1.0, sum(abs(share) for _, share in changes))
    position = velocity = acceleration = 0.0
    for time, share in changes:
        rest_of_cycle = (1.0 - time) * PERIOD
        jump = share / all_changes * SLIDER.jerks[0] * PERIOD
        position += jump * rest_of_cycle**2 / 2.0
        velocity += jump * rest_of_cycle
        acceleration += jump
    now = rows(0, position=position, velocity=velocity, acceleration=acceleration)
    assert at_the_gate(now, STANDS) is None


@pytest.mark.parametrize("n", range(3))
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_gate_knows_the_platforms_velocity_acceleration_and_jerk(n: int, sign: float) -> None:
    for row, quantity in enumerate(("velocity", "acceleration", "jerk")):
        most = sign * PLATFORM[row, n] * (1.0 + EXCESS)
        for share, refused in ((1.0 - HAIR, False), (1.0 + HAIR, True)):
            now, before = [[0.0] * 3 for _ in range(3)], [[0.0] * 3 for _ in range(3)]
            if quantity == "jerk":
                now[2][n], now[1][n] = share * most * PERIOD, share * most * PERIOD**2 / 2.0
            else:
                now[1 + row][n] = before[1 + row][n] = share * most
            if quantity == "velocity":
                now[0][n] = share * most * PERIOD
            if quantity == "acceleration":
                now[1][n], now[0][n] = share * most * PERIOD, share * most * PERIOD**2 / 2.0
            violation = at_the_gate(STANDS, STANDS, now, before)
            assert (violation is not None) is refused, (quantity, violation)
            if violation is not None:
                assert (violation.axis, violation.quantity) == (("x", "y", "phi")[n], quantity)
                assert abs(violation.limit) == PLATFORM[row, n]


@pytest.mark.parametrize("n", range(3))
@pytest.mark.parametrize("end", range(2))
def test_the_gate_knows_where_the_platform_may_be(n: int, end: int) -> None:
    limit, outward = (LIMITS.platform.x, LIMITS.platform.y, LIMITS.platform.phi)[n][end], (-1.0, 1.0)[end]
    for share, refused in ((0.99, False), (1.01, True)):
        motion, before = ([[0.0] * 3 for _ in range(3)] for _ in range(2))
        motion[0][n] = limit + outward * share * EDGE
        before[0][n] = limit + outward * 0.98 * EDGE
        violation = at_the_gate(STANDS, STANDS, motion, before)
        assert (violation is not None) is refused
        if violation is not None:
            assert (violation.axis, violation.quantity, violation.limit) == (("x", "y", "phi")[n], "position", limit)


@pytest.mark.parametrize(
    ("later", "said"),
    [
        (lambda m: m._replace(velocity=(0.1, 0.0, 0.0)), "jerk"),
        (lambda m: m._replace(acceleration=(1.5, 0.0, 0.0)), "jerk"),
        (lambda m: m._replace(pose=(m.pose[0] + 5e-5, *m.pose[1:])), "jerk"),
    ],
)
def test_a_step_in_any_row_is_a_fault_before_it_is_sent(later: Callable[[MotionState], MotionState], said: str) -> None:
    rig = Rig()
    rig.enable()
    rig.goal("g1", 0.1, 0.0, 0.0)
    rig.cycles(20)
    rig.go_on_with(later(rig.control.commanded))
    rig.cycle()
    assert rig.mode is Mode.FAULT
    assert "setpoint refused: " in (rig.control.fault or "")
    assert said in (rig.control.fault or "")
    assert not any(message.arbitration_id - 0x300 in (1, 2, 3) for message in rig.sent)
    rig.bus.shutdown()


def test_a_motion_that_ends_at_once_is_a_fault(rig: ControlRig) -> None:
    rig.enable()
    rig.goal("g1", 0.1, 0.0, 0.0)
    rig.cycles(100)
    rig.go_on_with(rest(rig.control.commanded.pose))
    rig.cycle()
    assert "jerk" in (rig.control.fault or "")


def test_a_position_just_beyond_its_limit_is_told_from_it(rig: ControlRig) -> None:
    rig.enable()
    answer = refusal(rig.send("g1", SlidersGoal((-0.1700001, 0.0, 0.0))))
    assert "slider A: position is 100 nm beyond the limit of -170 mm" in answer.message
    assert (answer.value, answer.limit) == (-0.1700001, -0.17)


# ---------------------------------------------------------------------- jogs, and an override of zero


@pytest.mark.parametrize(
    ("velocity", "bound"),
    [
        ((0.2, 0.0, 0.0), "platform x (position 150 mm)"),
        ((0.0, 0.0, -1.0), "slider A (position -170 mm)"),
    ],
)
def test_a_jog_into_a_limit_ends_there_and_says_so(
    rig: ControlRig, velocity: tuple[float, float, float], bound: str
) -> None:
    rig.enable()
    jog = VelocityGoal(*velocity, timeout=0.2)
    for _ in range(60):
        answer = rig.send("j1", jog)
        rig.cycles(40)
        if rig.mode is Mode.HOLDING:
            break
    assert isinstance(answer, Accepted) or refusal(answer).code == "at_limit"  # it ended as this one was planned
    assert rig.outcomes() == [("j1", "done")]
    assert f"goal j1 done: at the limit of {bound}" in [said.message for said in rig.notices]
    again = refusal(rig.send("j1", jog))
    assert again.code == "at_limit"
    assert f"has ended at the limit of {bound}" in again.message
    assert rig.outcomes() == [("j1", "done")]


@example((0.2, 0.0, 0.0), (0.05, 1.0, 1.0), None)
@example((0.2, 0.0, 0.0), (0.05, 1.0, 1.0), 0.05)
@example((0.2, 0.04, -1.4), (1.0, 1.0, 1.0), None)
@given(
    st.tuples(st.floats(-0.25, 0.25), st.floats(-0.25, 0.25), st.floats(-1.5, 1.5)),
    st.tuples(*[st.sampled_from([0.05, 0.2, 0.5, 1.0])] * 3),
    st.sampled_from([None, None, None, 0.05]),
)
@settings(max_examples=50)
def test_a_jog_that_the_sliders_slow_goes_on_to_the_limit(
    velocity: tuple[float, float, float], shares: tuple[float, float, float], renewed: float | None
) -> None:
    assume(max(abs(velocity[0]), abs(velocity[1]), 0.2 * abs(velocity[2])) > 0.05)
    rig = ControlRig(with_sliders_of(shares))
    rig.enable()
    jog = VelocityGoal(*velocity, timeout=10.0 if renewed is None else 0.25)
    assert isinstance(rig.send("j1", jog), Accepted)
    while not rig.holds():
        rig.cycles(round((renewed or 0.05) / rig.config.period))
        if renewed is not None:
            rig.post("j1", jog)
    assert rig.outcomes() == [("j1", "done")]
    way = np.array(rig.control.commanded.pose)
    ahead = way + 0.05 * way + 1e-6 * way / np.abs(way).max()
    assert refusal(rig.goal("ahead", *ahead.tolist())).code in ("out_of_workspace", "singular")
    assert_within_limits(rig)


TAKEN = (0.3, 1.0, 1.0 + 1e-9, -1.0)
"""Shares of the platform's limits at which a jog is taken."""


@pytest.mark.long
@pytest.mark.parametrize("beyond", [1.001, -1.001, 2.0, 40.0, -1000.0])
@pytest.mark.parametrize("axis", range(3))
def test_a_jog_above_the_platforms_velocity_is_refused_and_one_that_is_not_taken(axis: int, beyond: float) -> None:
    rig = ControlRig()
    rig.enable()
    top = CONFIG.limits.platform.velocity[axis]

    def jog(share: float) -> VelocityGoal:
        x, y, phi = (np.eye(3)[axis] * share * top).tolist()
        return VelocityGoal(x, y, phi, timeout=0.02)

    answer = refusal(rig.send("fast", jog(beyond)))
    assert answer.code == "above_limit"
    assert (answer.value, answer.limit) == (beyond * top, math.copysign(top, beyond))
    assert rig.mode is Mode.HOLDING
    for number, share in enumerate(TAKEN):
        assert isinstance(rig.send(f"j{number}", jog(share)), Accepted)
        rig.until(rig.holds)


@pytest.mark.parametrize(
    ("velocity", "said"),
    [
        ((10.0, 0.0, 0.0), "velocity 10000 mm/s in x is above the limit of 250 mm/s: did you mean 10 mm/s?"),
        ((0.0, -100.0, 0.0), "velocity -100000 mm/s in y is above the limit of -250 mm/s: did you mean -100 mm/s?"),
        ((0.0, 0.0, 20.0), "velocity 1145.92°/s in phi is above the limit of 85.9437°/s: did you mean 20°/s?"),
        ((1000.0, 0.0, 0.0), "velocity 1e+06 mm/s in x is above the limit of 250 mm/s"),
        ((0.5, 0.0, 0.0), "velocity 500 mm/s in x is above the limit of 250 mm/s"),
    ],
)
def test_a_jog_meant_in_millimetres_or_degrees_is_told_so(
    rig: ControlRig, velocity: tuple[float, float, float], said: str
) -> None:
    rig.enable()
    assert refusal(rig.send("j1", VelocityGoal(*velocity))).message.endswith(f"the jog's {said}")


@pytest.mark.parametrize(
    ("pose", "said"),
    [
        ((0.01, -20.0, 0.0), "platform y: position -20000 mm is beyond the limit of -150 mm: did you mean -20 mm?"),
        ((0.0, 0.0, 30.0), "platform phi: position 1718.87° is beyond the limit of 48.7014°: did you mean 30°?"),
        ((0.2, 0.0, 0.0), "platform x: position 200 mm is beyond the limit of 150 mm"),
        ((0.0, 0.0, 1.0), "platform phi: position 57.2958° is beyond the limit of 48.7014°"),
    ],
)
def test_a_pose_meant_in_millimetres_or_degrees_is_told_so(
    rig: ControlRig, pose: tuple[float, float, float], said: str
) -> None:
    rig.enable()
    assert refusal(rig.send("g1", PoseGoal(*pose))).message == f"the goal is outside the workspace: {said}"


def test_a_renewal_that_is_refused_ends_the_jog_at_once(rig: ControlRig) -> None:
    rig.enable()
    rig.send("j1", VelocityGoal(0.05, 0.0, 0.0, timeout=10.0))
    rig.cycles(100)
    assert refusal(rig.send("j1", VelocityGoal(50.0, 0.0, 0.0, timeout=10.0))).code == "above_limit"
    rig.post("j1", VelocityGoal(0.05, 0.0, 0.0, timeout=10.0))  # what comes right behind does not take it up again
    rig.cycles(200)  # it would have gone on for ten seconds
    assert rig.mode is Mode.HOLDING
    assert rig.outcomes() == [("j1", "done")]


def test_a_jog_that_is_let_go_before_a_limit_is_not_at_it(rig: ControlRig) -> None:
    rig.enable()
    rig.send("j1", VelocityGoal(0.2, 0.0, 0.0, timeout=0.4))
    rig.until(rig.holds)
    assert [said.message for said in rig.notices if said.outcome] == ["goal j1 done: released"]


def test_a_jog_of_no_velocity_brakes_one_and_begins_none(rig: ControlRig) -> None:
    rig.enable()
    assert refusal(rig.send("j1", VelocityGoal(0.0, 0.0, 0.0))).code == "no_velocity"
    rig.send("j2", VelocityGoal(0.1, 0.0, 0.0, timeout=0.5))
    rig.cycles(200)
    assert isinstance(rig.send("j2", VelocityGoal(0.0, 0.0, 0.0, timeout=0.5)), Accepted)
    rig.until(rig.holds, 200)


@pytest.mark.parametrize("goal", [PoseGoal(0.05, 0.0, 0.0), SlidersGoal((0.01, 0.0, 0.0))])
def test_at_override_zero_a_goal_has_no_expected_end(rig: ControlRig, goal: Goal) -> None:
    rig.enable()
    rig.command("override", 0.0)
    for number in range(2):
        blended = goal if isinstance(goal, SlidersGoal) else PoseGoal(0.05, 0.01 * number, 0.0, blend=0.01)
        answer = rig.send(f"g{number}", blended)
        assert isinstance(answer, Accepted)
        assert expected_duration(answer) == math.inf


@pytest.mark.long
@pytest.mark.parametrize(("override", "speed"), [(2.0, 0.5), (0.5, 1.0), (0.3, 0.5), (1.5, 0.3)])
@pytest.mark.parametrize("wait", [60, 150, 250])
def test_a_goal_that_preempts_at_an_override_goes_on_as_the_robot_moves(
    override: float, speed: float, wait: int
) -> None:
    """The new path cannot take the rate of the old one, or its time runs slower: neither is a step of the setpoints."""
    rig = Watched()
    rig.enable()
    rig.command("override", override)
    rig.goal("g1", 0.1, 0.0, 0.0, speed=speed)
    rig.cycles(wait)
    answer = rig.goal("g2", 0.03, 0.06, 0.2)
    assert isinstance(answer, Accepted)
    assert not answer.reply.stops_first
    taken = rig.until(rig.holds) * PERIOD - LIMITS.in_position.dwell
    assert taken == pytest.approx(expected_duration(answer), rel=0.1)
    assert rig.outcomes() == [("g1", "preempted"), ("g2", "done")]
    assert (rig.used() <= 1.0 + BETWEEN).all()
    assert_within_limits(rig)


@pytest.mark.parametrize("coordinate", range(3))
def test_how_far_a_trajectory_may_begin_from_where_the_robot_stands(rig: ControlRig, coordinate: int) -> None:
    rig.enable()
    for off, taken in ((0.99 * START, True), (-1.01 * START, False)):
        x, y, phi = np.eye(3)[coordinate] * off
        made = TrajectoryPoint(0.0, x, y, phi), TrajectoryPoint(1.0, 0.0, 0.0, 0.0)
        answer = rig.send(f"g{off}", TrajectoryGoal(made))
        assert isinstance(answer, Accepted) is taken
        if not taken:
            assert refusal(answer).code == "wrong_start"
            name = ("x", "y", "phi")[coordinate]
            shown = "-0.00578687°" if name == "phi" else "-0.101 mm"
            assert f"begins at {name} = {shown}, but the robot is at 0" in refusal(answer).message
        rig.until(rig.holds)
    assert_within_limits(rig)


def test_a_slider_beyond_its_travel_by_more_than_can_be_measured_is_enabled_with_a_warning() -> None:
    """The pose is inside the platform's limits: it is the slider that is not."""
    low, high = 0.0, LIMITS.platform.phi[0]
    for _ in range(50):
        middle = (low + high) / 2.0
        inside = min(sliders_at(0.0, 0.0, middle)) >= LIMITS.slider.positions[0][0] - 2e-4
        low, high = (middle, high) if inside else (low, middle)
    assert abs(high) < abs(LIMITS.platform.phi[0])
    rig = ControlRig(changed(CONFIG, start=sliders_at(0.0, 0.0, high)))
    rig.enable()
    (warning,) = (said.message for said in rig.notices if said.level == "warning")
    assert (
        "the robot is outside its limits, and only motion back towards them is accepted: slider A: position" in warning
    )
