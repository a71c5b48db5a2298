"""What a child says to the supervisor: whole lines of any length, without waiting for one that reads nothing."""

from __future__ import annotations

import fcntl
import os
import random
from collections.abc import Iterator

import msgspec
import pytest
from trirail.processes import child_process
from trirail.processes.child_process import COMPILING, MEASURED, Child


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
