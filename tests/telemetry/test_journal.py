"""The lines of the logs, as a recording holds them."""

from __future__ import annotations

import msgspec
import pytest
from trirail.telemetry import journal
from trirail.telemetry.journal import EVENTS, REQUESTS, Entry
from trirail.wire.goals import PoseGoal
from trirail.wire.messages import Event, Level
from trirail.wire.packets import CommandRequest, ControlInput, GoalRequest
from trirail.wire.vocabulary import Command

SAID = 1_700_000_000_500_000_000
EVENT = Event("goal", "warning", "goal g expired", id="g", seq=7, t=1.25, cycle=1250, time=1_700_000_000.5)
GOAL = ControlInput(3, 1250, 5_000_000_000, GoalRequest(1, "ann", "g", PoseGoal(0.01, 0.0, 0.0), 4_999_000_000))
STOP = ControlInput(4, 1300, 5_050_000_000, CommandRequest(2, "ann", Command.STOP))


def test_lines_of_one_log_are_one_chunk_with_their_own_times() -> None:
    remark = Entry(EVENTS, 1.5, SAID * 1e-9 + 0.25, "a word", "error")
    given = [journal.input_entry(what, 1000, 1_000_000_000) for what in (GOAL, STOP)]
    events, requests = journal.chunks([journal.event_entry(EVENT), given[0], remark, given[1]])
    assert (events.entity_path, requests.entity_path) == (EVENTS, REQUESTS)
    batch = events.to_record_batch()
    assert batch.column("TextLog:text").to_pylist() == [["    1.250 s   goal g expired"], ["    1.500 s   a word"]]
    assert batch.column("words").to_pylist() == [["goal g expired"], ["a word"]]
    assert batch.column("TextLog:level").to_pylist() == [["WARN"], ["ERROR"]]
    assert batch.column("t").to_numpy().astype(int).tolist() == [1_250_000_000, 1_500_000_000]
    wall = [SAID, SAID + 250_000_000]
    assert batch.column("wall").to_numpy().astype(int).tolist() == pytest.approx(wall, rel=0, abs=256)  # [ns]
    said, none = batch.column("json").to_pylist()
    assert msgspec.json.decode(said[0], type=Event) == EVENT
    assert not none
    batch = requests.to_record_batch()
    assert batch.column("words").to_pylist() == [["goal g of ann: pose"], ["stop by ann"]]
    assert [msgspec.json.decode(text, type=ControlInput) for (text,) in batch.column("json").to_pylist()] == [
        GOAL,
        STOP,
    ]
    assert batch.column("t").to_numpy().astype(int).tolist() == [1_250_000_000, 1_300_000_000]
    assert batch.column("wall").to_numpy().astype(int).tolist() == [6_000_000_000, 6_050_000_000]


@pytest.mark.parametrize(("level", "shown"), [("info", "INFO"), ("warning", "WARN"), ("error", "ERROR")])
def test_levels_are_those_that_the_viewer_colours(level: Level, shown: str) -> None:
    (chunk,) = journal.chunks([Entry(EVENTS, 0.0, 0.0, "", level)])
    assert chunk.to_record_batch().column("TextLog:level").to_pylist() == [[shown]]


def test_nothing_said_is_no_chunk() -> None:
    assert journal.chunks([]) == []
