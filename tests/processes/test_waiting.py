"""Waiting for a call: who calls is heard at once, and nothing ends the wait before its deadline otherwise."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from trirail.processes.clock import PollSet, called, wait_for_call
from trirail.wire import links
from trirail.wire.links import PacketLink, Port

NAMES = ("gateway", "recorder", "planner")
SOON = 5_000_000
LATER = 10_000_000_000


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


def waited(ports: list[Port], deadline_ns: int) -> bool:
    """Whether somebody calls before a deadline."""
    poll_set = PollSet(ports)
    poll_set.refresh()
    return bool(wait_for_call(deadline_ns, poll_set.pollfds, np.zeros(2, np.int64)))


def test_the_deadline_is_waited_for_where_nobody_is_connected(ports: list[Port]) -> None:
    deadline = time.monotonic_ns() + SOON
    assert not waited(ports, deadline)
    assert time.monotonic_ns() >= deadline


@pytest.mark.parametrize("place", range(len(NAMES)))
@pytest.mark.parametrize("gone", [False, True])
def test_who_calls_or_goes_is_heard_long_before_the_deadline(
    ports: list[Port], peers: list[PacketLink], place: int, gone: bool
) -> None:
    poll_set, deadline = PollSet(ports), time.monotonic_ns() + LATER
    poll_set.refresh()
    assert not called(poll_set.pollfds)
    if gone:
        peers[place].close()
    else:
        peers[place].send(b"now")
    assert called(poll_set.pollfds)
    assert waited(ports, deadline)
    assert time.monotonic_ns() < deadline


def test_a_deadline_that_is_over_is_not_waited_for(ports: list[Port], peers: list[PacketLink]) -> None:
    peers[0].send(b"late")
    assert not waited(ports, time.monotonic_ns())


@pytest.mark.usefixtures("peers")
def test_signals_do_not_end_the_wait(ports: list[Port]) -> None:
    before = signal.signal(signal.SIGALRM, lambda *_: None)
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.001, 0.001)
        deadline = time.monotonic_ns() + 4 * SOON
        assert not waited(ports, deadline)
        assert time.monotonic_ns() >= deadline
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
