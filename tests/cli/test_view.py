"""The viewers: what they show is looked at, in pictures that they take of themselves."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import made
import msgspec
import numpy as np
import pytest
import screenshot
from chromium import chromium, needs_chromium
from PIL import Image
from ports import free_port
from rerun.chunk import Chunk, RrdReader
from trirail.cli import remote_view, view
from trirail.config import SIM, load
from trirail.errors import ServiceError
from trirail.processes import operating_system
from trirail.processes.publications import info
from trirail.telemetry import reading, retention
from trirail.telemetry.readout import ReadoutState
from trirail.telemetry.recorder import Recorder
from trirail.wire import zenoh_session
from trirail.wire.endpoints import is_local
from waiting import wait_until

VIEWS = {
    "demo: 3-PRP planar robot",
    "Mode",
    "Events",
    "Slider position λ  [mm]",
    "Slider velocity  [mm/s]",
    "Slider acceleration  [m/s²]",
    "Following error  [µm], limit ±4 mm",
    "Centre x, y  [mm]",
    "Angle φ  [°]",
    "Distance to singularity  [°]",
    "Loop timing  [µs]",
}
WITHIN = 60.0
INSTALL = "make ci-packages installs it on Debian"
needs_vulkan = pytest.mark.skipif(
    not list(Path("/usr/share/vulkan/icd.d").glob("lvp_icd*.json")),
    reason=f"no software Vulkan driver (mesa-vulkan-drivers): {INSTALL}",
)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of ten seconds of motion."""
    path = tmp_path_factory.mktemp("recording") / "made.rrd"
    recorder = Recorder(load(SIM), path.parent, path=path, live=False)
    recorder.bus_load(0.75)
    recorder.update_state(ReadoutState("g-1", (0.05, 0.02, 0.3)))
    records = made.records(10.0)
    for start in range(0, len(records), 50):
        recorder.records(records[start : start + 50].tobytes())
    recorder.close()
    return path


def colours(picture: Image.Image) -> int:
    """Return how many colours cover at least a few pixels: a blank picture has a handful."""
    _, counts = np.unique(np.asarray(picture.convert("RGB")).reshape(-1, 3), axis=0, return_counts=True)
    return int(np.count_nonzero(counts > 20))


def near(picture: Image.Image, colour: tuple[int, ...]) -> int:
    """Return how many pixels are of about a colour."""
    return int(np.count_nonzero(np.abs(np.asarray(picture.convert("RGB")).astype(int) - colour[:3]).max(axis=2) < 24))


@pytest.mark.viewer
@needs_vulkan
def test_the_viewer_shows_every_view_without_complaint(recording: Path, tmp_path: Path) -> None:
    from trirail.telemetry import palette

    with screenshot.viewer(recording, 1280, 800) as client:
        views = {shown.name: shown for shown in client.get_state().views}
        picture = screenshot.picture(client)
    assert views.keys() >= VIEWS
    assert [report for name in VIEWS for report in views[name].reports] == []
    assert colours(picture) > 40
    for colour in (*palette.SLIDERS, palette.PLATFORM, palette.X, palette.SINGULARITY):
        assert near(picture, colour) > 50, colour


@contextmanager
def trirail_view(*arguments: object) -> Iterator[str]:
    """Run `trirail view --web`, yield the page's address, and see that it ends well."""
    command = [sys.executable, "-m", "trirail", "view", "--web", "--json", *map(str, arguments)]
    environment = {name: value for name, value in os.environ.items() if name not in ("DISPLAY", "WAYLAND_DISPLAY")}
    with subprocess.Popen(command, stdout=subprocess.PIPE, env=environment) as process:
        assert process.stdout is not None
        try:
            yield msgspec.json.decode(process.stdout.readline())["url"]
        finally:
            process.send_signal(signal.SIGTERM)
            code = process.wait(WITHIN)
    assert code == 0


@pytest.mark.viewer
@needs_chromium
def test_the_browser_shows_a_recording(recording: Path, tmp_path: Path) -> None:
    from trirail.telemetry import palette

    with trirail_view(recording) as url, chromium("chromium", tmp_path) as page:
        page.open(f"{url}&renderer=webgl")
        found = lambda: all(near(page.picture(), colour) > 50 for colour in palette.SLIDERS)  # noqa: E731
        wait_until(found, "the sliders' colours", within=4 * WITHIN)  # drawn without a graphics card
        assert colours(page.picture()) > 40


@pytest.mark.parametrize("state", ["whole", "cut", "growing"])
def test_a_viewer_is_given_only_complete_messages_of_a_file(recording: Path, tmp_path: Path, state: str) -> None:
    """It shows nothing of a file that was cut off within a message, as by a power cut or while it is being written."""
    file = tmp_path / "demo.rrd"
    file.write_bytes(recording.read_bytes()[: -7000 if state == "cut" else None])
    lock = retention.lock(file) if state == "growing" else -1
    with view._source(file, [], "", None, records=False) as (source, _):
        retention.unlock(lock)
        assert (source == str(file)) is (state == "whole")
        assert Path(source).stat().st_size == reading._complete_length(Path(source)) > 100_000
    assert Path(source).exists() is (state == "whole")


def test_what_serves_the_browser_listens_on_the_loopback_alone(recording: Path) -> None:
    with trirail_view(recording) as url:
        ports = [int(found) for found in re.findall(r"(?::|%3A)(\d+)", url)]
        assert len(ports) == 2
        listening = Path("/proc/net/tcp").read_text() + Path("/proc/net/tcp6").read_text()
        for port in ports:
            addresses = re.findall(rf"^\s*\d+: ([0-9A-F]+):{port:04X} \S+ 0A ", listening, re.MULTILINE)
            assert addresses == ["0100007F"]


@pytest.mark.parametrize(
    ("locator", "local"),
    [
        ("tcp/127.0.0.1:7447", True),
        ("tcp/127.8.0.1:7447", True),
        ("tls/localhost:7447", True),
        ("tcp/[::1]:7447#iface=lo", True),
        ("unixsock-stream//run/trirail/zenoh", True),
        ("tcp/192.168.1.7:7447", False),
        ("quic/robot.example:7447", False),
        ("tcp/[2001:db8::1]:7447", False),
    ],
)
def test_which_locators_stay_on_this_machine(locator: str, local: bool) -> None:
    assert is_local(locator) is local


def test_a_frozen_viewer_is_skipped_counted_and_does_not_stop_the_file(tmp_path: Path) -> None:
    """The server holds its sender up when a viewer takes nothing more, after some 400 MB: here from the beginning."""
    config = load(SIM)
    config = msgspec.structs.replace(config, telemetry=msgspec.structs.replace(config.telemetry, live_port=free_port()))
    recorder = Recorder(config, tmp_path)
    relay, thawed = recorder._live, threading.Event()
    assert relay is not None

    def hold(_chunks: list[Chunk]) -> None:
        thawed.wait()

    relay._deliver = hold
    records = made.records(20.0)
    try:
        with socket.create_connection(("127.0.0.1", config.telemetry.live_port)):
            for start in range(0, len(records), 20):
                recorder.records(records[start : start + 20].tobytes())
        skipped = recorder.skipped
        assert skipped > 0
    finally:
        thawed.set()
        recorder.close()
    chunks = list(RrdReader(recorder.path).stream())
    assert sum(chunk.num_rows for chunk in chunks if chunk.entity_path == "/record") == len(records)
    assert recorder.lost == 0
    said = [chunk.to_record_batch() for chunk in chunks if chunk.entity_path == "/events"]
    texts = [text for batch in said for (text,) in batch.column("TextLog:text").to_pylist()]
    assert any(f"0 batches in the file, {skipped} in the live view" in text for text in texts), texts


def test_reruns_programs_are_told_to_send_no_analytics() -> None:
    with view._settings() as environment:
        asked = [sys.executable, "-m", "rerun_cli", "analytics", "config"]
        told = subprocess.run(asked, env=environment, capture_output=True, check=True)
        assert msgspec.json.decode(told.stdout)["analytics_enabled"] is False


@pytest.mark.parametrize(("machine", "remote"), [("another", True), (operating_system.machine(), False), ("", False)])
def test_through_a_tunnel_the_view_is_that_of_the_service_s_machine(
    machine: str, remote: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another robot's live view may be served on this machine at the same address."""

    @contextmanager
    def service(*_: Any, **__: Any) -> Iterator[Any]:
        yield SimpleNamespace(info=lambda: msgspec.structs.replace(info(load(SIM)), machine=machine, live=live))

    @contextmanager
    def drawn_here(*_: Any) -> Iterator[Any]:
        yield SimpleNamespace(url="drawn here", ended=threading.Event(), robots=[SimpleNamespace(restarted=False)])

    monkeypatch.setattr(view, "Robot", service)
    monkeypatch.setattr(view, "credentials_for", lambda *_: None)
    monkeypatch.setattr(remote_view, "RemoteView", drawn_here)
    with socket.create_server(("127.0.0.1", 0)) as server:
        live = f"rerun+http://127.0.0.1:{server.getsockname()[1]}/proxy"
        with view._source(None, ["demo"], "tcp/127.0.0.1:7447", None, records=False) as (source, _):
            assert source == ("drawn here" if remote else live)


@pytest.mark.parametrize("names", [["demo"], ["left", "right"]])
def test_a_view_from_records_ends_with_words_when_a_service_is_restarted(
    names: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its times begin again, which the viewer would show before all that it has, with another robot perhaps."""
    queues: list[Any] = []

    def publish(cycle: int) -> None:
        records = made.records(0.5)
        records["cycle"] += cycle
        queues[-1].put(records.tobytes())

    def subscribe(robot: Any, _name: str) -> None:
        queues.append(robot._queue)
        publish(3_600_000)

    @contextmanager
    def viewer(*_: str) -> Iterator[Any]:
        publish(3_600_500)
        publish(0)
        yield SimpleNamespace(poll=lambda: None, wait=lambda: 0)  # the person does not close it

    @contextmanager
    def service(name: str, *_: Any, **__: Any) -> Iterator[Any]:
        yield SimpleNamespace(info=lambda: msgspec.structs.replace(info(load(SIM)), robot=name))

    session = SimpleNamespace(close=lambda: None)
    monkeypatch.setattr(zenoh_session, "open_client", lambda *_: session)
    monkeypatch.setattr(remote_view.RemoteRobot, "_subscribe", subscribe)
    for name, instead in (("Robot", service), ("_rerun", viewer), ("has_display", lambda: True)):
        monkeypatch.setattr(view, name, instead)
    monkeypatch.setattr(view, "credentials_for", lambda *_: None)
    handler = signal.getsignal(signal.SIGTERM)
    try:
        with pytest.raises(ServiceError, match=f"service of {names[-1]} was restarted.* run trirail view again"):
            view.run(None, names, "tcp/127.0.0.1:1", None, web=False, records=True, say=lambda *_: None)
    finally:
        signal.signal(signal.SIGTERM, handler)
