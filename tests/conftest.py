"""A robot without processes: the control over the real driver on the simulated bus, with a fake clock."""

from __future__ import annotations

import gc
import heapq
import itertools
import math
import os
import signal
import tempfile
import traceback
import tracemalloc
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from typing import Any, cast

import blas_threads  # noqa: F401 - before numpy
import can
import msgspec
import numpy as np
import pytest
import trirail
from control_rig import CONFIG, ControlRig
from numpy.typing import NDArray
from trirail.config import Config
from trirail.wire.packets import Request
from trirail_drivers.cia402 import canopen_frames
from trirail_drivers.connection.opening import simulated_bus
from trirail_drivers.interface import Feedback, Triple
from trirail_drivers.protocols import PROTOCOLS
from trirail_drivers.simulated import SimulatedDrive

_STATE = tempfile.TemporaryDirectory(prefix="trirail-tests-")
os.environ["STATE_DIRECTORY"] = _STATE.name  # the poses that somebody has taught on this machine are no test's

for _setting in ("TRIRAIL_ROBOT", "TRIRAIL_CONNECT", "TRIRAIL_TLS"):  # the tests start robots of their own
    os.environ.pop(_setting, None)

pytest_plugins = ["caused_messages", "generated", "parsed_eds", "parts", "warm"]

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as shells have it for what runs in the background
    signal.signal(signal.SIGINT, signal.default_int_handler)


def changed(config: Config, **simulated: object) -> Config:
    """Change how the simulated drives behave."""
    behaviour = msgspec.structs.replace(config.can.simulated, **simulated)
    return msgspec.structs.replace(config, can=msgspec.structs.replace(config.can, simulated=behaviour))


Delay = Callable[[can.Message], float]
"""How long the bus takes for a frame from a drive [s]."""


def delay_answers(bus: can.BusABC, delay: Delay, clock: Callable[[], float]) -> None:
    """Let what the drives send be received only after its delay, as on a wire, and in the order of arrival."""
    receive = bus.recv
    travelling: list[tuple[float, int, can.Message]] = []
    number = itertools.count()

    def recv(timeout: float | None = None) -> can.Message | None:
        while (message := receive(timeout)) is not None:
            wait = delay(message)
            if wait == 0.0:
                return message
            heapq.heappush(travelling, (clock() + wait, next(number), message))
        if travelling and travelling[0][0] <= clock() + 1e-9:
            return heapq.heappop(travelling)[2]
        return None

    bus.recv = recv  # type: ignore[method-assign]


def part_of_a_cycle(message: can.Message) -> float:
    return 0.4 * CONFIG.period


def a_cycle(message: can.Message) -> float:
    return CONFIG.period


def one_drive_late(message: can.Message) -> float:
    return 0.4 * CONFIG.period if message.arbitration_id == canopen_frames.TPDO2 + 2 else 0.0


FRAMES = 25
"""How deep a stack is looked into for who has allocated."""


class Rig(ControlRig):
    """The same over the real driver and simulated drives; keeps every frame that was sent."""

    def __init__(self, config: Config = CONFIG, delay: Delay | None = None) -> None:
        """`delay`: of the drives' frames."""
        self.now = 100.0
        self.bus = simulated_bus(config.can, config.drives, lambda: self.now)
        self.sent: list[can.Message] = []
        self.seen: list[list[tuple[int, int]]] = []
        self._send = self.bus.send
        self.bus.send = self._note  # type: ignore[assignment,method-assign]
        driver = PROTOCOLS[config.drives.protocol].driver(
            self.bus, config.can.timing, config.drives, lambda: self.now, None, config.drive_io
        )
        driver.configure(config.period)
        if delay is not None:
            delay_answers(self.bus, delay, lambda: self.now)
        super().__init__(config, driver)

    def _note(self, message: can.Message, timeout: float | None = None) -> None:
        self.sent.append(message)
        self._send(message, timeout)

    @property
    def drives(self) -> tuple[SimulatedDrive, ...]:
        return cast(tuple[SimulatedDrive, ...], self.bus.drives)  # tests with another protocol take rig.bus.drives

    def cycle(self, request: Request | None = None) -> None:
        """Run one cycle, with a request or without; `sent` holds its frames afterwards."""
        self.sent.clear()
        super().cycle(request)
        setpoints = [sent for sent in self.sent if sent.arbitration_id >> 7 == 6]
        self.seen.append([canopen_frames.SETPOINT.unpack(bytes(sent.data).ljust(8, b"\0")) for sent in setpoints])

    def captured(self) -> NDArray[np.float64]:
        """Return what the frames of all cycles so far have, not a number where no setpoints were sent."""
        scale = np.array([drive.counts_per_metre * drive.direction for drive in self.config.drives.each])
        offset = np.array([drive.offset for drive in self.config.drives.each])
        nothing = [(math.nan, math.nan)] * 3
        counts = np.array([sent if len(sent) == 3 else nothing for sent in self.seen])
        return np.stack([counts[:, :, 0] / scale + offset, counts[:, :, 1] / scale], axis=1)


class Followers:
    """Powered drives that are where they were told to be: no bus, no frames, and next to no memory of their own."""

    bus_load = 0.0
    missing_protections = ()
    traffic = 0
    path_outputs = (True, True, True)

    def __init__(self, feedback: Feedback) -> None:
        self._feedback = feedback._replace(warnings=())
        self._due = feedback.position, feedback.position

    def sync(self) -> None:
        """Reach what was written a cycle before the last one."""
        self._feedback = self._feedback._replace(position=self._due[0], age=(0, 0, 0))

    def read(self) -> Feedback:
        return self._feedback

    def write(self, position: Triple, velocity: Triple) -> None:
        self._due = self._due[1], position

    def set_outputs(self, words: Sequence[int]) -> None:
        pass


def alone(check: Callable[[], None]) -> None:
    """Check something in a copy of this process, in which no thread of another test runs; fail as it fails."""
    gc.collect()  # what others have left is not taken apart in the copy
    reading, writing = os.pipe()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # the copy takes no lock that another thread may hold
        pid = os.fork()
    if pid == 0:
        said = ""
        try:
            check()
        except BaseException:  # noqa: BLE001 - all of it is told
            said = traceback.format_exc()
        os.write(writing, said.encode()[-60_000:])  # a pipe holds that much
        os._exit(0)
    os.close(writing)
    with open(reading, encoding="utf-8", errors="replace") as told:
        said = told.read()
    _, status = os.waitpid(pid, 0)
    if said or status:
        pytest.fail(said or f"the copy ended with status {status}", pytrace=False)


def what_memory_takes(cycle: Callable[[], None], cycles: int) -> tuple[int, int]:
    """Return by how many bytes memory grows in so many cycles, and how many are in use for a moment at most.

    Of all threads: to be called `alone`. Without the garbage collector, as the loop runs. The cycles before are for
    what is made once, and for the tuples that CPython keeps for later: 2000 of each length, then no more. These are
    not traced, which takes ten times as long; those that follow are for what each cycle makes in the place of what an
    earlier one has made. Only what code of the package has allocated, called from here, counts as grown.
    """
    gc.disable()
    for _ in range(2500):
        cycle()
    tracemalloc.start(FRAMES)
    try:
        for _ in range(500):
            cycle()
        before = _allocated_here()
        in_use = _peak(cycle, cycles)
        grown = _allocated_here().compare_to(before, "lineno")
    finally:
        tracemalloc.stop()
        gc.enable()
    return sum(line.size_diff for line in grown), in_use


def _peak(cycle: Callable[[], None], cycles: int) -> int:
    held, _ = tracemalloc.get_traced_memory()
    tracemalloc.reset_peak()
    for _ in range(cycles):
        cycle()
    _, peak = tracemalloc.get_traced_memory()
    return peak - held


def _allocated_here() -> tracemalloc.Snapshot:
    """Return what is held that code of the package has allocated, called from here."""
    found = tracemalloc.take_snapshot()
    for one in (f"{os.path.dirname(trirail.__file__)}/*", __file__):
        found = found.filter_traces([tracemalloc.Filter(True, one, all_frames=True)])
    return found


def pytest_collection_finish() -> None:
    """Have the garbage collector leave out modules and tests: they stay, and are half a gigabyte to look through."""
    gc.collect()
    gc.freeze()


def pytest_unconfigure() -> None:
    """Have the collector look at everything again: nanobind prints what is left at the end of the interpreter."""
    gc.unfreeze()


@pytest.fixture
def robots() -> Iterator[Callable[..., Rig]]:
    """Makes a robot of what Rig takes; its bus is shut down at the end of the test."""
    with ExitStack() as made:

        def robot(*given: Any) -> Rig:
            rig = Rig(*given)
            made.callback(rig.bus.shutdown)  # not driver.close, which waits for standstill by a clock that stands
            return rig

        yield robot


@pytest.fixture
def rig(robots: Callable[..., Rig]) -> Rig:
    return robots()


@pytest.fixture(scope="module")
def locator(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Where a service on simulated drives is, one for all tests of a module."""
    from trirail.client import own_service

    folder = tmp_path_factory.mktemp("service")
    config, locator = own_service.private(folder)
    with own_service.service(config, folder / "session.rrd"):
        yield locator
