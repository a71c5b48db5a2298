"""The view that is drawn on this machine from what a service publishes."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, cast

import made
import msgspec
import pytest
from rerun.chunk import Chunk
from trirail.cli import remote_view
from trirail.cli.remote_view import RemoteRobot
from trirail.config import SIM, load
from trirail.processes.publications import StateMaker, info
from trirail.telemetry.sinks import Relay
from trirail.wire.messages import Event
from trirail.wire.state import State
from trirail.wire.vocabulary import Mode
from waiting import wait_until

CONFIG = load(SIM)
Shown = Callable[[str], list[Chunk]]


@contextmanager
def drawn(monkeypatch: pytest.MonkeyPatch, *published: bytes | Event | State) -> Iterator[Shown]:
    """Yield a function that returns what is shown at an entity path of a service that has published some messages."""

    def subscribe(robot: RemoteRobot, _name: str) -> None:
        for each in published:
            robot._queue.put(each)

    monkeypatch.setattr(RemoteRobot, "_subscribe", subscribe)
    chunks: list[Chunk] = []
    relay = Relay(chunks.extend, lambda: None)
    robot = RemoteRobot(info(CONFIG), cast(Any, None), "demo", "", threading.Event())
    robot.draw(relay)
    try:
        yield lambda path: [each for each in chunks if each.entity_path == path]
    finally:
        robot.end()
        relay.close()


def walls(chunks: list[Chunk]) -> list[int]:
    """Times on the wall clock [ns]."""
    return [int(each) for chunk in chunks for each in chunk.to_record_batch().column("wall").cast("int64").to_pylist()]


@pytest.mark.parametrize("ahead", [-30.0, 0.0, 3600.0])
def test_an_event_is_shown_at_its_cycle_whatever_the_clock_of_the_service_says(
    ahead: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise all curves would end long before the newest event, or hide it."""
    event = Event("mode", "info", "moving", seq=1, t=0.5, cycle=500, time=time.time() + ahead)
    records = made.records(1.0)
    with drawn(monkeypatch, records[:600].tobytes(), event, records[600:].tobytes()) as shown:
        pass
    (at,) = walls(shown("/events"))
    assert max(walls(shown("/robot/platform"))) - at == pytest.approx(499_000_000, abs=1e3)


def test_the_death_of_the_loop_is_shown_though_no_records_follow(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(remote_view, "SILENCE_S", 0.1)
    records = made.records(1.0)
    states = StateMaker(CONFIG)
    states.records(records)
    died = "the loop has died"
    event = Event("fault", "error", died, seq=1, t=1.0, cycle=1000, time=time.time())
    state = msgspec.structs.replace(states.newest(), mode=Mode.FAULT, goal=None, faults=(died,))
    with drawn(monkeypatch, records.tobytes(), event, state) as shown:
        wait_until(lambda: bool(shown("/events")))
        wait_until(lambda: shown("/mode")[-1].to_record_batch().column("StateChange:state")[0].as_py() == ["fault"])
        words = [text for chunk in shown("/events") for text in chunk.to_record_batch().column("words").to_pylist()]
        assert words == [[died], ["no messages for 0.1 s: service ended or connection lost"]]
        (readout,) = shown("/readout")[-1].to_record_batch().column("TextDocument:text")[-1].as_py()
        assert "**FAULT**" in readout
        assert died in readout
