"""Black boxes of faults that repeat: none is without its minute, and they do not pile up."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from trirail.telemetry.blackbox import AFTER_S, BEFORE_S, BlackBox
from trirail.telemetry.recorder import Recorder
from trirail.wire.event_codes import EventCode, EventText
from trirail.wire.messages import Event
from trirail.wire.records import DTYPE

RATE_HZ, BATCH = 10, 2
BEFORE, AFTER = round(BEFORE_S * RATE_HZ), round(AFTER_S * RATE_HZ)
NAME = "black box"


class Kept:
    """What a black box contains, in place of its file."""

    lost, path = 0, Path("fault.rrd")

    def __init__(self, reason: str) -> None:
        self.reason = reason
        self.cycles: set[int] = set()
        self.faults: list[str] = []

    def records(self, batch: bytes) -> None:
        self.cycles.update(np.frombuffer(batch, DTYPE)["cycle"].tolist())

    def event(self, event: Event) -> None:
        self.faults.append(event.message)

    def close(self) -> None:
        """Do nothing."""


class Run:
    """A service whose drives have faults in the given cycles; `meanwhile` is called after each batch."""

    def __init__(self, faults: set[int], cycles: int, meanwhile: Callable[[], object]) -> None:
        self.boxes: list[Kept] = []
        self.told: list[EventText] = []
        self.cycle = 0
        self.may_begin = threading.Event()
        self.may_begin.set()
        self._faults, self._cycles, self._meanwhile = faults, cycles, meanwhile
        self._box = BlackBox(RATE_HZ, self._begin, self.told.append)

    def go(self) -> None:
        """Run all cycles, and end."""
        for first in range(0, self._cycles, BATCH):
            batch = np.zeros(BATCH, DTYPE)
            batch["cycle"] = range(first, first + BATCH)
            for cycle in self._faults & set(batch["cycle"].tolist()):
                t = cycle / RATE_HZ
                self._box.event(Event("fault", "error", f"fault {cycle}", seq=cycle, t=t, cycle=cycle, time=1e9 + t))
            self._box.records(batch.tobytes())
            self.cycle = first
            self._meanwhile()
        self._box.close()

    def _begin(self, _name: str, reason: str) -> Recorder:
        self.may_begin.wait()
        self.boxes.append(Kept(reason))
        return cast("Recorder", self.boxes[-1])


def writing() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name == NAME]


def write_all() -> None:
    """Let the disk be so fast that a box is complete before more data arrive."""
    for thread in writing():
        thread.join()


@settings(max_examples=200)
@example(faults=set(range(700, 2000, 6)), cycles=2000)
@example(faults={700, 719, 721}, cycles=2000)
@example(faults={700, 700 + BEFORE + AFTER - 1, 700 + BEFORE + AFTER + 1}, cycles=2000)
@given(faults=st.sets(st.integers(0, 2999), max_size=20), cycles=st.integers(1, 1500).map(lambda half: 2 * half))
def test_every_fault_is_saved_with_its_minute_in_one_file_a_minute(faults: set[int], cycles: int) -> None:
    run = Run(faults, cycles, write_all)
    run.go()
    happened = {cycle for cycle in faults if cycle < cycles}
    saved = set[int]().union(*(box.cycles for box in run.boxes))
    for cycle in happened:
        assert set(range(max(0, cycle - BEFORE), min(cycles, cycle + AFTER))) <= saved
    assert {text for box in run.boxes for text in box.faults} == {f"fault {cycle}" for cycle in happened}
    assert all(box.reason in box.faults for box in run.boxes)
    assert len(run.boxes) <= 2 + cycles // BEFORE
    assert bool(run.boxes) == bool(happened)


def slow(faults: set[int], cycles: int, until: int) -> tuple[Run, int]:
    """Return a run on whose disk no file can be begun until a cycle, and the greatest number of writing threads."""
    threads = list[int]()

    def meanwhile() -> None:
        threads.append(len(writing()))
        if run.cycle >= until:
            run.may_begin.set()
            write_all()

    run = Run(faults, cycles, meanwhile)
    run.may_begin.clear()
    run.go()
    return run, max(threads)


def test_one_thread_writes_and_later_faults_are_in_the_next_file() -> None:
    run, threads = slow(set(range(700, 1500, 6)), 1500, until=1360)
    assert threads == 1
    assert [box.reason for box in run.boxes] == ["fault 700", "fault 724", "fault 1348"]
    assert {text for box in run.boxes for text in box.faults} == {f"fault {cycle}" for cycle in range(700, 1500, 6)}
    assert [text.fields["event_code"] for text in run.told] == [EventCode.BLACK_BOX_LATER] * 2


def test_faults_that_a_slow_disk_loses_are_reported_once() -> None:
    run, threads = slow({700, 750, 800, 2550}, 3000, until=2600)
    assert threads == 1
    assert [box.reason for box in run.boxes] == ["fault 700", "fault 2550"]
    codes = [text.fields["event_code"] for text in run.told]
    assert codes == [EventCode.BLACK_BOX_LATER, EventCode.NO_BLACK_BOX]


@pytest.mark.parametrize("age", [3.0, 30.0, 100.0])
def test_a_fault_of_before_the_recorder_gets_no_file_but_the_reason(age: float) -> None:
    """The loop sends events again to a recorder that has restarted."""
    run = Run(set(), 0, write_all)
    t = 1000 / RATE_HZ
    run._box.event(Event("fault", "error", "old", seq=1, t=t - age, cycle=1, time=1e9 + t - age))
    for first in range(1000, 2600, BATCH):
        batch = np.zeros(BATCH, DTYPE)
        batch["cycle"] = range(first, first + BATCH)
        run._box.records(batch.tobytes())
        write_all()
    run._box.close()
    assert run.boxes == []
    (told,) = run.told
    assert "the recorder has restarted since" in told.text
