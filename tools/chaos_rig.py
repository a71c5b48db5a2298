"""Test rig of tools/chaos.py: drives in a separate process, a service, and a listener on the bus."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import socket
import struct
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import can
import numpy as np
from trirail.client import own_service
from trirail.client.client import Robot
from trirail.config import SIM, load
from trirail.errors import EmptyRecordingError, ServiceError, TrirailError
from trirail.processes.operating_system import child
from trirail.telemetry.reading import read
from trirail.telemetry.recording import Recording
from trirail.telemetry.sinks import LOOPBACK, free_port
from trirail.wire.state import State
from trirail_drivers.bus.unixbus import UnixBus
from trirail_drivers.cia402 import canopen_frames
from trirail_drivers.errors import BusError

ROOT = Path(__file__).parents[1]
EVENT_TIMEOUT_S = 20.0
"""Time limit for any expected event [s]."""
PROCESSES = ("supervisor", "fork-server", "gateway", "loop", "planner", "recorder")
NODES = (1, 2, 3)
# The rate is low and the watchdogs are slow, so that several processes have enough time even on a slow machine.
CHANGES = {
    "rate_hz": "100",
    "missed_syncs": "30",
    "heartbeat": "0.3",
    "following_error": "0.05",
    "enable_timeout": "60.0",
}


class Failed(Exception):
    """A requirement of the kill matrix is violated."""


def wait_for(condition: Callable[[], bool], what: str, within: float = EVENT_TIMEOUT_S) -> None:
    """Wait until a condition is True. Raises Failed after `within` [s]; `what` describes the condition."""
    deadline = time.monotonic() + within
    while not condition():
        if time.monotonic() > deadline:
            raise Failed(f"not within {within:g} s: {what}")
        time.sleep(0.01)


def _connect(path: Path, buses: list[UnixBus]) -> bool:
    """Try to connect to a bus; return whether it has succeeded. The path exists before somebody listens there."""
    try:
        buses.append(UnixBus(str(path)))
    except BusError:
        return False
    return True


class Rig:
    """Drives on a bus between processes, and services that are started on this bus one after the other."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.bus_path = folder / "bus"
        self.ports = free_port(), free_port()
        self.config = folder / "robot.toml"
        self.config.write_text(self._configuration(), encoding="utf-8")
        self.period = load(self.config).period
        self.limits = load(self.config).limits.slider
        self.counts = load(self.config).drives.A.counts_per_metre
        self._drives = subprocess.Popen(
            [*_python("tools/virtual_drives.py"), str(self.config), "--interface", "unix", "--channel", self.bus_path],
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
        )
        buses: list[UnixBus] = []
        try:
            wait_for(lambda: _connect(self.bus_path, buses), "virtual drives")
        except BaseException:
            self._drives.terminate()
            raise
        (self._bus,) = buses
        self._lock = threading.Lock()
        self._heard: list[can.Message] = []
        self._closing = False
        self._listener = threading.Thread(target=self._listen, name="bus", daemon=True)
        self._listener.start()

    def _configuration(self) -> str:
        text = SIM.read_text(encoding="utf-8")
        zenoh, live = self.ports
        changes = CHANGES | {
            "interface": f'"unix"\nchannel = "{self.bus_path}"',
            "listen": f'["tcp/{LOOPBACK}:{zenoh}"]',
            "live_port": str(live),
            "directory": f'"{self.folder}/recordings"',
        }
        for key, value in changes.items():
            text, count = re.subn(rf"^{key} = [^#\n]*", f"{key} = {value} ", text, flags=re.MULTILINE)
            if not count:
                raise Failed(f"{SIM} has no key {key}")
        return text

    def close(self) -> None:
        """Stop the drives."""
        self._closing = True
        self._drives.terminate()
        self._drives.wait(EVENT_TIMEOUT_S)
        self._listener.join(EVENT_TIMEOUT_S)
        self._bus.shutdown()

    # ------------------------------------------------------------------ the service

    def start(self) -> None:
        """Start a service on the bus, and forget the frames received up to now."""
        self._heard = []
        runtime = self.folder / "runtime"
        runtime.mkdir(exist_ok=True)
        with (self.folder / "service.log").open("wb") as log:
            self.service = own_service.start(self.config, log, TMPDIR=str(runtime))

    @property
    def locator(self) -> str:
        """Locator of the service."""
        return f"tcp/{LOOPBACK}:{self.ports[0]}"

    def robot(self) -> Robot:
        """Return a client of the service."""
        return Robot("demo", self.locator, user="chaos")

    def served(self) -> Robot:
        """Wait until the service answers; return a client. Raises Failed."""
        deadline = time.monotonic() + EVENT_TIMEOUT_S
        while True:
            robot: Robot | None = None
            try:
                robot = self.robot()
                robot.state()
            except TrirailError as error:
                if robot is not None:
                    robot.close()
                if time.monotonic() > deadline:
                    raise Failed(f"nobody answers: {error}") from error
            else:
                return robot

    def process(self, name: str) -> int:
        """Return the process id of one of PROCESSES."""
        return self.service.pid if name == "supervisor" else child(self.service.pid, name)

    def major_faults(self) -> int:
        """Return the number of pages for which the loop had to wait for a disk."""
        return int(Path(f"/proc/{self.process('loop')}/stat").read_text().rpartition(")")[2].split()[9])

    def fault(self, line: str) -> None:
        """Inject a fault into the drives, in the language of trirail_drivers.simulated.faultlines."""
        if self._drives.stdin is not None:
            self._drives.stdin.write(line.encode() + b"\n")
            self._drives.stdin.flush()

    def remains(self) -> list[int]:
        """Return the ids of the service's remaining processes."""
        pids = []
        for entry in Path("/proc").glob("[0-9]*"):
            with contextlib.suppress(OSError):
                # Forked processes have the arguments, and sometimes the environment, of their parent. Therefore all
                # processes are recognised by their standard output.
                speaks_to = (entry / "fd" / "1").readlink()
                if speaks_to.is_relative_to(self.folder) and b"virtual_drives" not in (entry / "cmdline").read_bytes():
                    pids.append(int(entry.name))
        return pids

    def clean_up(self) -> None:
        """Remove everything that one service could leave behind for the next: processes and recordings."""
        for process in self.remains():
            with contextlib.suppress(ProcessLookupError):
                os.kill(process, signal.SIGKILL)
        self.service.wait()
        wait_for(lambda: not self.remains(), "killed processes are gone")
        for file in (self.folder / "recordings").glob("*"):
            file.unlink()

    def recordings(self) -> list[Recording]:
        """Return all recordings of the service. Raises Failed if a file cannot be read."""
        recordings = []
        for file in sorted((self.folder / "recordings").glob("*.rrd")):
            if file.name.startswith("fault-"):
                continue
            try:
                recordings.append(read(file))
            except EmptyRecordingError:  # of a recorder that was restarted just before the service ended
                continue
            except ServiceError as error:
                raise Failed(str(error)) from error
        return recordings

    def warnings(self) -> str:
        """Return the service's warnings, to find the cause of a failure."""
        with contextlib.suppress(Failed):
            lines = [line for recording in self.recordings() for line in recording.events]
            return " | ".join(f"{line.t:.2f} s {line.text}" for line in lines if line.level != "INFO")
        return ""

    def ports_are_free(self) -> bool:
        """Return whether both ports are free."""
        for port in self.ports:
            with socket.socket() as probe:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                try:
                    probe.bind((LOOPBACK, port))
                except OSError:
                    return False
        return True

    # ------------------------------------------------------------------ the bus

    def _listen(self) -> None:
        while not self._closing:
            try:
                message = self._bus.recv(0.1)
            except can.CanOperationError:  # the drives have ended
                return
            if message is not None:
                with self._lock:
                    self._heard.append(message)

    def ask(self, node: int, index: int) -> int:
        """Read the value of a drive's object by SDO. Raises Failed if the drive does not answer."""
        with self._lock:
            begin = len(self._heard)
        request = struct.pack("<BHB4x", 0x40, index, 0)
        self._bus.send(
            can.Message(arbitration_id=canopen_frames.SDO_REQUEST + node, data=request, is_extended_id=False)
        )

        def answers() -> list[int]:
            with self._lock:
                new = self._heard[begin:]
            return [
                int.from_bytes(m.data[4:8], "little", signed=True)
                for m in new
                if m.arbitration_id == canopen_frames.SDO_ANSWER + node
                and int.from_bytes(m.data[1:3], "little") == index
            ]

        wait_for(lambda: bool(answers()), f"drive {node} answers")
        return answers()[0]

    def check_rest(self) -> None:
        """Raise Failed if the position of a drive changes."""
        before = [self.ask(node, 0x6064) for node in NODES]
        time.sleep(0.2)
        moved = [self.ask(node, 0x6064) - position for node, position in zip(NODES, before, strict=True)]
        if max(map(abs, moved)) > 1e-6 * self.counts:
            raise Failed(f"the drives move: {moved} counts in 0.2 s")

    def check_unpowered(self) -> None:
        """Raise Failed if a drive still follows setpoints."""
        words = [self.ask(node, 0x6041) & 0x6F for node in NODES]
        if 0x27 in words:
            raise Failed(f"drives are enabled still: statuswords {words}")

    def check_setpoints(self) -> None:
        """Raise Failed if the position or the velocity of the setpoints jumps by more than the limits allow."""
        for node in NODES:
            for setpoints in self._followed(node):
                step, bend = (np.abs(np.diff(setpoints, order)).max(initial=0.0) for order in (1, 2))
                if step > self.limits.fastest * self.period * 1.01:
                    raise Failed(f"drive {node}: a setpoint steps by {step * 1e3:.2f} mm in a cycle")
                if bend > max(self.limits.accelerations) * self.period**2 * 1.05 + 1e-6:
                    raise Failed(f"drive {node}: the velocity of setpoints steps by {bend / self.period:.3f} m/s")

    def _followed(self, node: int) -> list[np.ndarray[tuple[int], np.dtype[np.float64]]]:
        """Return the setpoints of a drive while it is commanded to follow them [m], one array for each power-up.

        All other setpoints are measured positions, and may jump.
        """
        runs: list[list[float]] = []
        state = 0
        with self._lock:
            heard = list(self._heard)
        for message in heard:
            if message.arbitration_id == canopen_frames.RPDO1 + node:
                before, state = (
                    state,
                    canopen_frames.CONTROLWORD.unpack(message.data[:2])[0] & canopen_frames.ENABLE_OPERATION,
                )
                if state == canopen_frames.ENABLE_OPERATION != before:
                    runs.append([])
            elif message.arbitration_id == canopen_frames.RPDO2 + node and state == canopen_frames.ENABLE_OPERATION:
                runs[-1].append(canopen_frames.SETPOINT.unpack(message.data)[0] / self.counts)
        return [np.array(run) for run in runs]


@contextlib.contextmanager
def running_rig(folder: Path) -> Iterator[Rig]:
    """Run drives and a first service; at the end of the context, also after a failed start, end what still runs."""
    with contextlib.closing(Rig(folder)) as rig:
        rig.start()
        try:
            yield rig
        finally:
            rig.clean_up()


def _python(*arguments: str) -> list[str]:
    from trirail.processes.operating_system import python

    # The option -P of `python` is omitted: tools import other tools from their own folder, which -P would exclude.
    return [python()[0], *arguments]


def states(robot: Robot, condition: Callable[[State], bool]) -> State:
    """Wait for the first state that satisfies a condition, and return it. Raises Failed."""
    deadline = time.monotonic() + EVENT_TIMEOUT_S
    for state in robot.states(timeout=EVENT_TIMEOUT_S):
        if condition(state):
            return state
        if time.monotonic() > deadline:
            break
    raise Failed("a state that had to come has not come")
