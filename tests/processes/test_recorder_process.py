"""The recorder process: access rights of its files, and saving while packets keep arriving."""

from __future__ import annotations

import contextlib
import os
import socket
import stat
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import made
import msgspec
import numpy as np
import pytest
from control_rig import CONFIG
from hypothesis import given, settings
from hypothesis import strategies as st
from trirail.analysis.summary import summarise
from trirail.config import Config
from trirail.processes import recording
from trirail.processes.heartbeats import Heartbeats
from trirail.telemetry.reading import read
from trirail.telemetry.recorder import Recorder
from trirail.wire.links import PACKETS_PER_TURN, LinkClosed, PacketLink
from trirail.wire.messages import Event
from trirail.wire.packets import EventReport, EventsWritten, Kind, decode_recorder, message
from trirail.wire.records import DTYPE, SIZE


def config_in(folder: Path) -> Config:
    telemetry = msgspec.structs.replace(CONFIG.telemetry, directory=str(folder), live_port=0)
    return msgspec.structs.replace(CONFIG, telemetry=telemetry)


@pytest.fixture(params=[0o000, 0o022, 0o077])
def umask(request: pytest.FixtureRequest) -> Iterator[int]:
    before = os.umask(request.param)
    yield request.param
    os.umask(before)


def test_a_recording_and_its_folder_are_not_for_others(umask: int, tmp_path: Path) -> None:
    config = config_in(tmp_path / "new")
    ours, loops = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    loops.send(bytes((Kind.RECORDS,)) + bytes(SIZE))
    loops.close()  # the loop has gone, so it ends at once
    heart = Heartbeats.create().heart("recorder")
    with ours:
        assert recording.main(config, None, PacketLink(ours), heart, lambda _: None, lambda _: None) == 0
    modes = [stat.S_IMODE(file.stat().st_mode) for file in (tmp_path / "new").glob("*.rrd")]
    assert modes == [0o640 & ~umask] * 2, "the recording, and the black box of the loop's death"
    assert stat.S_IMODE((tmp_path / "new").stat().st_mode) == 0o750 & ~umask


def test_the_last_packets_of_a_loop_that_has_left_a_packet_unread_are_recorded(tmp_path: Path) -> None:
    """The kernel reports the unread packet as an error, before it delivers what the loop has sent."""
    ours, loops = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    records = made.records(0.1)
    loops.send(bytes((Kind.RECORDS,)) + records.tobytes())
    ours.send(b"a notice")
    loops.close()
    heart = Heartbeats.create().heart("recorder")
    with ours:
        recording.main(config_in(tmp_path), None, PacketLink(ours), heart, lambda _: None, lambda _: None, lambda: 99)
    (file,) = tmp_path.glob("*.rrd")
    assert len(read(file).records) == len(records)


def event(seq: int) -> bytes:
    return message(EventReport(Event("service", "info", "output switched", seq=seq, t=0.0, cycle=0, time=0.0)))


def test_the_loop_is_told_which_events_are_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ours, loops = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, loops:
        intake = recording.Intake(config_in(tmp_path), None, PacketLink(ours), lambda _: None)

        def written() -> list[int]:
            intake.save()
            told = []
            with contextlib.suppress(BlockingIOError):
                while isinstance(said := decode_recorder(loops.recv(1000, socket.MSG_DONTWAIT)[1:]), EventsWritten):
                    told.append(said.newest)
            return told

        assert written() == []
        for seq in (1, 2):
            intake.on_packet(event(seq))
        assert written() == [2]
        assert written() == []
        with monkeypatch.context() as full:
            full.setattr(intake.recorder, "_write", lambda _: False)
            intake.on_packet(event(3))
            assert written() == []
        intake.on_packet(event(4))
        assert written() == [4]
        intake.close()


class BusyLink(PacketLink):
    """A link on which another packet is always waiting, until 1000 packets have been received."""

    taken = 0

    def receive(self) -> bytes:
        self.taken += 1
        if self.taken > 1000:
            raise LinkClosed
        record = np.zeros(1, DTYPE)
        record["cycle"] = self.taken
        return bytes([Kind.RECORDS]) + record.tobytes()


def test_the_recorder_saves_while_packets_keep_arriving(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Data that is not saved is lost if the process is killed, and a failing disk is reported when data is saved."""
    ours, loops = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    saved_at: list[int] = []
    pauses: list[float] = []
    with ours, loops:
        link = BusyLink(ours)
        loops.send(b"more")
        monkeypatch.setattr(recording.Intake, "save", lambda _intake: saved_at.append(link.taken))
        monkeypatch.setattr("trirail.processes.recording.time.sleep", pauses.append)
        heart = Heartbeats.create().heart("recorder")
        assert recording.main(config_in(tmp_path), None, link, heart, lambda _: None, lambda _: None) == 0
    assert len(pauses) == 1  # the pause in which packets accumulate: none while packets are waiting
    (file,) = tmp_path.glob("demo-*.rrd")
    assert read(file).records["cycle"].tolist() == [*range(1, 1001)]
    assert np.diff([0, *saved_at, 1000]).max() <= PACKETS_PER_TURN


@given(st.integers(1, 100), st.integers(0, 5000))
@settings(max_examples=10)
def test_the_last_cycles_that_a_slow_recorder_misses_are_no_fault_but_missing(received: int, missing: int) -> None:
    """The end itself needs no space at the recorder's socket."""
    ours, loops = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with TemporaryDirectory() as folder, ours, loops:
        loops.send(bytes([Kind.RECORDS]) + made.records(3.0)[1 : 1 + received].tobytes())
        loops.close()
        heartbeats = Heartbeats.create()
        heartbeats.record_end(received + missing)
        given = PacketLink(ours), heartbeats.heart("recorder"), lambda _: None, lambda _: None, heartbeats.last_cycle
        assert recording.main(config_in(Path(folder)), None, *given) == 0
        (file,) = Path(folder).glob("*.rrd")  # no black box
        summed = summarise(read(file))
    assert (summed.cycles, summed.lacking, summed.faults) == (received, missing, [])
    words = f"missing data: the last {missing} cycles (recorder too slow)"
    assert [each.message for each in summed.warnings] == ([words] if missing else [])


def test_a_black_box_has_the_times_of_the_moment_though_the_clock_was_set(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent, start = made.records(3.0), 1_795_245_300_000_000_000
    clocks = {"monotonic": made.MONOTONIC_NS, "offset": start - made.MONOTONIC_NS}

    def recorder(*given: Any, **more: Any) -> Recorder:
        wall_ns, monotonic_ns = lambda: sum(clocks.values()), lambda: clocks["monotonic"]
        return Recorder(*given, **more, wall_ns=wall_ns, monotonic_ns=monotonic_ns)

    monkeypatch.setattr(recording, "Recorder", recorder)
    ours, loops = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, loops:
        intake = recording.Intake(config_in(tmp_path), None, PacketLink(ours), lambda _: None)
        for first in range(0, len(sent), 100):
            batch = sent[first : first + 100]
            clocks["monotonic"] = int(batch["deadline_ns"][-1])
            if first == 500:
                clocks["offset"] += 3_600_000_000_000
            intake.on_packet(bytes([Kind.RECORDS]) + batch.tobytes())
            if first == 700:
                wall = sum(clocks.values()) * 1e-9
                fault = Event("fault", "error", "drive B: silent", seq=1, t=0.8, cycle=800, time=wall)
                intake.on_packet(message(EventReport(fault)))
        intake.close()
    kept, box = (read(next(tmp_path.glob(f"{name}-*.rrd"))) for name in ("demo", "fault"))
    expected = start + np.arange(3000) * 1_000_000 + np.where(np.arange(3000) >= 500, 3_600_000_000_000, 0)
    for found in (kept, box):
        assert np.array_equal(found.wall.astype(np.int64), expected[found.records["cycle"]])
    assert set(range(1000)) <= set(box.records["cycle"].tolist())
