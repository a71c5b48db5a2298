"""The guide on simulated drives, with somebody beside them who sees what rules show: clean, and with every fault."""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import itertools
import json
import random
import re
from collections.abc import Callable, Sequence
from pathlib import Path

import can
import msgspec
import numpy as np
import pytest
from control_rig import CONFIG
from trirail.commissioning import bench as benches
from trirail.commissioning import opening
from trirail.commissioning.bench import DrivesStoppedError
from trirail.commissioning.guide import Guide
from trirail.commissioning.judgement import Judgement
from trirail.commissioning.observer import Observer
from trirail.commissioning.opening import open_steps
from trirail.commissioning.person import Question, QuitRequest
from trirail.commissioning.report import CommissioningReport, ReportFile, StepReport
from trirail.commissioning.session import Session
from trirail.commissioning.steps import Steps
from trirail.config import SIM, Config, load
from trirail.kinematics.arrays import Array
from trirail_drivers import config, files
from trirail_drivers.cia402.drives import Cia402
from trirail_drivers.cia402.eds import SERVO
from trirail_drivers.errors import DriveError
from trirail_drivers.interface import NAMES, PowerState
from trirail_drivers.protocols import CIA402
from trirail_drivers.simulated import SimulatedBus, SimulatedDrive

pytestmark = pytest.mark.long

ROBOT = msgspec.structs.replace(CONFIG, loop=msgspec.structs.replace(CONFIG.loop, rate_hz=500))
"""At half the rate of what is shipped the same minute of somebody's work is half the cycles."""
HOMING = config.Homing(method=19, speed_switch=0.02, speed_zero=0.005, acceleration=0.5, timeout=10.0)
ODRIVE_COUNTS = 200.0


class Beside:
    """Somebody who answers what simulated drives propose, skips some steps, and has answers of their own."""

    def __init__(self, skip: Sequence[str] = (), answers: dict[str, list[str]] | None = None) -> None:
        """`answers`: those to questions that begin so, one after the other, before the proposed ones."""
        self.lines: list[str] = []
        self.asked: list[str] = []
        self._skip = skip
        self._answers = answers or {}
        self._title = ""

    def show(self, line: str) -> None:
        self.lines.append(line)
        if title := re.match(r"\d+/\d+  (.*)", line):
            self._title = title[1]

    def show_judgement(self, judgement: Judgement) -> None:
        self.lines += judgement.words

    def ask(self, question: Question, idle: Callable[[], object]) -> str:
        idle()
        text = question.text.strip()
        self.asked.append(text)
        for begin, own in self._answers.items():
            if text.startswith(begin) and own:
                return own.pop(0)
        if text.startswith("Run it?") and any(re.search(word, self._title) for word in self._skip):
            return "s"
        if question.default is None:
            raise QuitRequest
        return question.default


class Run:
    """A commissioning that was carried out."""

    def __init__(
        self,
        folder: Path,
        robot: Config = ROBOT,
        faults: Sequence[str] = (),
        person: Beside | None = None,
        source: Path = SIM,
    ) -> None:
        self.person = person or Beside()
        self.keeper = ReportFile(
            CommissioningReport(robot.robot.name, str(source), "now", True, "tests"), folder / "report.json"
        )
        self.path = folder / "robot.toml"
        if not self.path.exists():
            self.path.write_text(source.read_text(encoding="utf-8"), encoding="utf-8")
        self.written: Path | None = None
        with open_steps(robot, faults, self.person, lambda: False, sleep=lambda _: None) as steps:
            self.steps: Steps = steps
            guide = Guide(robot, self.path, steps, self.person, self.keeper)
            guide.run()
            self.written = guide.write(None)

    def of(self, step: str, drive: str = "") -> StepReport:
        return self.keeper.report.latest[step, drive]


def only(name: str) -> list[str]:
    """Skip what other drives do, and sliders pushed by hand."""
    others = "".join(set(NAMES) - {name})
    return ["by hand", f"(drive|Drive|slider) [{others}]"]


def found(run: Run, step: str, name: str, words: str, remedy: str) -> None:
    entry = run.of(step, name)
    assert entry.verdict == "wrong", entry
    assert re.search(words, " ".join(entry.words)), entry.words
    assert re.search(remedy, entry.remedy), entry.remedy


def with_drives(robot: Config, **keys: object) -> Config:
    drives = robot.drives
    for name in NAMES:
        drives = msgspec.structs.replace(drives, **{name: msgspec.structs.replace(getattr(drives, name), **keys)})
    simulated = msgspec.structs.replace(robot.can.simulated, built=None)
    return msgspec.structs.replace(robot, drives=drives, can=msgspec.structs.replace(robot.can, simulated=simulated))


def odrives() -> Config:
    robot = with_drives(ROBOT, counts_per_metre=ODRIVE_COUNTS)
    return msgspec.structs.replace(robot, drives=msgspec.structs.replace(robot.drives, protocol="odrive"))


@pytest.mark.parametrize(
    "robot", [pytest.param(with_drives(ROBOT, direction=-1), marks=pytest.mark.core), ROBOT, odrives()]
)
def test_a_sound_robot_passes_every_step(robot: Config, tmp_path: Path) -> None:
    run = Run(tmp_path, robot)
    report = run.keeper.report
    assert [entry for entry in report.steps if entry.verdict != "ok"] == []
    switches = [] if robot.drives.protocol == "odrive" else ["switches"]
    each = [name for step in ("push", "power", "move", *switches, "watchdog") for name in [step] * 3]
    assert [entry.step for entry in report.steps] == ["bus", "setup", *each, "square", "kind"]
    assert (report.ok, report.complete, report.changes, run.written) == (True, True, {}, None)
    for name in NAMES:
        assert run.of("move", name).measured["out"] == pytest.approx(0.001, abs=1e-6)
        assert run.of("move", name).measured["slider"] == name
    assert run.of("square").measured["deviation"] < 1e-4  # type: ignore[operator]


def test_drives_that_are_to_be_homed_are_homed_one_by_one(tmp_path: Path) -> None:
    robot = with_drives(ROBOT, homing=HOMING)
    start = msgspec.structs.replace(robot.can.simulated, start=(0.01, 0.02, 0.03))
    robot = msgspec.structs.replace(robot, can=msgspec.structs.replace(robot.can, simulated=start))
    run = Run(tmp_path, robot)
    assert run.keeper.report.complete, run.person.lines
    assert run.steps.session.bench().feedback.homed == (True, True, True)
    for name, way in zip(NAMES, (-0.01, -0.02, -0.03), strict=True):
        assert run.of("home", name).measured["way"] == pytest.approx(way, abs=2e-3)


@pytest.mark.parametrize("method", [19, 37])
def test_the_travel_of_a_homing_is_not_derived_from_an_encoder_whose_zero_moves(method: int) -> None:
    robot = with_drives(ROBOT, homing=msgspec.structs.replace(HOMING, method=method))
    start = msgspec.structs.replace(robot.can.simulated, start=(0.012, 0.0, 0.0))
    robot = msgspec.structs.replace(robot, can=msgspec.structs.replace(robot.can, simulated=start))
    person = Beside(answers={"Did slider A stop": ["y"]})
    with open_steps(robot, [], person, lambda: False, sleep=lambda _: None) as steps:
        steps.session.set_up()
        rules = steps.session.environment.rules
        assert rules is not None
        steps._observer = Observer(person, None, steps.session.idle, NAMES)  # as with real drives
        before = rules.read()[0]
        judgement, measured = steps.home("A")
        assert abs(rules.read()[0] - before) == pytest.approx(0.012 if method == 19 else 0.0, abs=2e-3)
    assert (judgement.verdict, measured["way"]) == ("ok", None)
    assert re.fullmatch(r"drive A reports home; slider A is at [+-]\d\.\d+ mm", judgement.words[0])


@pytest.mark.parametrize(("step", "motions"), [("square", 0), ("kind", 0), ("kind", 1)])
def test_the_platform_does_not_move_after_a_drive_has_lost_its_home(step: str, motions: int) -> None:
    """Drive A restarts before the step, or after `motions` of it, and counts from where its slider is."""

    class Restarter(Beside):
        def ask(self, question: Question, idle: Callable[[], object]) -> str:
            answer = super().ask(question, idle)
            if sum("the sliders move" in asked for asked in self.asked) == motions + 1 and not restarted:
                restart()
            return answer

    def restart() -> None:
        bus.faults.add("A reboot")
        bench.wait(0.01)
        servo = bus.drives[0].servo
        servo.shift(-servo.position)
        bench.wait(4.0)
        restarted.append(rules.read())

    restarted: list[tuple[float, ...]] = []
    robot = with_drives(ROBOT, homing=HOMING)
    with open_steps(robot, [], Restarter(), lambda: False, sleep=lambda _: None) as steps:
        steps.session.set_up()
        bench, environment = steps.session.bench(), steps.session.environment
        assert isinstance(environment.bus, SimulatedBus)
        assert environment.rules is not None
        bus, rules = environment.bus, environment.rules
        for name in NAMES:
            assert steps.home(name)[0].verdict == "ok"
        rules.push(0, 0.02)
        bench.wait(0.1)
        if motions == 0:
            restart()
        judgement, _ = getattr(steps, step)()
        assert rules.read() == pytest.approx(restarted[0], abs=2e-5)
    assert judgement.verdict == "failed"
    assert "drive A is not homed: repeat its home step" in judgement.words[0]


def test_a_drive_without_homing_that_has_lost_its_position_is_set_up_again() -> None:
    with open_steps(odrives(), [], Beside(), lambda: False, sleep=lambda _: None) as steps:
        steps.session.set_up()
        bench = steps.session.bench()
        bench.check_homed()
        bench.feedback = bench.feedback._replace(homed=(True, False, True))
        with pytest.raises(DrivesStoppedError, match="drive B is not homed: repeat the set-up to accept its position"):
            bench.check_homed()


# ---------------------------------------------------------------------- faults, found and named


MOVED = {
    "A reversed": ("wrong direction", r"drives\.A\.direction = -1", {"drives.A.direction": -1}),
    "A scale 0.5": ("wrong scale: .* 2 times", r"counts_per_metre = 20000000,", {"drives.A.counts_per_metre": 2e7}),
    "A scale 4": ("wrong scale: .* 0.25 times", r"counts_per_metre", {"drives.A.counts_per_metre": 2.5e6}),
    "A loose": ("loose encoder", "fasten the encoder of drive A", {}),
    "A slips 0.5": ("slipping encoder", "fasten encoder and coupling of drive A", {}),
    "A slips 0.15": ("slipping encoder", "fasten encoder and coupling of drive A", {}),
    "A against": ("counts against its motor", "motor phases", {}),
}


@pytest.mark.parametrize(
    ("fault", "words", "remedy", "changes"), [(f, *each) for f, each in MOVED.items()], ids=list(MOVED)
)
def test_a_fault_is_found_by_1_mm_under_power(
    fault: str, words: str, remedy: str, changes: dict[str, float], tmp_path: Path
) -> None:
    run = Run(tmp_path, faults=[fault], person=Beside(only("A")))
    found(run, "move", "A", words, remedy)
    assert run.of("move", "A").changes == changes
    assert run.keeper.report.ok is False
    assert run.of("square").verdict == "skipped"


PUSHED = {fault: MOVED[fault] for fault in ("A reversed", "A scale 0.5", "A loose", "A slips 0.5")} | {
    "A slips 0.05": MOVED["A slips 0.5"],
    "A counts -2e7": (
        "wrong direction.*wrong scale",
        "counts",
        {"drives.A.direction": -1, "drives.A.counts_per_metre": 2e7},
    ),
    "A scale 0.1": ("wrong scale: .* 10 times", "counts_per_metre", {"drives.A.counts_per_metre": 1e8}),
}


@pytest.mark.parametrize(
    ("fault", "words", "remedy", "changes"), [(f, *each) for f, each in PUSHED.items()], ids=list(PUSHED)
)
def test_a_fault_is_found_by_hand_before_anything_has_power(
    fault: str, words: str, remedy: str, changes: dict[str, float], tmp_path: Path
) -> None:
    run = Run(tmp_path, faults=[fault], person=Beside(["Power on drive [BC]"]))
    found(run, "push", "A", words, remedy)
    assert run.of("push", "A").changes == changes
    assert (run.of("power", "A").verdict, run.of("move", "A").verdict) == ("skipped", "skipped")


@pytest.mark.parametrize("step", ["push", "move"])
def test_swapped_nodes_are_found_and_exchanged_in_a_new_file(step: str, tmp_path: Path) -> None:
    skip = ["by hand", "drive C", "Watchdog"] if step == "move" else ["Power"]
    run = Run(tmp_path, faults=["A swapped B", "B swapped A"], person=Beside(skip))
    found(run, step, "A", "swapped nodes: drive [AB], node [12], has slider [AB]", r"drives\.[AB]\.node = [12]")
    assert run.keeper.report.changes == {"drives.A.node": 2, "drives.B.node": 1}
    assert run.written is not None
    written = load(run.written)
    assert (written.drives.A.node, written.drives.B.node, written.drives.C.node) == (2, 1, 3)


def test_a_ring_of_three_is_found_too(tmp_path: Path) -> None:
    run = Run(tmp_path, faults=["A swapped B", "B swapped C", "C swapped A"], person=Beside(["Power"]))
    assert run.keeper.report.changes == {"drives.A.node": 3, "drives.B.node": 1, "drives.C.node": 2}


RATIOS = (1.0, -1.0, 0.5, -2.0, 1.1, -0.93, 4.0, 0.21)


def relative(orders: Sequence[int], ratios: Sequence[float]) -> list[str]:
    """Slider s is moved by drive orders[s], `ratios[s]` times as far as it counts: as faults of the drives."""
    lines = []
    for slider, (drive, ratio) in enumerate(zip(orders, ratios, strict=True)):
        name = NAMES[drive]
        lines += [f"{name} swapped {NAMES[slider]}", f"{name} scale {abs(ratio)!r}"]
        lines += [f"{name} reversed"] * (ratio < 0.0)
    return lines


def absolute(orders: Sequence[int], ratios: Sequence[float]) -> list[str]:
    """The same, as a robot that is built so whatever its configuration says."""
    built = zip(NAMES, orders, ratios, strict=True)
    return [
        f"{name} {line}" for name, drive, ratio in built for line in (f"node {drive + 1}", f"counts {1e7 / ratio!r}")
    ]


@pytest.mark.generated(0, 1, 2, 3)
def test_the_cures_of_what_was_found_end_it(seed: int, tmp_path: Path) -> None:
    """However drives are wired, turned and scaled: what is written is how the robot is built."""
    chance = random.Random(seed)
    orders, ratios = chance.sample(range(3), 3), [chance.choice(RATIOS) for _ in NAMES]
    slip = f"{chance.choice(NAMES)} slips {chance.choice((0.3, 0.04))}" if seed % 4 > 1 else ""
    faults = (absolute if seed % 2 else relative)(orders, ratios)
    robot, source = ROBOT, SIM
    for number in range(3):
        folder = tmp_path / str(number)
        folder.mkdir()
        run = Run(folder, robot, [*faults, slip] if slip else faults, Beside(["Watchdog", "Switches"]), source)
        told = [entry for entry in run.keeper.report.steps if "slipping" in " ".join(entry.words)]
        assert {key.rpartition(".")[2] for entry in told for key in entry.changes} <= {"node"}
        assert bool(told) is bool(slip), "slips are told as slips, and nothing else is"
        if run.written is not None:
            robot, source = load(run.written), run.written
            if seed % 2:  # a cure that was typed in by hand
                robot = with_drives(robot)
        if run.keeper.report.ok:
            break
        slip = ""  # somebody has fastened it
    assert run.keeper.report.ok, run.person.lines
    assert run.written is None
    for slider, (drive, ratio) in enumerate(zip(orders, ratios, strict=True)):
        found = robot.drives.each[slider]
        assert found.node == drive + 1
        assert found.direction * found.counts_per_metre == pytest.approx(1e7 / ratio, rel=0.021)


def test_a_slider_that_does_not_move_is_told_from_a_loose_encoder(tmp_path: Path) -> None:
    run = Run(tmp_path, faults=["A stuck"], person=Beside(only("A")))
    found(run, "move", "A", "no slider moved.*following error", "motor phases, brake")


@pytest.mark.parametrize("play", ["0.00005", "0.00015", "0.0003", "0.0006"])
def test_play_is_never_told_as_a_scale(play: str, tmp_path: Path) -> None:
    run = Run(tmp_path, faults=[f"A play {play}"], person=Beside(["(drive|Drive|slider|Slider) [BC]"]))
    assert run.keeper.report.changes == {}
    told = " ".join([*run.of("push", "A").words, *run.of("move", "A").words])
    assert ("play" in told) is (float(play) > 1e-4)


def test_a_motor_that_moves_nothing(tmp_path: Path) -> None:
    answers = {"Which slider moved": ["n"]}
    run = Run(tmp_path, person=Beside(only("A"), answers))
    found(run, "move", "A", "the coupling between them is loose", "coupling between motor A")


def test_a_switch_that_is_pressed_at_rest_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    press = SimulatedDrive.press
    monkeypatch.setattr(SimulatedDrive, "press", lambda self, switches: press(self, switches ^ 2))
    person = Beside(["by hand", "Watchdog"])
    boot = SimulatedDrive.restarted

    def restarted(self: SimulatedDrive) -> None:
        boot(self)
        self.press(0)

    monkeypatch.setattr(SimulatedDrive, "restarted", restarted)
    run = Run(tmp_path, robot=with_drives(ROBOT, homing=HOMING), person=person)
    found(run, "switches", "A", "reports its positive limit switch as pressed", "normally closed")
    assert run.of("home", "A").verdict == "skipped"


def test_switches_that_are_not_seen_are_asked_about(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(SimulatedDrive, "press", lambda self, switches: None)
    answers = {"Switches that changed: none": ["n", "y"]}
    run = Run(tmp_path, person=Beside(["by hand", "Power"], answers))
    assert [run.of("switches", name).verdict for name in NAMES] == ["wrong", "ok", "ok"]


def test_a_reading_that_fails_is_no_change_of_a_switch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    readings = itertools.cycle((4, None))  # each slider stands at its home switch
    protocol = dataclasses.replace(CIA402, inputs=lambda *_: lambda _: next(readings))
    monkeypatch.setattr(opening, "PROTOCOLS", {CIA402.name: protocol})
    run = Run(tmp_path, person=Beside(["by hand", "Power"]))
    assert run.of("switches", "A").measured == {"at_rest": 4, "changed": 0}


def test_a_drive_that_breaks_down_is_named_and_the_step_can_be_repeated(tmp_path: Path) -> None:
    answers = {"Continue with the next step?": ["y"]}
    run = Run(tmp_path, faults=["when A enabled A fault 4310"], person=Beside(only("A"), answers))
    tries = [entry for entry in run.keeper.report.steps if entry.step == "power"]
    assert [entry.verdict for entry in tries if entry.drive == "A"] == ["failed", "ok"]
    assert "4310" in tries[0].words[0]
    assert run.of("move", "A").verdict == "ok"


def test_a_wrong_geometry_is_seen_in_the_square(tmp_path: Path) -> None:
    run = Run(tmp_path, person=Beside(["by hand"], {"Did the platform move": ["n"]}))
    found(run, "square", "", "followed their setpoints", r"\[geometry\]")


def test_a_drive_that_does_not_answer_is_named(tmp_path: Path) -> None:
    run = Run(tmp_path, faults=["B silent"])
    found(run, "bus", "", "drive B: .*no answer|drive B: .*within", "supply, wiring")
    assert run.of("setup").verdict == "skipped"


def lacking(folder: Path, *objects: str) -> Config:
    """Drives without objects that protect a robot, which the configuration accepts."""
    eds = folder / f"without {' '.join(objects)}.eds"
    sections = re.split(r"(?m)^(?=\[)", SERVO.read_text(encoding="utf-8"))
    eds.write_text("".join(each for each in sections if each[1:5] not in objects), encoding="utf-8")
    return with_drives(ROBOT, eds=str(eds), accept_without=objects)


@pytest.mark.parametrize("name", NAMES)
def test_a_drive_without_a_watch_on_sync_is_told_from_one_without_any(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    others = "".join(set(NAMES) - {name})
    skip = ["by hand", f"(drive|Drive) [{others}]"]
    run = Run(tmp_path, lacking(tmp_path, "1006"), person=Beside(skip))
    watch = run.of("watchdog", name)
    assert watch.verdict == "ok", watch
    assert "8130" in watch.words[0]
    assert "monitoring heartbeats" in watch.words[1]

    kept = f"drive {name} kept its power without SYNC and heartbeat"
    for robot, words in (
        (lacking(tmp_path, "1006", "6007"), f"{kept}: drive {name}: emergency 0x8130"),  # it only reports the loss
        (lacking(tmp_path, "1006"), f"{kept}: operation enabled"),
    ):
        for name_of_report in ("report.json", "report.txt"):
            (tmp_path / name_of_report).unlink()
        found(Run(tmp_path, robot, person=Beside(skip)), "watchdog", name, words, "1006h")
        monkeypatch.setattr(SimulatedDrive, "_master_lost", lambda self: None)


# ---------------------------------------------------------------------- what it promises


def test_every_step_can_be_refused_and_nothing_moves(tmp_path: Path) -> None:
    run = Run(tmp_path, person=Beside(["by hand", "Power"]))
    assert {entry.verdict for entry in run.keeper.report.steps} == {"ok", "skipped"}
    assert (run.keeper.report.ok, run.keeper.report.complete) == (True, False)
    assert {"push A", "power B", "square"} <= set(run.keeper.report.incomplete)
    assert run.steps.session.environment.rules is not None
    assert run.steps.session.environment.rules.read() == (0.0, 0.0, 0.0)


def test_only_the_drive_of_the_step_ever_has_power(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    powered: list[set[str]] = []
    turn = benches.Bench.cycle

    def watched(self: benches.Bench, *rates: object) -> object:
        fed = turn(self, *rates)  # type: ignore[arg-type]
        on = {name for name, state in zip(NAMES, fed.state, strict=True) if state is PowerState.OPERATION_ENABLED}
        if on and (not powered or powered[-1] != on):
            powered.append(on)
        return fed

    monkeypatch.setattr(benches.Bench, "cycle", watched)
    Run(tmp_path)
    assert powered[-1] == {"A", "B", "C"}
    assert all(len(on) == 1 for on in powered[:-1])


def test_the_sliders_never_go_faster_than_5_mm_a_second(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fastest, send = [0.0], SimulatedBus.send

    def watched(self: SimulatedBus, msg: can.Message, timeout: float | None = None) -> None:
        fastest[0] = max(fastest[0], *(abs(drive.servo.velocity) / 1e7 for drive in self.drives))
        send(self, msg, timeout)

    monkeypatch.setattr(SimulatedBus, "send", watched)
    assert Run(tmp_path, person=Beside(["by hand", "square"])).keeper.report.ok
    assert 0.0049 < fastest[0] < 0.0051


def move_alone(low: float, high: float, at: float) -> tuple[Judgement, list[float]]:
    """Run the step `move` of slider A, at a position in limits [m]; return its judgement, and the positions on the way.

    All lengths are in mm.
    """
    slider = ROBOT.limits.slider
    ranges = ((low * 1e-3, high * 1e-3), (-0.1, 0.1), (-0.1, 0.1))
    limits = msgspec.structs.replace(ROBOT.limits, slider=msgspec.structs.replace(slider, position=ranges))
    start = msgspec.structs.replace(ROBOT.can.simulated, start=(at * 1e-3, 0.0, 0.0))
    robot = msgspec.structs.replace(ROBOT, limits=limits, can=msgspec.structs.replace(ROBOT.can, simulated=start))
    visited = []
    with open_steps(robot, [], Beside(), lambda: False, sleep=lambda _: None) as steps:
        steps.session.set_up()
        rules = steps.session.environment.rules
        assert rules is not None
        bench, cycle = steps.session.bench(), benches.Bench.cycle

        def watched(*rates: object) -> object:
            visited.append(at + rules.read()[0] * 1e3)  # the rules read zero at the start
            return cycle(bench, *rates)  # type: ignore[arg-type]

        bench.cycle = watched  # type: ignore[method-assign, assignment]
        judgement, _ = steps.move("A")
    return judgement, [at, *visited]


@pytest.mark.parametrize(
    ("low", "high", "at", "to"),
    [
        (-20.0, 20.0, 0.0, 1.0),
        (-20.0, 20.0, 18.5, 17.5),
        (-1.0, 1.0, -0.5, 0.5),
        (-1.0, 1.0, 0.5, -0.5),
        (-1.0, 1.0, 0.0, 0.9),
        (-0.5, 0.5, 0.0, 0.45),
        (-0.5, 0.5, 0.2, -0.43),
        (-20.0, 20.0, -22.0, -21.0),  # outside its limits: inwards
        (-20.0, 20.0, 22.0, 21.0),
    ],
)
def test_a_slider_moves_alone_within_its_limits(low: float, high: float, at: float, to: float) -> None:
    judgement, visited = move_alone(low, high, at)
    assert judgement.verdict == "ok", judgement
    farthest = max(visited, key=lambda each: abs(each - at))
    assert farthest == pytest.approx(to, abs=0.01)
    assert min(low, at) - 0.001 <= min(visited) <= max(visited) <= max(high, at) + 0.001


@pytest.mark.parametrize(("low", "high", "at"), [(-0.4, 0.4, 0.0), (-0.2, 0.2, 0.1)])
def test_a_slider_without_room_for_a_test_does_not_move(low: float, high: float, at: float) -> None:
    judgement, visited = move_alone(low, high, at)
    assert judgement.verdict == "failed"
    assert re.search(r"slider A: .* mm to the farther limit .* limits\.slider\.position\[0\]", judgement.words[0])
    assert visited == pytest.approx([at] * len(visited), abs=1e-4)


def test_a_drive_that_keeps_its_power_when_stopped_is_told_of(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    taken: list[PowerState] = []

    def deaf(self: SimulatedDrive, state: PowerState) -> None:
        if self.node == 1 and self.state is PowerState.OPERATION_ENABLED:
            taken.append(state)
            return
        change(self, state)

    change = SimulatedDrive._change
    monkeypatch.setattr(SimulatedDrive, "_change", deaf)
    run = Run(tmp_path, faults=["when A enabled B fault 4310"], person=Beside(only("A")))
    assert taken
    assert "drive A STILL HAS POWER: press the emergency stop" in run.of("power", "A").words[0]


class PowerObserver(Beside):
    """Somebody who sees at every question which drives have power, and lets a drive keep its power from a step on."""

    def __init__(self, since: str) -> None:
        super().__init__()
        self.keeps_power = False
        self.endangered: list[str] = []
        self.powered: Callable[[], list[object]] = list
        self._since = since

    def ask(self, question: Question, idle: Callable[[], object]) -> str:
        idle()
        text = question.text.strip()
        self.keeps_power = self.keeps_power or (text.startswith("Run it?") and self._title == self._since)
        is_choice = text.startswith(("Run it?", "Continue"))
        if self.powered() and not is_choice:
            self.endangered.append(f"{self._title}: {text}")
        if self.powered() and is_choice and not any("STILL HAS POWER" in line for line in self.lines[-4:]):
            self.endangered.append(f"not told: {self._title}: {text}")
        return super().ask(question, idle)


@pytest.mark.parametrize(
    "since", ["Power on drive A alone", "Drive A moves 1 mm", "Watchdog of drive B", "3-PRP or 3-PPR"]
)
def test_nobody_is_asked_to_touch_a_robot_while_a_drive_keeps_its_power(
    since: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    person, change = PowerObserver(since), SimulatedDrive._change
    kept = 2 if since.endswith("B") else 1

    def deaf(self: SimulatedDrive, state: PowerState) -> None:
        if not (person.keeps_power and self.node == kept and self.state is PowerState.OPERATION_ENABLED):
            change(self, state)

    monkeypatch.setattr(SimulatedDrive, "_change", deaf)

    def observed(session: Session) -> Steps:
        steps = Steps(session)
        drives = steps.session.environment.bus.drives  # type: ignore[attr-defined]
        person.powered = lambda: [drive for drive in drives if drive.state is PowerState.OPERATION_ENABLED]
        return steps

    monkeypatch.setattr(opening, "Steps", observed)
    run = Run(tmp_path, person=person)
    assert person.endangered == []
    entries = run.keeper.report.steps
    told = f"drive {NAMES[kept - 1]} STILL HAS POWER: press the emergency stop"
    after = entries[next(k for k, entry in enumerate(entries) if told in " ".join(entry.words)) :]
    assert (after[0].step, after[0].verdict) == (
        {"P": "power", "D": "move", "W": "watchdog", "3": "kind"}[since[0]],
        "wrong" if since[0] == "W" else "failed",
    )
    assert {entry.verdict for entry in after[1:]} <= {"failed", "skipped"}
    assert all(told in " ".join(entry.words) for entry in after)


def test_ctrl_c_twice_names_the_drive_that_has_power(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The second one comes while the drives stop."""
    pressed, wait = [False], benches.Bench._wait_without_power

    def interrupted(self: benches.Bench, *limit: float) -> bool:
        if pressed[0]:
            raise KeyboardInterrupt
        return wait(self, *limit)

    def press(self: benches.Bench, *rates: object) -> object:
        pressed[0] = pressed[0] or self.max_errors[0] > 0.0
        return turn(self, *rates)  # type: ignore[arg-type]

    turn = benches.Bench.cycle
    monkeypatch.setattr(benches.Bench, "cycle", press)
    monkeypatch.setattr(benches.Bench, "_wait_without_power", interrupted)
    monkeypatch.setattr(opening, "Bench", lambda a, b, tick, _: benches.Bench(a, b, tick, lambda: pressed[0]))
    person = Beside(only("A"))
    with pytest.raises(KeyboardInterrupt):
        Run(tmp_path, person=person)
    told = json.loads((tmp_path / "report.json").read_text())["steps"][-1]
    assert (told["step"], told["verdict"]) == ("move", "failed")
    assert "drive A STILL HAS POWER: press the emergency stop" in told["words"]
    assert person.lines[-1] == "drive A STILL HAS POWER: press the emergency stop"


DRIVE_FAULTS = ("{} silent", "{} silent for 1.5", "{} drop tpdo2", "{} fault 4310", "{} emcy 3220", "{} reboot")


@pytest.mark.generated(*range(12))
def test_a_fault_of_a_drive_is_never_blamed_on_the_mechanics(seed: int) -> None:
    """It comes before a step, or while a person answers one of its questions."""
    chance = random.Random(seed)
    step, name, number = ("push", "move", "switches")[seed % 3], chance.choice(NAMES), chance.choice((0, 0, 1, 2, 3, 4))
    line = chance.choice(DRIVE_FAULTS).format(chance.choice(NAMES))

    class Beginner(Beside):
        def ask(self, question: Question, idle: Callable[[], object]) -> str:
            answer = super().ask(question, idle)
            if len(self.asked) == number:
                begin(line)
            return answer

    def begin(line: str) -> None:
        faults.add(line)
        bench.wait(0.3)

    person = Beginner()

    with open_steps(
        ROBOT, [], person := Beginner(answers={"Are those all": ["n"]}), lambda: False, lambda _: None
    ) as steps:
        steps.session.set_up()
        bench, bus = steps.session.bench(), steps.session.environment.bus
        assert isinstance(bus, SimulatedBus)
        faults = bus.faults
        if number == 0:
            begin(line)
        judgement, _ = getattr(steps, step)(name)
    fault, silent = bench.feedback.fault, any(bench.feedback.unready)
    assert judgement.verdict in ("ok", "failed"), (line, person.asked, judgement)
    if judgement.verdict == "ok":
        assert not silent
    else:
        assert fault is not None
        assert fault.message in judgement.words[0]


@pytest.mark.parametrize("step", ["push", "switches"])
def test_sliders_can_be_pushed_while_the_emergency_stop_is_pressed(step: str) -> None:
    """Some drives report it as a fault that cannot be reset. The person is safer than without."""
    with open_steps(ROBOT, [], Beside(), lambda: False, lambda _: None) as steps:
        steps.session.set_up()
        bench, bus = steps.session.bench(), steps.session.environment.bus
        assert isinstance(bus, SimulatedBus)
        for name in NAMES:
            bus.faults.add(f"{name} fault 3220")
        bench.wait(0.1)
        vars(bench._drives).update(reset=lambda: None)
        judgement, _ = getattr(steps, step)("A")
        assert bench.feedback.fault is not None
    assert judgement.verdict == "ok", judgement


def noted(name: str, do: Callable[[], None], told: list[str]) -> Callable[[], None]:
    """Return the same call, that notes its name."""

    def doing() -> None:
        told.append(name)
        do()

    return doing


def test_ctrl_c_stops_in_that_cycle_and_ends_without_power(monkeypatch: pytest.MonkeyPatch) -> None:
    pressed = [False]
    told: list[str] = []
    with open_steps(ROBOT, [], Beside(), lambda: pressed[0], sleep=lambda _: None) as steps:
        steps.session.set_up()
        bench = steps.session.bench()
        for name in ("sync", "quick_stop"):
            do = getattr(bench._drives, name)
            monkeypatch.setattr(bench._drives, name, noted(name, do, told))
        with contextlib.ExitStack() as power:
            power.enter_context(bench.power("A"))
            bench.wait(0.2)
            assert bench.feedback.state[0] is PowerState.OPERATION_ENABLED
            told.clear()
            pressed[0] = True
            with pytest.raises(KeyboardInterrupt):
                bench.cycle()
        assert told[:2] == ["sync", "quick_stop"]
        assert bench.feedback.state == (PowerState.SWITCH_ON_DISABLED,) * 3


def test_the_report_is_in_its_files_after_every_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    person = Beside()
    seen, ask, shown = person.show_judgement, person.ask, list[Judgement]()

    def show(judgement: Judgement) -> None:
        shown.append(judgement)
        seen(judgement)

    def look(question: Question, idle: Callable[[], object]) -> str:
        if shown:
            told = json.loads((tmp_path / "report.json").read_text())
            assert [entry["words"] for entry in told["steps"]] == [list(judgement.words) for judgement in shown]
        return ask(question, idle)

    monkeypatch.setattr(person, "show_judgement", show)
    monkeypatch.setattr(person, "ask", look)
    run = Run(tmp_path, faults=["C reversed"], person=person)
    told = json.loads((tmp_path / "report.json").read_text())
    assert told["changes"] == {"drives.C.direction": -1}
    assert (told["ok"], told["written"]) == (False, str(run.written))
    words = (tmp_path / "report.txt").read_text()
    assert "push C: wrong" in words
    assert "remedy: in the configuration drives.C.direction = -1" in words


def test_a_step_is_recorded_although_the_terminal_was_closed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def closed(*_: object) -> None:
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(Beside, "show_judgement", closed)
    with pytest.raises(OSError, match="Input/output"):
        Run(tmp_path)
    assert [entry["step"] for entry in json.loads((tmp_path / "report.json").read_text())["steps"]] == ["bus"]


@pytest.mark.generated(0, 1, 2)
def test_a_report_that_cannot_be_saved_hides_no_judgement(
    seed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    chance, replace, failed, person = random.Random(seed), files.replace, list[Path](), Beside(["by hand", "Power"])

    def full(path: Path, content: bytes, mode: int = 0o644) -> None:
        if "No corrected values" not in " ".join(person.lines) and chance.random() < 0.5:
            failed.append(path)
            raise OSError(errno.ENOSPC, "No space left on device")
        replace(path, content, mode)

    monkeypatch.setattr(files, "replace", full)
    run = Run(tmp_path, person=person)
    warnings = [line for line in person.lines if line.startswith("  The report is not saved")]
    assert len(warnings) == len(failed) > 0
    assert all("No space left on device" in line for line in warnings)
    told = json.loads((tmp_path / "report.json").read_text())["steps"]
    assert len(told) == len(run.keeper.report.plan)
    assert all(set(entry["words"]) <= set(person.lines) for entry in told)


def allow_one_setup(monkeypatch: pytest.MonkeyPatch) -> None:
    configure, configured = Cia402.configure, list[Cia402]()

    def configure_once(self: Cia402, *args: float, **keys: object) -> None:
        if configured:
            raise DriveError("drive C: does not answer")
        configured.append(self)
        configure(self, *args, **keys)  # type: ignore[arg-type]

    monkeypatch.setattr(Cia402, "configure", configure_once)


def test_a_failed_repeat_keeps_what_later_steps_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The set-up fails when it is repeated after a push: no later step runs again, and its correction is written."""
    person = Beside(answers={"Run it?": ["y", "y", "y", "b", "b", "y"]})
    allow_one_setup(monkeypatch)
    run = Run(tmp_path, faults=["A reversed"], person=person)
    assert run.of("setup").verdict == "failed"
    assert (run.of("push", "A").verdict, run.of("push", "B").verdict) == ("wrong", "skipped")
    assert run.keeper.report.changes == {"drives.A.direction": -1}
    assert run.written is not None


def test_no_step_runs_after_one_that_it_needs_has_failed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """After a failed repeat of the set-up, an earlier result of a step between does not let a later one run."""
    skipped = ["s"] * 3
    person = Beside(answers={"Run it?": ["y", "y", *skipped, "y", "b", "b", "b", "b", "b", "y"]})
    allow_one_setup(monkeypatch)
    run = Run(tmp_path, person=person)
    assert (run.of("setup").verdict, run.of("power", "A").verdict) == ("failed", "ok")
    assert run.of("move", "A").words == ("requires setup to be ok",)
    assert not any("needs no correction" in line for line in person.lines)
    assert "setup" in person.lines[-1]


@pytest.mark.parametrize("resolution", ["0.0005", "0.002", "0.02"])
def test_the_platform_moves_only_after_the_person_has_taken_the_hands_off(resolution: str) -> None:
    motions: list[tuple[str, float]] = []
    placed = []

    class Mover(Beside):
        def show(self, line: str) -> None:
            super().show(line)
            if "Place the instrument" in line:
                placed.append(len(motions))

        def ask(self, question: Question, idle: Callable[[], object]) -> str:
            now = np.array(read())
            if self.asked:
                motions.append((self.asked[-1], float(np.abs(now - positions[-1]).max())))
            positions.append(now)
            return super().ask(question, idle)

    person = Mover(answers={"To how many mm can you read the instrument": [resolution]})
    with open_steps(ROBOT, [], person, lambda: False, sleep=lambda _: None) as steps:
        steps.session.set_up()
        rules = steps.session.environment.rules
        assert rules is not None
        read, positions = rules.read, list[Array]()
        judgement, _ = steps.kind()
        motions.append((person.asked[-1], float(np.abs(np.array(read()) - positions[-1]).max())))
    assert judgement.verdict == "ok"
    moved = [(text, length) for text, length in motions if length > 2e-5]
    assert len(moved) == 3
    for text, length in motions:
        announced = re.search(r"move by up to ([\d.]+) mm.*hands off", text)
        assert length < 2e-5 if announced is None else length == pytest.approx(float(announced[1]) * 1e-3, abs=2e-4)
    # Only the first motion is over, and the next question is not yet about the second one.
    assert placed == [motions.index(moved[0])]


def test_a_rule_that_is_read_coarsely_tells_no_scale_from_1_mm(tmp_path: Path) -> None:
    answers = {"To how many mm": ["0.2"]}
    run = Run(tmp_path, faults=["A scale 0.8"], person=Beside(only("A"), answers))
    assert run.of("move", "A").verdict == "ok"
    assert "does not show the scale" in " ".join(run.of("move", "A").words)


def test_no_rule_is_asked_for_what_was_answered_wrongly(tmp_path: Path) -> None:
    answers = {"What does the rule": ["ten", "1e9", "nan", "0,00 mm"], "Which slider": ["x"]}
    run = Run(tmp_path, person=Beside(only("A"), answers))
    assert run.of("move", "A").verdict == "ok"
    assert sum("is no length" in line for line in run.person.lines) == 3
    assert sum("is not an answer" in line for line in run.person.lines) == 1
