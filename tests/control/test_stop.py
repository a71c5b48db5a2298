"""Stop is never deaf: whatever is planned or waits, a stop is carried out at once, and nobody's key moves the robot."""

from __future__ import annotations

import math

import numpy as np
import pytest
from control_rig import CONFIG, ControlRig, carried
from hypothesis import example, given, settings
from hypothesis import strategies as st
from trirail.config import Config
from trirail.control.modes import ModeEvent
from trirail.errors import RefusalCode, RefusedError
from trirail.motion.goal_planner import GoalPlanner
from trirail.motion.time_scaling import TimeScaling
from trirail.wire.event_codes import EventCode, coded
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
from trirail.wire.packets import Accepted, Answer, CommandDone, CommandRequest, GoalRequest, Refused
from trirail.wire.vocabulary import Command, FaultCause, Mode, Override, Stop

PERIOD = CONFIG.period
PROMPT = round(0.05 / PERIOD)
"""What a stop may take beside braking [cycles]."""


def answer_to(rig: ControlRig, ticket: int) -> Answer | None:
    return next((answer for answer in rig.answers if getattr(answer, "ticket", None) == ticket), None)


def refuse(*_: object) -> None:
    """Find no path."""
    raise RefusedError(RefusalCode.NO_PLAN, "no path")


def confirmed_after(rig: ControlRig, name: str, within: int) -> int:
    """Send a command beside what waits; return after how many cycles it is confirmed."""
    ticket = 10**6 + len(rig.rows)
    rig.cycle(CommandRequest(ticket, "bob", Command(name), carried(name)))
    for number in range(within):
        answer = answer_to(rig, ticket)
        if answer is not None:
            assert isinstance(answer, CommandDone), answer
            return number
        rig.cycle()
    raise AssertionError(f"{name} is not confirmed within {within} cycles; the mode is {rig.mode}")


def braking(config: Config) -> int:
    """Cycles in which any motion can be stopped: three times those from full speed to rest.

    A path out of a motion may turn back first, from full speed to as much the other way, at the platform's limits all
    along: nothing is left of them to brake it, and it is stopped where it has turned.
    """
    platform = config.limits.platform
    rows = zip(platform.velocity, platform.acceleration, platform.jerk, strict=True)
    return round(3.0 * max(v / a + a / j for v, a, j in rows) / config.period)


@pytest.fixture
def rig() -> ControlRig:
    return ControlRig()


def circles(number: int, duration: float, radius: float) -> TrajectoryGoal:
    """Three turns of a circle, from rest to rest, as a number of points."""
    points = []
    for u in np.linspace(0.0, 1.0, number).tolist():
        angle = 6.0 * math.pi * u * u * (3.0 - 2.0 * u)
        x, y = radius * (math.cos(angle) - 1.0), radius * math.sin(angle)
        points.append(TrajectoryPoint(duration * u, x, y, 0.0))
    return TrajectoryGoal(tuple(points), settle=False)


@pytest.mark.parametrize("name", [Command.STOP, Command.DISABLE, Command.ENABLE])
@pytest.mark.parametrize(
    ("goal", "cycles"), [(PoseGoal(0.1, 0.0, 0.0), 150), (circles(3000, 9.1, 0.015), 3640)], ids=["line", "circles"]
)
def test_whoever_stops_again_and_again_delays_no_stop(goal: Goal, cycles: int, name: Command) -> None:
    """Nor does what changes nothing while the robot brakes. It takes cycles to find out how a long path is braked."""
    braked = []
    for again in (False, True):
        rig = ControlRig()
        rig.enable()
        assert isinstance(rig.send("g", goal), Accepted)
        rig.cycles(cycles)
        assert not rig.outcomes()
        rig.cycle(CommandRequest(1, "ann", Command.STOP, carried("stop")))
        number = 0
        while rig.mode is Mode.STOPPING:
            number += 1
            rig.cycle(CommandRequest(10 + number, "ann", name, carried(name)) if again else None)
            assert number < 1000
        braked.append(number)
    assert braked[1] <= braked[0] + 1


def test_what_changes_nothing_does_not_void_a_plan(rig: ControlRig) -> None:
    rig.enable()
    rig.planner.delay = 40
    rig.post("g", PoseGoal(0.05, 0.0, 0.0))
    for _ in range(4):
        rig.cycles(8)
        rig.order("enable")
    rig.until(rig.holds)
    rig.until(lambda: rig.outcomes() == [("g", "done")])


@pytest.mark.parametrize("name", ["stop", "quick_stop", "disable", "override"])
def test_goals_that_wait_at_override_zero_deafen_nothing(rig: ControlRig, name: str) -> None:
    rig.enable()
    rig.command("override", 0.0)
    for number, (x, y) in enumerate([(0.01, 0.0), (0.02, 0.01), (0.03, 0.0), (0.03, 0.02)]):
        rig.post(f"g{number}", PoseGoal(x, y, 0.0, blend=0.05))
    rig.cycles(100)
    assert [type(answer) for answer in rig.answers[-4:]] == [Accepted] * 4
    assert confirmed_after(rig, name, PROMPT + round(CONFIG.drives.stop_timeout / PERIOD)) <= PROMPT
    if name != "override":
        assert {outcome for _, outcome in rig.outcomes()} == {"faulted" if name == "quick_stop" else "stopped"}


def test_goals_blended_at_override_zero_are_run_when_it_is_raised(rig: ControlRig) -> None:
    rig.enable()
    rig.command("override", 0.0)
    for number, (x, y) in enumerate([(0.01, 0.0), (0.02, 0.01), (0.03, 0.0)]):
        rig.post(f"g{number}", PoseGoal(x, y, 0.0, blend=0.005))
    rig.cycles(200)
    rig.command("override", 1.0)
    rig.until(rig.holds)
    assert rig.control.commanded.pose == pytest.approx((0.03, 0.0, 0.0))
    assert rig.outcomes() == [("g0", "done"), ("g1", "done"), ("g2", "done")]


# ---------------------------------------------------------------------- what has been sent but not begun


FAR = PoseGoal(0.03, 0.02, 0.1)


@pytest.fixture
def slow(rig: ControlRig) -> ControlRig:
    """A robot that is enabled, and whose planner thinks for 20 cycles about every goal."""
    rig.enable()
    rig.planner.delay = 20
    return rig


def planned(rig: ControlRig, goal: PoseGoal, name: str) -> None:
    """Move, and send a goal whose planning is not over."""
    rig.goal("running", -0.12, 0.0, 0.0)
    rig.cycles(150)
    rig.post(name, goal)
    assert not rig.control.goal_queue.idle


@pytest.mark.parametrize("event", [ModeEvent.GATEWAY_LOST, ModeEvent.LATE, ModeEvent.SHUTDOWN])
def test_a_goal_that_is_planned_while_the_robot_is_to_stand_never_begins(slow: ControlRig, event: ModeEvent) -> None:
    planned(slow, FAR, "g1")
    slow.control.modes.handle_disturbance(event, coded("gone", EventCode.OTHER))
    slow.until(lambda: slow.mode in (Mode.HOLDING, Mode.DISABLED))
    pose = slow.control.commanded.pose
    slow.cycles(200)
    assert slow.control.commanded.pose == pytest.approx(pose, abs=1e-4)  # a disabled robot follows what is measured
    assert slow.outcomes() == [("running", "stopped"), ("g1", "stopped")]


def test_missed_ticks_are_reported_also_at_rest(slow: ControlRig) -> None:
    for number in (1, 2):
        slow.control.modes.handle_disturbance(ModeEvent.LATE, coded("3 ticks missed", EventCode.OTHER))
        slow.cycle()
        assert slow.mode is Mode.HOLDING
        assert [notice.message for notice in slow.notices].count("3 ticks missed") == number


def test_a_goal_that_is_planned_from_rest_does_not_begin_without_a_gateway(slow: ControlRig) -> None:
    slow.post("g1", FAR)
    slow.control.modes.handle_disturbance(ModeEvent.GATEWAY_LOST, coded("gone", EventCode.GATEWAY_LOST))
    slow.cycles(100)
    assert slow.mode is Mode.HOLDING
    assert slow.outcomes() == [("g1", "stopped")]


def test_stop_of_the_running_goal_stops_the_robot_and_what_waits(slow: ControlRig) -> None:
    planned(slow, FAR, "g1")
    slow.cycle(CommandRequest(99, "ann", Command.STOP, Stop("running")))
    slow.until(slow.holds)
    assert slow.outcomes() == [("running", "stopped"), ("g1", "stopped")]


@pytest.mark.parametrize("waiting", ["planned", "behind it"])
def test_stop_of_a_goal_that_has_not_begun_leaves_the_others(slow: ControlRig, waiting: str) -> None:
    planned(slow, FAR, "g1")
    slow.post("g2", PoseGoal(0.0, 0.03, 0.0))
    slow.cycle(CommandRequest(99, "ann", Command.STOP, Stop("g1" if waiting == "planned" else "g2")))
    assert (
        isinstance(answer_to(slow, 99), CommandDone)
        or slow.until(lambda: isinstance(answer_to(slow, 99), CommandDone)) < 3
    )
    slow.until(lambda: slow.holds() and slow.control.goal_queue.idle)
    assert sorted(slow.outcomes()) == [
        ("g1", "stopped" if waiting == "planned" else "done"),
        ("g2", "done" if waiting == "planned" else "stopped"),
        ("running", "preempted"),
    ]
    answered = [answer.ticket for answer in slow.answers if isinstance(answer, Accepted | Refused)]
    assert len(answered) == len(set(answered)) == 3  # each goal once


@pytest.mark.parametrize("name", ["g2", "g3", "g4", "never"])
def test_stop_of_one_of_several_goals_that_wait_for_a_plan_is_of_that_one_alone(slow: ControlRig, name: str) -> None:
    slow.goal("g0", 0.001, 0.0, 0.0)
    slow.until(slow.holds)
    places = {"g1": 0.01, "g2": 0.02, "g3": 0.03, "g4": 0.04}
    for goal, x in places.items():
        slow.post(goal, PoseGoal(x, 0.0, 0.0))
    slow.cycle(CommandRequest(99, "ann", Command.STOP, Stop(name)))
    slow.until(lambda: answer_to(slow, 99) is not None)
    assert isinstance(answer_to(slow, 99), Refused if name == "never" else CommandDone)
    slow.until(lambda: slow.holds() and slow.control.goal_queue.idle)
    assert [goal for goal, outcome in slow.outcomes() if outcome == "stopped"] == [name] * (name in places)
    last = [x for goal, x in places.items() if goal != name][-1]
    assert slow.control.commanded.pose == pytest.approx((last, 0.0, 0.0))


@pytest.mark.parametrize("next_goal", [PoseGoal(0.0, 0.0, 0.0), MoveGoal(0.02, 0.0, 0.0)])
def test_a_goal_that_is_planned_behind_one_that_is_cancelled_follows_the_one_before(
    rig: ControlRig, next_goal: Goal
) -> None:
    """Within the blend of that one, and relative to its end."""
    rig.enable()
    rig.planner.delay = 6
    rig.send("g1", PoseGoal(0.1, 0.0, 0.0, blend=0.0))
    rig.send("g2", PoseGoal(0.1, 0.08, 0.0, blend=0.05))
    rig.post("g3", next_goal)
    rig.cycles(2)
    rig.cycle(CommandRequest(99, "ann", Command.STOP, Stop("g2")))
    places = []
    while not rig.holds():
        rig.cycle()
        places.append(rig.control.commanded.pose)
    assert rig.outcomes() == [("g2", "stopped"), ("g1", "done"), ("g3", "done")]
    assert min(math.dist(place, (0.1, 0.0, 0.0)) for place in places) < 1e-6
    end = (0.12, 0.0, 0.0) if isinstance(next_goal, MoveGoal) else (0.0, 0.0, 0.0)
    assert places[-1] == pytest.approx(end, abs=1e-9)


def test_a_goal_that_has_ended_cannot_be_stopped(rig: ControlRig) -> None:
    rig.enable()
    rig.goal("g1", 0.01, 0.0, 0.0)
    rig.until(rig.holds)
    rig.cycle(CommandRequest(99, "ann", Command.STOP, Stop("g1")))
    answer = answer_to(rig, 99)
    assert isinstance(answer, Refused)
    assert answer.code == "no_goal"
    assert rig.outcomes() == [("g1", "done")]


def test_a_goal_that_runs_for_longer_than_it_was_valid_arrives(rig: ControlRig) -> None:
    rig.enable()
    rig.send("g1", PoseGoal(0.05, 0.0, 0.0, valid_for=0.1))
    rig.until(rig.holds)
    assert rig.outcomes() == [("g1", "done")]


def test_what_was_sent_before_a_pause_does_not_begin(slow: ControlRig) -> None:
    planned(slow, FAR, "g1")
    slow.post("g2", FAR)
    slow.command("pause")
    slow.cycles(300)
    assert slow.holds()
    assert [outcome for outcome in slow.outcomes() if outcome[0] != "running"] == [("g1", "stopped"), ("g2", "stopped")]
    tickets = [answer.ticket for answer in slow.answers if isinstance(answer, Refused)]
    assert len(tickets) == len(set(tickets)) == 2  # each is answered once


@pytest.mark.parametrize("delay", [20, 300])
@pytest.mark.generated(*range(6))
def test_a_goal_that_is_still_planned_does_not_begin_after_a_pause(delay: int, seed: int) -> None:
    """The robot stands and holds, so there is no goal to resume: the pause is confirmed, and the goal is stopped."""
    rng = np.random.default_rng(seed)
    rig = ControlRig(delay=delay)
    rig.enable()
    for number in range(int(rng.integers(1, 4))):
        rig.post(f"g{number}", PoseGoal(*rng.uniform(-0.03, 0.03, 3).tolist()))
    rig.cycles(int(rng.integers(1, delay - 8)))
    number = len(rig.rows)
    assert confirmed_after(rig, "pause", PROMPT) <= 5
    rig.cycles(2 * delay + 50)
    assert rig.holds()
    assert {outcome for _, outcome in rig.outcomes()} == {"stopped"}
    assert all(row == rig.rows[number] for row in rig.rows[number:])


@pytest.mark.parametrize("pauses", [False, True])
@pytest.mark.generated(*range(6))
def test_a_goal_that_waits_at_the_start_of_its_path_expires(seed: int, pauses: bool) -> None:
    """With an override of 0, a goal is accepted and does not move the robot, not even when the override rises later."""
    rng = np.random.default_rng(seed)
    rig = ControlRig()
    rig.enable()
    rig.cycle(CommandRequest(50, "ann", Command.OVERRIDE, Override(0.0)))
    valid = round(rng.uniform(0.05, 0.4), 3)
    goals = [f"g{number}" for number in range(int(rng.integers(1, 4)))]
    for name in goals:
        x, y, phi = rng.uniform(-0.03, 0.03, 3).tolist()
        rig.send(name, PoseGoal(x, y, phi, valid_for=valid, blend=0.001))
    if pauses:
        rig.command("pause")
    rig.cycles(round(valid / PERIOD) + 5)
    assert rig.holds()
    assert not rig.control.state.paused
    assert dict(rig.outcomes()) == dict.fromkeys(goals, "stopped") | {"g0": "expired"}
    assert isinstance(rig.command("override", 1.0), CommandDone)
    rig.cycles(100)
    assert all(row == rig.rows[5] for row in rig.rows[5:])


@pytest.mark.parametrize("override", [0.0, 0.01, 1.0])
def test_a_goal_that_has_begun_does_not_expire(rig: ControlRig, override: float) -> None:
    rig.enable()
    rig.send("g1", PoseGoal(0.05, 0.0, 0.0, valid_for=0.2))
    rig.cycles(50)
    rig.cycle(CommandRequest(50, "ann", Command.OVERRIDE, Override(override * 100.0)))
    rig.cycles(400)
    rig.cycle(CommandRequest(51, "ann", Command.OVERRIDE, Override(100.0)))
    rig.until(rig.holds)
    assert rig.outcomes() == [("g1", "done")]


def test_a_goal_sent_twice_and_then_paused_goes_on_when_it_is_resumed_and_ends_once(rig: ControlRig) -> None:
    rig.enable()
    rig.planner.delay = 20
    rig.goal("g1", 0.1, 0.0, 0.0)
    rig.post("g2", PoseGoal(0.0, 0.03, 0.0))  # while it is planned, the next one waits
    rig.post("g1", PoseGoal(0.1, 0.0, 0.0))
    rig.command("pause")
    assert rig.outcomes() == [("g2", "stopped")]
    assert rig.control.state.paused
    rig.command("resume")
    rig.until(rig.holds)
    assert rig.outcomes() == [("g2", "stopped"), ("g1", "done")]


def test_drives_that_still_have_power_are_not_enabled_again(rig: ControlRig) -> None:
    """Their statuswords would be those from before they were disabled."""
    rig.enable()
    rig.goal("g1", 0.05, 0.0, 0.0)
    rig.cycles(100)
    rig.cycle(CommandRequest(98, "ann", Command.DISABLE, carried("disable")))
    rig.until(lambda: rig.mode is Mode.DISABLED)
    assert rig.control.measured.powered
    refused = rig.command("enable")
    assert isinstance(refused, Refused)
    assert (refused.code, refused.message[:29]) == (RefusalCode.STOPPING, "drive A is operation enabled,")
    rig.until(lambda: not rig.control.measured.powered)
    assert isinstance(answer_to(rig, 98), CommandDone)
    assert isinstance(rig.command("enable"), CommandDone)
    assert rig.holds()
    assert not rig.control.ledger.busy


def test_a_pause_brakes_also_where_a_goal_waits_for_the_end_of_the_old_motion(
    rig: ControlRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither a path from the motion nor a law that stops it is found. The path of the goal begins at its end."""
    rig.enable()
    rig.goal("g1", -0.12, 0.0, 0.0)
    rig.cycles(150)
    with monkeypatch.context() as patch:
        patch.setattr(GoalPlanner, "_plan_from_motion", refuse)
        patch.setattr(TimeScaling, "stop", lambda *_: None)
        accepted = rig.goal("g2", 0.0, 0.03, 0.0)
    assert isinstance(accepted, Accepted)
    assert accepted.reply.stops_first
    assert len(rig.control.schedule.runs) == 2
    rig.order("pause")
    rig.until(lambda: rig.control.commanded.at_rest)
    assert rig.control.commanded.pose[0] > -0.11
    rig.until(rig.holds)
    assert dict(rig.outcomes()) == {"g1": "preempted", "g2": "stopped"}
    assert isinstance(rig.command("resume"), Refused)


@pytest.mark.parametrize("wait", [0, 3, 10, 30])
def test_a_goal_that_is_sent_to_a_robot_that_pauses_is_not_paused(rig: ControlRig, wait: int) -> None:
    rig.enable()
    rig.goal("running", -0.1, 0.0, 0.0)
    rig.cycles(150)
    rig.order("pause")
    rig.cycles(wait)
    assert rig.mode is Mode.STOPPING
    rig.send("g2", PoseGoal(0.0, 0.03, 0.0))
    rig.until(lambda: rig.holds() and rig.control.goal_queue.idle)
    assert dict(rig.outcomes()) == {"running": "preempted", "g2": "done"}
    assert rig.control.commanded.pose == pytest.approx((0.0, 0.03, 0.0))


def test_a_goal_that_is_sent_to_a_paused_robot_begins(slow: ControlRig) -> None:
    slow.goal("running", -0.12, 0.0, 0.0)
    slow.cycles(200)
    slow.command("pause")
    slow.send("g2", PoseGoal(0.0, 0.03, 0.0))
    slow.until(lambda: slow.holds() and slow.control.goal_queue.idle)
    assert dict(slow.outcomes()) == {"running": "preempted", "g2": "done"}


# ---------------------------------------------------------------------- the dead man


def stands_from(rig: ControlRig) -> int:
    """Return the cycle after which no setpoint has moved."""
    position = rig.setpoints()[:, 0]
    moved = np.flatnonzero((np.abs(np.diff(position, axis=0)) > 1e-12).any(axis=1))
    return int(moved[-1]) + 1 if len(moved) else 0


@pytest.mark.parametrize("override", [0.0, 0.02, 0.1, 0.5, 1.0, 2.0])
@pytest.mark.parametrize("timeout", [0.05, 0.2, 1.0])
def test_a_jog_that_nobody_renews_is_over_in_real_time(rig: ControlRig, override: float, timeout: float) -> None:
    rig.enable()
    rig.command("override", override)
    sent = len(rig.rows)
    rig.post("j1", VelocityGoal(0.05, 0.0, 0.1, timeout=timeout))
    rig.cycles(round(timeout / PERIOD) + braking(CONFIG) + PROMPT)
    assert rig.mode is Mode.HOLDING
    assert rig.outcomes() == [("j1", "done")]
    assert stands_from(rig) <= sent + round(timeout / PERIOD) + braking(CONFIG) + PROMPT
    rig.command("override", 1.0)
    pose = rig.control.commanded.pose
    rig.cycles(300)
    assert rig.control.commanded.pose == pose


@pytest.mark.parametrize("override", [0.1, 1.0, 2.0])
def test_a_jog_lasts_as_long_as_it_is_renewed(rig: ControlRig, override: float) -> None:
    rig.enable()
    rig.command("override", override)
    for _ in range(30):
        assert isinstance(rig.send("j1", VelocityGoal(0.02, 0.0, 0.0, timeout=0.06)), Accepted)
        rig.cycles(20)
    assert rig.mode is Mode.MOVING
    assert rig.control.commanded.velocity[0] == pytest.approx(0.02 * min(override, 1.0), rel=1e-6)
    assert rig.outcomes() == []


def test_a_jog_goes_on_until_its_time_is_over(rig: ControlRig) -> None:
    rig.enable()
    jog = VelocityGoal(0.05, 0.0, 0.0, timeout=0.2)
    rig.cycle(GoalRequest(500, "ann", "j1", jog, round((rig.now + PERIOD) * 1e9)))
    sent = len(rig.rows)
    rig.until(lambda: rig.mode is Mode.STOPPING)
    assert len(rig.rows) - sent == round(0.2 / PERIOD) + 1


def test_a_stop_begins_in_the_cycle_in_which_it_is_asked_for(rig: ControlRig) -> None:
    rig.enable()
    rig.goal("g1", 0.1, 0.0, 0.0)
    rig.cycles(250)
    speed = rig.control.commanded.velocity[0]
    rig.order("stop")
    assert rig.control.commanded.velocity[0] < speed


@pytest.mark.parametrize(("timeout", "code"), [(0.02, "jog_over"), (0.2, "jog_over"), (10.0, "at_limit")])
def test_a_jog_says_whether_it_was_let_go_or_has_reached_a_limit(rig: ControlRig, timeout: float, code: str) -> None:
    """Also where it would have reached the limit, had it not been let go."""
    rig.enable()
    jog = VelocityGoal(0.2, 0.0, 0.0, timeout=timeout)
    rig.send("j1", jog)
    rig.until(rig.holds)
    (end,) = (notice for notice in rig.notices if notice.outcome == "done")
    assert (end.event_code == "stopped_at_limit") == (code == "at_limit")
    assert (rig.control.commanded.pose[0] > 0.149) == (code == "at_limit")
    answer = rig.send("j1", jog)
    assert isinstance(answer, Refused)
    assert answer.code == code


def test_a_jog_that_was_let_go_does_not_come_back(rig: ControlRig) -> None:
    rig.enable()
    rig.send("j1", VelocityGoal(0.2, 0.0, 0.0, timeout=0.1))
    rig.until(lambda: rig.mode is Mode.STOPPING)
    answer = rig.send("j1", VelocityGoal(0.2, 0.0, 0.0, timeout=0.1))
    assert isinstance(answer, Refused)
    assert answer.code == "jog_over"
    rig.until(rig.holds)
    assert rig.outcomes() == [("j1", "done")]


@pytest.mark.parametrize(
    "goal", [VelocityGoal(0.05, 0.0, 0.0, timeout=0.2), TrackGoal(0.05, 0.0, 0.0)], ids=["jog", "track"]
)
@pytest.mark.parametrize(
    ("end", "said"),
    [
        ("silence", "was not renewed in time"),
        ("pause", "stopped: pause by ann"),
        ("stop", "stopped: stop by ann"),
        ("quick_stop", "faulted: quick_stop by ann"),
        ("disable", "stopped: disable by ann"),
        ("another", "preempted: preempted by goal g1"),
    ],
)
def test_what_was_renewed_and_is_over_says_how_it_ended(rig: ControlRig, goal: Goal, end: str, said: str) -> None:
    """Whatever has ended it, and in every mode: who streams one id looks at the last answer."""
    rig.enable()
    rig.send("j1", goal)
    rig.cycles(50)
    if end == "another":
        rig.goal("g1", 0.0, 0.0, 0.0)
    elif end != "silence":
        rig.command(end)
    rig.until(lambda: rig.mode not in (Mode.MOVING, Mode.STOPPING), 1500)
    for _ in range(2):
        answer = rig.send("j1", goal)
        assert isinstance(answer, Refused)
        assert answer.code == "jog_over"
        assert said in answer.message
    other = rig.send("j1", PoseGoal(0.0, 0.0, 0.0))  # the id stays used for all else
    assert isinstance(other, Refused)
    assert other.code == "duplicate_id"


@pytest.mark.parametrize(
    "goal", [VelocityGoal(0.05, 0.0, 0.0, timeout=0.2), TrackGoal(0.05, 0.0, 0.0)], ids=["jog", "track"]
)
def test_what_was_renewed_and_refused_goes_on_to_say_why(rig: ControlRig, goal: Goal) -> None:
    assert getattr(rig.send("j1", goal), "code", None) == "not_enabled"
    answer = rig.send("j1", goal)
    assert isinstance(answer, Refused)
    assert answer.code == "jog_over"
    assert "rejected: the robot is disabled: send enable first); start a new goal" in answer.message


@pytest.mark.parametrize("waiting", [False, True])
def test_a_jog_that_a_refused_renewal_ends_says_why(rig: ControlRig, waiting: bool) -> None:
    """In its events and answers, while it brakes and afterwards; another renewal may wait behind the refused one."""
    rig.enable()
    jog = VelocityGoal(0.1, 0.0, 0.0, timeout=0.5)
    rig.send("j1", jog)
    rig.cycles(100)
    rig.notices.clear()
    rig.post("j1", VelocityGoal(0.4, 0.0, 0.0, timeout=0.5))
    if waiting:
        rig.post("j1", jog)
    rig.until(lambda: rig.mode is Mode.STOPPING)
    while_braking = rig.send("j1", jog)
    assert rig.mode is Mode.STOPPING
    rig.until(rig.holds)
    answers = [while_braking, rig.send("j1", jog)]
    why = "400 mm/s in x is above the limit of 250 mm/s"
    assert [getattr(answer, "code", None) for answer in answers] == ["jog_over"] * 2
    assert all(why in refused(answer) for answer in answers)
    told = [
        said.message for said in rig.notices if said.kind in ("mode", "goal") and said.message != "holding: standstill"
    ]
    assert len(told) == 2
    assert all(why in message for message in told)
    assert rig.outcomes() == [("j1", "done")]
    (end,) = [said for said in rig.notices if said.kind == "goal"]
    assert (end.code, end.event_code, end.value, end.limit) == ("above_limit", "refused", 0.4, 0.25)
    assert not any("not renewed" in text for text in (*told, *map(refused, answers)))


def test_what_is_refused_in_fault_says_which_and_only_there(rig: ControlRig) -> None:
    rig.enable()
    assert "fault" not in refused(rig.command("resume"))
    rig.command("quick_stop")
    assert refused(rig.command("enable")).endswith("(fault: quick_stop by ann)")


def refused(answer: object) -> str:
    assert isinstance(answer, Refused)
    return answer.message


def test_the_first_reason_of_a_fault_stays_and_is_told_once(rig: ControlRig) -> None:
    rig.enable()
    rig.command("quick_stop")
    told = len(rig.notices)
    rig.control.modes.trip(coded("what came of it", EventCode.OTHER), FaultCause.INTERNAL)
    assert rig.control.fault == "quick_stop by ann"
    assert len(rig.notices) == told


@pytest.mark.parametrize("override", [0.25, 0.5, 2.0])
def test_what_is_resumed_goes_on_at_the_override(rig: ControlRig, override: float) -> None:
    def takes(rate: float, x: float) -> int:
        """Cycles from a resume just after the start to the end, at a speed that the limits leave room for."""
        rig.command("override", rate)
        rig.send(f"g{x}", PoseGoal(x, 0.0, 0.0, speed=0.2))
        rig.cycles(5)
        rig.command("pause")
        rig.order("resume")
        return rig.until(rig.holds, 60_000)

    rig.enable()  # the stop and the change of the rate take a time that the override does not divide
    assert takes(override, 0.05) * override == pytest.approx(takes(1.0, 0.0), rel=0.2)


def test_another_goal_may_follow_a_jog_that_brakes(rig: ControlRig) -> None:
    rig.enable()
    rig.send("j1", VelocityGoal(0.2, 0.0, 0.0, timeout=0.1))
    rig.until(lambda: rig.mode is Mode.STOPPING)
    assert isinstance(rig.goal("g1", 0.0, 0.0, 0.0), Accepted)
    rig.until(rig.holds)
    assert rig.outcomes() == [("j1", "preempted"), ("g1", "done")]


@pytest.mark.parametrize(
    "goal", [VelocityGoal(0.05, 0.0, 0.0, timeout=0.2), TrackGoal(0.05, 0.0, 0.0)], ids=["jog", "track"]
)
@pytest.mark.parametrize("name", ["stop", "quick_stop", "pause", "disable"])
def test_what_is_stopped_while_its_renewal_is_planned_ends_once(slow: ControlRig, name: str, goal: Goal) -> None:
    slow.send("j1", goal)
    slow.post("j1", goal)
    slow.cycles(5)
    assert not slow.control.goal_queue.idle
    slow.order(name)
    slow.cycles(600)
    assert [goal_id for goal_id, _ in slow.outcomes()] == ["j1"]
    assert len(slow.answers) == len({answer.ticket for answer in slow.answers if hasattr(answer, "ticket")})


def test_nobody_else_renews_a_jog(rig: ControlRig) -> None:
    rig.enable()
    jog = VelocityGoal(0.05, 0.0, 0.0, timeout=0.2)
    rig.send("j1", jog)
    for number in range(8):
        rig.cycle(GoalRequest(500 + number, "bob", "j1", jog, round(rig.now * 1e9)))
        rig.cycles(60)
        answer = answer_to(rig, 500 + number)
        assert isinstance(answer, Refused)
        assert answer.code == "duplicate_id"
    assert rig.mode is Mode.HOLDING
    assert rig.outcomes() == [("j1", "done")]


def test_a_jog_that_waited_too_long_does_not_begin(rig: ControlRig) -> None:
    rig.enable()
    rig.cycle(GoalRequest(500, "ann", "j1", VelocityGoal(0.05, 0.0, 0.0, timeout=0.2), round((rig.now - 0.3) * 1e9)))
    assert rig.mode is Mode.HOLDING
    assert rig.outcomes() == [("j1", "expired")]


# ---------------------------------------------------------------------- any sequence, then a stop


def fast(velocity: tuple[float, float, float], timeout: float) -> VelocityGoal:
    x, y, phi = velocity
    return VelocityGoal(3.0 * x, 3.0 * y, 3.0 * phi, timeout=timeout)


POSE = st.tuples(st.floats(-0.05, 0.05), st.floats(-0.05, 0.05), st.floats(-0.5, 0.4))
BLEND = st.sampled_from([None, 0.0, 0.005, 0.05])
GOAL = st.one_of(
    st.builds(lambda pose, blend: PoseGoal(pose[0], pose[1], pose[2], blend=blend), POSE, BLEND),
    st.builds(lambda pose: PoseGoal(pose[0], pose[1], pose[2], speed=0.1), POSE),
    st.tuples(*[st.floats(-0.03, 0.03)] * 3).map(SlidersGoal),
    st.builds(fast, POSE, st.sampled_from([0.05, 2.0])),
    st.builds(lambda pose, going: TrackGoal(pose[0], pose[1], pose[2], going, timeout=0.3), POSE, POSE),
)
OVERRIDE = st.sampled_from([0.0, 0.0, 0.02, 0.3, 1.0, 2.0])
STEP = st.tuples(
    st.one_of(GOAL, GOAL, OVERRIDE, st.sampled_from(["pause", "resume", "cancel", "stop"])),
    st.sampled_from([0, 1, 5, 30, 200]),
)


def play(rig: ControlRig, steps: list[tuple[object, int]]) -> None:
    """Send all of it without waiting for any answer."""
    for number, (what, wait) in enumerate(steps, start=1):
        if isinstance(what, float):
            rig.cycle(CommandRequest(number, "ann", Command.OVERRIDE, Override(100.0 * what)))
        elif what == "cancel":
            rig.cycle(CommandRequest(number, "ann", Command.STOP, Stop(f"g{number - 1}")))
        elif isinstance(what, str):
            rig.cycle(CommandRequest(number, "ann", Command(what)))
        else:
            rig.cycle(GoalRequest(number, "ann", f"g{number}", what, round(rig.now * 1e9)))  # type: ignore[arg-type]
        rig.cycles(wait)


@pytest.mark.parametrize("name", ["stop", "disable", "quick_stop"])
@settings(max_examples=40)
@given(st.lists(STEP, min_size=1, max_size=14))
@example(
    [(TrackGoal(0.0, 0.048, -0.3738, timeout=0.3), 200), (PoseGoal(0.0456, 0.0, 0.0), 0), (PoseGoal(0.0, 0.0, 0.0), 0)]
)
def test_after_any_sequence_a_stop_is_confirmed_in_time(name: str, steps: list[tuple[object, int]]) -> None:
    rig = ControlRig()
    rig.command("enable")
    rig.answers.clear()
    play(rig, steps)
    cycles = confirmed_after(rig, name, braking(CONFIG) + PROMPT + 5000)
    assert cycles <= braking(CONFIG) + PROMPT
    if name != "quick_stop":  # whose ramp is the drives'
        assert rig.control.commanded.at_rest
    rig.cycles(50)
    goals = {f"g{number}" for number, (what, _) in enumerate(steps, start=1) if not isinstance(what, float | str)}
    assert sorted(str(goal) for goal, _ in rig.outcomes()) == sorted(goals)  # each ended once
    answered = [answer.ticket for answer in rig.answers if hasattr(answer, "ticket") and answer.ticket < 10**6]
    assert sorted(answered) == list(range(1, len(steps) + 1))  # and each was answered once


RATES = st.lists(st.tuples(st.one_of(OVERRIDE, st.sampled_from(["pause", "resume"])), st.integers(0, 150)), max_size=8)


@settings(max_examples=40)
@example(  # acceleration was greatest between two looks
    [(PoseGoal(-0.0017, 0.0, 0.3686), 200), (0.0, 5), (PoseGoal(0.0115, -0.0293, -0.0748), 30)],
    (0.0, 0.0, 0.04),
    0.05,
    [],
)
@given(st.lists(STEP, max_size=6), POSE, st.sampled_from([0.05, 0.2]), RATES)
def test_a_robot_whose_last_goal_is_a_jog_stands_when_the_dead_man_is_over(
    before: list[tuple[object, int]],
    velocity: tuple[float, float, float],
    timeout: float,
    after: list[tuple[object, int]],
) -> None:
    """Whatever was sent before, and however the rate is changed: nothing but a renewal keeps a jog alive."""
    rig = ControlRig()
    rig.command("enable")
    play(rig, [*before, ("stop", 600), (1.0, 0)])
    sent = len(rig.rows)
    jog = fast(velocity, timeout)
    rig.cycle(GoalRequest(900, "ann", "jog", jog, round(rig.now * 1e9)))
    play(rig, after)
    rig.cycles(1000)
    assert rig.mode is Mode.HOLDING
    assert stands_from(rig) <= sent + round(timeout / PERIOD) + braking(CONFIG) + PROMPT
