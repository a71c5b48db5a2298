"""Program that tools/hil.py runs inside the emulated machine: a service on can0, its drives on can1, and a client.

python tools/hil_guest.py FOLDER    as root; FOLDER has robot.toml and second.toml, and receives logs and result.json

After this robot, the program runs a second robot.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hil_programs import Machine

LOGS = {"bus.log": "bus.log", "second-bus.log": "second-bus.log", "recordings/*.log": "service-frames.log"}
"""Files in memory that are copied to the host, and their names on the host."""

CARDS = ("can0", "can1")


def main() -> int:
    """Run both robots; write the logs and result.json; return the exit code."""
    folder, began = Path(sys.argv[1]), time.monotonic()
    # The folder is on the host, and writing to it is slow. Files that are written in motion are first stored in memory.
    memory = Path(os.environ["TMPDIR"])
    result: dict[str, Any] = {"checks": {}, "failure": None, "loops": {}}

    def held(check: str, detail: str) -> None:
        result["checks"][check] = detail
        print(f"guest {time.monotonic() - began:5.0f} s  {check}: {detail}", flush=True)

    try:
        with Machine(folder, memory) as machine:
            _run(machine, folder, held, result)
    except Exception as error:  # noqa: BLE001 - the host reports any error
        result["failure"] = f"{type(error).__name__}: {error}"
    finally:
        result["lost"] = {card: _lost(card) for card in CARDS}
        for pattern, name in LOGS.items():
            for log in memory.glob(pattern):
                shutil.copy(log, folder / name)
        (folder / "result.json").write_text(json.dumps(result))
    return 0 if result["failure"] is None else 1


def _run(machine: Machine, folder: Path, held: Callable[[str, str], None], result: dict[str, Any]) -> None:
    prepared = _compiled()
    # All programs start slowly on this machine. They start first, in parallel with this program's own imports.
    drives = machine.begin_drives("robot.toml", "can1")
    doctor = machine.doctor()
    machine.candump("can1", "bus.log")
    import hil_scenario
    import hil_second
    from trirail.config import load

    machine.await_drives(drives)
    held("drives", "three virtual drives on can1")
    service = machine.begin_service("robot.toml")
    held("doctor", doctor())
    machine.await_service(service)
    hil_scenario.disturbed(machine, load(folder / "robot.toml"), held, result)
    # The second service starts while the first service writes its black boxes.
    service.send_signal(signal.SIGTERM)
    second, drives = hil_second.begin(machine)
    machine.await_end(service, "the service", code=1)
    held("end", "exit code 1 after SIGTERM: its interface is down, and nobody knows whether the drives have power")
    hil_second.run(machine, second, drives, load(folder / "second.toml"), held, result)
    here = sorted(_compiled() - prepared)
    held("compiled code", f"{len(prepared)} functions from outside, {len(here)} compiled here: {', '.join(here)}")


def _lost(card: str) -> int:
    """Return the number of frames for which a card had no room (linux/if_link.h, rx_over_errors)."""
    return int(Path(f"/sys/class/net/{card}/statistics/rx_over_errors").read_text())


def _compiled() -> set[str]:
    """Return the names of the functions in numba's cache."""
    return {path.name for path in Path(os.environ["NUMBA_CACHE_DIR"]).glob("*/*.nbc")}


if __name__ == "__main__":
    sys.exit(main())
