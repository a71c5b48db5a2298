"""A report's picture, as `trirail report --plot` draws it: of sessions in any mode, with one table of colours."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import made
import numpy as np
import pytest
from rich.style import Style
from trirail.analysis import charts
from trirail.analysis.summary import UNKNOWN
from trirail.cli import recording_commands, terminal
from trirail.config import SIM, load
from trirail.telemetry import palette
from trirail.telemetry.recorder import Recorder
from trirail.wire.messages import Outcome
from trirail.wire.vocabulary import MODES, Mode


def test_every_mode_has_a_colour_of_its_own_wherever_it_is_shown() -> None:
    assert set(palette.MODES) == set(Mode)
    for shown in (palette.MODES, charts.MODE_COLOURS, terminal.COLOURS):
        assert [*shown] == [*MODES]
        assert len(set(shown.values())) == len(MODES)
    assert all(Style.parse(style).color is not None for style in terminal.COLOURS.values())


def test_every_outcome_has_one_colour_wherever_it_is_shown() -> None:
    assert set(palette.OUTCOMES) == {*get_args(Outcome), UNKNOWN}
    assert all(Style.parse(palette.code(colour)).color is not None for colour in palette.OUTCOMES.values())


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
