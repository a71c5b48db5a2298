"""What tools/hil.py runs inside the machine: the service on can0, drives on can1, goals from a client.

python tools/hil_guest.py FOLDER    as root; FOLDER has robot.toml and homing.toml, and takes logs and result.json
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import hil_scenario
from hil_programs import Failed, Machine
from trirail.config import load
from trirail.errors import TrirailError


def main() -> int:
    """Run the scenarios; leave logs and result.json."""
    folder, began = Path(sys.argv[1]), time.monotonic()
    # The folder is on the host and slow to write: the frames go to memory first.
    memory = Path(os.environ["TMPDIR"])
    frames = memory / "bus.log"
    result: dict[str, Any] = {"checks": {}, "failure": None, "loops": {}}

    def held(check: str, detail: str) -> None:
        result["checks"][check] = detail
        print(f"guest {time.monotonic() - began:5.0f} s  {check}: {detail}", flush=True)

    try:
        with Machine(folder, frames) as machine:
            held("doctor", machine.doctor())
            machine.candump()
            hil_scenario.disturbed(machine, load(folder / "robot.toml"), held, result)
            hil_scenario.homed(machine, load(folder / "homing.toml"), held, result)
    except (Failed, TrirailError, TimeoutError, OSError, subprocess.SubprocessError) as error:
        result["failure"] = f"{type(error).__name__}: {error}"
    finally:
        for log, name in ((frames, "bus.log"), *_captured(memory / "recordings")):
            if log.exists():
                shutil.copy(log, folder / name)
        (folder / "result.json").write_text(json.dumps(result))
    return 0 if result["failure"] is None else 1


def _captured(recordings: Path) -> Iterator[tuple[Path, str]]:
    """Yield the log of frames that the service of the first scenario has captured, the oldest one."""
    logs = sorted(recordings.glob("*.log"), key=lambda log: log.stat().st_mtime)
    yield from ((log, "service-frames.log") for log in logs[:1])


if __name__ == "__main__":
    sys.exit(main())
