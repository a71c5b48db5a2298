"""Outputs of the drives: set by users, switched on the path, safe without power; and inputs that end a goal."""

from __future__ import annotations

import itertools
from collections import Counter
from typing import Any

import msgspec
import numpy as np
import pytest
from control_rig import CONFIG, ControlRig, PerfectDrives
from numpy.typing import NDArray
from trirail.config import SIM, Config, Input, Output, load
from trirail.control.modes import ModeEvent
from trirail.control.outputs import LOG_LENGTH, SWITCHED
from trirail.errors import RefusalCode
from trirail.wire.event_codes import EventCode, coded
from trirail.wire.goal_kind import OwnLimits
from trirail.wire.goals import MoveGoal, PoseGoal
from trirail.wire.marks import Mark, StopAt, Switch
from trirail.wire.messages import GoalReply, Outcome
from trirail.wire.packets import Accepted, Answer, CommandDone, CommandRequest, GoalRequest, Refused, Request
from trirail.wire.vocabulary import Command, Mode, SetOutput

OUTPUTS = {
    "valve": Output("A", 16),
    "light": Output("B", 17, safe=True, always=True),
    "late": Output("C", 31, delay=0.0053),
}
INPUTS = {"part": Input("B", 16)}


def with_outputs(config: Config) -> Config:
    missed = msgspec.structs.replace(config.drives, missed_positions=3)
    return msgspec.structs.replace(config, drives=missed, outputs=OUTPUTS, inputs=INPUTS)


ROBOTS = {"3-PRP": with_outputs(CONFIG), "3-PPR": with_outputs(load(SIM.with_name("uvw-ppr.toml")))}
REACH = {"3-PRP": (0.05, 0.05, 0.3), "3-PPR": (0.004, 0.004, 0.02)}
BITS = {"valve": (0, 16), "light": (1, 17), "late": (2, 31)}


class Rig(ControlRig):
    """A robot with outputs; what each cycle commanded, and the words of its drives."""

    def __init__(self, kind: str = "3-PRP") -> None:
        self.poses: list[NDArray[np.float64]] = []
        self.words: list[tuple[int, ...]] = []
        super().__init__(ROBOTS[kind])

    @property
    def drives(self) -> PerfectDrives:
        assert isinstance(self.driver, PerfectDrives)
        return self.driver

    def cycle(self, request: Request | None = None) -> None:
        super().cycle(request)
        record = self.control.measured.record[0]
        self.poses.append(record["commanded_pose"].copy())
        self.words.append(tuple(self.drives.outputs))
        assert tuple(record["outputs"]) == self.words[-1]

    def set(self, output: str, value: bool) -> Answer:
        self.cycle(CommandRequest(7_000_000 + len(self.words), "ann", Command.SET_OUTPUT, SetOutput(output, value)))
        return self.answers[-1]

    def value(self, name: str) -> bool:
        drive, bit = BITS[name]
        return bool(self.drives.outputs[drive] >> bit & 1)

    def changes(self, name: str) -> list[tuple[int, bool]]:
        """Return the cycles, from 1, whose setpoints came with another value of an output, and that value."""
        drive, bit = BITS[name]
        values = [word[drive] >> bit & 1 for word in self.words]
        return [(k + 1, bool(now)) for k, (before, now) in enumerate(itertools.pairwise(values), 1) if before != now]

    @property
    def switches(self) -> list[Switch]:
        return [switch for notice in self.notices for switch in notice.marks]


@pytest.fixture
def rig() -> Rig:
    rig = Rig()
    rig.enable()
    return rig


def test_an_output_is_set_with_the_next_setpoints(rig: Rig) -> None:
    assert isinstance(rig.set("valve", True), CommandDone)
    assert rig.value("valve")
    assert [notice.message for notice in rig.notices if notice.kind == "output"] == ["output valve switched on by ann"]
    rig.set("valve", False)
    assert not rig.value("valve")


def test_an_unknown_output_is_refused(rig: Rig) -> None:
    refused = rig.set("pump", True)
    assert isinstance(refused, Refused)
    assert (refused.code, refused.message) == (
        RefusalCode.UNKNOWN_OUTPUT,
        "there is no output 'pump': the robot has valve, light, late",
    )


@pytest.mark.parametrize("how", ["disable", "quick_stop"])
def test_outputs_are_safe_without_power(rig: Rig, how: str) -> None:
    rig.set("valve", True)
    rig.set("light", False)
    rig.order(how)
    rig.cycles(3)
    assert (rig.value("valve"), rig.value("light")) == (False, True)
    refused = rig.set("valve", True)
    assert isinstance(refused, Refused)
    assert refused.code in (RefusalCode.NOT_ENABLED, RefusalCode.FAULT)
    assert "output 'valve' stays at its safe value, off" in refused.message
    assert isinstance(rig.set("light", False), CommandDone)  # always = true
    assert not rig.value("light")


@pytest.mark.parametrize("how", [Command.DISABLE, Command.QUICK_STOP])
def test_an_output_that_is_set_with_a_stop_in_the_same_cycle_stays_set(rig: Rig, how: Command) -> None:
    rig.set("light", False)
    rig.more.append(CommandRequest(1, "ann", how))
    rig.cycle(CommandRequest(2, "ann", Command.SET_OUTPUT, SetOutput("light", False)))
    rig.cycles(5)
    assert not rig.value("light")


def test_an_output_keeps_its_value_over_a_reset_and_is_safe_in_the_next_fault(rig: Rig) -> None:
    rig.order("quick_stop")
    rig.cycles(100)
    rig.set("light", False)
    assert isinstance(rig.command("reset"), CommandDone)
    rig.cycles(3)
    assert not rig.value("light")
    rig.order("quick_stop")
    rig.cycles(3)
    assert rig.mode is Mode.FAULT
    assert rig.value("light")


def test_a_fault_makes_outputs_safe_in_its_cycle(rig: Rig) -> None:
    rig.set("valve", True)
    rig.drives.write((0.3, 0.0, 0.0), (0.0, 0.0, 0.0))  # a slider that is not where it should be
    rig.drives.write((0.3, 0.0, 0.0), (0.0, 0.0, 0.0))
    rig.cycle()
    assert rig.mode is Mode.FAULT
    assert not rig.value("valve")


def nearest(rig: Rig, pose: tuple[float, float, float], delay: float = 0.0, since: int = 0) -> int:
    """Return the cycle, from 1, whose commanded pose, a delay later, is nearest to a pose."""
    poses = np.array(rig.poses)[since:]
    ahead = delay / rig.config.period
    at = np.arange(len(poses)) + ahead
    shifted = np.array([np.interp(at, np.arange(len(poses)), poses[:, i]) for i in range(3)]).T
    return since + int(np.argmin(np.linalg.norm((shifted - pose) / REACH["3-PRP"], axis=1))) + 1


@pytest.mark.parametrize("kind", ROBOTS)
@pytest.mark.generated(*range(25))
def test_each_mark_switches_once_in_the_cycle_nearest_to_its_place(kind: str, seed: int) -> None:
    """Random goals, marks, overrides and pauses: places are kept, whatever the speed."""
    rng = np.random.default_rng(seed)
    rig = Rig(kind)
    rig.enable()
    if rng.random() < 0.5:
        rig.command("override", float(rng.uniform(0.1, 2.0)))
    x, y, phi = rng.uniform(-1.0, 1.0, 3) * REACH[kind]
    shares = np.sort(rng.uniform(0.02, 0.98, 3))
    shares = shares[np.append(True, np.diff(shares) > 0.1)]
    marks = tuple(
        Mark(name, value=bool(k % 2 == 0), at_path_fraction=float(share))
        for name in ("valve", "late")
        for k, share in enumerate(shares)
    )
    since = len(rig.poses)
    answer = rig.send("g", PoseGoal(x, y, phi, speed=float(rng.uniform(0.1, 1.0)), marks=marks))
    assert isinstance(answer, Accepted), answer
    for _ in range(int(rng.integers(3))):
        rig.cycles(int(rng.integers(1, 200)))
        if rig.mode is not Mode.MOVING:
            break
        match rng.integers(3):
            case 0:
                rig.command("override", float(rng.uniform(0.05, 2.0)))
            case 1:
                rig.command("pause")
                rig.cycles(int(rng.integers(1, 50)))
                rig.command("resume")
            case _:
                rig.order("pause")
                rig.cycle()
                rig.order("resume")
    rig.until(rig.holds, 60_000)
    assert rig.outcomes() == [("g", "done")]
    rows = rig.switches
    assert sorted((row.mark, row.value) for row in rows) == [(k, mark.value) for k, mark in enumerate(marks)]
    for row, placed in ((row, answer.reply.marks[row.mark]) for row in rows):
        assert row.goal == "g"
        assert (row.cycle, row.value) in rig.changes(row.output) or len(rows) > len(set(rows))
        delay = OUTPUTS[row.output].delay
        best = nearest(rig, placed.pose, delay, since)
        assert abs(row.cycle - best) <= (1 if delay else 0) or _as_near(rig, row, placed.pose, best)
        assert row.commanded == tuple(rig.poses[row.cycle - 1])


def _as_near(rig: Rig, row: Switch, pose: tuple[float, float, float], best: int) -> bool:
    """Whether a cycle is as near to a pose as the best one, but for rounding: where the robot waits, many are."""
    here, there = (np.linalg.norm((rig.poses[cycle - 1] - pose) / REACH["3-PRP"]) for cycle in (row.cycle, best))
    return bool(here <= there + 1e-6)


@pytest.mark.parametrize("speed", [0.2, 1.0])
def test_a_delay_is_made_up_for(rig: Rig, speed: float) -> None:
    marks = tuple(Mark("late", value=k % 2 == 0, at_path_fraction=0.2 + 0.1 * k) for k in range(7))
    since = len(rig.poses)
    answer = rig.send("g", PoseGoal(0.05, 0.0, 0.0, speed=speed, marks=marks))
    assert isinstance(answer, Accepted)
    rig.until(rig.holds, 20_000)
    places = {placed.mark: placed.pose for placed in answer.reply.marks}
    rows = rig.switches
    assert len(rows) == len(marks)
    for row in rows:
        assert abs(row.cycle - nearest(rig, places[row.mark], OUTPUTS["late"].delay, since)) <= 1


def test_a_full_log_keeps_its_first_rows(rig: Rig) -> None:
    outputs = rig.control.outputs
    room = np.zeros(LOG_LENGTH + 1, SWITCHED)
    outputs.log, outputs.logged = room[:LOG_LENGTH], LOG_LENGTH
    outputs.state["until"], outputs.state["goal"], outputs.state["opened"] = 1, 1, 1
    outputs.words[:] = -1
    outputs.step(None, 0.0, rig.control.schedule.version, 7, rig.control.measured.record)
    assert outputs.logged == LOG_LENGTH
    assert np.array_equal(room, np.zeros(LOG_LENGTH + 1, SWITCHED))
    assert not outputs.values()["valve"]


@pytest.mark.parametrize("kind", ROBOTS)
@pytest.mark.generated(*range(25))
def test_in_sessions_of_goals_no_mark_switches_twice_or_after_its_goals_end(kind: str, seed: int) -> None:
    """Twenty random goals per session, that follow, blend into or preempt each other, or are stopped."""
    rng = np.random.default_rng(1000 + seed)
    rig = Rig(kind)
    rig.enable()
    replies: dict[str, GoalReply] = {}
    sent: dict[str, PoseGoal] = {}
    for number in range(20):
        x, y, phi = rng.uniform(-1.0, 1.0, 3) * REACH[kind]
        shares = rng.uniform(0.0, 1.0, int(rng.integers(1, 3)))
        marks = tuple(Mark("valve", value=bool(rng.random() < 0.5), at_path_fraction=float(share)) for share in shares)
        blend = float(rng.uniform(1e-4, 0.005)) if rng.random() < 0.5 else None
        goal = PoseGoal(x, y, phi, speed=float(rng.uniform(0.2, 1.0)), blend=blend, marks=marks)
        if isinstance(answer := rig.send(f"g{number}", goal), Accepted):
            sent[f"g{number}"], replies[f"g{number}"] = goal, answer.reply
        for _ in range(int(rng.integers(3))):
            rig.cycles(int(rng.integers(1, 150)))
            match rng.integers(4):
                case 0:
                    rig.order("override", float(rng.uniform(0.1, 2.0)))
                case 1 if rig.mode is Mode.MOVING:
                    rig.order("pause")
                    rig.cycles(int(rng.integers(1, 100)))
                    rig.order("resume")
                case 2 if rng.random() < 0.2:
                    rig.order("stop")
                case _:
                    pass
        if rng.random() < 0.5:
            rig.until(rig.holds, 60_000)
    rig.until(rig.holds, 60_000)
    rig.cycles(200)
    assert len(sent) > 5
    ends = {notice.id: notice for notice in rig.notices if notice.kind == "goal"}
    assert {ends[name].outcome for name in sent} <= {"done", "preempted", "stopped"}
    switched = Counter((row.goal, row.mark) for row in rig.switches)
    assert set(switched.values()) <= {1}
    for name, goal in sent.items():
        if ends[name].outcome == "done" and goal.blend is None:
            assert {mark for of, mark in switched if of == name} == set(range(len(goal.marks))), name
    poses = np.array(rig.poses)
    for row in rig.switches:
        assert rig.words[row.cycle - 1][0] >> 16 & 1 in (row.value, *_others(rig, row))
        assert row.commanded == tuple(rig.poses[row.cycle - 1])
        placed = next(placed for placed in replies[row.goal].marks if placed.mark == row.mark)
        around = poses[row.cycle - 2 : row.cycle + 1]
        before, here, after = np.linalg.norm((around - placed.pose) / REACH[kind], axis=1)
        assert here <= after + 1e-6, row
        # The setpoint at the start of a path that preempts another has been sent when the goal begins.
        assert here <= before + 1e-6 or placed.time <= rig.config.period / 2.0, row


def _others(rig: Rig, row: Switch) -> list[bool]:
    """Return the values to which later marks switch the same output in the same cycle."""
    return [other.value for other in rig.switches if other.cycle == row.cycle and other != row]


def test_pulses_last_their_width_and_are_closed_by_a_stop(rig: Rig) -> None:
    mark = Mark("valve", start=0.0, increment=0.005, pulse_width=0.01)
    answer = rig.send("g", PoseGoal(0.05, 0.0, 0.0, speed=0.2, marks=(mark,)))
    assert isinstance(answer, Accepted)
    assert answer.reply.marks[0].number == 11
    rig.until(rig.holds, 20_000)
    rig.cycles(200)
    changes = rig.changes("valve")
    assert [value for _, value in changes] == [True, False] * 11
    widths = np.diff([cycle for cycle, _ in changes])[::2]
    assert np.all(widths == round(0.01 / rig.config.period))


@pytest.mark.parametrize("rate", [1.0, 1.5, 2.0])
@pytest.mark.parametrize("queued", [False, True])
def test_pulses_keep_their_number_and_width_at_every_override(rig: Rig, rate: float, queued: bool) -> None:
    """At a rate above 1, pulses that are close at full speed would merge."""
    rig.command("override", rate)
    if queued:
        rig.send("first", PoseGoal(0.01, 0.0, 0.0, blend=0.0, speed=0.4))
    mark = Mark("valve", start=0.02, end=0.06, increment=0.002, pulse_width=0.016)
    # Behind a motion above 100 %, the goal is planned only when the motion is slower, or has ended.
    assert isinstance(rig.send("g", PoseGoal(0.08, 0.0, 0.0, speed=0.4, marks=(mark,)), 1000), Accepted)
    rig.until(rig.holds, 20_000)
    rig.cycles(100)
    changes = rig.changes("valve")
    assert [value for _, value in changes] == [True, False] * 21
    assert np.all(np.diff([cycle for cycle, _ in changes])[::2] == 16)


@pytest.mark.parametrize("mark", [{"after_start": 0.0}, {"start": 0.0, "increment": 0.005, "pulse_width": 0.005}])
@pytest.mark.parametrize("begins", [True, False])
def test_a_mark_at_the_start_waits_for_the_motion_at_override_0(rig: Rig, mark: dict[str, Any], begins: bool) -> None:
    """A goal that expires before it has moved has switched nothing."""
    rig.command("override", 0.0)
    rig.send("g", PoseGoal(0.05, 0.0, 0.0, speed=0.5, valid_for=0.2, marks=(Mark("valve", **mark),)))
    rig.cycles(100)
    assert rig.changes("valve") == []
    if begins:
        rig.command("override", 1.0)
    rig.until(rig.holds, 20_000)
    rig.cycles(10)
    moving = np.flatnonzero(np.any(np.diff(rig.poses, axis=0) != 0.0, axis=1))
    assert bool(len(moving)) == bool(rig.changes("valve")) == begins
    if begins:
        cycle, on = rig.changes("valve")[0]
        assert on
        assert abs(cycle - (moving[0] + 2)) <= 1


def test_a_goals_own_limits_apply_at_every_override(rig: Rig) -> None:
    rig.command("override", 2.0)
    own = OwnLimits(velocity=(0.05, 0.05, 0.5), acceleration=(0.2, 0.2, 1.0), jerk=(2.0, 2.0, 10.0))
    assert isinstance(rig.send("g", PoseGoal(0.05, 0.0, 0.0, limits=own)), Accepted)
    begun = len(rig.poses)
    rig.until(rig.holds, 20_000)
    speeds = np.diff(np.array(rig.poses[begun:])[:, 0]) / rig.config.period
    assert speeds.max() == pytest.approx(0.05, rel=1e-3)


@pytest.mark.parametrize("blend", [None, 0.01])
def test_a_pulse_may_end_long_after_its_goal_is_done(rig: Rig, blend: float | None) -> None:
    rig.send("g1", PoseGoal(0.02, 0.0, 0.0, blend=blend, marks=(Mark("valve", after_start=0.005, pulse_width=2.0),)))
    if blend is not None:
        rig.send("g2", PoseGoal(0.02, 0.02, 0.0))
    rig.until(rig.holds)
    assert rig.value("valve")
    rig.cycles(2500)
    assert rig.control.fault is None
    (on, off) = rig.changes("valve")
    assert (on[1], off[1], off[0] - on[0]) == (True, False, round(2.0 / rig.config.period))
    assert [(row.goal, row.value) for row in rig.switches] == [("g1", True), ("g1", False)]


@pytest.mark.parametrize("how", ["set_output", "disable", "quick_stop"])
def test_the_end_of_a_pulse_changes_no_output_that_was_set_or_made_safe_meanwhile(rig: Rig, how: str) -> None:
    """Although the goal of the pulse is done, whose pulses run to their end. The light is safe when it is on."""
    rig.set("light", False)
    rig.send("g", PoseGoal(0.01, 0.0, 0.0, marks=(Mark("light", value=True, after_start=0.005, pulse_width=2.0),)))
    rig.until(lambda: rig.holds() and rig.outcomes() == [("g", "done")])
    assert rig.value("light")
    if how == "set_output":
        rig.set("light", True)
    else:
        rig.order(how)
    for _ in range(2500):
        rig.cycle()
        assert rig.value("light")


@pytest.mark.parametrize("how", ["stop", "quick_stop", "disable"])
def test_a_stretch_is_closed_where_its_goal_is_stopped(rig: Rig, how: str) -> None:
    rig.send(
        "g", PoseGoal(0.05, 0.0, 0.0, speed=0.2, marks=(Mark("valve", start=0.002), Mark("late", after_start=0.03)))
    )
    rig.until(lambda: rig.value("valve"))
    rig.cycles(20)
    rig.order(how)
    rig.until(lambda: rig.mode in (Mode.HOLDING, Mode.FAULT, Mode.DISABLED), 5000)
    rig.cycles(300)
    assert not rig.value("valve")
    assert not rig.changes("late")  # not reached
    assert [(row.output, row.value, row.closed) for row in rig.switches][:1] == [("valve", True, False)]


@pytest.mark.parametrize("how", ["stop", "preempted", "edge", "disable"])
def test_a_closed_row_has_the_deadline_of_its_cycle_and_the_poses_of_the_cycle_before(rig: Rig, how: str) -> None:
    def cycles(number: int) -> None:
        for _ in range(number):
            rig.cycle()
            record = rig.control.measured.record
            record["cycle"], record["deadline_ns"] = rig.control.cycles, 5_000_000_000 + 1_000_000 * rig.control.cycles

    edge = StopAt("part") if how == "edge" else None
    rig.send("g", PoseGoal(0.05, 0.0, 0.0, marks=(Mark("valve", start=0.01),), stop_at=edge))
    rig.until(lambda: rig.poses[-1][0] > 0.02)
    cycles(2)
    match how:
        case "preempted":
            rig.more.append(GoalRequest(99, "ann", "g2", PoseGoal(0.0, 0.03, 0.0), 0))
        case "edge":
            rig.drives.inputs = (0, 1 << 16, 0)
        case _:
            rig.more.append(CommandRequest(99, "ann", Command(how)))
    cycles(10)
    rig.until(lambda: any(row.closed for row in rig.switches))
    (row,) = (row for row in rig.switches if row.closed)
    assert row.time == pytest.approx(5.0 + 1e-3 * row.cycle, abs=1e-9)
    assert (row.cycle, False) in rig.changes("valve")
    assert row.commanded == tuple(rig.poses[row.cycle - 2])


@pytest.mark.generated(*range(30))
def test_each_section_and_pulse_is_closed_before_the_next_begins_wherever_the_goal_ends(seed: int) -> None:
    """Random sections and pulses of one output, of which those that overlap are refused, and a random stop."""
    rng = np.random.default_rng(2000 + seed)
    rig = Rig()
    rig.enable()
    marks = []
    for begin, end in rng.uniform(0.0, 0.06, (int(rng.integers(1, 4)), 2)).tolist():
        value = bool(rng.random() < 0.7)
        if rng.random() < 0.7:
            marks.append(Mark("valve", value=value, start=min(begin, end), end=max(begin, end)))
        else:
            marks.append(Mark("valve", value=value, after_start=begin, pulse_width=float(rng.uniform(1e-3, 0.05))))
    answer = rig.send("g", PoseGoal(0.06, 0.0, 0.0, speed=0.3, marks=tuple(marks)))
    if isinstance(answer, Refused):
        assert answer.code is RefusalCode.BAD_MARK
        del marks[1:]
        answer = rig.send("g1", PoseGoal(0.06, 0.0, 0.0, speed=0.3, marks=tuple(marks)))
    assert isinstance(answer, Accepted)
    rig.cycles(int(rng.integers(1300)))
    rig.order("stop")
    rig.until(rig.holds, 20_000)
    rig.cycles(100)
    rows = [(row.mark, row.value) for row in rig.switches]
    assert [row for opened in rows[::2] for row in (opened, (opened[0], not opened[1]))] == rows
    assert all(value == marks[mark].value for mark, value in rows[::2])


@pytest.mark.generated(*range(12))
def test_accepted_pulses_keep_their_number_after_their_width_is_rounded(seed: int) -> None:
    """Random widths, at the least increment that is accepted."""
    rng = np.random.default_rng(3000 + seed)
    width = float(rng.integers(4) + rng.uniform(0.5, 1.0)) * 1e-3
    for increment in np.arange(0.2, 2.0, 0.02) * 1e-3:
        rig = Rig()
        rig.enable()
        mark = Mark("valve", start=0.02, end=0.03, increment=float(increment), pulse_width=width)
        answer = rig.send("g", PoseGoal(0.05, 0.0, 0.0, speed=0.2, marks=(mark,)))
        if isinstance(answer, Accepted):
            break
    assert isinstance(answer, Accepted)
    rig.until(rig.holds, 20_000)
    assert [value for _, value in rig.changes("valve")] == [True, False] * answer.reply.marks[0].number


def test_marks_of_blended_goals(rig: Rig) -> None:
    """Each in its own goal; those that a blend cuts off do not switch, unless the next goal is cancelled in time."""
    first = PoseGoal(
        0.05,
        0.0,
        0.0,
        speed=0.3,
        blend=0.02,
        marks=(Mark("valve", after_start=0.01), Mark("late", before_target=0.001)),
    )
    rig.send("g1", first)
    rig.send("g2", PoseGoal(0.05, 0.04, 0.0, marks=(Mark("valve", value=False, before_target=0.01),)))
    rig.until(rig.holds, 20_000)
    rig.cycles(200)
    assert rig.outcomes() == [("g1", "done"), ("g2", "done")]
    assert [(row.goal, row.mark) for row in rig.switches] == [("g1", 0), ("g2", 0)]
    assert not rig.changes("late")


@pytest.mark.generated(*range(20))
def test_marks_at_the_end_of_a_path_switch_if_the_next_goal_follows_with_blend_zero(seed: int) -> None:
    rng = np.random.default_rng(4000 + seed)
    rig = Rig()
    rig.enable()
    names = "g0", "g1", "g2"
    for name in names:
        x, y, phi = rng.uniform(-1.0, 1.0, 3) * REACH["3-PRP"]
        marks = (
            Mark("valve", before_target=0.0, value=name != "g1"),
            Mark("light", before_target_s=0.0, value=name == "g1"),
            Mark("late", at_path_fraction=1.0, value=name != "g1"),
        )
        assert isinstance(rig.send(name, PoseGoal(x, y, phi, blend=0.0, marks=marks)), Accepted)
    rig.until(rig.holds, 60_000)
    assert sorted((row.goal, row.mark) for row in rig.switches) == [(name, k) for name in names for k in range(3)]


def test_marks_that_a_cancelled_blend_had_cut_off_switch_again(rig: Rig) -> None:
    first = PoseGoal(
        0.05,
        0.0,
        0.0,
        speed=0.1,
        blend=0.02,
        marks=(Mark("valve", after_start=0.01), Mark("late", before_target=0.001)),
    )
    rig.send("g1", first)
    rig.send("g2", PoseGoal(0.05, 0.04, 0.0, valid_for=0.3))
    rig.until(rig.holds, 20_000)
    rig.cycles(200)
    assert rig.outcomes() == [("g2", "expired"), ("g1", "done")]
    assert [(row.goal, row.mark) for row in rig.switches] == [("g1", 0), ("g1", 1)]


def test_the_places_of_accepted_marks_are_an_event_for_all(rig: Rig) -> None:
    marks = (Mark("valve", after_start=0.01), Mark("light", start=0.01, end=0.03, increment=0.01, pulse_width=0.01))
    rig.send("g1", PoseGoal(0.05, 0.0, 0.0, marks=marks))
    rig.send("g2", PoseGoal(0.0, 0.0, 0.0))
    accepted = next(answer for answer in rig.answers if isinstance(answer, Accepted) and answer.reply.id == "g1")
    (notice,) = [notice for notice in rig.notices if notice.event_code == EventCode.MARKS_PLANNED]
    assert (notice.goal, notice.planned) == ("g1", accepted.reply.marks)
    assert [(mark.output, mark.number) for mark in notice.planned] == [("valve", 1), ("light", 3)]


def test_marks_of_a_preempted_goal_do_not_switch(rig: Rig) -> None:
    rig.send("g1", PoseGoal(0.05, 0.0, 0.0, speed=0.3, marks=(Mark("valve", after_start=0.04),)))
    rig.cycles(10)
    rig.send("g2", PoseGoal(0.0, 0.03, 0.0))
    rig.until(rig.holds, 20_000)
    assert rig.switches == []


def test_a_goal_ends_at_an_edge(rig: Rig) -> None:
    rig.send(
        "g", PoseGoal(0.05, 0.0, 0.0, speed=0.2, stop_at=StopAt("part"), marks=(Mark("valve", after_start=0.045),))
    )
    rig.cycles(200)
    rig.drives.inputs = (0, 1 << 16, 0)
    rig.cycle()
    edge = [notice for notice in rig.notices if notice.kind == "input"]
    assert len(edge) == 1
    assert edge[0].params["on"] == 1.0
    rig.until(rig.holds, 5000)
    (end,) = (notice for notice in rig.notices if notice.kind == "goal")
    assert (end.outcome, end.reason) == ("done", "input part rising")
    assert end.params["x"] == pytest.approx(edge[0].params["x"])
    assert rig.poses[-1][0] < 0.045
    assert not rig.switches


@pytest.mark.generated(*range(8))
def test_a_section_ends_at_its_end_or_at_the_edge_that_ends_its_goal(rig: Rig, seed: int) -> None:
    """Not where the robot comes to rest, far beyond both."""
    rng = np.random.default_rng(seed)
    pulses: dict[str, Any] = {"increment": 0.002, "pulse_width": 0.002} if seed % 2 else {}
    mark = Mark("valve", start=0.005, end=0.02, **pulses)
    rig.send("g", PoseGoal(0.08, 0.0, 0.0, speed=0.5, stop_at=StopAt("part"), marks=(mark,)))
    place = rng.uniform(0.006, 0.03)
    rig.until(lambda: rig.poses[-1][0] >= place)
    rig.drives.inputs = (0, 1 << 16, 0)
    rig.cycle()
    assert not rig.value("valve")
    cycle = len(rig.words)
    rig.until(rig.holds, 5000)
    rig.cycles(100)
    assert not [change for change in rig.changes("valve") if change[0] > cycle]
    assert rig.outcomes() == [("g", "done")]
    assert len(rig.switches) == len(rig.changes("valve"))


@pytest.mark.parametrize("later", [1, 30, 400])
def test_an_edge_ends_a_goal_that_is_not_in_position(rig: Rig, later: int) -> None:
    """Its path has ended, but slider A is beside its setpoint, for instance because the platform touches the part."""
    write = rig.drives.write
    rig.drives.write = lambda position, velocity: write((position[0] + 3e-4, *position[1:]), velocity)  # type: ignore[method-assign]
    rig.send("g", PoseGoal(0.02, 0.0, 0.0, stop_at=StopAt("part")))
    rig.until(lambda: rig.control.measured.settling.under_way, 5000)
    rig.cycles(later)
    assert rig.mode is Mode.MOVING
    rig.drives.inputs = (0, 1 << 16, 0)
    rig.cycles(3)
    assert rig.holds()
    (end,) = (notice for notice in rig.notices if notice.kind == "goal")
    assert (end.outcome, end.reason, end.event_code) == ("done", "input part rising", EventCode.INPUT_REACHED)


def test_goals_behind_one_that_ends_at_an_edge_do_not_run(rig: Rig) -> None:
    rig.send("g1", PoseGoal(0.05, 0.0, 0.0, speed=0.2, blend=0.001, stop_at=StopAt("part")))
    assert isinstance(rig.send("g2", PoseGoal(0.0, 0.03, 0.0, blend=0.001)), Accepted)
    rig.cycles(200)
    rig.drives.inputs = (0, 1 << 16, 0)
    rig.until(rig.holds, 5000)
    rig.cycles(500)
    assert sorted(rig.outcomes()) == [("g1", "done"), ("g2", "stopped")]
    assert rig.poses[-1][1] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(
    ("how", "outcome"), [("stop", "done"), ("disable", "done"), ("gateway", "done"), ("quick_stop", "faulted")]
)
def test_a_goal_that_brakes_at_its_edge_is_done_there_unless_a_fault_ends_it(
    rig: Rig, how: str, outcome: Outcome
) -> None:
    """Its end tells the pose at the edge, also if a stop follows."""
    rig.send("g", PoseGoal(0.05, 0.0, 0.0, speed=0.2, stop_at=StopAt("part")))
    rig.cycles(200)
    rig.drives.inputs = (0, 1 << 16, 0)
    rig.cycles(2)
    assert not rig.outcomes(), "it brakes"
    if how == "gateway":
        rig.control.modes.handle_disturbance(ModeEvent.GATEWAY_LOST, coded("gateway lost", EventCode.GATEWAY_LOST))
        rig.cycle()
    else:
        rig.order(how)
    (end,) = (notice for notice in rig.notices if notice.kind == "goal")
    (edge,) = (notice for notice in rig.notices if notice.kind == "input")
    assert end.outcome == outcome
    if outcome == "done":
        assert (end.reason, end.event_code) == ("input part rising", EventCode.INPUT_REACHED)
        assert end.params["x"] == pytest.approx(edge.params["x"])


@pytest.mark.parametrize("paused_for", [1, 2000])
def test_an_edge_ends_a_paused_goal(rig: Rig, paused_for: int) -> None:
    rig.send("g", PoseGoal(0.05, 0.0, 0.0, speed=0.2, stop_at=StopAt("part")))
    rig.cycles(200)
    rig.order("pause")
    rig.cycles(paused_for)
    rig.drives.inputs = (0, 1 << 16, 0)
    rig.cycles(2)
    rig.until(rig.holds, 5000)
    (end,) = (notice for notice in rig.notices if notice.kind == "goal")
    assert (end.outcome, end.reason) == ("done", "input part rising")
    before = rig.poses[-1]
    assert isinstance(rig.command("resume"), Refused)
    rig.cycles(100)
    assert np.array_equal(before, rig.poses[-1])


def test_an_edge_while_a_queue_is_being_paused_ends_the_goal_before_the_robot_passes_on(rig: Rig) -> None:
    rig.post("g1", PoseGoal(0.1, 0.0, 0.0, blend=0.03, stop_at=StopAt("part")))
    rig.post("g2", PoseGoal(0.1, 0.05, 0.0))
    rig.until(lambda: rig.control.commanded.pose[0] > 0.055)  # it brakes until beyond the place of the blend
    rig.order("pause")
    rig.drives.inputs = (0, 1 << 16, 0)
    rig.cycle()
    rig.until(lambda: rig.mode is not Mode.STOPPING, 5000)
    assert rig.control.fault is None
    assert sorted(rig.outcomes()) == [("g1", "done"), ("g2", "stopped")]


def test_a_move_sent_while_a_goal_ends_at_an_edge_does_not_count_from_where_that_goal_would_have_ended(
    rig: Rig,
) -> None:
    rig.send("g1", PoseGoal(0.1, 0.0, 0.0, speed=0.5, stop_at=StopAt("part")))
    rig.cycles(250)
    rig.drives.inputs = (0, 1 << 16, 0)
    rig.cycle()
    touched = rig.poses[-1][0]
    rig.send("g2", MoveGoal(-0.005, 0.0, 0.0))
    rig.until(rig.holds, 20_000)
    assert touched - 0.005 - 1e-9 <= rig.poses[-1][0] < touched


def test_a_goal_sent_while_one_ends_at_an_edge_is_done_for_its_own_reason(rig: Rig) -> None:
    rig.send("g1", PoseGoal(0.05, 0.0, 0.0, speed=0.5, stop_at=StopAt("part")))
    rig.cycles(200)
    rig.drives.inputs = (0, 1 << 16, 0)
    rig.cycle()
    rig.send("g2", PoseGoal(0.0, 0.0, 0.0))
    rig.until(rig.holds, 20_000)
    ends = {notice.id: notice for notice in rig.notices if notice.kind == "goal"}
    assert (ends["g1"].outcome, ends["g1"].event_code) == ("done", EventCode.INPUT_REACHED)
    assert ends["g2"].outcome == "done"
    assert ends["g2"].event_code is not EventCode.INPUT_REACHED


def test_while_a_goal_brakes_at_its_edge_its_own_target_and_progress_are_reported(rig: Rig) -> None:
    """The path goes on to the goal that followed, which the edge has withdrawn."""
    rig.send("a", PoseGoal(0.05, 0.0, 0.0, speed=0.5, blend=0.01, stop_at=StopAt("part")))
    rig.send("b", PoseGoal(0.05, 0.08, 0.0))
    rig.cycles(100)
    before, progress = rig.control.target, float(rig.control.measured.record["progress"][0])
    rig.drives.inputs = (0, 1 << 16, 0)
    rig.cycles(2)
    assert rig.control.target == before == pytest.approx((0.05, 0.0, 0.0))
    assert progress < rig.control.measured.record["progress"][0] < progress + 0.02
    rig.until(rig.holds, 20_000)
    assert rig.outcomes() == [("b", "stopped"), ("a", "done")]


def test_other_edges_are_events_alone(rig: Rig) -> None:
    rig.drives.inputs = (0, 1 << 16, 0)
    rig.send("g", PoseGoal(0.01, 0.0, 0.0, stop_at=StopAt("part")))
    rig.drives.inputs = (0, 0, 0)
    rig.until(rig.holds, 5000)
    (end,) = (notice for notice in rig.notices if notice.kind == "goal")
    assert (end.outcome, end.reason) == ("done", "arrived") or end.outcome == "done"
    assert [notice.params["on"] for notice in rig.notices if notice.kind == "input"] == [1.0, 0.0]


@pytest.mark.parametrize(
    ("goal", "code"),
    [
        ({"marks": (Mark("pump", after_start=0.01),)}, RefusalCode.UNKNOWN_OUTPUT),
        ({"stop_at": StopAt("door")}, RefusalCode.UNKNOWN_OUTPUT),
        ({"marks": (Mark("valve", after_start=1.0),)}, RefusalCode.BAD_MARK),
    ],
)
def test_impossible_marks_are_refused_and_nothing_moves(rig: Rig, goal: dict[str, Any], code: RefusalCode) -> None:
    refused = rig.send("g", PoseGoal(0.05, 0.0, 0.0, **goal))
    assert isinstance(refused, Refused)
    assert refused.code is code
    assert rig.mode is Mode.HOLDING
