"""Waiting for a tick: who calls with time left is heard at once, and nothing makes a tick come early."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from trirail.processes.clock import PollSet
from trirail.wire import links
from trirail.wire.links import PacketLink, Port

NAMES = ("gateway", "recorder", "planner")
SOON = 5_000_000
LATER = 10_000_000_000
SPARE = 500_000


@pytest.fixture
def ports(tmp_path: Path) -> Iterator[list[Port]]:
    made = [Port(links.listen(tmp_path / name)) for name in NAMES]
    yield made
    for port in made:
        port.close()


@pytest.fixture
def peers(ports: list[Port], tmp_path: Path) -> Iterator[list[PacketLink]]:
    made = [links.connect(tmp_path / name) for name in NAMES]
    for port in ports:
        port.accept()
    yield made
    for peer in made:
        peer.close()


def test_a_tick_is_waited_for_where_nobody_is_connected(ports: list[Port]) -> None:
    deadline = time.monotonic_ns() + SOON
    assert not PollSet(ports).wait(deadline, SPARE)
    assert time.monotonic_ns() >= deadline


@pytest.mark.parametrize("place", range(len(NAMES)))
@pytest.mark.parametrize("gone", [False, True])
def test_who_calls_or_goes_is_heard_long_before_the_tick(
    ports: list[Port], peers: list[PacketLink], place: int, gone: bool
) -> None:
    poll_set, deadline = PollSet(ports), time.monotonic_ns() + LATER
    assert not poll_set.called()
    if gone:
        peers[place].close()
    else:
        peers[place].send(b"now")
    assert poll_set.called()
    assert poll_set.wait(deadline, SPARE)
    assert time.monotonic_ns() < deadline


def test_who_calls_too_late_does_not_delay_the_tick(ports: list[Port], peers: list[PacketLink]) -> None:
    peers[0].send(b"late")
    deadline = time.monotonic_ns() + SPARE
    assert not PollSet(ports).wait(deadline, SPARE)
    assert time.monotonic_ns() >= deadline


@pytest.mark.usefixtures("peers")
def test_signals_do_not_make_a_tick_come_early(ports: list[Port]) -> None:
    before = signal.signal(signal.SIGALRM, lambda *_: None)
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.001, 0.001)
        deadline = time.monotonic_ns() + 4 * SOON
        assert not PollSet(ports).wait(deadline, SPARE)
        assert time.monotonic_ns() >= deadline
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
