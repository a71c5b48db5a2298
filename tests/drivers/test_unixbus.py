"""The bus between processes: frames whole and unchanged, to all but the sender; clear words without it."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import can
import pytest
from trirail_drivers.bus.unixbus import UnixBus
from trirail_drivers.errors import BusError

ROOT = Path(__file__).parents[2]
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
        can.Message(arbitration_id=0x7FF, data=b"\x01\x02\x03", is_extended_id=False),
        can.Message(arbitration_id=0x080, is_extended_id=False),
        can.Message(arbitration_id=0x1ABCDEF0, data=bytes(range(8)), is_extended_id=True),
        can.Message(arbitration_id=0x185, is_remote_frame=True, dlc=6, is_extended_id=False),
        can.Message(arbitration_id=0x040, is_error_frame=True, data=bytes(8), is_extended_id=False),
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
        one.send(can.Message(arbitration_id=0x123, data=b"\x07", is_extended_id=False))
        for receiver in (hub, two, three):
            arrived = receiver.recv(WAIT)
            assert arrived is not None
            assert (arrived.arbitration_id, bytes(arrived.data)) == (0x123, b"\x07")
        assert one.recv(0.0) is None


def test_frames_keep_their_order(hub: UnixBus, path: str) -> None:
    with connected(hub, path) as peer:
        for n in range(50):
            peer.send(can.Message(arbitration_id=n, is_extended_id=False))
        arrived = [hub.recv(WAIT) for _ in range(50)]
        assert [message.arbitration_id for message in arrived if message] == list(range(50))


def test_a_peer_that_leaves_or_does_not_read_hinders_nobody(hub: UnixBus, path: str) -> None:
    connected(hub, path).shutdown()
    with connected(hub, path), connected(hub, path) as reader:
        for n in range(2000):
            hub.send(can.Message(arbitration_id=n % 0x800, is_extended_id=False))
            assert reader.recv(WAIT) is not None


def test_nobody_listening_is_told_with_the_remedy(path: str) -> None:
    with pytest.raises(BusError, match=r"nobody listens there; start tools/virtual_drives\.py"):
        UnixBus(path)


def test_two_cannot_listen_at_one_path(hub: UnixBus, path: str) -> None:
    with pytest.raises(BusError, match="somebody listens there already"):
        UnixBus(path, listen=True)


def test_a_folder_that_is_not_there_is_told(tmp_path: Path) -> None:
    with pytest.raises(BusError, match="cannot listen there"):
        UnixBus(str(tmp_path / "nowhere" / "can"), listen=True)


def test_a_socket_left_behind_is_taken_over(path: str) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as dead:
        dead.bind(path)
    with UnixBus(path, listen=True) as hub, connected(hub, path) as peer:
        peer.send(can.Message(arbitration_id=1, is_extended_id=False))
        assert hub.recv(WAIT) is not None
    assert not Path(path).exists()


def test_the_end_of_the_bus_is_an_error_to_its_peers(hub: UnixBus, path: str) -> None:
    with connected(hub, path) as peer:
        hub.shutdown()
        with pytest.raises(can.CanOperationError, match="the listening end is gone"):
            peer.recv(WAIT)
        with pytest.raises(can.CanOperationError, match="cannot send"):
            peer.send(can.Message(arbitration_id=1, is_extended_id=False))


def test_virtual_drives_serve_a_bus_and_leave_on_sigterm(path: str) -> None:
    command = [sys.executable, "tools/virtual_drives.py", "configs/sim.toml"]
    with subprocess.Popen(
        [*command, "--interface", "unix", "--channel", path], cwd=ROOT, stdout=subprocess.PIPE, text=True
    ) as program:
        assert program.stdout is not None
        assert program.stdout.readline() == "A switch on disabled, 0.000 mm\n"
        with UnixBus(path) as bus:
            request = b"\x40\x00\x10\x00\x00\x00\x00\x00"
            bus.send(can.Message(arbitration_id=0x602, data=request, is_extended_id=False))
            answer = bus.recv(WAIT)
            assert answer is not None
            assert (answer.arbitration_id, bytes(answer.data)) == (0x582, b"\x43\x00\x10\x00\x92\x01\x02\x00")
        program.send_signal(signal.SIGTERM)
        assert program.wait(WAIT) == 0
    assert not Path(path).exists()
