"""Replays: a session of a real service, given to the control again, comes out the same to the last bit."""

from __future__ import annotations

import contextlib
import json
import random
import time
from pathlib import Path

import made
import msgspec
import numpy as np
import pytest
from processes.test_service import until
from trirail.analysis import charts
from trirail.analysis.replay import replay_session
from trirail.analysis.summary import summarise
from trirail.cli import recording_commands
from trirail.client import own_service
from trirail.client.client import Robot
from trirail.config import SIM, Config, geometry, load
from trirail.config.as_built import AsBuilt, format_map, geometry_of
from trirail.errors import RefusedError, ServiceError
from trirail.processes.cycle_core import MOST_AHEAD
from trirail.telemetry import provenance
from trirail.telemetry.reading import join, read
from trirail.telemetry.recording import Recording
from trirail.wire.goals import MoveGoal, PoseGoal, VelocityGoal
from trirail.wire.packets import CheckRequest, CommandRequest, DecidedAhead, Disturbance, DrivesFault, GoalRequest
from trirail.wire.plan_packets import NotPlanned, PathExtension, PreemptingMotion
from warm import trirail

pytestmark = pytest.mark.slow

STEPS = 14


def act(robot: Robot, choice: random.Random) -> None:
    """Do one of the things that clients do, whether or not the service agrees."""
    x, y, phi = (choice.uniform(-span, span) for span in (0.07, 0.07, 0.5))
    match choice.randrange(9):
        case 0 | 1:
            robot.check(PoseGoal(x, y, phi))
            robot.move_to(x=x, y=y, phi=phi, valid_for=5.0)
        case 2:
            for blend in (0.01, None):
                robot.move_to(x=x, y=y, phi=phi, blend=blend)
                x = -x
        case 3:
            robot.move_sliders(x, y, 0.1 * phi)
        case 4:
            for _ in range(3):
                robot.send(lambda name: VelocityGoal(0.1 * x, y, phi, timeout=0.2, id=name), "jog")
        case 5:
            with robot.track() as track:
                for n in range(10):
                    track.update((x * n / 10.0, y, phi), (x, 0.0, 0.0))
                    time.sleep(0.01)
        case 6:
            robot.override(choice.choice([30.0, 100.0, 150.0]))
        case 7:
            robot.check(MoveGoal(0.1 * x, 0.0, 0.0))
            robot.pause()
            robot.resume()
        case _:
            robot.stop()


def session(folder: Path) -> Path:
    """Run a random session on a service of its own; return its recording."""
    recording = folder / "session.rrd"
    config, locator = own_service.private(folder)
    choice = random.Random(6)
    with own_service.service(config, recording) as service, Robot("demo", locator, user="ann") as robot:
        for then in (robot.stop, robot.quick_stop):
            robot.enable()
            for _ in range(STEPS):
                with contextlib.suppress(RefusedError):
                    act(robot, choice)
                for _, _ in zip(range(choice.randrange(12)), robot.states(60.0), strict=False):
                    pass  # some 20 ms for each state
            then()
        while True:  # the drives take their time to stand
            with contextlib.suppress(RefusedError):
                robot.reset()
                break
        robot.enable()
        robot.move_to(x=0.05, y=0.0, phi=0.0)
        assert own_service.end(service) == 0  # in motion
    return recording


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return session(tmp_path_factory.mktemp("session"))


@pytest.fixture(scope="module")
def recording(path: Path) -> Recording:
    return read(path)


@pytest.fixture(scope="module")
def config(recording: Recording) -> Config:
    config = provenance.configuration(recording.texts)
    assert config is not None
    return config


def test_the_recording_is_whole(recording: Recording) -> None:
    assert np.array_equal(recording.records["cycle"], np.arange(1, len(recording.records) + 1))
    assert recording.records["lateness_ns"].min() >= 0, "no SYNC leaves before its tick"
    assert [what.seq for what in recording.requests] == list(range(1, len(recording.requests) + 1))
    kinds = {type(what.given) for what in recording.requests}
    assert {GoalRequest, CheckRequest, CommandRequest, Disturbance} <= kinds
    again = {what.given.again for what in recording.requests if isinstance(what.given, DecidedAhead)}
    assert again == {False, True}  # decisions beside cycles, also where the control has just decided


def test_it_comes_out_the_same_to_the_last_bit(recording: Recording, config: Config) -> None:
    compared = replay_session(recording, config, simulated=False)
    assert compared.cycles == len(recording.records)
    assert compared.lacking == 0
    assert (compared.differing, compared.first) == (0, None)
    assert compared.position == (0.0, 0.0, 0.0)


def test_a_corrected_session_comes_out_the_same_without_the_maps_file(tmp_path: Path) -> None:
    """The recording holds the map; what takes up backlash comes of what the sliders were told before."""
    made = geometry_of(geometry(load(SIM).geometry))
    nodes = np.random.default_rng(8).uniform(-2e-5, 2e-5, (5, 5, 5, 3)).tolist()
    low, high = (-0.15, -0.15, -1.2), (0.15, 0.15, 0.85)
    (tmp_path / "as_built.toml").write_text(format_map(AsBuilt("today", made, low, high, nodes)), encoding="utf-8")
    file, locator = own_service.private(tmp_path)
    told = '\n[correction]\nmap = "as_built.toml"\nbacklash = [5e-5, 5e-5, 5e-5]\n'
    file.write_text(file.read_text(encoding="utf-8") + told, encoding="utf-8")
    with own_service.service(file, tmp_path / "session.rrd") as service, Robot("demo", locator, user="ann") as robot:
        assert robot.info().correction is not None
        robot.enable()
        for x in (0.03, -0.02, 0.01):
            assert robot.move_to(x=x, y=-x, phi=x).wait(60.0).outcome == "done"
        until(robot, lambda state: state.pose == pytest.approx((0.01, -0.01, 0.01), abs=1e-4))
        assert own_service.end(service) == 0
    (tmp_path / "as_built.toml").unlink()
    recording = read(tmp_path / "session.rrd")
    assert np.abs(recording.records["backlash"]).max() == pytest.approx(2.5e-5)
    config = provenance.configuration(recording.texts)
    assert config is not None
    compared = replay_session(recording, config, simulated=False)
    assert (compared.lacking, compared.differing, compared.plans_differing) == (0, 0, 0)
    assert compared.plans >= 3


def test_what_was_planned_is_planned_the_same_again(recording: Recording, config: Config) -> None:
    compared = replay_session(recording, config, simulated=False)
    answers = [
        what for what in recording.requests if isinstance(what.given, PreemptingMotion | PathExtension | NotPlanned)
    ]
    assert compared.plans == len(answers) > 5
    assert (compared.plans_differing, compared.plans_rounded) == (0, 0)
    assert compared.requests + len(answers) <= len(recording.requests)


def test_an_answer_that_would_be_another_now_is_noticed_and_used_all_the_same(
    recording: Recording, config: Config
) -> None:
    """What moved the robot is what was answered then; that it is planned otherwise now is said beside."""
    number, what = next(
        (number, what) for number, what in enumerate(recording.requests) if isinstance(what.given, PreemptingMotion)
    )
    assert isinstance(what.given, PreemptingMotion)
    requests = list(recording.requests)
    answer = msgspec.structs.replace(what.given, reply=what.given.reply.with_duration(1000.0))
    requests[number] = msgspec.structs.replace(what, given=answer)
    compared = replay_session(recording._replace(requests=tuple(requests)), config, simulated=False)
    assert (compared.plans_differing, compared.differing) == (1, 0)


def test_a_recording_without_answers_is_planned_anew(recording: Recording, config: Config) -> None:
    """As one that was made before there was a planner to answer."""
    kinds = PreemptingMotion | PathExtension | NotPlanned | DrivesFault
    kept = [what for what in recording.requests if not isinstance(what.given, kinds)]
    numbered = tuple(msgspec.structs.replace(what, seq=seq) for seq, what in enumerate(kept, start=1))
    compared = replay_session(recording._replace(requests=numbered), config, simulated=True)
    assert (compared.plans, compared.cycles) == (0, len(recording.records))


def test_on_simulated_drives_it_comes_out_the_same_too(recording: Recording, config: Config) -> None:
    """On a busy machine, the session's drives answered some cycles late, and a goal settled that much later.

    Its last setpoint and the target that is held then differ by their rounding, and setpoints that follow the measured
    sliders by a count.
    """
    compared = replay_session(recording, config, simulated=True)
    late = recording.records["age"].any()
    assert max(compared.position) < (1.1 / abs(config.drives.A.counts_per_metre) if late else 1e-15)
    assert max(compared.velocity) < 1e-12
    assert compared.differing == 0 or late


def test_a_motion_one_cycle_later_is_noticed(recording: Recording, config: Config) -> None:
    number, what = next(
        (number, what) for number, what in enumerate(recording.requests) if isinstance(what.given, PreemptingMotion)
    )
    requests = list(recording.requests)
    requests[number] = msgspec.structs.replace(what, cycle=what.cycle + 1)
    compared = replay_session(recording._replace(requests=tuple(requests)), config, simulated=False)
    assert compared.differing > 0
    assert compared.first is not None
    assert what.cycle <= compared.first <= what.cycle + 30
    assert max(compared.position) > 0.0


def test_after_a_gap_nothing_is_compared(recording: Recording, config: Config) -> None:
    half = len(recording.records) // 2
    kept = np.delete(recording.records, slice(half, half + 20))
    compared = replay_session(recording._replace(records=kept), config, simulated=False)
    assert (compared.cycles, compared.differing) == (half, 0)
    assert compared.lacking == len(kept) - half


def test_nothing_that_a_lacking_input_may_concern_is_compared(recording: Recording, config: Config) -> None:
    """Inputs are taken away one at a time: the first of them, and some later ones."""
    requests = recording.requests
    together = [n for n in range(1, len(requests) - 1) if requests[n].cycle <= requests[n - 1].cycle]
    later = random.Random(5).sample(range(12, len(requests) - 1), 8)
    for lacking in (*range(1, 12), *together[::5], *later):
        kept = requests[:lacking] + requests[lacking + 1 :]
        compared = replay_session(recording._replace(requests=kept), config, simulated=False)
        assert compared.differing == 0, (lacking, compared)
        assert compared.cycles + compared.lacking == len(recording.records)
        assert compared.cycles <= requests[lacking].cycle - recording.records["cycle"][0]
        assert compared.cycles > requests[lacking - 1].cycle - recording.records["cycle"][0] - MOST_AHEAD - 1


def test_that_the_first_cycle_lacks_an_input_is_told(recording: Recording, config: Config) -> None:
    first, second, *others = recording.requests
    begin = int(np.flatnonzero(recording.records["cycle"] == first.cycle)[0])
    lacking = recording._replace(records=recording.records[begin:], requests=(first, *others))
    with pytest.raises(ServiceError, match=f"lacks input {second.seq} of the control, .* first cycle, {first.cycle},"):
        replay_session(lacking, config, simulated=False)


def test_before_its_first_answer_a_recording_comes_out_the_same(recording: Recording, config: Config) -> None:
    answered = next(what for what in recording.requests if isinstance(what.given, PreemptingMotion))
    ends = int(np.flatnonzero(recording.records["cycle"] == answered.cycle)[0])
    begun = tuple(what for what in recording.requests if what.cycle < answered.cycle)
    compared = replay_session(
        recording._replace(records=recording.records[:ends], requests=begun), config, simulated=False
    )
    assert (compared.cycles, compared.differing) == (ends, 0)


def test_what_begins_in_motion_is_refused(recording: Recording, config: Config) -> None:
    moving = int(np.flatnonzero(np.any(recording.records["commanded_velocity"] != 0.0, axis=1))[0])
    late = recording._replace(records=recording.records[moving:])
    # What is advised must be possible: the file of a recorder that was restarted has none before it.
    with pytest.raises(ServiceError, match=r"in mode moving; a replay needs .* mode disabled.*restarted.*report"):
        replay_session(late, config, simulated=False)


def test_what_begins_after_the_first_inputs_is_refused_also_where_the_robot_is_disabled(
    recording: Recording, config: Config
) -> None:
    """Nobody knows the override, or the place that was commanded last."""
    later = recording._replace(requests=recording.requests[1:])
    with pytest.raises(ServiceError, match=r"with input 2 of the control; a replay needs .* the first input"):
        replay_session(later, config, simulated=False)


def test_another_rate_is_refused(recording: Recording, config: Config) -> None:
    slower = msgspec.structs.replace(config, loop=msgspec.structs.replace(config.loop, rate_hz=500))
    with pytest.raises(ServiceError, match="500 Hz, but the recording has 1000 cycles per second"):
        replay_session(recording, slower, simulated=True)


def test_parts_are_put_together(recording: Recording) -> None:
    half = len(recording.records) // 2
    first = recording._replace(
        records=recording.records[:half], t=recording.t[:half], wall=recording.wall[:half], events=[], requests=()
    )
    second = recording._replace(
        records=recording.records[half - 10 :], t=recording.t[half - 10 :], wall=recording.wall[half - 10 :]
    )
    whole = join([second, first])
    assert made.bits(whole.records) == made.bits(recording.records)
    assert np.array_equal(whole.t, recording.t)
    assert (whole.requests, whole.events) == (recording.requests, recording.events)
    with pytest.raises(ServiceError, match="is not of the same session as"):
        join([first, second._replace(name="other")])


# ---------------------------------------------------------------------- what it comes to


def test_every_goal_has_the_outcome_that_was_said(recording: Recording) -> None:
    summed = summarise(recording)
    events = [line.event for line in reversed(recording.events) if line.event is not None]
    said = {event.id: event.outcome for event in events if event.outcome}
    assert {goal.id: goal.outcome for goal in summed.goals} == said
    assert all(goal.ended is not None and goal.given is not None for goal in summed.goals)
    assert all((goal.ended or 0.0) >= (goal.given or 0.0) for goal in summed.goals)
    assert {goal.kind for goal in summed.goals} >= {"pose", "sliders"}


def test_of_a_goal_that_was_requested_before_the_recording_nobody_knows_how_long_it_took(
    recording: Recording, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    without = recording._replace(requests=())
    later = summarise(without)
    assert {(goal.given, goal.ended is None) for goal in later.goals} == {(None, False)}
    recording_commands._print_goals(list(later.goals))
    assert all(line.split()[0] == "before" for line in capsys.readouterr().out.splitlines())
    charts.draw(tmp_path / "session.svg", without, later)


def test_the_quick_stop_is_the_fault(recording: Recording) -> None:
    (fault,) = summarise(recording).faults
    assert fault.message == "quick_stop by ann"


def test_errors_are_those_of_enabled_drives(recording: Recording) -> None:
    summed = summarise(recording)
    assert all(0.0 < each.rms <= each.max < 0.004 for each in summed.tracking)
    assert sum(summed.modes.values()) == pytest.approx(summed.cycles / summed.rate_hz)


def test_the_commands(path: Path, tmp_path: Path) -> None:
    replayed = trirail("replay", path)
    assert replayed.returncode == 0, replayed.stderr
    assert "the same to the last bit" in replayed.stdout
    picture = tmp_path / "report.png"
    reported = trirail("report", path, "--plot", picture, "--json")
    assert reported.returncode == 0, reported.stderr
    assert json.loads(reported.stdout)["faults"][0]["message"] == "quick_stop by ann"
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_another_configuration_is_tried_on_simulated_drives(path: Path, tmp_path: Path) -> None:
    config, _ = own_service.private(tmp_path)
    config.write_text(config.read_text().replace("velocity = [0.25, 0.25, 1.5]", "velocity = [0.1, 0.1, 1.0]"))
    assert load(config).limits.platform.velocity == (0.1, 0.1, 1.0)
    replayed = trirail("replay", path, "--config", config, "--json")
    assert replayed.returncode == 0, replayed.stderr
    compared = json.loads(replayed.stdout)
    assert compared["differing"] > 0
    assert compared["simulated_drives"]
