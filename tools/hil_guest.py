"""What tools/hil.py runs inside the machine: a service on can0, its drives on can1, a client; then a second robot.

python tools/hil_guest.py FOLDER    as root; FOLDER has robot.toml and second.toml, and takes logs and result.json
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
"""What is brought out of memory: what the host has it by."""

CARDS = ("can0", "can1")


def main() -> int:
    """Run both robots; leave logs and result.json."""
    folder, began = Path(sys.argv[1]), time.monotonic()
    # The folder is on the host and slow to write: what is written in motion goes to memory first.
    memory = Path(os.environ["TMPDIR"])
    result: dict[str, Any] = {"checks": {}, "failure": None, "loops": {}}

    def held(check: str, detail: str) -> None:
        result["checks"][check] = detail
        print(f"guest {time.monotonic() - began:5.0f} s  {check}: {detail}", flush=True)

    try:
        with Machine(folder, memory) as machine:
            _run(machine, folder, held, result)
    except Exception as error:  # noqa: BLE001 - whatever it is, the host is to tell it
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
    # What takes this slow machine long begins at once, beside this program's own imports.
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
    # The first service writes its black boxes; the second one starts beside it.
    service.send_signal(signal.SIGTERM)
    second = hil_second.begin(machine)
    machine.await_end(service, "the service")
    held("end", "exit code 0 after SIGTERM")
    hil_second.run(machine, second, load(folder / "second.toml"), held, result)
    here = sorted(_compiled() - prepared)
    held("compiled code", f"{len(prepared)} functions from outside, {len(here)} compiled here: {', '.join(here)}")


def _lost(card: str) -> int:
    """How often a card had no room for a frame that came: linux/if_link.h, rx_over_errors."""
    return int(Path(f"/sys/class/net/{card}/statistics/rx_over_errors").read_text())


def _compiled() -> set[str]:
    """The names of what numba keeps."""
    return {path.name for path in Path(os.environ["NUMBA_CACHE_DIR"]).glob("*/*.nbc")}


if __name__ == "__main__":
    sys.exit(main())
