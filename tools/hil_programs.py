"""Programs that run inside the emulated machine: the doctor, drives, candump and the service, each with a log."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path

ROOT = Path(__file__).parents[1]
STEP_TIMEOUT_S = 900.0
"""Time limit of each step in this slow machine [s]. On a busy host, a start may take five times as long as on an idle
one. The host limits the time of the whole run.
"""
BUFFER = 8_000_000
"""Receive buffer of candump's socket [bytes], so large that no frame is lost on a busy machine."""
HEARTBEAT_TIMEOUT_S = 10.0
"""Heartbeat time-out of a process of the service [s]. In this slow machine, a process may have to wait long for the
processor while others start.
"""
PATIENT = (
    "from trirail.cli import app; from trirail.processes import supervisor; "
    f"supervisor.START_WITHIN = supervisor.END_WITHIN = {STEP_TIMEOUT_S}; "
    f"supervisor.MAX_SILENCE_S = {HEARTBEAT_TIMEOUT_S}; app.main()"
)
"""Program `trirail` with longer time-outs: in this machine, the interpreters alone take a minute to start, and the
black box of each fault takes some seconds to write."""


class Failed(Exception):
    """A requirement is missing, or a step or a check has failed; the message contains the remedy or names the log."""


def changed(text: str, changes: Mapping[str, str]) -> str:
    """Replace parts of a configuration. Raises Failed unless each part occurs exactly once."""
    for before, after in changes.items():
        if text.count(before) != 1:
            raise Failed(f"the configuration must contain {before!r} once, not {text.count(before)} times")
        text = text.replace(before, after)
    return text


class Machine:
    """Context in which programs run, each with its output in a log in `folder`; at its end, all programs are ended."""

    def __init__(self, folder: Path, memory: Path) -> None:
        """`memory` is a folder in memory, which is fast to write to."""
        self._folder = folder
        self._memory = memory
        self._systemd: dict[str, socket.socket] = {}
        self._processes: list[subprocess.Popen[bytes]] = []

    def __enter__(self) -> Machine:
        return self

    def __exit__(self, *_: object) -> None:
        for process in reversed(self._processes):
            if process.poll() is None:
                process.terminate()
        for process in self._processes:
            try:
                process.wait(STEP_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

    def start(self, name: str, *command: object, **environment: str) -> subprocess.Popen[bytes]:
        """Start a program, and write its output to NAME.log."""
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

    def end(self, process: subprocess.Popen[bytes], name: str) -> None:
        """End a program by SIGTERM. Raises Failed unless it ends in time with exit code 0."""
        process.send_signal(signal.SIGTERM)
        self.await_end(process, name)

    def await_end(self, process: subprocess.Popen[bytes], name: str, code: int = 0) -> None:
        """Wait for the end of a program after SIGTERM. Raises Failed unless it ends in time with this exit code."""
        wait_until(lambda: process.poll() is not None, f"{name} ends")
        if process.returncode != code:
            raise Failed(f"{name} ended with exit code {process.returncode}, not {code}, after SIGTERM")

    def log(self, name: str) -> str:
        """Return the output of a program up to now."""
        return (self._folder / f"{name}.log").read_text(errors="replace")

    def doctor(self) -> Callable[[], str]:
        """Start `trirail doctor`; return a function that waits for its end and returns its findings on can0.

        The returned function raises Failed unless all checks of can0 pass.
        """
        command = (sys.executable, "-P", "-m", "trirail", "doctor", self._folder / "robot.toml", "--quick", "--json")
        process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE)
        self._processes.append(process)

        def verdict() -> str:
            output, _ = process.communicate(timeout=STEP_TIMEOUT_S)
            can0 = [check for check in json.loads(output)["checks"] if check["name"].startswith("can0")]
            if len(can0) != 4 or any(check["verdict"] != "ok" for check in can0):
                raise Failed(f"the doctor says of can0: {can0}")
            return ", ".join(f"{check['name']} {check['found']}" for check in can0)

        return verdict

    def measured_timing(self) -> str:
        """Run `trirail doctor can0` while the service runs, and return its finding on the timing of the bus.

        Raises Failed unless the frames of the service were measured.
        """
        command = (sys.executable, "-P", "-m", "trirail", "doctor", "can0", "--json")
        done = subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, timeout=STEP_TIMEOUT_S, check=False)
        answer = json.loads(done.stdout)
        (check,) = [check for check in answer["checks"] if check["name"] == "can0 timing"]
        if (
            answer["bus_timing"] is None
            or answer["bus_timing"]["source"] != "service"
            or answer["bus_timing"]["setpoints_us"] is None
        ):
            raise Failed(f"the doctor says of the service's frames: {check}")
        return str(check["found"])

    def candump(self, channel: str, name: str) -> None:
        """Start to log all frames on an interface to the file `name` in memory."""
        with (self._memory / name).open("wb") as log:
            command = ("candump", "-L", "-D", "-r", str(BUFFER), channel)
            self._processes.append(subprocess.Popen(command, stdout=log))

    def begin_drives(
        self, config: str, channel: str, name: str = "drives", faults: str | None = None
    ) -> subprocess.Popen[bytes]:
        """Start the virtual drives of a configuration on an interface."""
        more = ("--faults", self._folder / faults) if faults else ()
        return self.begin("tools/virtual_drives.py", config, channel, name, *more)

    def restart_drives(self, config: str, channel: str, name: str, faults: str) -> None:
        """Start virtual drives while services run. They get their real-time priority only after their imports."""
        process = self.start(
            name,
            *(sys.executable, "tools/virtual_drives.py", self._folder / config),
            *("--interface", "socketcan", "--channel", channel, "--faults", self._folder / faults),
        )
        self.await_drives(process, name)
        run("chrt", "--all-tasks", "--fifo", "--pid", "50", str(process.pid))

    def begin(self, program: str, config: str, channel: str, name: str, *more: object) -> subprocess.Popen[bytes]:
        """Start a program that simulates a configuration's drives on an interface."""
        # Real drives share no processor with other programs, so these have precedence over everything but the loop.
        return self.start(
            name,
            *("chrt", "--fifo", "50", sys.executable, program, self._folder / config),
            *("--interface", "socketcan", "--channel", channel, *more),
        )

    def await_drives(self, process: subprocess.Popen[bytes], name: str = "drives") -> None:
        """Wait until a program has reported the state of drive C, the last of its drives."""
        wait_until(lambda: "C " in self.log(name), f"{name} are there", process)

    def begin_service(self, config: str, name: str = "service") -> subprocess.Popen[bytes]:
        """Start the service. When it is up, it notifies systemd; here, this program receives the notification."""
        self._systemd[name] = systemd = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        address = self._memory / f"notify-{name}"
        systemd.bind(str(address))
        systemd.settimeout(1.0)
        command = (sys.executable, "-P", "-c", PATIENT, "run", self._folder / config)
        return self.start(name, *command, NOTIFY_SOCKET=str(address))

    def await_service(self, process: subprocess.Popen[bytes], name: str = "service") -> None:
        """Wait until a service that `begin_service` has started is up. Raises Failed."""
        with self._systemd.pop(name) as systemd:
            wait_until(lambda: _received(systemd) == "READY=1", f"{name} is up", process)


def run(*command: str) -> None:
    """Run a command, and wait for its end. Raises subprocess.SubprocessError if it fails."""
    subprocess.run(command, check=True)


def wait_until(condition: Callable[[], bool], what: str, process: subprocess.Popen[bytes] | None = None) -> None:
    """Wait until a condition is True. Raises Failed if that takes too long, or if the process ends first."""
    deadline = time.monotonic() + STEP_TIMEOUT_S
    while not condition():
        if process is not None and process.poll() is not None:
            raise Failed(f"{what}: no, the process has ended with exit code {process.returncode}")
        if time.monotonic() > deadline:
            raise Failed(f"{what}: not within {STEP_TIMEOUT_S:g} s")
        time.sleep(0.1)


def _received(receiver: socket.socket) -> str:
    try:
        return receiver.recv(100).decode()
    except TimeoutError:
        return ""
