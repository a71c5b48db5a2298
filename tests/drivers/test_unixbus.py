"""The bus between processes: frames whole and unchanged, to all but the sender; clear words without it."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from pathlib import Path

import can
import pytest
from rigs import frame
from trirail_drivers.bus.unixbus import UnixBus
from trirail_drivers.errors import BusError

WAIT = 60.0
"""Longest wait for a frame that has to come [s]."""


@pytest.fixture
def path(tmp_path: Path) -> str:
    return str(tmp_path / "can")


@pytest.fixture
def hub(path: str) -> Iterator[UnixBus]:
    with UnixBus(path, listen=True) as bus:
        yield bus


def connected(hub: UnixBus, path: str) -> UnixBus:
    """A peer that the hub has accepted."""
    peer = UnixBus(path)
    hub.recv(0.0)
    return peer


@pytest.mark.parametrize(
    "message",
    [
        frame(0x7FF, b"\x01\x02\x03"),
        frame(0x080),
        frame(0x1ABCDEF0, bytes(range(8)), is_extended_id=True),
        can.Message(arbitration_id=0x185, is_remote_frame=True, dlc=6, is_extended_id=False),
        frame(0x040, bytes(8), is_error_frame=True),
    ],
    ids=str,
)
def test_a_frame_arrives_as_it_was_sent_both_ways(hub: UnixBus, path: str, message: can.Message) -> None:
    with connected(hub, path) as peer:
        for sender, receiver in ((peer, hub), (hub, peer)):
            sender.send(message)
            arrived = receiver.recv(WAIT)
            assert arrived is not None
            assert arrived.equals(message, timestamp_delta=None, check_direction=False)
            assert arrived.timestamp > 0.0


def test_the_listening_end_relays_to_all_but_the_sender(hub: UnixBus, path: str) -> None:
    with connected(hub, path) as one, connected(hub, path) as two, connected(hub, path) as three:
        one.send(frame(0x123, b"\x07"))
        for receiver in (hub, two, three):
            arrived = receiver.recv(WAIT)
            assert arrived is not None
            assert (arrived.arbitration_id, bytes(arrived.data)) == (0x123, b"\x07")
        assert one.recv(0.0) is None


def test_a_peer_that_leaves_or_does_not_read_hinders_nobody(hub: UnixBus, path: str) -> None:
    connected(hub, path).shutdown()
    with connected(hub, path), connected(hub, path) as reader:
        for n in range(2000):
            hub.send(frame(n % 0x800))
            assert reader.recv(WAIT) is not None


def test_a_path_with_nobody_with_somebody_or_that_is_none_is_told_with_the_remedy(path: str) -> None:
    with pytest.raises(BusError, match=r"no process listens there; start tools/virtual_drives\.py"):
        UnixBus(path)
    with UnixBus(path, listen=True), pytest.raises(BusError, match="another process already listens"):
        UnixBus(path, listen=True)
    with pytest.raises(BusError, match="cannot listen there"):
        UnixBus(f"{path}/can", listen=True)


def test_a_socket_left_behind_is_taken_over(path: str) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as dead:
        dead.bind(path)
    with UnixBus(path, listen=True) as hub, connected(hub, path) as peer:
        peer.send(frame(1))
        assert hub.recv(WAIT) is not None
    assert not Path(path).exists()
