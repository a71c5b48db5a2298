"""The recorder process: access rights of its files, and saving while packets keep arriving."""

from __future__ import annotations

import os
import socket
import stat
from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest
from control_rig import CONFIG
from trirail.config import Config
from trirail.processes import recording
from trirail.processes.heartbeats import Heartbeats
from trirail.telemetry.reading import read
from trirail.wire.links import PACKETS_PER_TURN, LinkClosed, PacketLink
from trirail.wire.packets import Kind
from trirail.wire.records import DTYPE


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
    loops.close()  # the loop has gone, so it ends at once
    heart = Heartbeats.create().heart("recorder")
    with ours:
        assert recording.main(config, None, PacketLink(ours), heart, lambda _: None, lambda _: None) == 0
    (file,) = (tmp_path / "new").glob("*.rrd")
    assert stat.S_IMODE(file.stat().st_mode) == 0o640 & ~umask
    assert stat.S_IMODE((tmp_path / "new").stat().st_mode) == 0o750 & ~umask


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
