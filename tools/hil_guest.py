"""What tools/hil.py runs inside the machine: the service on can0, drives on can1, goals from a client.

python tools/hil_guest.py FOLDER    as root; FOLDER has robot.toml, and takes logs and result.json
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import hil_scenario
from hil_programs import Failed, Machine
from trirail.config import load
from trirail.errors import TrirailError


def main() -> int:
    """Run the scenario; leave logs and result.json."""
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
    except (Failed, TrirailError, TimeoutError, OSError, subprocess.SubprocessError) as error:
        result["failure"] = f"{type(error).__name__}: {error}"
    finally:
        for log in (frames, *(memory / "recordings").glob("*.log")):
            if log.exists():
                shutil.copy(log, folder / ("bus.log" if log == frames else "service-frames.log"))
        (folder / "result.json").write_text(json.dumps(result))
    return 0 if result["failure"] is None else 1


if __name__ == "__main__":
    sys.exit(main())
