"""The numbers beside the drawing, and what a viewer gets that joins late."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from pathlib import Path

import made
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from markdown_it import MarkdownIt
from ports import free_port
from rerun.chunk import RrdReader
from rerun.error_utils import RerunWarning
from trirail.config import SIM, load
from trirail.processes.operating_system import python
from trirail.telemetry import readout
from trirail.telemetry.drawn_robot import DrawnRobot
from trirail.telemetry.readout import ReadoutState
from trirail.telemetry.sinks import live_relay, live_server
from trirail.telemetry.streams import Streams
from trirail.wire.vocabulary import MODES, Mode

RECORD = made.records(0.01, mode=Mode.FAULT)[-1]


def test_it_says_mode_goal_pose_sliders_and_what_is_wrong() -> None:
    record = RECORD.copy()
    record["pose"] = 0.0123456, -0.02, np.radians(12.5)
    record["position"] = 0.001, -0.0025, 0.1
    record["progress"], record["remaining"] = 0.4, 0.71
    record["homed"] = True
    said = readout.markdown(record, ReadoutState("g-1", (0.03, 0.0, 0.5), 0.5, "drive B: EMCY 8700"))
    assert "**FAULT**   override 50%   goal **g\\-1**: 40%, 0.7 s left" in said
    assert "40%, waits on its path" in readout.markdown(record, ReadoutState("g-1", override=0.0))
    record["mode"] = MODES.index(Mode.HOLDING)
    assert "40%, waits on its path" in readout.markdown(record, ReadoutState("g-1"))
    record["mode"] = MODES.index(Mode.FAULT)
    assert "**drive B\\: EMCY 8700**" in said
    assert "| measured | 12.346 | -20.000 | 12.500 | λ [mm] | 1.000 | -2.500 | 100.000 |" in said
    assert "| goal | 30.000 | 0.000 | 28.648 |" in said
    assert "| goal | – | – | – |" in readout.markdown(record, ReadoutState())
    record["homed"] = True, False, True
    assert "| measured | – | – | – | λ [mm] | 1.000 | not homed | 100.000 |" in readout.markdown(record, ReadoutState())


WORDS = st.text(st.characters(exclude_categories=["C", "Z"]), min_size=1)


@given(WORDS, WORDS)
def test_what_clients_and_drives_wrote_is_shown_as_it_is(goal: str, fault: str) -> None:
    """By a parser of Markdown that others wrote: no link, no picture, no table comes of a goal's id."""
    said = readout.markdown(RECORD, ReadoutState(goal, None, 1.0, fault))
    tokens = MarkdownIt("commonmark").enable(["table", "strikethrough"]).parse(said)
    inline = [token for token in tokens if token.type == "inline"]
    assert "".join(child.content for child in inline[1].children or ()) == fault
    assert f"goal {goal}: " in "".join(child.content for child in inline[0].children or ())
    assert {child.type for token in inline for child in token.children or ()} <= {"text", "strong_open", "strong_close"}


def test_a_viewer_that_joins_late_is_sent_the_present_first(tmp_path: Path) -> None:
    port, saved, batches = free_port(), tmp_path / "seen.rrd", 100
    streams = Streams(DrawnRobot.from_config(load(SIM)), "late", 0)
    relay = live_relay(streams.open(live_server(port, 64.0)))
    streams.attach(relay, 5)
    for number, batch in enumerate(np.split(made.records(20.0), batches)):
        streams.records(batch.tobytes())
        while relay._waiting:  # as slow as the server takes them: none is skipped
            time.sleep(0.001)
        assert relay.skipped == 0, number
    url = f"rerun+http://127.0.0.1:{port}/proxy"
    viewer = subprocess.Popen(python("-m", "rerun_cli", "--save", str(saved), "--connect", url), start_new_session=True)
    try:
        deadline = time.monotonic() + 60.0
        while len(came := _times(saved)) < batches:
            assert time.monotonic() < deadline, came
            time.sleep(0.2)
    finally:
        os.killpg(viewer.pid, signal.SIGTERM)
        viewer.wait()
        relay.close()
    assert came == sorted(came, reverse=True)


def _times(saved: Path) -> list[int]:
    """Return the first times of the batches in a file that a viewer writes, in the order in which they came."""
    if not saved.is_file():
        return []
    try:
        with pytest.warns(RerunWarning, match="no footer"):
            chunks = [chunk for chunk in RrdReader(saved).stream() if chunk.entity_path == "/pose/phi"]
    except (RuntimeError, ValueError):
        return []
    batches = [chunk.to_record_batch() for chunk in chunks]
    return [int(batch.column("t").to_numpy().astype(int)[0]) for batch in batches if "t" in batch.schema.names]
