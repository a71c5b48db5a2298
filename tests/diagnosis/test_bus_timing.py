"""The timing on the bus: computed from the timestamps, and measured without a disturbance of drives or masters."""

from __future__ import annotations

import itertools
import socket
import struct
import threading
import time
from collections.abc import Iterator, Sequence
from types import SimpleNamespace
from typing import Any

import carriers
import pytest
from hypothesis import given
from hypothesis import strategies as st
from trirail.config import LoopTable
from trirail.diagnosis import bus_timing
from trirail.diagnosis.bus_timing import TEST_FRAMES, MeasuredTiming, compute_timing
from trirail_drivers.bus import loopback
from trirail_drivers.bus.can_frame import CAN_FRAME, ERROR, REMOTE
from trirail_drivers.bus.loopback import StampedFrame
from trirail_drivers.cia402 import canopen_frames as layout
from trirail_drivers.odrive import cansimple
from trirail_drivers.protocols import CIA402
from trirail_drivers.timing import DEFAULT_TIMING, BusTiming

SYNC, SETPOINTS = layout.SYNC, CIA402.setpoints
LOOP = LoopTable(rate_hz=100, realtime="off")


def frame(identifier: int, t_us: float, size: int = 8, *, local: bool = True, hardware: bool = False) -> StampedFrame:
    return StampedFrame(identifier, bytes(size), round(t_us * 1e3), local, hardware)


def cycles(late_us: Sequence[float], last_us: Sequence[float], **marks: bool) -> list[StampedFrame]:
    """Cycles of 1 kHz: SYNC is so late, and the last setpoint follows it after such a time."""
    frames = []
    for number, (late, last) in enumerate(zip(late_us, last_us, strict=True)):
        t = 1000.0 * number + late
        frames.append(frame(SYNC, t, 0, **marks))
        frames += [frame(layout.RPDO2 + node, t + last - 3 + node, **marks) for node in (1, 2, 3)]
    return frames


@given(st.lists(st.tuples(st.integers(0, 150), st.integers(10, 840)), min_size=1, max_size=40))
def test_intervals_and_setpoints_are_those_of_the_timestamps(each: list[tuple[int, int]]) -> None:
    late, last = [0.0, *(float(a) for a, _ in each), 0.0], [10.0, *(float(b) for _, b in each)]
    timing = compute_timing([cycles(late, [*last, 10.0])], "service", SYNC, SETPOINTS)
    assert timing is not None
    errors = [abs(after - before) for before, after in itertools.pairwise(late)]
    assert timing.interval_error_us.max == pytest.approx(max(errors))
    assert timing.setpoints_us is not None
    assert timing.setpoints_us.max == pytest.approx(max(last))
    assert (timing.rate_hz, timing.syncs, timing.without_setpoints) == (1000, len(late), 0)


def test_a_missed_tick_is_an_interval_of_two_periods() -> None:
    frames = [each for each in cycles([0.0] * 20, [100.0] * 20) if not 4900.0 < each.t * 1e-3 < 5900.0]
    timing = compute_timing([frames], "service", SYNC, SETPOINTS)
    assert timing is not None
    assert timing.rate_hz == 1000
    assert timing.interval_error_us.max == pytest.approx(1000.0)


def test_a_setpoint_behind_the_next_sync_is_counted() -> None:
    timing = compute_timing([cycles([0.0] * 10, [100.0] * 4 + [1001.0] + [100.0] * 5)], "service", SYNC, SETPOINTS)
    assert timing is not None
    assert timing.without_setpoints == 1


def test_only_the_frames_of_this_machine_that_every_cycle_sends_are_setpoints() -> None:
    more = [
        frame(SYNC, 500.0, 0, local=False),
        frame(layout.RPDO2 + 1, 900.0, local=False),
        frame(layout.RPDO1 + 1, 950.0, 2),
        frame(layout.SDO_REQUEST + 1, 980.0),
        frame(layout.HEARTBEAT + 127, 990.0, 1),
    ]
    timing = compute_timing([cycles([0.0] * 10, [100.0] * 10) + more], "service", SYNC, SETPOINTS)
    assert timing is not None
    assert timing.syncs == 10
    assert timing.setpoints_us is not None
    assert timing.setpoints_us.max == pytest.approx(100.0)


def test_runs_are_not_joined_and_one_sync_is_no_interval() -> None:
    run = cycles([0.0, 0.0], [100.0, 100.0])
    later = [each._replace(t=each.t + 12_345_678) for each in run]
    timing = compute_timing([run, later], "test frames", SYNC, SETPOINTS)
    assert timing is not None
    assert timing.interval_error_us.max == 0.0
    assert compute_timing([run[:4], later[:4]], "test frames", SYNC, SETPOINTS) is None
    assert compute_timing([], "service", SYNC, SETPOINTS) is None


def test_without_setpoints_the_intervals_remain() -> None:
    frames = [each for each in cycles([0.0] * 5, [1.0] * 5) if each.identifier == SYNC]
    timing = compute_timing([frames], "service", SYNC, SETPOINTS)
    assert timing is not None
    assert timing.setpoints_us is None
    assert timing.without_setpoints == 0


@pytest.mark.parametrize("hardware", [True, False])
def test_the_origin_of_the_timestamps_is_told(hardware: bool) -> None:
    timing = compute_timing([cycles([0.0] * 3, [1.0] * 3, hardware=hardware)], "service", SYNC, SETPOINTS)
    assert timing is not None
    assert timing.timestamps == ("hardware" if hardware else "software")


def ancillary(software: tuple[int, int], hardware: tuple[int, int]) -> list[tuple[int, int, bytes]]:
    # linux/errqueue.h: struct scm_timestamping has three struct timespec
    content = struct.pack("@6l", *software, 0, 0, *hardware)
    return [(socket.SOL_SOCKET, 35, bytes(16)), (socket.SOL_SOCKET, 37, content)]


def test_packets_are_read_with_the_best_timestamp_they_have() -> None:
    packet = CAN_FRAME.pack(0x301, 2, b"\1\2" + bytes(6))
    by_kernel = loopback.parse(packet, ancillary((5, 7), (0, 0)), socket.MSG_DONTROUTE)
    assert by_kernel == StampedFrame(0x301, b"\1\2", 5_000_000_007, True, False)
    by_card = loopback.parse(packet, ancillary((5, 7), (2, 3)), 0)
    assert by_card == StampedFrame(0x301, b"\1\2", 2_000_000_003, False, True)
    assert loopback.parse(packet, [], 0) is None
    assert loopback.parse(CAN_FRAME.pack(0x80 | ERROR, 8, bytes(8)), ancillary((5, 7), (0, 0)), 0) is None
    assert loopback.parse(packet[:-1], ancillary((5, 7), (0, 0)), 0) is None


def test_no_device_of_either_protocol_uses_the_test_frames() -> None:
    used = {cansimple.RX_SDO, cansimple.TX_SDO, cansimple.ADDRESS, cansimple.HEARTBEAT, cansimple.GET_VERSION}
    used |= {cansimple.SET_AXIS_STATE, cansimple.SET_INPUT_POS, cansimple.CLEAR_ERRORS, cansimple.GET_ERROR}
    for identifier in TEST_FRAMES:
        assert 0x780 <= identifier <= 0x7FF  # restricted in CiA 301, table 4
        assert identifier not in (0x7E4, 0x7E5)  # CiA 305
        assert identifier >> 5 != 0x3F  # the node id of an ODrive without an address
        assert identifier & 0x1F not in used


class FakeLoopback:
    """Loopback on which frames have been heard; nothing can be sent."""

    heard: Sequence[StampedFrame] = ()

    def __init__(self, channel: str) -> None:
        self._left = list(self.heard)
        if channel == "gone":
            raise OSError(19, "No such device")

    def __enter__(self) -> FakeLoopback:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def listen(self, seconds: float) -> Iterator[StampedFrame]:
        while self._left:
            yield self._left.pop(0)


def sent(*_: object) -> str:
    return "test frames were sent"


HEARTBEATS = [frame(layout.HEARTBEAT + node, 1000.0 * node, 1, local=False) for node in range(1, 20)]


@pytest.mark.parametrize(
    ("heard", "more", "said"),
    [
        ([], {}, "test frames were sent"),
        (HEARTBEATS, {}, "test frames were sent"),
        (HEARTBEATS, {"bus": BusTiming(10_000)}, "other nodes use 8.2% of the bus"),
        ([frame(SYNC, 0.0, 0, local=False)], {}, "another node sends SYNC"),
        ([frame(SYNC, 0.0, 0)], {}, "only one SYNC"),
        ([], {"unfit": "not error-active"}, "not error-active"),
        ([], {"channel": "gone"}, "No such device"),
        ([frame(SYNC, 0.0, 0, local=False)] * 500, {"sync": None}, "other nodes use 1.8% of the bus"),
    ],
)
def test_test_frames_are_sent_only_on_an_idle_bus(
    heard: list[StampedFrame], more: dict[str, Any], said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bus_timing, "Loopback", type("Heard", (FakeLoopback,), {"heard": heard}))
    monkeypatch.setattr(bus_timing, "_send_test_frames", sent)
    arguments: dict[str, Any] = {"channel": "can0", "bus": DEFAULT_TIMING, "sync": SYNC} | more
    found = bus_timing.measure(loop=LOOP, setpoints=SETPOINTS, **arguments)
    assert isinstance(found, str)
    assert found.startswith(said)


def test_a_service_is_listened_to(monkeypatch: pytest.MonkeyPatch) -> None:
    heard = cycles([0.0] * 10, [300.0] * 10)
    monkeypatch.setattr(bus_timing, "Loopback", type("Heard", (FakeLoopback,), {"heard": heard}))
    monkeypatch.setattr(bus_timing, "_send_test_frames", sent)
    found = bus_timing.measure("can0", DEFAULT_TIMING, LOOP, SYNC, SETPOINTS, "not error-active")
    assert isinstance(found, MeasuredTiming)
    assert found.source == "service"
    assert found.setpoints_us is not None
    assert found.setpoints_us.p50 == 300.0


def test_frames_of_fewer_than_half_of_the_cycles_are_no_setpoints() -> None:
    seldom = [frame(layout.RPDO2 + 9, 1000.0 * number + 500.0) for number in range(4)]
    timing = compute_timing([cycles([0.0] * 10, [100.0] * 10) + seldom], "service", SYNC, SETPOINTS)
    assert timing is not None
    assert timing.without_setpoints == 0
    assert timing.setpoints_us is not None
    assert timing.setpoints_us.max == pytest.approx(100.0)


class FakeCarrier:
    """Socket of an interface whose other end the loopback hears."""

    def __init__(self, heard: list[bytes]) -> None:
        self._ours, self.other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.other.setblocking(False)
        self.heard = heard

    def __enter__(self) -> FakeCarrier:
        return self

    def __exit__(self, *_: object) -> None:
        self._ours.close()
        self.other.close()

    def setsockopt(self, *_: object) -> None:
        pass

    def bind(self, address: tuple[str]) -> None:
        assert address == ("can0",)

    def fileno(self) -> int:
        return self._ours.fileno()

    def send(self, packet: bytes) -> None:
        self._ours.send(packet)

    def listen(self, seconds: float) -> Iterator[StampedFrame]:
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            try:
                packet = self.other.recv(CAN_FRAME.size)
            except BlockingIOError:
                return
            self.heard.append(packet)
            identifier, length, data = CAN_FRAME.unpack(packet)
            yield StampedFrame(identifier, data[:length], time.monotonic_ns(), True, False)


@pytest.mark.parametrize("acknowledged", [True, False])
def test_only_test_frames_are_sent_and_the_first_must_be_acknowledged(
    acknowledged: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    heard: list[bytes] = []
    carrier = FakeCarrier(heard)
    if not acknowledged:
        monkeypatch.setattr(carrier, "listen", lambda _: iter(()))
    names = {name: getattr(socket, name, 0) for name in ("AF_CAN", "SOCK_RAW", "CAN_RAW", "SOL_CAN_RAW")}
    made = SimpleNamespace(**names, CAN_RAW_FILTER=1, socket=lambda *_: carrier)
    monkeypatch.setattr(bus_timing, "socket", made)
    monkeypatch.setattr(bus_timing, "SENDING_S", 1.0)
    monkeypatch.setattr(bus_timing, "SENT_WITHIN_S", 0.05)
    done: list[float] = []
    found = bus_timing._send_test_frames("can0", DEFAULT_TIMING, LOOP, carrier, done.append)  # type: ignore[arg-type]
    if not acknowledged:
        assert isinstance(found, str)
        assert found.startswith("no node acknowledged a test frame")
        assert done == []
        return
    assert isinstance(found, MeasuredTiming)
    batches = round(1.0 * LOOP.rate_hz / bus_timing.BATCH_CYCLES)
    assert (found.source, found.syncs, done[-1]) == ("test frames", batches * bus_timing.BATCH_CYCLES, 1.0)
    assert found.without_setpoints == 0
    first, *others = (CAN_FRAME.unpack(packet)[:2] for packet in heard)
    assert first == (TEST_FRAMES[0], 0)
    cycle = [(TEST_FRAMES[0], 0), *((identifier, 8) for identifier in TEST_FRAMES)]
    assert others == cycle * (batches * bus_timing.BATCH_CYCLES)


@pytest.fixture
def interface() -> Iterator[str]:
    with carriers.vcan() as name:
        yield name


@carriers.on_vcan
def test_the_kernel_stamps_what_a_service_sends(interface: str, monkeypatch: pytest.MonkeyPatch) -> None:
    ended = threading.Event()
    setpoints = [CAN_FRAME.pack(layout.RPDO2 + node, 8, bytes(8)) for node in (1, 2, 3)]
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as sender:
        sender.bind((interface,))

        def serve() -> None:
            while not ended.wait(0.02):
                for each in (CAN_FRAME.pack(SYNC, 0, bytes(8)), *setpoints, CAN_FRAME.pack(0x701 | REMOTE, 0, b"")):
                    sender.send(each)

        service = threading.Thread(target=serve)
        service.start()
        try:
            began = time.time_ns()
            found = bus_timing.measure(interface, DEFAULT_TIMING, LOOP, SYNC, SETPOINTS)
        finally:
            ended.set()
            service.join()
    assert isinstance(found, MeasuredTiming)
    assert (found.source, found.timestamps) == ("service", "software")
    assert found.setpoints_us is not None
    assert 0.0 < found.setpoints_us.p50 < (time.time_ns() - began) * 1e-3
    assert found.syncs > 2


@carriers.on_vcan
def test_test_frames_are_measured_and_nothing_else_is_sent(interface: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bus_timing, "SENDING_S", 1.0)
    with loopback.Loopback(interface) as other:
        found = bus_timing.measure(interface, DEFAULT_TIMING, LOOP, SYNC, SETPOINTS)
        frames = list(other.arrived())
    assert isinstance(found, MeasuredTiming)
    assert found.source == "test frames"
    assert found.rate_hz == pytest.approx(100, rel=0.2)  # of what the kernel's clock shows, on a machine that stalls
    assert found.setpoints_us is not None
    assert found.syncs == 100
    assert {each.identifier for each in frames} == set(TEST_FRAMES)
    assert len(frames) == 1 + 4 * found.syncs
