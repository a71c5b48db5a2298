"""A service on a CAN FD bus at 2 kHz, which no classical bus of 1 Mbit/s carries."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from trirail.analysis.replay import replay_session
from trirail.client import own_service
from trirail.client.client import Robot
from trirail.config import load
from trirail.diagnosis.drive_checks import bus_use
from trirail.telemetry.reading import read

pytestmark = [pytest.mark.slow, pytest.mark.alone]

POSES = ((0.03, -0.02, 0.1), (-0.02, 0.01, -0.2), (0.0, 0.0, 0.0))


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path, _ = own_service.private(tmp_path)
    text, count = re.subn(r"(?m)^rate_hz = .*$", "rate_hz = 2000", path.read_text(encoding="utf-8"))
    text, sections = re.subn(r"(?m)^\[can\]$", "[can]\nfd = true", text)
    assert (count, sections) == (1, 1)
    path.write_text(text, encoding="utf-8")
    return path


def test_a_robot_moves_at_2_khz(config: Path, tmp_path: Path) -> None:
    loaded = load(config)
    assert bus_use(loaded).load < 0.8
    with own_service.service(config, tmp_path / "session.rrd") as service:
        with Robot("demo", loaded.zenoh.listen[0], user="ann") as robot:
            robot.enable()
            for x, y, phi in POSES:
                assert robot.move_to(x=x, y=y, phi=phi).wait(60.0).outcome == "done"
        assert own_service.end(service) == 0
    recording = read(tmp_path / "session.rrd")
    assert np.median(np.diff(recording.records["deadline_ns"])) == 500_000
    assert recording.records["commanded_pose"][-1] == pytest.approx(POSES[-1], abs=1e-9)
    replayed = replay_session(recording, loaded, simulated=False)
    assert (replayed.differing, replayed.plans_differing, replayed.lacking) == (0, 0, 0)
