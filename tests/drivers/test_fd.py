"""CAN FD: every data frame that leaves is one, frames of both kinds arrive, and what stays classical is refused."""

from __future__ import annotations

import contextlib
import re
import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import can
import msgspec
import numpy as np
import pytest
from conftest import Rig
from hypothesis import given
from hypothesis import strategies as st
from rigs import alike
from trirail.config import SIM, load, parse
from trirail.errors import ConfigError
from trirail.processes.cycle_frames import receive_frames, send_frames
from trirail.telemetry.candump import CandumpLog
from trirail_drivers.bus.can_frame import BIT_RATE_SWITCH, CAN_FRAME, CANFD_FRAME, ERROR, FD_FORMAT, REMOTE
from trirail_drivers.bus.capture import Capture, CapturedBus
from trirail_drivers.bus.frame_calls import FrameCalls
from trirail_drivers.bus.frame_io import PythonCanFrames, Received, SocketFrames, frame_io
from trirail_drivers.bus.frames import Frame, fd_message, fd_packed, packed, unpacked
from trirail_drivers.bus.packed_frames import BusAccess, PackedFrames, packed_frames
from trirail_drivers.bus.reopening import AbsentBus
from trirail_drivers.bus.unixbus import UnixBus
from trirail_drivers.config import Can, Drives
from trirail_drivers.connection import opening, serving
from trirail_drivers.driver.cyclic import Cyclic
from trirail_drivers.driver.exclusive_bus import ExclusiveBus
from trirail_drivers.errors import BusAbsentError, BusError, DriveError
from trirail_drivers.timing import BusTiming

from drivers import test_foreign

FD = FD_FORMAT | BIT_RATE_SWITCH
TIMING = BusTiming(1_000_000, 5_000_000)
DRIVES = Drives("cia402", *alike())
LENGTHS = (*range(9), 12, 16, 20, 24, 32, 48, 64)
TEXT = SIM.read_text()

identifiers = st.integers(0, 0x7FF)
classical = st.builds(Frame, identifiers, st.binary(max_size=8)).map(lambda frame: bytes(frame.packed))
remote = st.builds(Frame, identifiers, st.just(b""), remote=st.just(True)).map(lambda frame: bytes(frame.packed))
of_fd = st.builds(
    lambda identifier, data, flags: CANFD_FRAME.pack(identifier, len(data), flags, data),
    identifiers,
    st.sampled_from(LENGTHS).flatmap(lambda n: st.binary(min_size=n, max_size=n)),
    st.sampled_from([0, 1, 2, 3, 4, 5, 6, 7]),
)
mixed = st.lists(classical | remote | of_fd, max_size=30)


def understood(packet: bytes) -> Received:
    """What a frame of either kind says, read here by hand."""
    identifier, length = int.from_bytes(packet[:4], "little"), packet[4]
    return identifier, bytearray(packet[8 : 8 + length] if not identifier & REMOTE else b"")


@contextlib.contextmanager
def pair() -> Iterator[tuple[socket.socket, socket.socket]]:
    with contextlib.ExitStack() as stack:
        ends = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        for end in ends:
            stack.enter_context(end)
            end.settimeout(10.0)
        ends[0].setblocking(False)
        yield ends


@contextlib.contextmanager
def unix(folder: Path, *, fd: bool) -> Iterator[tuple[UnixBus, socket.socket]]:
    """A bus and its far end."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
        listener.bind(str(folder / "can"))
        listener.listen()
        with UnixBus(str(folder / "can"), fd=fd) as opened, listener.accept()[0] as far:
            far.settimeout(10.0)
            yield opened, far


@given(packets=mixed)
def test_a_socket_gives_python_frames_of_both_kinds(packets: list[bytes]) -> None:
    with pair() as (near, far):
        frames = SocketFrames(near, fd=True)
        for packet in packets:
            far.send(packet)
        assert [frames.receive() for _ in range(len(packets) + 1)] == [*map(understood, packets), None]


@given(packets=mixed)
def test_a_socket_gives_compiled_code_frames_of_both_kinds(packets: list[bytes]) -> None:
    room, scratch = PackedFrames(32), np.zeros(2, np.int64)
    with pair() as (near, far):
        bus, frames = np.array(BusAccess(near.fileno()), np.int64), SocketFrames(near, fd=True)
        for packet in packets:
            far.send(packet)
        number, error = receive_frames(bus, room.headers, room.frames, scratch)
        assert (number, error) == (len(packets), 0)
        for row, packet in zip(room.frames, packets, strict=False):
            assert row.tobytes()[: len(packet)] == packet
        frames.put_back(room, 0, number, error)
        assert [frames.receive() for _ in range(number + 1)] == [*map(understood, packets), None]


@pytest.mark.parametrize("size", [1, 15, 17, 71])
def test_a_packet_of_another_size_ends_receiving(size: int) -> None:
    room, scratch = PackedFrames(32), np.zeros(2, np.int64)
    with pair() as (near, far):
        far.send(Frame(0x181).packed)
        far.send(bytes(size))
        number, error = receive_frames(np.array(BusAccess(near.fileno()), np.int64), room.headers, room.frames, scratch)
        assert number == 1
        assert error < 0
        far.send(bytes(size))
        with pytest.raises(can.CanOperationError):
            SocketFrames(near).receive()


@pytest.mark.parametrize("timing", [TIMING, BusTiming(1_000_000)], ids=["fd", "classical"])
def test_compiled_code_sends_frames_of_the_bus_and_counts_their_time(timing: BusTiming) -> None:
    own = [Frame(0x080), Frame(0x301, b"\1\2\3\4\5\6"), Frame(0x701, b"\5"), Frame(0x302, bytes(8))]
    sent = packed_frames(own, fd=timing.fd)
    with pair() as (near, far):
        tables = Cyclic(BusAccess(near.fileno()), 0, timing)
        assert send_frames(tables.bus, sent.headers, sent.frames, tables.times) == len(own)
        expected = [fd_packed(frame.packed) if timing.fd else bytes(frame.packed) for frame in own]
        assert [far.recv(100) for _ in own] == expected
        assert tables.times[0]["traffic"] == sum(timing.frame_ns(n) for n in (0, 6, 1, 8))


def test_frames_are_filled_again_in_the_format_of_the_bus() -> None:
    sent = packed_frames([Frame(0x301, bytes(8))], fd=True)
    sent.fill([Frame(0x301, b"\1\2\3")], fd=True)
    assert CANFD_FRAME.unpack(sent.frames[0].tobytes()) == (0x301, 3, FD, b"\1\2\3".ljust(64, b"\0"))


@pytest.mark.parametrize("captured", [False, True])
def test_data_frames_leave_as_frames_of_can_fd_and_others_do_not(captured: bool, tmp_path: Path) -> None:
    capture = Capture()
    with unix(tmp_path, fd=True) as (opened, far):
        bus: can.BusABC = CapturedBus(opened, capture) if captured else opened
        frames = frame_io(bus)
        assert isinstance(frames, SocketFrames)
        frames.send(Frame(0x201, b"\1\2"))
        bus.send(Frame(0x202, b"\3").message())
        frames.send(Frame(0x701, remote=True))
        assert CANFD_FRAME.unpack(far.recv(100)) == (0x201, 2, FD, b"\1\2".ljust(64, b"\0"))
        assert CANFD_FRAME.unpack(far.recv(100)) == (0x202, 1, FD, b"\3".ljust(64, b"\0"))
        assert far.recv(100) == bytes(Frame(0x701, remote=True).packed)
        far.send(Frame(0x581, b"\7").packed)
        far.send(fd_packed(Frame(0x582, b"\x08").packed))
        assert [frames.receive(), frames.receive()] == [(0x581, bytearray(b"\7")), (0x582, bytearray(b"\x08"))]
    if captured:
        assert logged(capture, tmp_path) == ["201##10102", "202##103", "701#R", "581#07", "582##108"]


def logged(capture: Capture, folder: Path) -> list[str]:
    """The frames as candump writes them; python-can reads them too."""
    log = CandumpLog(folder / "x.log", "can0")
    for batch in capture.drain():
        log.write(batch)
    log.close()
    lines = (folder / "x.log").read_text().splitlines()
    messages = list(can.CanutilsLogReader(folder / "x.log"))
    assert [(each.is_fd, each.bitrate_switch) for each in messages] == [("##" in line, "##1" in line) for line in lines]
    return [line.split()[2] for line in lines]


def test_a_bus_of_python_can_receives_frames_of_both_kinds(tmp_path: Path) -> None:
    with unix(tmp_path, fd=True) as (opened, far):
        far.send(Frame(0x581, b"\7").packed)
        far.send(fd_packed(Frame(0x582, b"\x08").packed))
        one, other = opened.recv(10.0), opened.recv(10.0)
        assert one is not None
        assert other is not None
        assert (one.is_fd, one.arbitration_id, bytes(one.data)) == (False, 0x581, b"\7")
        assert (other.is_fd, other.bitrate_switch, bytes(other.data)) == (True, True, b"\x08")


def test_a_classical_end_sends_no_frame_of_can_fd(tmp_path: Path) -> None:
    with (
        unix(tmp_path, fd=False) as (opened, _),
        pytest.raises(can.CanOperationError, match="CAN FD frames cannot be sent"),
    ):
        opened.send(fd_message(Frame(0x201).message()))


@given(identifiers, st.binary(max_size=8), st.booleans())
def test_packing_a_message_is_undone_by_unpacking_it(identifier: int, data: bytes, fd: bool) -> None:
    message = Frame(identifier, data).message()
    message = fd_message(message) if fd else message
    again = unpacked(packed(message))
    assert again.equals(message, timestamp_delta=None)
    assert (again.is_fd, again.bitrate_switch) == (fd, fd)
    assert fd_message(again).is_fd


def test_error_frames_do_not_change() -> None:
    error = CAN_FRAME.pack(0x20 | ERROR, 8, bytes(8))
    assert fd_packed(error) == error


def fd_robot() -> Can:
    return msgspec.structs.replace(load(SIM).can, fd=True)


def test_simulated_drives_answer_with_frames_of_can_fd() -> None:
    config = load(SIM)
    rig = Rig(msgspec.structs.replace(config, can=fd_robot()))
    arrived: list[can.Message] = []
    receive = rig.bus._recv_internal

    def note(timeout: float | None) -> tuple[can.Message | None, bool]:
        message, filtered = receive(timeout)
        if message is not None:
            arrived.append(message)
        return message, filtered

    rig.bus._recv_internal = note  # type: ignore[method-assign]
    rig.order("enable")
    for _ in range(100):
        rig.cycle()
    assert len(arrived) > 300
    assert all(each.is_fd and each.bitrate_switch for each in arrived)
    rig.bus.shutdown()


@pytest.mark.parametrize("fd", [False, True])
def test_served_drives_answer_in_the_format_of_their_bus(fd: bool) -> None:
    """Whatever the format of what they are asked in."""
    with pair() as (near, far):
        near.settimeout(10.0)
        thread = threading.Thread(
            target=serving.exchange, args=(far, Can("unix", fd=fd), DRIVES, lambda: None), daemon=True
        )
        thread.start()
        booted = [near.recv(100) for _ in range(3)]
        request = Frame(0x601, bytes.fromhex("4000100000000000"))
        answers = []
        for packet in (bytes(request.packed), fd_packed(request.packed)):
            near.send(packet)
            answers.append(near.recv(100))
        assert {len(packet) for packet in (*booted, *answers)} == {CANFD_FRAME.size if fd else CAN_FRAME.size}
        assert answers[0] == answers[1]
        assert understood(answers[0])[1].hex() == "4300100092010200"
        near.close()
        thread.join(10.0)
        assert not thread.is_alive()


def configured(can: str = "", **changes: str) -> str:
    text = TEXT.replace("[can]\n", f"[can]\n{can}\n")
    for before, after in changes.items():
        text = text.replace(before, after)
    return text


def test_what_is_configured_is_what_the_bus_has() -> None:
    assert parse(TEXT).can.timing == BusTiming(1_000_000)
    assert parse(configured("fd = true")).can.timing == TIMING
    assert parse(configured("fd = true\ndata_bitrate = 8_000_000")).can.timing == BusTiming(1_000_000, 8_000_000)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            configured("data_bitrate = 5_000_000"),
            "can.data_bitrate = 5000000: only CAN FD frames have a data bit rate; set can.fd = true, or omit",
        ),
        (
            configured("fd = true\ndata_bitrate = 500_000"),
            "can.data_bitrate = 500000: expected at least can.bitrate, 1000000 bit/s",
        ),
        (
            configured("fd = true", **{'interface = "simulated"': 'interface = "slcan"\nchannel = "x"'}),
            'can.fd = true: interface "slcan" is used for classical CAN only; CAN FD needs interface = "socketcan"',
        ),
        (
            configured("fd = true", **{'protocol = "cia402"': 'protocol = "odrive"'}),
            'can.fd = true: not with drives.protocol = "odrive": the driver requests each position by a remote frame',
        ),
    ],
)
def test_what_stays_classical_is_refused_before_any_drive_is_contacted(text: str, said: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(said)):
        parse(text)


@pytest.mark.parametrize("name", ["fd", "data_bitrate"])
def test_can_fd_is_no_option_of_python_can(name: str) -> None:
    text = TEXT.replace('interface = "simulated"', 'interface = "gs_usb"')
    with pytest.raises(ConfigError, match=rf"can\.options\.{name}: not allowed here"):
        parse(f"{text}\n[can.options]\n{name} = true\n")


def test_an_interface_of_python_can_is_refused_by_who_opens_it() -> None:
    with pytest.raises(BusError, match='interface "virtual" is used for classical CAN only'):
        opening.open_bus(Can("virtual", fd=True), DRIVES)


@pytest.mark.parametrize(("mtu", "fd", "refused"), [(16, True, True), (72, True, False), (16, False, False)])
def test_an_interface_that_is_up_without_can_fd_is_refused_with_its_remedy(
    mtu: int, fd: bool, refused: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "can0"
    folder.mkdir()
    for name, content in (("flags", "0x40081"), ("carrier", "1"), ("mtu", str(mtu))):
        (folder / name).write_text(f"{content}\n")
    monkeypatch.setattr(opening, "NETWORK_INTERFACES", tmp_path)

    class Opened(can.BusABC):
        def __init__(self, *given: object, **options: object) -> None:
            self.channel_info = "opened"
            super().__init__("can0")

        def send(self, msg: can.Message, timeout: float | None = None) -> None: ...

    monkeypatch.setattr(can, "Bus", Opened)
    monkeypatch.setattr(opening, "FdSocketcanBus", Opened)
    section = Can("socketcan", channel="can0", fd=fd, data_bitrate=4_000_000 if fd else None)
    if refused:
        with pytest.raises(BusAbsentError) as caught:
            opening.open_bus(section, DRIVES)
        text = str(caught.value)
        assert 'CAN interface "can0" is set up for classical CAN only (MTU 16)' in text
        assert "ip link set can0 up type can bitrate 1000000 dbitrate 4000000 fd on" in text
        assert "\n" not in text
    else:
        opening.open_bus(section, DRIVES).shutdown()


def test_node_guarding_is_refused(closing: Callable[[test_foreign.Rig], test_foreign.Rig]) -> None:
    """Its drive has no heartbeat consumer; on classical CAN it is guarded."""
    guarded = closing(test_foreign.Rig("technosoft_ipos"))
    guarded.ready()
    rig = closing(test_foreign.Rig("technosoft_ipos"))
    rig.wires._can_protocol = can.CanProtocol.CAN_FD
    with pytest.raises(DriveError, match=r"drive A lacks protections: 1016, .*CAN FD has no remote frames"):
        rig.ready()
    assert not any(message.is_remote_frame for message in rig.wires.sent if isinstance(message, can.Message))


def test_a_bus_that_is_no_socket_is_one_of_can_fd_for_compiled_code(tmp_path: Path) -> None:
    """Rows of both kinds have the same distance, so Python's functions find them."""
    with unix(tmp_path, fd=True) as (opened, far):
        calls = FrameCalls(PythonCanFrames(opened))
        sent = packed_frames([Frame(0x200 + i, bytes([i])) for i in range(4)], fd=True)
        tables = Cyclic(calls.access, 0, TIMING)
        assert send_frames(tables.bus, sent.headers, sent.frames, tables.times) == 4
        assert [CANFD_FRAME.unpack(far.recv(100))[:3] for _ in range(4)] == [(0x200 + i, 1, FD) for i in range(4)]
        far.send(Frame(0x581, b"\7").packed)
        far.send(fd_packed(Frame(0x582, b"\x08").packed))
        room = PackedFrames(32)
        assert receive_frames(tables.bus, room.headers, room.frames, np.zeros(2, np.int64)) == (2, 0)
        assert [row.tobytes()[:9][-1] for row in room.frames[:2]] == [7, 8]


@pytest.mark.parametrize("protocol", [can.CanProtocol.CAN_20, can.CanProtocol.CAN_FD])
@pytest.mark.parametrize("wrap", [lambda bus: CapturedBus(bus, Capture()), lambda bus: ExclusiveBus(bus, lambda _: "")])
def test_a_bus_around_another_has_its_protocol(
    wrap: Callable[[can.BusABC], can.BusABC], protocol: can.CanProtocol
) -> None:
    with AbsentBus("can0") as inner:
        inner._can_protocol = protocol
        with wrap(inner) as outer:
            assert outer.protocol is protocol
