"""The paper's motions by the running service: sent exactly, cut out of the recording in time, and equal."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Literal

import conftest
import msgspec
import numpy as np
import paper
import paper_service
import pytest
from generated import thinned
from paper_motions import DURATION, EXAMPLES, QUANTITIES, Example, computed, greatest_difference, platform
from paper_service import REACHED_AFTER_CYCLES, driven, points
from refusals import refused_as
from trirail.client import own_service
from trirail.config import SIM, load
from trirail.errors import RefusalCode, ServiceError
from trirail.telemetry.journal import Line
from trirail.telemetry.recording import Recording
from trirail.wire.goals import TrajectoryGoal
from trirail.wire.messages import Event
from trirail.wire.packets import Accepted
from trirail.wire.records import DTYPE
from trirail.wire.sizes import MAX_MESSAGE
from trirail.wire.vocabulary import MODES, Mode

PERIOD = 1e-3
BOUNDS = (1e-14, 5e-14, 1e-11)
"""Of position, velocity and acceleration [m, m/s, m/s²]: three times what they must be. The remainder of the quintics
is 5e-17, 9e-15, 3e-12 (paper_service.SPACING); the service's time, the sum of 3000 periods, ends 2.2e-13 s early: times
0.03 m/s and 0.03 m/s² that is 7e-15 in position and velocity; rounding of 1e-17 m over the square of 20 ms is 2e-12 in
acceleration. A motion that were one cycle off would differ by 3e-5."""


def recording(example: Example, first: int = 40, lost: slice = slice(0, 0)) -> Recording:
    """What the recorder leaves of a motion whose first cycle is the `first`; some records may be lost."""
    n = round(DURATION / PERIOD)
    records = np.zeros(first + n + 200, DTYPE)
    records["cycle"] = np.arange(100, 100 + len(records))
    records["mode"] = MODES.index(Mode.HOLDING)
    span = records[first : first + n]
    t = np.arange(1.0, n + 1.0) * PERIOD
    span["mode"] = MODES.index(Mode.MOVING)
    span["progress"] = t / DURATION
    _, span["commanded_position"], span["commanded_velocity"], span["commanded_acceleration"] = computed(example, t)
    records["position"][first + REACHED_AFTER_CYCLES : first + n + REACHED_AFTER_CYCLES] = span["commanded_position"]
    records = np.delete(records, lost)
    times = records["cycle"] * PERIOD
    events = [line(100 + first, "g")]
    return Recording("demo", records, times, np.zeros(len(records), "datetime64[ns]"), events, {})


def line(cycle: int, goal: str, kind: Literal["mode", "goal"] = "mode") -> Line:
    """A line of the log that names a goal: one with which the robot was set in motion, or one that has ended."""
    begun, ended = (goal, None) if kind == "mode" else (None, goal)
    event = Event(kind, "info", "", id=ended, goal=begun, seq=1, t=cycle * PERIOD, cycle=cycle, time=0.0)
    return Line(event.t, np.datetime64(0, "ns"), "INFO", event.message, event)


# ---------------------------------------------------------------------- what is sent


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda example: example.name)
def test_a_motion_fits_a_message_and_is_exact_at_its_points(example: Example) -> None:
    sent = points(example)
    message = TrajectoryGoal(tuple(sent), id="x" * 64)
    assert len(msgspec.json.encode(message)) < MAX_MESSAGE
    assert (sent[0].t, sent[-1].t) == (0.0, DURATION)
    exact = platform(example, np.array([point.t for point in sent]))
    for rows, values in zip(
        ([(p.x, p.y, p.phi) for p in sent], [p.velocity for p in sent], [p.acceleration for p in sent]),
        exact,
        strict=True,
    ):
        assert np.array_equal(np.array(rows), values)


@pytest.mark.parametrize("example", thinned(EXAMPLES, every=3), ids=lambda example: example.name)
def test_the_cycle_that_takes_the_goal_is_one_period_into_it(rig: conftest.Rig, example: Example) -> None:
    """What the alignment rests on, without processes: control and driver on the simulated bus.

    Also that the setpoint of a cycle is the one that drives are to have reached REACHED cycles later.
    """
    rig.enable()
    assert isinstance(rig.send("g", TrajectoryGoal(tuple(points(example)), settle=False)), Accepted)
    first = len(rig.rows) - 1
    assert rig.control.measured.record["progress"][0] == pytest.approx(PERIOD / DURATION)
    moving = 1
    measured, error = [rig.control.measured.feedback.position], [rig.control.measured.following_error]
    for _ in range(round(DURATION / PERIOD) + REACHED_AFTER_CYCLES):
        rig.cycle()
        moving += rig.mode is Mode.MOVING
        measured.append(rig.control.measured.feedback.position)
        error.append(rig.control.measured.following_error)
    assert moving == round(DURATION / PERIOD)
    setpoints = rig.setpoints()[first : first + moving]
    _, *exact = computed(example, np.arange(1.0, moving + 1.0) * PERIOD)
    for row, values in enumerate(exact):
        assert np.max(np.abs(setpoints[:, row] - values)) < BOUNDS[row]
    behind = setpoints[:, 0] - np.array(measured)[REACHED_AFTER_CYCLES : moving + REACHED_AFTER_CYCLES]
    assert np.array_equal(behind, np.array(error)[REACHED_AFTER_CYCLES : moving + REACHED_AFTER_CYCLES])


# ---------------------------------------------------------------------- in time


@pytest.mark.parametrize("first", [3, 40])
def test_a_motion_is_cut_out_in_time(first: int) -> None:
    example = EXAMPLES[0]
    commanded, measured = driven(recording(example, first), "g", PERIOD)
    assert np.array_equal(commanded.t, np.arange(1, 3001) * PERIOD)
    exact = computed(example, commanded.t)
    assert all(greatest_difference(commanded, exact, quantity) == 0.0 for quantity in QUANTITIES)
    assert np.array_equal(measured, exact.position)


def test_the_motion_is_found_by_its_goal() -> None:
    made = recording(EXAMPLES[0])
    other, later = line(101, "g2"), line(3500, "g", "goal")
    assert len(driven(made._replace(events=[other, *made.events, later]), "g", PERIOD).measured) == 3000
    with pytest.raises(ServiceError, match="says 0 times, not once, that goal g3 began"):
        driven(made, "g3", PERIOD)
    with pytest.raises(ServiceError, match="says 2 times, not once, that goal g began"):
        driven(made._replace(events=made.events * 2), "g", PERIOD)


@pytest.mark.parametrize("lost", [slice(700, 701), slice(40, 60), slice(3030, 3050), slice(1500, 3200)])
def test_a_gap_is_refused(lost: slice) -> None:
    with pytest.raises(ServiceError, match=r"goal g: .* expected 3000 without a gap"):
        driven(recording(EXAMPLES[0], lost=lost), "g", PERIOD)


def test_records_that_are_lost_elsewhere_do_not_matter() -> None:
    assert len(driven(recording(EXAMPLES[0], lost=slice(0, 20)), "g", PERIOD).measured) == 3000


def test_a_motion_that_was_stopped_is_refused() -> None:
    made = recording(EXAMPLES[0])
    made.records["mode"][2000:2100] = MODES.index(Mode.STOPPING)
    with pytest.raises(ServiceError, match="goal g: 1960 cycles of motion are recorded; expected 3000 without a gap"):
        driven(made, "g", PERIOD)


@pytest.mark.parametrize("rate", [0.999, 1.001])
def test_a_motion_whose_time_ran_at_another_rate_is_refused(rate: float) -> None:
    made = recording(EXAMPLES[0])
    made.records["progress"][1000:3040] *= rate
    with pytest.raises(ServiceError, match="its time did not run evenly"):
        driven(made, "g", PERIOD)


# ---------------------------------------------------------------------- a service of its own


def test_its_configuration_is_the_simulated_robots_out_of_reach_of_others(tmp_path: Path) -> None:
    path, locator = own_service.private(tmp_path)
    config, sim = load(path), load(SIM)
    assert config.zenoh.listen == (locator,)
    assert locator == f"unixsock-stream/{tmp_path}/zenoh"
    assert config.telemetry.live_port == 0
    assert config.watchdogs.max_overruns == 1000  # a machine that stalls for a second stops no simulated slider
    replaced = {name: getattr(sim, name) for name in ("zenoh", "telemetry", "watchdogs", "can", "drives")}
    assert msgspec.structs.replace(config, **replaced) == sim


@pytest.mark.slow
def test_the_service_does_what_the_paper_computes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert paper.main(["--output", str(tmp_path), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    for row, bound in zip(said["figures"], BOUNDS * 3, strict=True):
        assert 0.0 < row["service"] < bound, row
        assert Path(row["picture"]).exists()
    for row in said["figures"][::3]:
        assert 0.0 < row["measured"] < load(SIM).limits.slider.following_error
    assert said["service"].keys() == {"displacement", "velocity", "acceleration"}
    assert Path(said["recording"]) == tmp_path / "paper.rrd"


@pytest.mark.slow
def test_what_the_service_refuses_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    too_fast = [msgspec.structs.replace(point, t=point.t / 20.0) for point in points(EXAMPLES[0])]
    monkeypatch.setattr(paper_service, "points", lambda _: too_fast)
    with refused_as(RefusalCode.TOO_FAST):
        paper_service.drive(tmp_path / "a.rrd", lambda _: None)
