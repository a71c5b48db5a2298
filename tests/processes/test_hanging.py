"""A process that hangs is told from one that a busy machine keeps waiting, by what the kernel says of it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from trirail.config import SIM, load
from trirail.processes.child_process import Child
from trirail.processes.heartbeats import PROCESSES, Effort, HangWatch, Heartbeats, effort
from trirail.processes.order import Order

TURN = 0.1
TURNS = st.tuples(st.booleans(), st.sampled_from("RDSTtZ"), st.floats(0.0, TURN))
"""Whether it beats, its state, and what it uses of a processor [s]."""


@given(patience=st.floats(0.05, 2.0), turns=st.lists(TURNS, max_size=80))
def test_only_the_time_counts_in_which_it_could_have_given_a_sign_of_life(
    patience: float, turns: list[tuple[bool, str, float]]
) -> None:
    heart, used = Heartbeats.create().heart("planner"), 0.0
    heart.beat()
    now = Effort("R", 0.0)
    watch = HangWatch(heart, patience, TURN, lambda _: now)
    watch.hangs(1)
    could = 0.0
    for beats, state, more in turns:
        used += more
        now = Effort(state, used)
        if beats:
            heart.beat()
        could = 0.0 if beats else could + (more if state in "RD" else TURN)
        hangs = watch.hangs(1)
        if hangs:
            assert could > patience
        # What it used in the first turn of its silence began before that: it is not known how much.
        elif could > patience + 2.5 * TURN:
            raise AssertionError(f"it has hung for {could} s")


@given(turns=st.integers(1, 10_000), state=st.sampled_from("RD"))
def test_one_that_gets_nothing_of_the_machine_never_hangs(turns: int, state: str) -> None:
    heart = Heartbeats.create().heart("planner")
    heart.beat()
    watch = HangWatch(heart, 0.7, TURN, lambda _: Effort(state, 5.0))
    assert not any(watch.hangs(1) for _ in range(turns))


def test_nobody_hangs_who_is_not_expected_to_beat() -> None:
    watch = HangWatch(Heartbeats.create().heart("planner"), 0.7, TURN, lambda _: Effort("S", 0.0))
    assert not any(watch.hangs(1) for _ in range(100))


@pytest.mark.parametrize("name", PROCESSES)
def test_who_says_that_it_is_up_is_expected_to_beat_from_then_on(name: str) -> None:
    heartbeats = Heartbeats.create()
    hears, voice = os.pipe()
    try:
        child = Child(name, Order(load(SIM), None), Path(), heartbeats, [], voice)
        child.report_compiling("a function")
        assert heartbeats.heart(name).count == 0
        child.report_ready({"lacking": ()})
    finally:
        os.close(voice)
    watch = HangWatch(heartbeats.heart(name), 0.7, TURN, lambda _: Effort("S", 0.0))
    assert any(watch.hangs(1) for _ in range(20))
    with open(hears, "rb") as heard:
        assert [*map(msgspec.json.decode, heard)] == [{"compiling": "a function"}, {"lacking": []}]


@contextmanager
def running(program: str) -> Iterator[int]:
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE) as child:
        assert child.stdout is not None
        child.stdout.readline()
        try:
            yield child.pid
        finally:
            child.kill()


def waited(pid: int, state: str) -> Effort:
    """Wait until the kernel says a state of a process."""
    while (now := effort(pid)) is None or now.state != state:
        pass
    return now


@pytest.mark.parametrize("name", ["python", "a) R (b 1 2 3"])
def test_the_kernel_tells_what_works_from_what_is_stopped(name: str) -> None:
    busy = (
        f"from pathlib import Path; Path('/proc/self/comm').write_text({name!r}); print(flush=True)\nwhile True: pass"
    )
    with running(busy) as pid:
        before = waited(pid, "R")
        assert before.kept_waiting
        while waited(pid, "R").used <= before.used:
            pass
        os.kill(pid, signal.SIGSTOP)
        stopped = waited(pid, "T")
        assert not stopped.kept_waiting
    assert effort(pid) is None


def test_what_is_silent_and_works_is_killed_by_what_it_has_used() -> None:
    heart = Heartbeats.create().heart("planner")
    heart.beat()
    with running("print(flush=True)\nwhile True: pass") as pid:
        watch = HangWatch(heart, 0.3, TURN)
        watch.hangs(pid)
        watch.hangs(pid)
        began = effort(pid)
        assert began is not None
        while not watch.hangs(pid):
            pass
        now = effort(pid)
        assert now is not None
        assert now.used - began.used > 0.3 - TURN
