"""Robot on a CAN FD bus in the emulated machine: service, drives and log of frames on a virtual CAN interface.

python tools/hil_fd.py drives CONFIG CHANNEL    simulated drives on a SocketCAN interface, until SIGTERM
python tools/hil_fd.py guest FOLDER             in the machine; FOLDER has fd.toml, and receives logs and fd.json

Every frame must be a CAN FD frame with bit rate switch, and every setpoint must be correct. The robot has the low rate
of the first robot: at 2 kHz, the emulated processor needs 4 to 17 ms for a cycle of 0.5 ms. Therefore
tests/processes/test_fd_service.py runs at 2 kHz without emulation, on the simulated bus.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import signal
import socket
import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from hil_programs import STEP_TIMEOUT_S, Failed, Machine, changed, wait_until

if TYPE_CHECKING:
    from trirail.client.client import Robot
    from trirail.config import Config

CHANNEL = "vcan1"
CHANGES = {
    'name = "robot"': 'name = "fd"',
    'channel = "can0"': f'channel = "{CHANNEL}"\nfd = true',
    "capture_can = true": "capture_can = false",  # a capture passes each frame through Python
    "/zenoh": "/zenoh-fd",
    "/recordings": "/recordings-fd",
}
"""Differences between the configurations of this robot and of the first robot."""
LOG = "fd-bus.log"
LINE = re.compile(r"\((?P<t>[\d.]+)\) \w+ (?P<identifier>[0-9A-F]+)#(?P<fd>#(?P<flags>[0-9A-F]))?(?P<data>[0-9A-FR]*)")
"""Line of candump's log; the flags are those of `struct canfd_frame`."""
BIT_RATE_SWITCH = 1
HELD = "every frame is a CAN FD frame with bit rate switch, and every setpoint is correct"


def configure(first: str) -> str:
    """Return the configuration of this robot, given that of the first robot. Raises Failed."""
    return changed(first, CHANGES)


def format_problems(log: Path, until: float) -> Iterator[str]:
    """Yield an error for each identifier with frames before `until` that are not CAN FD frames with bit rate switch."""
    wrong: Counter[str] = Counter()
    number = 0
    for line in log.read_text().splitlines():
        frame = LINE.fullmatch(line.rpartition(" ")[0] if line[-1] in "RT" and line[-2] == " " else line)
        if frame is None:
            yield f"{line!r} is no line of candump's log"
            return
        if float(frame["t"]) < until:
            number += 1
            wrong[frame["identifier"]] += not (frame["fd"] and int(frame["flags"], 16) & BIT_RATE_SWITCH)
    if not number:
        yield "there are no frames"
    for identifier, count in wrong.items():
        if count:
            yield f"identifier {identifier}: {count} frames are not CAN FD frames with bit rate switch"


def check(folder: Path, config: Config) -> dict[str, Any]:
    """Check the result of the machine and the log of the frames; return statistics. Raises Failed."""
    import bus_log

    try:
        result: dict[str, Any] = json.loads((folder / "fd.json").read_text())
    except FileNotFoundError:
        raise Failed("the machine ended without a result of the CAN FD robot") from None
    if result["failure"]:
        raise Failed(f"CAN FD: {result['failure']}")
    until, frames = result["cut"], bus_log.read(folder / LOG)
    problems = [*format_problems(folder / LOG, until)]
    problems += bus_log.problems(frames, config, result["loop"]["overruns"], until)
    if problems:
        raise Failed("CAN FD frames are wrong:\n  " + "\n  ".join(problems[:10]) + f"\nsee {folder}/{LOG}")
    return bus_log.statistics(frames, config, until) | {"loop": result["loop"]}


def drives(config: Path, channel: str) -> None:
    """Simulate the drives of a configuration on a SocketCAN interface, until SIGTERM."""
    from trirail.config import load
    from trirail_drivers.connection.serving import exchange

    loaded = load(config)
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as carrier:
        carrier.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FD_FRAMES, 1)
        carrier.bind((channel,))
        # The same words as those of tools/virtual_drives.py, which Machine.await_drives expects.
        exchange(carrier, loaded.can, loaded.drives, lambda: print("A, B, C on", channel, flush=True))


def _connected(config: Config) -> Robot:
    """Connect to the service, which may be too busy to answer at first. Raises Failed."""
    from trirail.client.client import Robot
    from trirail.errors import ServiceError

    robots: list[Robot] = []

    def connect() -> bool:
        with contextlib.suppress(ServiceError):
            robots.append(Robot(config.robot.name, config.zenoh.listen[0]))
        return bool(robots)

    wait_until(connect, "the service answers")
    return robots[0]


def guest(folder: Path) -> int:
    """Run the robot in the machine; write the log and fd.json; return the exit code."""
    memory, began = Path(os.environ["TMPDIR"]), time.monotonic()
    result: dict[str, Any] = {"failure": None}

    def held(check: str, detail: str) -> None:
        print(f"fd {time.monotonic() - began:5.0f} s  {check}: {detail}", flush=True)

    try:
        with Machine(folder, memory) as machine:
            machine.candump(CHANNEL, LOG)
            program = machine.start(
                "fd-drives", sys.executable, "tools/hil_fd.py", "drives", folder / "fd.toml", CHANNEL
            )
            service = machine.begin_service("fd.toml", "fd-service")
            import hil_scenario
            from trirail.config import load

            config = load(folder / "fd.toml")
            machine.await_drives(program, "fd-drives")
            machine.await_service(service, "fd-service")
            held("service", f"up on {CHANNEL}, CAN FD")
            with contextlib.ExitStack() as stack:
                robot = stack.enter_context(_connected(config))
                hil_scenario.recover(robot)
                held("enable", "confirmed, the robot holds")
                moved = robot.move_to(x=0.01, y=-0.005, phi=0.05).wait(STEP_TIMEOUT_S)
                hil_scenario.expect(moved, "done", robot)
                held("goal", moved.message)
                robot.disable()
                result["loop"] = hil_scenario.loop_of(robot.state())
                result["cut"] = time.time()
                held("loop", json.dumps(result["loop"]))
            machine.end(service, "the service")
    except Exception as error:  # noqa: BLE001 - the host reports any error
        result["failure"] = f"{type(error).__name__}: {error}"
        held("failure", result["failure"])
    finally:
        if (memory / LOG).exists():
            shutil.copy(memory / LOG, folder / LOG)
        (folder / "fd.json").write_text(json.dumps(result))
    return 0 if result["failure"] is None else 1


def _terminate(_signal: int, _frame: FrameType | None) -> None:
    raise SystemExit(0)


def main() -> int:
    """Run the drives or the guest; return the exit code."""
    signal.signal(signal.SIGTERM, _terminate)
    match sys.argv[1:]:
        case ["drives", config, channel]:
            with contextlib.suppress(KeyboardInterrupt):
                drives(Path(config), channel)
            return 0
        case ["guest", folder]:
            return guest(Path(folder))
    print(__doc__, file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main())
