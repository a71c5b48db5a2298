"""What the recorder keeps in memory has a bound: the live view's past, however long the robot moves."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

MINUTES = 4
FEED = """
import sys
from pathlib import Path
import made, msgspec, numpy as np
from ports import free_port
from trirail.config import SIM, load
from trirail.telemetry.recorder import Recorder

def taken():
    (line,) = (line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("RssAnon"))
    return int(line.split()[1]) / 1e3

config = load(SIM)
telemetry = msgspec.structs.replace(config.telemetry, live_port=free_port(), live_mb=float(sys.argv[2]))
recorder = Recorder(msgspec.structs.replace(config, telemetry=telemetry), Path(sys.argv[1]))
records = made.records(60.0)
noise = np.random.default_rng(0)
for minute in range(1 + int(sys.argv[3])):
    for start in range(0, len(records), 200):
        some = records[start : start + 200].copy()
        some["cycle"] += minute * len(records)
        some["position"] += noise.normal(size=some["position"].shape)
        recorder.records(some.tobytes())
        recorder.save()
    print(taken(), flush=True)
"""


@pytest.mark.slow
def test_the_live_views_past_is_bounded(tmp_path: Path) -> None:
    command = [sys.executable, "-c", FEED, str(tmp_path), "4", str(MINUTES)]
    fed = subprocess.run(
        command, cwd=Path(__file__).parents[1], capture_output=True, text=True, timeout=500, check=True
    )
    first, *_, last = map(float, fed.stdout.split())
    assert (last - first) / MINUTES < 5.0  # MB a minute; the index of the file takes 2.4, until that is rotated
