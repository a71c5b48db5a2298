"""What a child says to the supervisor: whole lines of any length, without waiting for one that reads nothing."""

from __future__ import annotations

import fcntl
import os
import random
import select
from collections.abc import Iterator

import msgspec
import pytest
from trirail.processes import child_process
from trirail.processes.child_process import COMPILING, LOG_WITHIN, MEASURED, Child


class Said(msgspec.Struct):
    """Measurements of any length."""

    number: int
    content: str


@pytest.fixture
def pipe() -> Iterator[tuple[int, int]]:
    ends = os.pipe()
    os.set_blocking(ends[0], False)
    yield ends
    for end in ends:
        os.close(end)


def heard(pipe: int) -> bytes:
    try:
        return os.read(pipe, 1 << 20)
    except BlockingIOError:
        return b""


@pytest.mark.generated(0, 1, 2, 3)
def test_what_is_long_is_sent_whole_or_not_at_all_and_waits_for_nobody(
    pipe: tuple[int, int], monkeypatch: pytest.MonkeyPatch, seed: int
) -> None:
    monkeypatch.setattr(child_process, "LOG_WITHIN", 0.0)
    chance, (read, write) = random.Random(seed), pipe
    fcntl.fcntl(write, fcntl.F_SETPIPE_SZ, chance.choice((4096, 8192, 65_536)))
    child = Child("gateway", None, None, None, [], write)  # type: ignore[arg-type]
    came = b""
    for number in range(100):
        said = Said(number, "x" * chance.choice((10, 3000, 4096, 6000, 20_000)))
        chance.choice((child.report_measurements, child.log))(said)  # type: ignore[arg-type]
        if chance.random() < 0.3:
            came += heard(read)
    while child._unsent:
        came += heard(read)
        child.report_measurements(Said(100, ""))
    came += heard(read)
    *lines, rest = came.split(b"\n")
    assert not rest
    found = [next(iter(msgspec.json.decode(line).values()))["number"] for line in lines]
    assert found == sorted(set(found))
    assert found


def test_measurements_longer_than_a_pipe_takes_at_once_arrive(pipe: tuple[int, int]) -> None:
    child = Child("gateway", None, None, None, [], pipe[1])  # type: ignore[arg-type]
    said = Said(1, "x" * 10_000)
    child.report_measurements(said)
    assert msgspec.json.decode(heard(pipe[0])) == {MEASURED: msgspec.to_builtins(said)}


def test_a_message_that_must_arrive_follows_the_rest_of_another(pipe: tuple[int, int]) -> None:
    """A line in the middle of another would be two that nobody can read."""
    read, write = pipe
    fcntl.fcntl(write, fcntl.F_SETPIPE_SZ, 8192)
    child = Child("gateway", None, None, None, [], write)  # type: ignore[arg-type]
    said = Said(1, "x" * 10_000)
    child.report_measurements(said)
    came = heard(read)
    assert child._unsent
    child.report_compiling("a function")
    came += heard(read)
    assert [*map(msgspec.json.decode, came.splitlines())] == [
        {MEASURED: msgspec.to_builtins(said)},
        {COMPILING: "a function"},
    ]


@pytest.mark.generated(0, 1, 2, 3)
def test_a_supervisor_that_reads_nothing_is_waited_for_once(
    pipe: tuple[int, int], monkeypatch: pytest.MonkeyPatch, seed: int
) -> None:
    """Each wait would delay the next stop in the gateway."""
    waited: list[float] = []
    at_once = select.select

    def count(read: list[int], write: list[int], other: list[int], seconds: float) -> tuple[list[int], ...]:
        ready = at_once(read, write, other, 0.0)
        waited.append(0.0 if ready[1] else seconds)
        return ready

    monkeypatch.setattr(select, "select", count)
    chance, (read, write) = random.Random(seed), pipe
    fcntl.fcntl(write, fcntl.F_SETPIPE_SZ, chance.choice((4096, 8192, 65_536)))
    child = Child("gateway", None, None, None, [], write)  # type: ignore[arg-type]
    for _ in range(3):
        waited.clear()
        for number in range(200):
            child.log(Said(number, "x" * chance.choice((10, 300, 3000, 6000))))  # type: ignore[arg-type]
        assert sum(waited) == pytest.approx(LOG_WITHIN)
        while heard(read):
            pass
        child.log(Said(200, ""))  # type: ignore[arg-type]
        assert b'"number":200' in heard(read), "what follows a pause is not lost"
