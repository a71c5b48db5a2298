"""What tools/hil.py runs inside the machine: the service on can0, virtual drives on can1, goals from a client.

python tools/hil_guest.py FOLDER        as root; FOLDER has robot.toml and takes the logs and result.json
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from trirail.client.client import Result, Robot
from trirail.config import Config, load
from trirail.errors import RefusedError, TrirailError
from trirail.wire.state import State

ROOT = Path(__file__).parents[1]
WITHIN = 300.0
"""How long anything may take in this slow machine [s]; the whole run has a time limit of its own, outside."""
BUFFER = 8_000_000
"""Of candump's socket [bytes]: it shall see every frame, however busy the machine is."""
PATIENT = (
    "from trirail.cli import commands; from trirail.processes import supervisor; "
    f"supervisor.START_WITHIN = {WITHIN}; commands.main()"
)
"""`trirail`, with more patience: the interpreters alone take a minute to start here."""


class Failed(Exception):
    """Something is not as it has to be."""


def main() -> int:
    """Run the scenario; leave logs and result.json."""
    folder = Path(sys.argv[1])
    config = load(folder / "robot.toml")
    # The folder is on the host and slow to write: the frames go to memory first.
    frames = Path(os.environ["TMPDIR"]) / "bus.log"
    result: dict[str, Any] = {"checks": {}, "failure": None}
    try:
        with Machine(folder, config, frames) as machine:
            try:
                scenario(machine, result["checks"])
            finally:
                result |= machine.told
    except (Failed, TrirailError, TimeoutError, OSError, subprocess.SubprocessError) as error:
        result["failure"] = f"{type(error).__name__}: {error}"
    finally:
        for log in (frames, *Path(os.environ["TMPDIR"]).glob("recordings/*.log")):
            if log.exists():
                shutil.copy(log, folder / ("bus.log" if log == frames else "service-frames.log"))
        (folder / "result.json").write_text(json.dumps(result))
    return 0 if result["failure"] is None else 1


class Machine:
    """The programs under test in this machine, each with its log in `folder`; all ended when the context is left."""

    def __init__(self, folder: Path, config: Config, frames: Path) -> None:
        self.config = config
        self.told: dict[str, Any] = {}
        self._folder = folder
        self._frames = frames
        self._processes: list[subprocess.Popen[bytes]] = []

    def __enter__(self) -> Machine:
        return self

    def __exit__(self, *_: object) -> None:
        for process in reversed(self._processes):
            if process.poll() is None:
                process.terminate()
        for process in self._processes:
            try:
                process.wait(WITHIN)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

    def start(self, name: str, *command: object, **environment: str) -> subprocess.Popen[bytes]:
        """Start a program with its output in NAME.log."""
        with (self._folder / f"{name}.log").open("wb") as log:
            process = subprocess.Popen(
                [str(part) for part in command],
                stdout=log,
                stderr=subprocess.STDOUT,
                cwd=ROOT,
                env=os.environ | environment,
            )
        self._processes.append(process)
        return process

    def log(self, name: str) -> str:
        """What a program has said so far."""
        return (self._folder / f"{name}.log").read_text(errors="replace")

    def doctor(self) -> str:
        """What `trirail doctor` says of can0. Raises Failed unless all of it is well."""
        command = (sys.executable, "-P", "-m", "trirail", "doctor", self._folder / "robot.toml", "--json")
        said = subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, check=False)
        can0 = [check for check in json.loads(said.stdout)["checks"] if check["name"].startswith("can0")]
        if len(can0) != 3 or any(check["verdict"] != "ok" for check in can0):
            raise Failed(f"the doctor says of can0: {can0}")
        return ", ".join(f"{check['name']} {check['found']}" for check in can0)

    def drives(self) -> None:
        """Start the frames' log and the drives on can1."""
        with self._frames.open("wb") as log:
            command = ("candump", "-L", "-r", str(BUFFER), "can1")
            self._processes.append(subprocess.Popen(command, stdout=log))
        # Real drives do not share a processor with a desktop: these get theirs before everything but the loop.
        process = self.start(
            "drives",
            *("chrt", "--fifo", "50", sys.executable, "tools/virtual_drives.py", self._folder / "robot.toml"),
            *("--interface", "socketcan", "--channel", "can1"),
        )
        until(lambda: "C " in self.log("drives"), "the virtual drives are there", process)

    def service(self) -> subprocess.Popen[bytes]:
        """Start the service; wait until it tells systemd, whose place is taken here, that it is up."""
        address = f"{os.environ['TMPDIR']}/notify"
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
            systemd.bind(address)
            systemd.settimeout(1.0)
            process = self.start(
                "service",
                *(sys.executable, "-P", "-c", PATIENT, "run", self._folder / "robot.toml"),
                NOTIFY_SOCKET=address,
            )
            until(lambda: _received(systemd) == "READY=1", "the service is up", process)
        return process


def _received(receiver: socket.socket) -> str:
    try:
        return receiver.recv(100).decode()
    except TimeoutError:
        return ""


def until(condition: Callable[[], bool], what: str, process: subprocess.Popen[bytes] | None = None) -> None:
    """Wait for something to come true. Raises Failed if it does not in time, or if the process ends instead."""
    deadline = time.monotonic() + WITHIN
    while not condition():
        if process is not None and process.poll() is not None:
            raise Failed(f"{what}: no, the process has ended with exit code {process.returncode}")
        if time.monotonic() > deadline:
            raise Failed(f"{what}: not within {WITHIN:g} s")
        time.sleep(0.1)


def until_state(robot: Robot, condition: Callable[[State], bool], what: str) -> State:
    """Return the first state for which something holds."""
    deadline = time.monotonic() + WITHIN
    for state in robot.states(timeout=WITHIN):
        if condition(state):
            return state
        if time.monotonic() > deadline:
            raise Failed(f"{what}: not within {WITHIN:g} s; {_about(state)}")
    raise Failed(f"{what}: the service has gone silent")


def _about(state: State) -> str:
    return f"mode {state.mode}, faults {state.faults}, missed ticks {state.loop.overruns}"


def scenario(machine: Machine, checks: dict[str, str]) -> None:
    """Everything in order; `checks` gets a line for each thing that held."""
    began = time.monotonic()

    def held(check: str, detail: str) -> None:
        checks[check] = detail
        print(f"guest {time.monotonic() - began:5.0f} s  {check}: {detail}", flush=True)

    held("doctor", machine.doctor())
    machine.drives()
    held("drives", "three virtual drives on can1")
    service = machine.service()
    held("service", "up on can0, its drives set up and read back by SDO")
    with Robot(machine.config.robot.name, machine.config.zenoh.listen[0]) as robot:
        robot.enable()
        held("enable", "confirmed, the robot holds")
        result = robot.move_to(x=0.01, y=-0.005, phi=0.05).wait(WITHIN)
        expect(result, "done", robot)
        held("goal", result.message)
        try:
            robot.move_to(x=0.5, y=0.0, phi=0.0)
        except RefusedError as refused:
            held("goal out of reach", str(refused))
        else:
            raise Failed("a goal 0.5 m away was accepted")
        goal = robot.move_to(x=-0.08, y=0.0, phi=0.0)
        _until_moving(robot, goal.id)
        robot.stop()
        result = goal.wait(WITHIN)
        expect(result, "stopped", robot)
        held("stop", result.message)
        robot.disable()
        held("disable", "confirmed, no drive has power")
        robot.enable()
        goal = robot.move_to(x=0.08, y=0.0, phi=0.0)
        _until_moving(robot, goal.id)
        machine.told["loop"] = _loop(robot.state())
        machine.told["cut"] = time.time()
        subprocess.run(("ip", "link", "set", "can0", "down"), check=True)
        result = goal.wait(WITHIN)
        expect(result, "faulted", robot)
        state = until_state(robot, lambda state: state.mode == "fault", "fault with the interface down")
        if not any("CAN bus" in fault for fault in state.faults):
            raise Failed(f"the fault does not name the bus: {state.faults}")
        held("interface down in motion", "; ".join(state.faults))
        until(lambda: _stopped(machine.log("drives")), "the drives stop by their own watchdogs")
        held("drives without a master", "all three stopped by their own watchdogs")
    service.send_signal(signal.SIGTERM)
    until(lambda: service.poll() is not None, "the service ends")
    if service.returncode != 0:
        raise Failed(f"the service ended with exit code {service.returncode}, not 0, after SIGTERM")
    held("end", "exit code 0 after SIGTERM")


def _until_moving(robot: Robot, goal: str) -> None:
    until_state(
        robot,
        lambda state: state.goal is not None and state.goal.id == goal and state.goal.progress > 0.2,
        "the robot moves",
    )


def expect(result: Result, outcome: str, robot: Robot) -> None:
    """Raise Failed unless a goal ended as it should."""
    if result.outcome != outcome:
        raise Failed(f"goal: {result.message}; wanted is {outcome}. {_about(robot.state())}")


def _stopped(log: str) -> bool:
    """Whether the newest line of each drive says that its watchdog has put it in fault, where it has no power."""
    newest = {line[0]: line for line in log.splitlines() if line[:2] in {"A ", "B ", "C "}}
    return len(newest) == 3 and all(line[2:].startswith("fault,") for line in newest.values())


def _loop(state: State) -> dict[str, Any]:
    loop = state.loop
    return {
        "cycles": loop.cycles,
        "overruns": loop.overruns,
        "lateness_us": {"p50": loop.lateness_us.p50, "p99": loop.lateness_us.p99, "max": loop.lateness_us.max},
    }


if __name__ == "__main__":
    sys.exit(main())
