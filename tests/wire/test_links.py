"""Packets over real socket pairs: whole, in order, bounded, and never waited for."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from trirail.wire import links
from trirail.wire.links import LinkClosed, Port


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "port"


@pytest.fixture
def port(path: Path) -> Iterator[Port]:
    port = Port(links.listen(path))
    yield port
    port.close()


def test_packets_stay_whole_and_in_order(port: Port, path: Path) -> None:
    assert not port.accept()
    link = links.connect(path)
    assert not port.connected
    assert port.accept()
    assert not port.accept()
    for i in range(100):
        assert port.send(bytes([i]) * (i + 1))
    assert [link.receive() for _ in range(100)] == [bytes([i]) * (i + 1) for i in range(100)]
    assert link.receive() is None
    assert link.send(b"back")
    assert port.receive() == b"back"
    assert port.receive() is None
    link.close()


def test_a_peer_that_does_not_read_costs_a_counted_drop(port: Port, path: Path) -> None:
    link = links.connect(path)
    port.accept()
    sent = 0
    while port.send(bytes(60_000)):
        sent += 1
        assert sent < 10_000
    assert sent
    assert port.dropped == 1
    assert port.connected
    assert link.receive() == bytes(60_000)
    link.close()


def test_a_lost_peer_is_told_once_and_can_come_back(port: Port, path: Path) -> None:
    link = links.connect(path)
    port.accept()
    assert not port.clear_lost()
    link.close()
    assert port.receive() is None
    assert port.clear_lost()
    assert not port.clear_lost()
    assert not port.send(b"x")
    again = links.connect(path)
    assert port.accept()
    assert port.send(b"welcome back")
    assert again.receive() == b"welcome back"
    again.close()
    assert not port.send(b"x")  # a peer that is lost in sending is lost too
    assert port.clear_lost()


def test_a_peer_is_awaited_until_it_comes(port: Port, path: Path) -> None:
    assert not port.await_peer(0.0)
    link = links.connect(path)
    assert port.await_peer(1e6)
    assert port.connected
    link.close()


def test_the_peer_sees_the_end(port: Port, path: Path) -> None:
    link = links.connect(path)
    port.accept()
    port.close()
    with pytest.raises(LinkClosed):
        link.receive()
    link.close()


def test_nobody_listens(path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        links.connect(path)


def test_the_number_of_packets_per_turn_is_limited(port: Port, path: Path) -> None:
    link = links.connect(path)
    assert port.accept()
    assert list(link.packets()) == []
    for i in range(links.PACKETS_PER_TURN + 2):
        assert port.send(bytes([i + 1]))
    assert [packet[0] for packet in link.packets()] == [*range(1, links.PACKETS_PER_TURN + 1)]
    assert len(list(link.packets())) == 2
    port.close()
    with pytest.raises(LinkClosed):
        list(link.packets())
    link.close()
