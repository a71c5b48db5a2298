"""What is recorded is for its owner and the group, whatever umask the service was started with."""

from __future__ import annotations

import os
import socket
import stat
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest
from control_rig import CONFIG
from trirail.processes import recording
from trirail.processes.heartbeats import Heartbeats
from trirail.wire.links import PacketLink


@pytest.fixture(params=[0o000, 0o022, 0o077])
def umask(request: pytest.FixtureRequest) -> Iterator[int]:
    before = os.umask(request.param)
    yield request.param
    os.umask(before)


def test_a_recording_and_its_folder_are_not_for_others(umask: int, tmp_path: Path) -> None:
    telemetry = msgspec.structs.replace(CONFIG.telemetry, directory=str(tmp_path / "new"), live_port=0)
    config = msgspec.structs.replace(CONFIG, telemetry=telemetry)
    ours, loops = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    loops.close()  # the loop has gone, so it ends at once
    heart = Heartbeats.create().heart("recorder")
    with ours:
        assert recording.main(config, None, PacketLink(ours), heart, lambda _: None, lambda _: None) == 0
    (file,) = (tmp_path / "new").glob("*.rrd")
    assert stat.S_IMODE(file.stat().st_mode) == 0o640 & ~umask
    assert stat.S_IMODE((tmp_path / "new").stat().st_mode) == 0o750 & ~umask
