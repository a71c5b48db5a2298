"""Several robots in one recording: each whole, below its own entity, in a column of its own."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import made
import pytest
import rerun as rr
import screenshot
from cli.test_view import near, needs_vulkan
from rerun.chunk import RrdReader
from trirail.config import SIM, load
from trirail.telemetry import palette
from trirail.telemetry.drawn_robot import DrawnRobot
from trirail.telemetry.readout import ReadoutState
from trirail.telemetry.sinks import Relay, live_relay
from trirail.telemetry.streams import LIVE_HZ, Streams, open_together
from trirail.wire.messages import Event

NAMES = ("left", "right")
STARTED = {"left": 0, "right": 7_000_000_000}
"""Loops begin at different times: the wall clock less the monotonic one [ns]."""


def show(streams: Streams, relay: Relay) -> None:
    """Move for five seconds."""
    records = made.records(5.0)
    streams.attach(relay, LIVE_HZ)
    streams.update_state(ReadoutState("g-1", (0.05, 0.02, 0.3)))
    for start in range(0, len(records), 1000):
        streams.records(records[start : start + 1000].tobytes())
    streams.event(Event("mode", "info", f"{streams.shown.robot.name} moves", seq=1, t=0.5, cycle=500, time=0.5))
    streams.flush()


def entities(path: Path) -> set[str]:
    """All that is drawn in a file."""
    found = {chunk.entity_path for chunk in RrdReader(path).stream()}
    return {entity for entity in found if not entity.startswith("/__")}


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two robots, in a file as a viewer would get it."""
    path = tmp_path_factory.mktemp("together") / "two.rrd"
    robot = DrawnRobot.from_config(load(SIM))
    both = [Streams(replace(robot, name=name), name, STARTED[name], f"/{name}") for name in NAMES]
    relay = live_relay(open_together(both, "two", rr.FileSink(path)))
    for streams in both:
        show(streams, relay)
    relay.close()
    return path


def test_each_has_all_that_one_alone_has_and_nothing_of_another(file: Path, tmp_path: Path) -> None:
    alone = tmp_path / "alone.rrd"
    streams = Streams(DrawnRobot.from_config(load(SIM)), "alone", 0)
    relay = live_relay(streams.open(rr.FileSink(alone)))
    show(streams, relay)
    relay.close()
    assert entities(file) == {f"/{name}{entity}" for name in NAMES for entity in entities(alone)}
    said = {
        chunk.entity_path: chunk.to_record_batch().column("words").to_pylist()
        for chunk in RrdReader(file).stream()
        if chunk.entity_path.endswith("/events")
    }
    assert said == {f"/{name}/events": [[f"{name} moves"]] for name in NAMES}


def test_they_meet_on_the_wall_clock(file: Path) -> None:
    began: dict[str, tuple[int, int]] = {}
    for chunk in RrdReader(file).stream():
        if chunk.entity_path in (f"/{name}/robot/platform" for name in NAMES):
            batch = chunk.to_record_batch()
            name = chunk.entity_path.split("/")[1]
            wall, t = (int(batch.column(line).cast("int64")[0].as_py()) for line in ("wall", "t"))
            began[name] = min(began.get(name, (wall, t)), (wall, t))
    assert began["right"][0] - began["left"][0] == STARTED["right"]
    assert began["right"][1] == began["left"][1]


@pytest.mark.viewer
@needs_vulkan
def test_the_viewer_shows_them_side_by_side_without_complaint(file: Path) -> None:
    with screenshot.viewer(file, 1280, 800) as client:
        views = client.get_state().views
        picture = screenshot.picture(client)
    for name in ("Now", "Mode", "Events", "Slider position λ  [mm]"):
        assert [view.name for view in views].count(name) == len(NAMES)
    assert {f"{name}: 3-PRP planar robot" for name in NAMES} <= {view.name for view in views}
    assert [report for view in views for report in view.reports] == []
    width, height = picture.size
    for left, right in ((0, width // 2), (width // 2, width)):
        half = picture.crop((left, 0, right, height))
        for colour in (*palette.SLIDERS, palette.PLATFORM):
            assert near(half, colour) > 20, (left, colour)
