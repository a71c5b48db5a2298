"""Drives that others made lose their supply, with all that they were told, and are configured in the background."""

from __future__ import annotations

import os
import select
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from drivers.foreign_process import COUNTS
from drivers.test_foreign import IN_COUNTS, MAKES, Rig
from rigs import Closing, alike
from trirail_drivers.bus.unixbus import UnixBus
from trirail_drivers.cia402.drives import Cia402
from trirail_drivers.config import Drives
from trirail_drivers.interface import Feedback, PowerState
from trirail_drivers.timing import BusTiming
from waiting import WITHIN

ENDS = 4000
"""Cycles within which three drives are configured."""


@pytest.mark.parametrize("struck", [(1,), (0, 1, 2)], ids=["one", "all"])
@pytest.mark.parametrize("name", MAKES)
def test_drives_that_restart_are_configured_again(closing: Closing, name: str, struck: tuple[int, ...]) -> None:
    """In motion; then a reset, power and motion follow, and no drive has had power in between."""
    rig = closing(Rig(name))
    rig.ready()
    rig.enable()
    rig.go(0.05, 50)
    for index in struck:
        rig.nodes[index].boot()
    rig.feedback = rig.cycle(rig.feedback.position)
    assert rig.feedback.fault is not None
    assert "has restarted and lost its set-up" in rig.feedback.fault.message
    for _ in range(ENDS):
        rig.feedback = rig.cycle(rig.feedback.position)
        if rig.feedback.unready == (None, None, None):
            break
    assert rig.feedback.unready == (None, None, None)
    assert PowerState.OPERATION_ENABLED not in rig.feedback.state
    rig.drives.reset()
    for _ in range(20):
        rig.feedback = rig.cycle(rig.feedback.position)
    assert rig.feedback.fault is None, rig.feedback.fault
    rig.enable()
    rig.go(0.05, 50)


def test_a_drive_that_lost_a_unit_that_the_set_up_gave_it_gets_it_again(closing: Closing) -> None:
    rig = closing(Rig("maxon_epos4_compact50_5", None, IN_COUNTS, revolutions_per_metre=None))
    rig.ready()
    rig.nodes[0].boot()
    rig.feedback = rig.cycle(rig.feedback.position)
    assert rig.nodes[0].value(0x60A9) == 0x00B4_4700
    for _ in range(ENDS):
        rig.feedback = rig.cycle(rig.feedback.position)
        if rig.feedback.unready == (None, None, None):
            break
    assert rig.feedback.unready == (None, None, None)
    assert rig.nodes[0].value(0x60A9) == 0x00B5_0300


class KilledDrives:
    """Drives of another process, the driver under test, and cycles in the machine's own time."""

    PERIOD = 0.005
    NODES = ("1", "2", "3")

    def __init__(self, channel: Path) -> None:
        self.channel = channel
        self.bus = UnixBus(str(channel), listen=True)
        # A busy machine may keep either process waiting.
        config = Drives("cia402", *alike(counts_per_metre=COUNTS), heartbeat=1.0, missed_positions=100)
        self.drives = Cia402(self.bus, BusTiming(1_000_000), config)
        self.process = self.start()
        self.powered = False
        """Whether a drive may have power."""

    def start(self) -> subprocess.Popen[bytes]:
        script = Path(__file__).with_name("foreign_process.py")
        paths = os.pathsep.join([str(script.parents[1]), *sys.path])
        given = [sys.executable, str(script), str(self.channel), "elmo_gold", *self.NODES]
        return subprocess.Popen(given, env={**os.environ, "PYTHONPATH": paths})

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()

    def until(self, condition: Callable[[Feedback], bool]) -> Feedback:
        end = time.monotonic() + WITHIN
        while True:
            due = time.monotonic() + self.PERIOD
            self.drives.sync()
            feedback = self.drives.read()
            assert self.powered or PowerState.OPERATION_ENABLED not in feedback.state
            self.drives.write(feedback.position, (0.0, 0.0, 0.0))
            if condition(feedback):
                return feedback
            assert due < end, feedback
            while (left := due - time.monotonic()) > 0.0:
                select.select([self.bus.fileno()], [], [], left)
                self.drives.read()

    def enable(self) -> None:
        self.powered = True
        self.drives.enable()
        feedback = self.until(lambda said: said.fault is not None or set(said.state) == {PowerState.OPERATION_ENABLED})
        assert feedback.fault is None

    def close(self) -> None:
        self.kill()
        self.bus.shutdown()


@pytest.mark.long
def test_drives_whose_process_is_killed_and_started_again_are_configured_again(tmp_path: Path) -> None:
    rig = KilledDrives(tmp_path / "bus")
    try:
        rig.drives.configure(rig.PERIOD)
        rig.enable()
        rig.kill()
        rig.until(lambda said: said.fault is not None)
        rig.until(lambda said: [str(each) for each in said.unready] == [f"drive {n} does not answer" for n in "ABC"])
        rig.until(lambda said: PowerState.OPERATION_ENABLED not in said.state)
        rig.powered = False
        rig.process = rig.start()
        rig.until(lambda said: said.unready == (None, None, None))
        rig.drives.reset()
        assert rig.until(lambda said: said.fault is None).fault is None
        rig.enable()
    finally:
        rig.close()
