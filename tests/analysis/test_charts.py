"""A report's picture, as `trirail report --plot` draws it: of sessions in any mode, with one table of colours."""

from __future__ import annotations

import math
import re
from itertools import combinations
from pathlib import Path
from typing import Any, get_args

import made
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from matplotlib.figure import Figure
from rich.style import Style
from trirail.analysis import charts
from trirail.analysis.summary import UNKNOWN_LABEL, summarise
from trirail.cli import recording_commands, terminal
from trirail.config import SIM, load
from trirail.telemetry import palette
from trirail.telemetry.recorder import Recorder
from trirail.telemetry.recording import Recording
from trirail.wire.goals import SlidersGoal
from trirail.wire.looks import AlignmentLook, SeenMark
from trirail.wire.messages import Event, Outcome
from trirail.wire.packets import ControlInput, GoalRequest
from trirail.wire.vocabulary import MODES, Mode
from wire.looks import told


def test_every_mode_has_a_colour_of_its_own_wherever_it_is_shown() -> None:
    assert set(palette.MODES) == set(Mode)
    for shown in (palette.MODES, charts.MODE_COLOURS, terminal.COLOURS):
        assert [*shown] == [*MODES]
        assert len(set(shown.values())) == len(MODES)
    assert all(Style.parse(style).color is not None for style in terminal.COLOURS.values())


def test_every_outcome_has_one_colour_wherever_it_is_shown() -> None:
    assert set(palette.OUTCOMES) == {*get_args(Outcome), UNKNOWN_LABEL}
    assert all(Style.parse(palette.code(colour)).color is not None for colour in palette.OUTCOMES.values())
    for (one, of_one), (other, of_other) in combinations(palette.OUTCOMES.items(), 2):
        assert math.dist(of_one, of_other) > 40.0, f"{one} looks like {other}"


@pytest.mark.parametrize("picture", ["session.png", "session.svg"])
def test_a_session_that_was_in_every_mode_is_drawn(
    picture: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    records = made.records(0.7)
    records["mode"] = np.repeat(np.arange(len(MODES)), len(records) // len(MODES))
    recording = tmp_path / "session.rrd"
    recorder = Recorder(load(SIM), tmp_path, path=recording, live=False)
    recorder.records(records[:350].tobytes())
    recorder.records(records[350:].tobytes())
    recorder.close()
    assert recording_commands.report(recording, plot=tmp_path / picture) == 0
    said = capsys.readouterr().out
    assert all(f"{mode} 0.1 s" in said for mode in MODES)
    if picture.endswith(".svg"):
        drawn = (tmp_path / picture).read_text()
        assert all(f"<!-- {mode} -->" in drawn for mode in MODES)  # the legend names each
        assert all(f"fill: {colour}" in drawn for colour in charts.MODE_COLOURS.values())
    else:
        assert (tmp_path / picture).read_bytes().startswith(b"\x89PNG")


@given(st.floats(0.0, 1e6))
@example(179.7)
def test_a_duration_has_no_sixtieth_second(time: float) -> None:
    said = recording_commands._seconds(time)
    minutes, seconds = re.fullmatch(r"(?:(\d+) min )?([\d.]+) s", said).groups()  # type: ignore[union-attr]
    assert float(seconds) < 60.0 or minutes is None
    assert 60.0 * int(minutes or 0) + float(seconds) == pytest.approx(time, abs=0.051 if minutes is None else 0.5)


def test_faults_are_numbered_at_their_moment_and_told_below_the_curves(tmp_path: Path) -> None:
    """Texts in a picture of vectors are what a reader sees; ids and messages of any letters are drawn as they are."""
    records = made.records(2.0)
    records["position"][1000, 0] = -0.165  # near its limit of -0.17 m
    recorder = Recorder(load(SIM), tmp_path, path=tmp_path / "session.rrd", live=False)
    for half in np.split(records, 2):
        recorder.records(half.tobytes())
    for n in range(charts.MAX_LISTED_FAULTS + 2):
        fault = Event("fault", "error", f"drive B: fault $_{{{n}}} $", seq=n + 1, t=0.15 * n, cycle=150 * n, time=1.7e9)
        recorder.event(fault)
    marks = ("cost $5 or $6", r"$\frac$")
    for n in (1, 2):
        seen = tuple(SeenMark(mark, (1.0, 2.0), (1e-4 / n, 0.0)) for mark in marks)
        look = AlignmentLook("a-1", "alignment", n, seen, end="reached" if n == 2 else None)
        recorder.event(told(30 + n, look))
    name = "g $x_{1}$ %s"
    recorder.event(Event("goal", "info", "done", id=name, outcome="done", seq=20, t=1.9, cycle=1900, time=1.7e9))
    recorder.control_input(ControlInput(1, 100, 0, GoalRequest(1, "somebody", name, SlidersGoal((0.0, 0.0, 0.0)), 0)))
    recorder.close()
    picture = tmp_path / "session.svg"
    assert recording_commands.report(tmp_path / "session.rrd", plot=picture) == 0
    drawn = picture.read_text()
    assert all(f"<!-- {number} -->" in drawn for number in range(1, charts.MAX_LISTED_FAULTS + 1))
    for n in range(charts.MAX_LISTED_FAULTS):
        assert f"{n + 1}   {0.15 * n:.3f} s   drive B: fault $_{{{n}}} $" in drawn
    assert "and 2 more" in drawn
    assert f"<!-- {name} -->" in drawn
    assert all(f"<!-- {mark} -->" in drawn for mark in marks)
    assert drawn.count("stroke-dasharray") > 2, "the limit that A came near, beside the period and its legend"


def test_sliders_are_reported_without_the_backlash_compensation(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is in the positions of the drives, and jumps where a slider turns back."""
    records = made.records(2.0)
    compensated = records.copy()
    compensated["backlash"] = np.where(records["velocity"] > 0.0, 1e-3, -1e-3)
    compensated["position"] += compensated["backlash"]
    compensated["commanded_position"] += compensated["backlash"]
    drawn: dict[str, Any] = {}
    monkeypatch.setattr(charts, "_draw_curves", lambda panel, _, values, __: drawn.update({panel: values}))
    monkeypatch.setattr(charts, "_label_curves", lambda *_: None)
    panels: Any = {name: name for name in ("x, y [mm]", "φ [°]", "λ [mm]", "velocity [mm/s]", "error [µm]")}
    t = np.arange(len(records)) / made.RATE_HZ
    charts._draw_motion(panels, compensated, t, None, ("A", "B", "C"))
    assert drawn["λ [mm]"] == pytest.approx(records["position"] * 1e3)
    wall = t.astype("datetime64[ns]")
    summaries = [summarise(Recording("demo", each, t, wall, [], {})) for each in (records, compensated)]
    assert summaries[1].distance == pytest.approx(summaries[0].distance)


def test_a_place_that_is_not_known_is_not_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Before homing, the position of a slider is relative to where its drive was switched on."""
    records = made.records(2.0)
    records["homed"], records["homed"][:100, 1] = 1, 0
    drawn: dict[str, Any] = {}
    monkeypatch.setattr(charts, "_draw_curves", lambda panel, _, values, __: drawn.update({panel: values}))
    monkeypatch.setattr(charts, "_label_curves", lambda *_: None)
    panels: Any = {name: name for name in ("x, y [mm]", "φ [°]", "λ [mm]", "velocity [mm/s]", "error [µm]")}
    charts._draw_motion(panels, records, np.arange(len(records)) / made.RATE_HZ, None, ("A", "B", "C"))
    for panel in ("x, y [mm]", "φ [°]"):
        assert np.isnan(drawn[panel][:100]).all()
        assert np.isfinite(drawn[panel][100:]).all()
    assert np.isnan(drawn["λ [mm]"]).sum(axis=0).tolist() == [0, 100, 0]


@pytest.mark.parametrize("seconds", [1.0, 20.0])
def test_what_is_missing_in_a_recording_is_a_gap_in_its_curves_and_modes(seconds: float) -> None:
    whole = made.records(seconds)
    begin, end = len(whole) // 4, len(whole) // 2
    records = np.concatenate([whole[:begin], whole[end:]])
    t = records["cycle"] / made.RATE_HZ
    times, drawn = charts._decimate(t, records["pose"][:, 0])
    assert np.isnan(drawn[np.searchsorted(times, t[begin]) - 1])
    panel = Figure().subplots()
    charts._draw_modes(panel, records, t, summarise(Recording("demo", records, t, t.astype("M8[ns]"), [], {})))
    (bands,) = panel.collections
    ends = [tuple(path.get_extents().intervalx) for path in bands.get_paths()]
    assert ends == [pytest.approx((t[0], t[begin - 1])), pytest.approx((t[begin], t[-1]))]


@pytest.mark.generated(0, 1, 2)
def test_no_excursion_of_a_long_curve_is_lost(seed: int) -> None:
    """Neither the last one of the session, nor one right before a fault, since when there are no values."""
    random = np.random.default_rng(seed)
    number = int(random.integers(3 * charts.CURVE_BINS, 9 * charts.CURVE_BINS))
    t, values = np.arange(number) / 1e3, np.zeros(number)
    fault = int(random.integers(number // 2, number))
    values[fault:] = np.nan
    for curve in (values[:fault], values):
        curve[fault - 1 - int(random.integers(3))] = 7.0
        times, drawn = charts._decimate(t[: len(curve)], curve)
        assert np.nanmax(drawn) == 7.0
        assert (np.diff(times) >= 0.0).all()
    assert np.isnan(drawn[times >= t[fault] + 0.02]).all()
