"""The simulated drives, frame by frame, against CiA 301 and CiA 402; the clock is ours."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from struct import pack, unpack

import can
import pytest
from rigs import DeviceRig, alike, frame
from trirail_drivers import config
from trirail_drivers.connection.opening import simulated_bus
from trirail_drivers.interface import PowerState
from trirail_drivers.simulated import Servo, SimulatedBus, SimulatedDrive

NODE = 5
PERIOD = 0.001
START = 20_000
DECELERATION = 1_000_000
Frame = tuple[int, bytes]

S = PowerState


class Rig(DeviceRig[SimulatedDrive]):
    """A CiA 402 drive (1 µm a count, 2 m/s, 100 m/s² at most)."""

    def __init__(self, time_constant: float = 0.0, friction: float | None = None) -> None:
        self.servo = Servo(START, time_constant=time_constant, max_velocity=2e6, max_acceleration=1e8)
        super().__init__(SimulatedDrive(NODE, self.servo, friction=friction))

    def state(self) -> PowerState:
        return self.drive.state

    def nmt(self, command: int, node: int = NODE) -> list[Frame]:
        return self.send(0x000, bytes([command, node]))

    def sdo(self, *request: int) -> bytes:
        """One frame to the SDO server, padded to eight bytes, and its answer."""
        answers = [data for can_id, data in self.send(0x600 + NODE, bytes(request).ljust(8, b"\0")) if can_id == 0x585]
        assert len(answers) == 1
        assert len(answers[0]) == 8
        return answers[0]

    def read(self, index: int, subindex: int = 0) -> int:
        answer = self.sdo(0x40, *pack("<HB", index, subindex))
        assert answer[0] & 0xE3 == 0x43, f"{index:04X}:{subindex:02X} {answer.hex()}"
        return int.from_bytes(answer[4 : 8 - (answer[0] >> 2 & 3)], "little", signed=index in (0x6064, 0x606C))

    def refused(self, index: int, subindex: int = 0) -> int:
        """The abort code of an upload."""
        return abort_code(self.sdo(0x40, *pack("<HB", index, subindex)), index, subindex)

    def download(self, index: int, subindex: int, data: bytes) -> bytes:
        return self.sdo(0x23 | (4 - len(data)) << 2, *pack("<HB", index, subindex), *data)

    def write(self, index: int, subindex: int, data: bytes) -> None:
        assert self.download(index, subindex, data) == pack("<BHB4x", 0x60, index, subindex)

    def write_refused(self, index: int, subindex: int, data: bytes) -> int:
        """The abort code of a download."""
        return abort_code(self.download(index, subindex, data), index, subindex)

    def map(self, communication: int, cob_id: int, transmission: int, *entries: int) -> None:
        """Configure a PDO in the order that CiA 301 asks for."""
        mapping = communication + 0x200
        self.write(communication, 1, pack("<I", cob_id | 1 << 31))
        self.write(communication, 2, bytes([transmission]))
        self.write(mapping, 0, b"\0")
        for n, entry in enumerate(entries, 1):
            self.write(mapping, n, pack("<I", entry))
        self.write(mapping, 0, bytes([len(entries)]))
        self.write(communication, 1, pack("<I", cob_id))

    def cyclic(self) -> None:
        """Ready for the cycle: both PDOs by SYNC, SYNC expected, mode 8, OPERATIONAL."""
        self.write(0x1006, 0, pack("<I", round(PERIOD * 1e6)))
        self.write(0x6060, 0, b"\x08")
        self.write(0x6085, 0, pack("<I", DECELERATION))
        self.map(0x1400, 0x205, 1, 0x60400010, 0x607A0020)
        self.map(0x1401, 0x305, 1, 0x60B10020)
        self.map(0x1800, 0x40000185, 1, 0x60410010, 0x60640020)
        self.nmt(1)
        self.take()

    def cycle(self, controlword: int, target: int, offset: int = 0) -> tuple[int, int]:
        """One period: SYNC, whose TPDO gives statusword and position, then new setpoints."""
        self.now += PERIOD
        [(can_id, data)] = self.send(0x080)
        assert can_id == 0x185
        assert not self.send(0x205, pack("<Hi", controlword, target))
        assert not self.send(0x305, pack("<i", offset))
        status, position = unpack("<Hi", data)
        return status, position

    def enable(self) -> None:
        self.cyclic()
        for controlword in (0x06, 0x07, 0x0F):
            self.cycle(controlword, START)
        self.cycle(0x0F, START)
        assert self.state() is S.OPERATION_ENABLED

    def move(self, speed: float) -> int:
        """Reach a steady speed [counts/s], with feed-forward; the last target."""
        target = float(START)
        velocity = 0.0
        for _ in range(300):
            velocity = min(velocity + 5e7 * PERIOD, speed)
            target += velocity * PERIOD
            self.cycle(0x0F, round(target), round(velocity))
        assert self.servo.velocity == pytest.approx(speed, rel=1e-3)
        return round(target)


def abort_code(answer: bytes, index: int, subindex: int) -> int:
    command, refused_index, refused_subindex, code = unpack("<BHBI", answer)
    assert (command, refused_index, refused_subindex) == (0x80, index, subindex)
    return int(code)


def emergencies(frames: list[Frame]) -> list[tuple[int, int]]:
    """Error code and error register of every EMCY."""
    found = []
    for can_id, data in frames:
        if can_id == 0x80 + NODE:
            assert len(data) == 8
            found.append(unpack("<HB", data[:3]))
    return found


@pytest.fixture
def rig() -> Rig:
    return Rig()


# NMT and heartbeat.


def test_boots_up_once_and_into_pre_operational(rig: Rig) -> None:
    assert rig.take() == [(0x705, b"\0")]
    assert not rig.wait(1.0)
    rig.write(0x1017, 0, pack("<H", 100))
    assert rig.wait(0.05) == [(0x705, b"\x7f")]


@pytest.mark.parametrize(("command", "state"), [(1, 5), (2, 4), (128, 127)])
@pytest.mark.parametrize("node", [0, NODE])
def test_nmt_state_shows_in_the_heartbeat(rig: Rig, command: int, state: int, node: int) -> None:
    rig.write(0x1017, 0, pack("<H", 10))
    rig.wait(0.005)
    rig.nmt(command, node)
    assert (0x705, bytes([state])) in rig.wait(0.01)


def test_nmt_for_another_node_or_malformed_is_not_obeyed(rig: Rig) -> None:
    rig.nmt(1, NODE + 1)
    rig.send(0x000, b"\x01")
    rig.send(0x000, bytes([1, NODE, 0]))
    rig.nmt(7)
    assert rig.drive.nmt == 127


def test_heartbeat_keeps_its_period_and_follows_changes(rig: Rig) -> None:
    rig.write(0x1017, 0, pack("<H", 100))
    assert len(rig.wait(0.99)) == 10
    rig.write(0x1017, 0, pack("<H", 20))
    assert len(rig.wait(0.99)) == 50
    rig.write(0x1017, 0, pack("<H", 0))
    assert not rig.wait(1.0)


def test_a_late_heartbeat_is_sent_once(rig: Rig) -> None:
    rig.write(0x1017, 0, pack("<H", 100))
    rig.wait(0.0005)
    assert len(rig.wait(5.0, step=5.0)) == 1
    assert len(rig.wait(0.95)) == 9


def test_sdo_answers_unless_stopped(rig: Rig) -> None:
    assert rig.read(0x1000) == 0x00020192
    rig.nmt(1)
    assert rig.read(0x1000) == 0x00020192
    rig.nmt(2)
    assert not rig.send(0x605, pack("<BHB4x", 0x40, 0x1000, 0))
    rig.nmt(128)
    assert rig.read(0x1000) == 0x00020192


def test_pdos_only_in_operational(rig: Rig) -> None:
    for command in (128, 2):
        rig.nmt(command)
        rig.send(0x205, pack("<H", 0x06))
        assert rig.state() is S.SWITCH_ON_DISABLED
    assert (0x185, pack("<H", 0x0250)) in rig.nmt(1)
    assert rig.send(0x205, pack("<H", 0x06)) == [(0x185, pack("<H", 0x0231))]


def test_reset_node_restores_everything_and_reset_communication_its_own(rig: Rig) -> None:
    for command, mode in ((130, 8), (129, 0)):
        rig.write(0x1017, 0, pack("<H", 100))
        rig.write(0x6060, 0, b"\x08")
        rig.nmt(1)
        assert (0x705, b"\0") in rig.nmt(command)
        assert rig.drive.nmt == 127
        assert rig.read(0x1017) == 0
        assert not rig.wait(1.0)
        assert rig.read(0x6060) == mode


# SDO.


@pytest.mark.parametrize(
    ("index", "subindex", "data", "code"),
    [
        (0x2000, 0, b"\0", 0x06020000),
        (0x6040, 1, b"\0\0", 0x06090011),
        (0x1018, 9, b"\0", 0x06090011),
        (0x1000, 0, b"\0\0\0\0", 0x06010002),
        (0x6040, 0, b"\0\0\0", 0x06070012),
        (0x6040, 0, b"\0", 0x06070013),
        (0x1029, 1, b"\x03", 0x06090031),
        (0x60C2, 1, b"\x00", 0x06090032),
        (0x6060, 0, b"\x01", 0x06090030),
        (0x605A, 0, b"\x03\0", 0x06090030),
        (0x1003, 0, b"\x01", 0x06090030),
        (0x1005, 0, b"\x81\0\0\0", 0x06090031),
        (0x1400, 2, b"\xf5", 0x06090030),
    ],
)
def test_download_is_refused_with_its_abort_code(rig: Rig, index: int, subindex: int, data: bytes, code: int) -> None:
    assert rig.write_refused(index, subindex, data) == code


def test_a_refused_value_leaves_the_old_one(rig: Rig) -> None:
    rig.write(0x605A, 0, pack("<h", 6))
    rig.write_refused(0x605A, 0, pack("<h", 1))
    assert rig.read(0x605A) == 6


def test_segmented_transfer_protocol_errors(rig: Rig) -> None:
    assert abort_code(rig.sdo(0x21, 0x7A, 0x60, 0, 5, 0, 0, 0), 0x607A, 0) == 0x06070010
    assert rig.sdo(0x20, 0x7A, 0x60, 0)[0] == 0x60
    assert abort_code(rig.sdo(0x10, 1), 0x607A, 0) == 0x05030000
    assert rig.sdo(0x20, 0x7A, 0x60, 0)[0] == 0x60
    assert abort_code(rig.sdo(0x00, 1, 2, 3, 4, 5), 0x607A, 0) == 0x06070012
    assert rig.sdo(0x20, 0x7A, 0x60, 0)[0] == 0x60
    assert abort_code(rig.sdo(0x01 | 5 << 1, 1, 2), 0x607A, 0) == 0x06070013
    assert abort_code(rig.sdo(0x00, 1), 0, 0) == abort_code(rig.sdo(0x60), 0, 0) == 0x05040001
    assert abort_code(rig.sdo(0xE0, 0x7A, 0x60, 0), 0, 0) == 0x05040001
    assert not rig.send(0x605, b"\x80\x7a\x60\x00\x00\x00\x00\x08")
    assert not rig.send(0x605, b"\x40\x7a\x60\x00")


# PDO mapping and transmission.


def test_mapping_is_locked_until_pdo_and_count_are_cleared(rig: Rig) -> None:
    target = pack("<I", 0x607A0020)
    assert rig.write_refused(0x1600, 0, b"\0") == 0x06010000
    assert rig.write_refused(0x1600, 1, target) == 0x06010000
    rig.write(0x1400, 1, pack("<I", 0x80000205))
    assert rig.write_refused(0x1600, 1, target) == 0x06010000
    rig.write(0x1600, 0, b"\0")
    rig.write(0x1600, 1, target)
    rig.write(0x1600, 0, b"\1")
    assert rig.read(0x1600, 1) == 0x607A0020


@pytest.mark.parametrize(
    ("mapping", "entry", "code"),
    [
        (0x1600, 0x20000010, 0x06020000),
        (0x1600, 0x60C20308, 0x06090011),
        (0x1600, 0x60410010, 0x06040041),
        (0x1600, 0x60850020, 0x06040041),
        (0x1600, 0x60400020, 0x06040041),
        (0x1A00, 0x10170010, 0x06040041),
    ],
)
def test_what_may_not_be_mapped_is_refused(rig: Rig, mapping: int, entry: int, code: int) -> None:
    rig.write(mapping - 0x200, 1, pack("<I", 0x80000000))
    rig.write(mapping, 0, b"\0")
    assert rig.write_refused(mapping, 1, pack("<I", entry)) == code


def test_more_than_eight_bytes_are_refused(rig: Rig) -> None:
    rig.write(0x1800, 1, pack("<I", 0xC0000185))
    rig.write(0x1A00, 0, b"\0")
    for n in (1, 2, 3):
        rig.write(0x1A00, n, pack("<I", 0x60640020))
    assert rig.write_refused(0x1A00, 0, b"\x03") == 0x06040042
    assert rig.write_refused(0x1A00, 0, b"\x09") == 0x06040042
    assert rig.write_refused(0x1A00, 0, b"\x05") == 0x06020000
    rig.write(0x1A00, 0, b"\x02")


def test_cob_id_rules(rig: Rig) -> None:
    assert rig.write_refused(0x1400, 1, pack("<I", 0x206)) == 0x08000022
    assert rig.write_refused(0x1800, 3, pack("<H", 10)) == 0x08000022
    rig.write(0x1400, 1, pack("<I", 0x80000000))
    assert rig.write_refused(0x1400, 1, pack("<I", 0x20000206)) == 0x06090030
    for restricted in (0x000, 0x07F, 0x101, 0x180, 0x581, 0x67F, 0x6E0, 0x701, 0x7FF):
        assert rig.write_refused(0x1400, 1, pack("<I", restricted)) == 0x06090030
    rig.write(0x1400, 1, pack("<I", 0x206))
    rig.nmt(1)
    rig.send(0x205, pack("<H", 0x06))
    assert rig.state() is S.SWITCH_ON_DISABLED
    rig.send(0x206, pack("<H", 0x06))
    assert rig.state() is S.READY_TO_SWITCH_ON


def test_a_synchronous_rpdo_waits_for_the_sync_and_the_newest_counts(rig: Rig) -> None:
    rig.map(0x1400, 0x205, 1, 0x60400010, 0x607A0020)
    rig.nmt(1)
    rig.send(0x205, pack("<Hi", 0, 111))
    rig.send(0x205, pack("<Hi", 0, 222))
    assert rig.read(0x607A) == 0
    rig.send(0x080)
    assert rig.read(0x607A) == 222


@pytest.mark.parametrize("anew", [False, True], ids=["left operational", "mapped anew"])
def test_what_was_latched_is_forgotten(rig: Rig, anew: bool) -> None:
    rig.map(0x1400, 0x205, 1, 0x607A0020)
    rig.nmt(1)
    rig.send(0x205, pack("<i", 111))
    if anew:
        rig.map(0x1400, 0x205, 1, 0x60400010, 0x60B10020)
    else:
        rig.nmt(128)
        rig.nmt(1)
    rig.send(0x080)
    assert rig.read(0x607A) == rig.read(0x60B1) == 0


def test_an_event_driven_rpdo_acts_at_once(rig: Rig) -> None:
    rig.map(0x1400, 0x205, 254, 0x607A0020)
    rig.nmt(1)
    rig.send(0x205, pack("<i", 111))
    assert rig.read(0x607A) == 111


def test_setpoints_after_the_synchronous_window_are_discarded(rig: Rig) -> None:
    rig.map(0x1400, 0x205, 1, 0x607A0020)
    rig.write(0x1007, 0, pack("<I", 500))
    rig.nmt(1)
    for late, target in ((0.0004, 1), (0.0006, 2)):
        rig.send(0x080)
        rig.now += late
        rig.send(0x205, pack("<i", target))
    rig.send(0x080)
    assert rig.read(0x607A) == 1


@pytest.mark.parametrize("transmission", [1, 3, 240])
def test_a_tpdo_goes_with_every_nth_sync(rig: Rig, transmission: int) -> None:
    rig.map(0x1800, 0x40000185, transmission, 0x60410010, 0x60640020)
    assert not rig.send(0x080)
    rig.nmt(1)
    sent = [len(rig.send(0x080)) for _ in range(480)]
    assert sum(sent) == 480 // transmission
    assert all(sent[transmission - 1 :: transmission])


def test_tpdo_type_0_goes_with_a_sync_after_a_change(rig: Rig) -> None:
    rig.map(0x1800, 0x40000185, 0, 0x60410010)
    rig.nmt(1)
    assert rig.send(0x080) == [(0x185, pack("<H", 0x0250))]
    assert not rig.send(0x080)
    assert not rig.send(0x205, pack("<H", 0x06))
    assert rig.send(0x080) == [(0x185, pack("<H", 0x0231))]


def test_an_event_driven_tpdo_keeps_its_inhibit_time_and_event_timer(rig: Rig) -> None:
    rig.write(0x1800, 1, pack("<I", 0xC0000185))
    rig.write(0x1800, 3, pack("<H", 100))  # 10 ms
    rig.write(0x1800, 5, pack("<H", 50))
    rig.write(0x1800, 1, pack("<I", 0x40000185))
    assert (0x185, pack("<H", 0x0250)) in rig.nmt(1)
    assert not rig.send(0x205, pack("<H", 0x06))
    assert not rig.wait(0.009)
    assert rig.wait(0.0015) == [(0x185, pack("<H", 0x0231))]
    assert rig.wait(0.505) == [(0x185, pack("<H", 0x0231))] * 10


def test_a_remote_frame_gets_the_tpdo_where_its_cob_id_permits(rig: Rig) -> None:
    rig.nmt(1)
    rig.drive.receive_remote(0x185, rig.now)
    assert not rig.take()
    rig.map(0x1800, 0x185, 1, 0x60410010)
    rig.drive.receive_remote(0x185, rig.now)
    assert rig.take() == [(0x185, pack("<H", 0x0250))]


def test_a_short_rpdo_is_an_error_and_a_long_one_counts_as_far_as_mapped(rig: Rig) -> None:
    rig.map(0x1400, 0x205, 255, 0x607A0020)
    rig.nmt(1)
    assert emergencies(rig.send(0x205, b"\1\2\3")) == [(0x8210, 0x11)]
    assert not emergencies(rig.send(0x205, b"\1\2\3"))
    assert rig.read(0x607A) == 0
    assert rig.read(0x1001) == 0x11
    assert rig.read(0x1003, 0) == 1
    assert rig.read(0x1003, 1) == 0x00018210
    assert emergencies(rig.send(0x205, pack("<i", 7))) == [(0, 0)]
    assert emergencies(rig.send(0x205, pack("<iB", 8, 1))) == [(0x8220, 0x11)]
    assert rig.read(0x607A) == 8


def test_a_sync_with_data_is_an_error_and_no_sync(rig: Rig) -> None:
    rig.map(0x1800, 0x40000185, 1, 0x60410010)
    rig.nmt(1)
    frames = rig.send(0x080, b"\1")
    assert emergencies(frames) == [(0x8240, 0x11)]
    assert 0x185 not in dict(frames)
    assert emergencies(rig.send(0x080)) == [(0, 0)]


# EMCY and error history.


def test_history_holds_the_newest_first_and_can_be_emptied(rig: Rig) -> None:
    for code in range(0x5001, 0x500B):
        rig.drive.fail(code)
        rig.wait(0.001)
        rig.write(0x6040, 0, pack("<H", 0x80))
        rig.write(0x6040, 0, pack("<H", 0x00))
    assert rig.read(0x1003, 0) == 8
    assert [rig.read(0x1003, n) for n in range(1, 9)] == list(range(0x500A, 0x5002, -1))
    rig.write(0x1003, 0, b"\0")
    assert rig.read(0x1003, 0) == 0
    assert rig.refused(0x1003, 1) == 0x08000024


def test_error_reset_comes_with_the_end_of_the_last_error(rig: Rig) -> None:
    rig.nmt(1)
    rig.send(0x205, b"\1")
    rig.drive.fail(0x2310)
    assert rig.read(0x1001) == 0x13
    rig.wait(0.001)
    assert not emergencies(rig.send(0x205, pack("<H", 0)))
    assert rig.read(0x1001) == 0x03
    assert emergencies(rig.send(0x205, pack("<H", 0x80))) == [(0, 0)]


@pytest.mark.parametrize(("command", "sent"), [(129, []), (128, [(0x5001, 0x01)])])
def test_an_emergency_in_stopped_is_sent_on_leaving_it_unless_by_a_reset(
    rig: Rig, command: int, sent: list[tuple[int, int]]
) -> None:
    rig.nmt(2)
    rig.drive.fail(0x5001)
    assert not rig.take()
    assert emergencies(rig.nmt(command)) == sent
    assert not emergencies(rig.nmt(1))


# The power state machine.

WALK = {
    S.SWITCH_ON_DISABLED: (),
    S.READY_TO_SWITCH_ON: (0x06,),
    S.SWITCHED_ON: (0x06, 0x07),
    S.OPERATION_ENABLED: (0x06, 0x07, 0x0F),
    S.QUICK_STOP_ACTIVE: (0x06, 0x07, 0x0F, 0x02),
}
STATUS = {
    S.SWITCH_ON_DISABLED: (0x4F, 0x40),
    S.READY_TO_SWITCH_ON: (0x6F, 0x21),
    S.SWITCHED_ON: (0x6F, 0x23),
    S.OPERATION_ENABLED: (0x6F, 0x27),
    S.QUICK_STOP_ACTIVE: (0x6F, 0x07),
    S.FAULT_REACTION_ACTIVE: (0x4F, 0x0F),
    S.FAULT: (0x4F, 0x08),
}
SHUTDOWN, SWITCH_ON, ENABLE, VOLTAGE_OFF, QUICK_STOP = 0x06, 0x07, 0x0F, 0x00, 0x02
TRANSITIONS = {
    (S.SWITCH_ON_DISABLED, SHUTDOWN): S.READY_TO_SWITCH_ON,
    (S.READY_TO_SWITCH_ON, SWITCH_ON): S.SWITCHED_ON,
    (S.READY_TO_SWITCH_ON, ENABLE): S.OPERATION_ENABLED,
    (S.READY_TO_SWITCH_ON, VOLTAGE_OFF): S.SWITCH_ON_DISABLED,
    (S.READY_TO_SWITCH_ON, QUICK_STOP): S.SWITCH_ON_DISABLED,
    (S.SWITCHED_ON, SHUTDOWN): S.READY_TO_SWITCH_ON,
    (S.SWITCHED_ON, ENABLE): S.OPERATION_ENABLED,
    (S.SWITCHED_ON, VOLTAGE_OFF): S.SWITCH_ON_DISABLED,
    (S.SWITCHED_ON, QUICK_STOP): S.SWITCH_ON_DISABLED,
    (S.OPERATION_ENABLED, SWITCH_ON): S.SWITCHED_ON,
    (S.OPERATION_ENABLED, SHUTDOWN): S.READY_TO_SWITCH_ON,
    (S.OPERATION_ENABLED, VOLTAGE_OFF): S.SWITCH_ON_DISABLED,
    (S.OPERATION_ENABLED, QUICK_STOP): S.QUICK_STOP_ACTIVE,
    (S.QUICK_STOP_ACTIVE, VOLTAGE_OFF): S.SWITCH_ON_DISABLED,
    (S.QUICK_STOP_ACTIVE, ENABLE): S.OPERATION_ENABLED,
}


def in_state(rig: Rig, state: PowerState) -> None:
    """Bring a drive whose quick stop stays active (605Ah = 6) into `state`, by SDO."""
    rig.write(0x605A, 0, pack("<h", 6))
    rig.write(0x6060, 0, b"\x08")
    for controlword in WALK[state]:
        rig.write(0x6040, 0, pack("<H", controlword))
    assert rig.state() is state


@pytest.mark.parametrize("state", WALK)
@pytest.mark.parametrize("command", [SHUTDOWN, SWITCH_ON, ENABLE, VOLTAGE_OFF, QUICK_STOP])
@pytest.mark.parametrize("other_bits", [0x0000, 0xFF70])
def test_every_command_in_every_state(rig: Rig, state: PowerState, command: int, other_bits: int) -> None:
    in_state(rig, state)
    rig.write(0x6040, 0, pack("<H", command | other_bits))
    expected = TRANSITIONS.get((state, command), state)
    mask, value = STATUS[expected]
    assert rig.state() is expected
    assert rig.read(0x6041) & mask == value
    assert rig.read(0x6041) & 0x0200
    assert bool(rig.read(0x6041) & 0x1000) == (expected is S.OPERATION_ENABLED)


@pytest.mark.parametrize("state", WALK)
def test_a_fault_from_every_state_and_its_reset(rig: Rig, state: PowerState) -> None:
    in_state(rig, state)
    rig.drive.fail(0x2310)
    assert emergencies(rig.take()) == [(0x2310, 0x03)]
    assert rig.read(0x6041) & 0x4F == 0x0F
    rig.wait(0.001)
    assert rig.read(0x6041) & 0x4F == 0x08
    assert rig.read(0x603F) == 0x2310
    for command in (SHUTDOWN, SWITCH_ON, ENABLE, VOLTAGE_OFF, QUICK_STOP):
        rig.write(0x6040, 0, pack("<H", command))
        assert rig.state() is S.FAULT
    frames = rig.send(0x605, pack("<BHBHxx", 0x2B, 0x6040, 0, 0x80))
    assert emergencies(frames) == [(0, 0)]
    assert rig.state() is S.SWITCH_ON_DISABLED
    assert rig.read(0x1001) == 0


@pytest.mark.parametrize("then", [None, SWITCH_ON, SHUTDOWN, VOLTAGE_OFF, QUICK_STOP, "fault"])
def test_a_power_up_takes_its_time_and_ends_at_another_command_or_a_fault(rig: Rig, then: int | str | None) -> None:
    in_state(rig, S.SWITCHED_ON)
    rig.drive.power_up_time = 0.1
    for _ in range(9):
        rig.write(0x6040, 0, pack("<H", ENABLE))
        rig.wait(0.01)
        assert rig.state() is S.SWITCHED_ON
    if then == "fault":
        rig.drive.fail(0x2310)
    elif isinstance(then, int):
        rig.write(0x6040, 0, pack("<H", then))
    rig.wait(0.1)
    assert (rig.state() is S.OPERATION_ENABLED) is (then is None)


def test_fault_reset_needs_a_rising_edge(rig: Rig) -> None:
    rig.write(0x6040, 0, pack("<H", 0x80))
    rig.drive.fail(0x2310)
    rig.wait(0.001)
    rig.write(0x6040, 0, pack("<H", 0x80))
    assert rig.state() is S.FAULT
    rig.write(0x6040, 0, pack("<H", 0x00))
    rig.write(0x6040, 0, pack("<H", 0x80))
    assert rig.state() is S.SWITCH_ON_DISABLED


def test_quick_stop_that_does_not_stay_ends_in_switch_on_disabled_and_cannot_resume(rig: Rig) -> None:
    in_state(rig, S.OPERATION_ENABLED)
    rig.write(0x605A, 0, pack("<h", 2))
    rig.write(0x6040, 0, pack("<H", QUICK_STOP))
    rig.write(0x6040, 0, pack("<H", ENABLE))
    assert rig.state() is S.QUICK_STOP_ACTIVE
    rig.wait(0.001)
    assert rig.state() is S.SWITCH_ON_DISABLED


def test_modes_6_and_8_are_supported_and_none_follows_nothing(rig: Rig) -> None:
    assert rig.read(0x6502) == 1 << 5 | 1 << 7
    in_state(rig, S.OPERATION_ENABLED)
    assert rig.read(0x6061) == 8
    rig.write(0x6060, 0, b"\0")
    assert rig.read(0x6061) == 0
    assert not rig.read(0x6041) & 0x1000
    rig.write(0x607A, 0, pack("<i", START + 100))
    rig.wait(0.1)
    assert rig.read(0x6064) == START


# Homing (CiA 402-2, mode 6). The switch is at START - 3000 or START + 3000, in counts as at power-on.

START_HOMING = ENABLE | 0x10
HALT = 0x100
REACHED, ATTAINED, ERROR = 1 << 10, 1 << 12, 1 << 13


def homing_rig(method: int, switch: int | None) -> Rig:
    """A drive that is enabled in homing mode."""
    rig = Rig()
    rig.drive.homing.switch = switch
    rig.write(0x6098, 0, pack("<b", method))
    rig.write(0x6099, 1, pack("<I", 50_000))
    rig.write(0x6099, 2, pack("<I", 10_000))
    rig.write(0x609A, 0, pack("<I", 2_000_000))
    in_state(rig, S.OPERATION_ENABLED)
    rig.write(0x6060, 0, b"\x06")
    assert rig.read(0x6061) == 6
    assert homing_bits(rig) == REACHED  # not started
    return rig


def homing_bits(rig: Rig) -> int:
    return rig.read(0x6041) & (REACHED | ATTAINED | ERROR)


@pytest.mark.parametrize(("method", "direction"), [(17, 1), (18, -1), (19, -1), (20, 1), (21, 1), (22, -1)])
@pytest.mark.parametrize("switch", [START - 3000, START + 3000])
@pytest.mark.parametrize("offset", [0, -700])
def test_homing_ends_behind_the_edge_from_where_it_counts(
    method: int, direction: int, switch: int, offset: int
) -> None:
    rig = homing_rig(method, switch)
    rig.write(0x607C, 0, pack("<i", offset))
    rig.write(0x6040, 0, pack("<H", START_HOMING))
    assert homing_bits(rig) == 0
    speeds = set()
    for _ in range(4000):
        rig.wait(0.0005)
        speeds.add(round(rig.servo.velocity))
        if homing_bits(rig):
            break
    assert homing_bits(rig) == REACHED | ATTAINED
    assert max(abs(speed) for speed in speeds) == 50_000
    assert direction * 10_000 in speeds  # the edge is crossed slowly, and always from the same side
    beyond = rig.read(0x6064) - offset
    assert 0 <= direction * beyond <= 10_000**2 / 2 / 2_000_000 + 10  # as far as it takes to brake
    assert rig.drive.homing.switch == offset
    rig.wait(0.1)
    assert rig.read(0x6064) - offset == beyond


@pytest.mark.parametrize("method", [35, 37])
def test_homing_where_it_stands_moves_nothing(method: int) -> None:
    rig = homing_rig(method, None)
    rig.write(0x607C, 0, pack("<i", 123))
    rig.write(0x6040, 0, pack("<H", START_HOMING))
    assert homing_bits(rig) == REACHED | ATTAINED
    assert rig.read(0x6064) == 123
    rig.write(0x6060, 0, b"\x08")
    rig.write(0x607A, 0, pack("<i", 123))
    rig.wait(0.1)
    assert rig.read(0x6064) == 123


def test_homing_that_is_interrupted_stands_and_is_not_attained() -> None:
    rig = homing_rig(19, START + 3000)
    rig.write(0x6040, 0, pack("<H", START_HOMING))
    rig.wait(0.04)
    rig.write(0x6040, 0, pack("<H", ENABLE))
    assert homing_bits(rig) == 0
    rig.wait(0.1)
    assert homing_bits(rig) == REACHED
    before = rig.read(0x6064)
    rig.wait(0.1)
    assert rig.read(0x6064) == before != START


def test_homing_that_is_halted_goes_on_afterwards() -> None:
    rig = homing_rig(19, START + 3000)
    rig.write(0x6040, 0, pack("<H", START_HOMING))
    rig.wait(0.04)
    rig.write(0x6040, 0, pack("<H", START_HOMING | HALT))
    rig.wait(0.1)
    assert homing_bits(rig) == REACHED
    rig.write(0x6040, 0, pack("<H", START_HOMING))
    rig.wait(1.0)
    assert homing_bits(rig) == REACHED | ATTAINED


def test_homing_without_method_or_speed_is_an_error() -> None:
    rig = homing_rig(0, START)
    rig.write(0x6040, 0, pack("<H", START_HOMING))
    assert homing_bits(rig) == REACHED | ERROR
    rig = homing_rig(19, START + 100)
    rig.write(0x6099, 2, pack("<I", 0))
    rig.write(0x6040, 0, pack("<H", START_HOMING))
    assert homing_bits(rig) == REACHED | ERROR


def test_homing_methods_that_it_has_not_are_refused(rig: Rig) -> None:
    for method in (-1, 1, 16, 33, 38):
        assert rig.write_refused(0x6098, 0, pack("<b", method)) == 0x06090030


def test_quick_stop_ends_homing() -> None:
    rig = homing_rig(19, START + 3000)
    rig.write(0x6040, 0, pack("<H", START_HOMING))
    rig.wait(0.04)
    rig.write(0x6040, 0, pack("<H", QUICK_STOP))
    rig.wait(0.1)
    assert rig.state() is S.QUICK_STOP_ACTIVE
    assert not homing_bits(rig) & ATTAINED
    rig.write(0x6040, 0, pack("<H", ENABLE))
    assert rig.state() is S.OPERATION_ENABLED
    before = rig.read(0x6064)
    rig.wait(0.1)
    assert rig.read(0x6064) == before  # it does not go on by itself


# Motion.


def test_without_a_setpoint_the_target_is_where_the_drive_stands(rig: Rig) -> None:
    in_state(rig, S.OPERATION_ENABLED)
    assert rig.read(0x607A) == START
    rig.wait(0.1)
    assert rig.read(0x6064) == START


def test_enabling_again_does_not_go_back_to_an_old_setpoint(rig: Rig) -> None:
    in_state(rig, S.OPERATION_ENABLED)
    rig.write(0x607A, 0, pack("<i", START + 5000))
    rig.wait(0.005)
    rig.write(0x6040, 0, pack("<H", SWITCH_ON))
    stopped = rig.read(0x6064)
    assert START < stopped < START + 5000
    rig.write(0x6040, 0, pack("<H", ENABLE))
    rig.wait(0.1)
    assert rig.read(0x6064) == stopped


def test_a_setpoint_given_before_enabling_is_the_target(rig: Rig) -> None:
    in_state(rig, S.SWITCHED_ON)
    rig.write(0x607A, 0, pack("<i", START + 50))
    rig.write(0x6040, 0, pack("<H", ENABLE))
    rig.wait(0.1)
    assert rig.read(0x6064) == START + 50


def test_an_ideal_servo_is_at_the_next_sync_where_this_one_sent_it(rig: Rig) -> None:
    rig.enable()
    targets = [START + n * (n + 1) * 20 for n in range(50)]
    seen = [rig.cycle(0x0F, target)[1] for target in targets]
    assert seen[2:] == targets[:-2]


def test_progress_is_one_period_a_sync_whatever_the_clock_says() -> None:
    def positions(jitter: Callable[[int], float]) -> list[int]:
        rig = Rig(time_constant=0.004)
        rig.enable()
        seen = []
        for n in range(100):
            rig.now += jitter(n)
            seen.append(rig.cycle(0x0F, START + 100 * n)[1])
        return seen

    assert positions(lambda n: 0.0) == positions(lambda n: 0.0015 * (n % 2))


@pytest.mark.parametrize("speed", [1e5, 1e6])
def test_lag_is_the_time_constant_without_feed_forward_and_none_with_it(speed: float) -> None:
    for share, lag in ((0.0, 0.004), (0.5, 0.002), (1.0, 0.0)):
        rig = Rig(time_constant=0.004)
        rig.enable()
        for n in range(200):
            rig.cycle(0x0F, START + round(n * speed * PERIOD), round(share * speed))
        assert rig.servo.following_error == pytest.approx(lag * speed, abs=2.0)


def test_no_lag_under_constant_acceleration_with_its_velocity_as_feed_forward() -> None:
    rig = Rig(time_constant=0.004)
    rig.enable()
    acceleration = 1e7
    for n in range(100):
        t = n * PERIOD
        rig.cycle(0x0F, START + round(0.5 * acceleration * t**2), round(acceleration * t))
        assert abs(rig.servo.following_error) <= 1.0


@pytest.mark.parametrize("time_constant", [0.0, 0.001, 0.004])
@pytest.mark.parametrize("distance", [1, -300, 30_000, -200_000])
def test_a_constant_target_is_reached_within_the_limits(time_constant: float, distance: int) -> None:
    rig = Rig(time_constant=time_constant)
    rig.enable()
    velocity = furthest = 0.0
    for _ in range(400):
        rig.cycle(0x0F, START + distance)
        assert abs(rig.servo.velocity) <= 2e6
        assert abs(rig.servo.velocity - velocity) <= 1e8 * PERIOD * (1 + 1e-9)
        velocity = rig.servo.velocity
        furthest = max(furthest, (rig.servo.position - START) / distance)
    status, position = rig.cycle(0x0F, START + distance)
    assert position == START + distance
    assert furthest * abs(distance) <= abs(distance) + 1e8 * PERIOD**2
    assert not status & 0x0800


def test_the_limit_bit_tells_of_a_setpoint_too_fast_to_follow(rig: Rig) -> None:
    rig.enable()
    rig.cycle(0x0F, START + 100_000)
    rig.cycle(0x0F, START + 100_000)
    assert rig.cycle(0x0F, START + 100_000)[0] & 0x0800


def test_following_error_beyond_its_window_for_its_time_is_a_fault(rig: Rig) -> None:
    rig.write(0x6065, 0, pack("<I", 1000))
    rig.write(0x6066, 0, pack("<H", 10))
    rig.enable()
    found = []
    for _ in range(30):
        rig.now += PERIOD
        found.append(emergencies(rig.send(0x080)))
        rig.send(0x205, pack("<Hi", 0x0F, START + 300_000))
    # AcceptedPlan up at SYNC 1 and beyond the window from SYNC 2 on: SYNC 12 is 10 ms later.
    assert [n for n, emergency in enumerate(found) if emergency] == [12]
    assert found[12] == [(0x8611, 0x21)]
    assert rig.read(0x603F) == 0x8611
    assert rig.read(0x6041) & 0x2000


# Quick stop and the watchdogs.


def test_quick_stop_brakes_with_its_ramp_and_time_runs_on_without_sync(rig: Rig) -> None:
    rig.enable()
    target = rig.move(1e5)
    rig.cycle(QUICK_STOP, target)
    rig.now += PERIOD
    rig.send(0x080)
    assert rig.state() is S.QUICK_STOP_ACTIVE
    began = rig.servo.position
    rig.wait(0.05)
    assert rig.state() is S.QUICK_STOP_ACTIVE
    assert 0.0 < rig.servo.velocity < 1e5
    rig.wait(0.1)
    assert rig.state() is S.SWITCH_ON_DISABLED
    coasted = 3 * PERIOD * 1e5  # until the SYNC was found lost
    assert rig.servo.position - began == pytest.approx(1e5**2 / (2 * DECELERATION) + coasted, rel=1e-6)


@pytest.mark.parametrize("friction", [5e6, None])
@pytest.mark.parametrize("why", ["command", "fault"])
def test_without_power_friction_stops_the_axis(why: str, friction: float | None) -> None:
    """Also after a fault whose reaction is no ramp (605Eh = 0)."""
    rig = Rig(friction=friction)
    rig.drive.objects[0x605E, 0].value = 0
    rig.enable()
    target = rig.move(1e5)
    if why == "command":
        rig.cycle(0x00, target)
    else:
        rig.drive.fail(0x2310)
    rig.now += PERIOD
    rig.send(0x080)
    assert rig.state() is (S.SWITCH_ON_DISABLED if why == "command" else S.FAULT)
    began, moving = rig.servo.position, rig.servo.velocity
    for _ in range(100):
        rig.now += PERIOD
        rig.send(0x080)
    assert rig.servo.velocity == 0.0
    deceleration = friction or rig.servo.max_acceleration
    assert rig.servo.position - began == pytest.approx(moving**2 / (2 * deceleration), rel=1e-6)
    assert friction is None or rig.servo.position - began > 500


def test_a_ramp_that_began_without_sync_does_not_hurry_when_sync_comes_back(rig: Rig) -> None:
    rig.enable()
    rig.move(1e5)
    rig.wait(0.02)
    assert rig.state() is S.FAULT_REACTION_ACTIVE
    velocity = rig.servo.velocity
    for n in range(5):
        assert rig.servo.velocity == pytest.approx(velocity - n * DECELERATION * PERIOD)
        rig.now += PERIOD
        rig.send(0x080)


def test_quick_stop_advances_by_sync_while_there_is_one(rig: Rig) -> None:
    rig.enable()
    target = rig.move(1e5)
    rig.cycle(QUICK_STOP, target)
    rig.cycle(QUICK_STOP, target)
    for n in range(1, 50):
        rig.cycle(QUICK_STOP, target)
        assert rig.servo.velocity == pytest.approx(1e5 - n * DECELERATION * PERIOD)


@pytest.mark.parametrize("step", [0.0002, 0.5])
def test_three_missed_syncs_are_a_fault_however_rarely_the_drive_is_polled(rig: Rig, step: float) -> None:
    rig.enable()
    rig.move(1e5)
    began = rig.servo.position
    assert not emergencies(rig.wait(2 * PERIOD + 0.0008))
    frames = rig.wait(1.0, step)
    assert emergencies(frames) == [(0x8700, 0x11)]
    assert rig.state() is S.FAULT
    coasted = 3 * PERIOD * 1e5
    assert rig.servo.position - began == pytest.approx(1e5**2 / (2 * DECELERATION) + coasted, rel=0.01)


def test_a_lost_sync_is_no_fault_without_power(rig: Rig) -> None:
    rig.cyclic()
    rig.cycle(0x06, START)
    assert not emergencies(rig.wait(1.0))


@pytest.mark.parametrize("operational", [True, False])
def test_a_lost_sync_is_no_fault_unless_operational_and_told_to_expect_it(rig: Rig, operational: bool) -> None:
    rig.write(0x6007, 0, pack("<h", 0))
    rig.enable()
    if operational:
        rig.write(0x1006, 0, pack("<I", 0))
    else:
        rig.nmt(128)
    rig.send(0x080)
    assert not emergencies(rig.wait(1.0))
    assert rig.state() is S.OPERATION_ENABLED


def sync_only(rig: Rig, seconds: float) -> list[Frame]:
    """Cycles in which the master sends everything but its heartbeat."""
    frames = []
    for _ in range(round(seconds / PERIOD)):
        rig.now += PERIOD
        frames += rig.send(0x080)
    return frames


@pytest.mark.parametrize(
    ("option", "state"),
    [
        (0, S.OPERATION_ENABLED),
        (1, S.FAULT_REACTION_ACTIVE),
        (2, S.SWITCH_ON_DISABLED),
        (3, S.QUICK_STOP_ACTIVE),
    ],
)
def test_loss_of_the_masters_heartbeat(rig: Rig, option: int, state: PowerState) -> None:
    rig.write(0x6007, 0, pack("<h", option))
    rig.write(0x1029, 1, b"\x01")
    rig.write(0x1016, 1, pack("<I", 126 << 16 | 100))
    rig.enable()
    rig.move(1e5)
    assert not emergencies(sync_only(rig, 0.3))  # watching begins with the first heartbeat
    rig.move(1e5)
    rig.send(0x77E, b"\x05")
    assert not emergencies(sync_only(rig, 0.099))
    rig.servo.velocity = 1e5
    assert emergencies(sync_only(rig, 0.002)) == [(0x8130, 0x11)]
    assert rig.state() is state
    assert not emergencies(sync_only(rig, 0.3))
    expected_reset = [] if option == 1 else [(0, 0)]
    assert emergencies(rig.send(0x77E, b"\x05")) == expected_reset
    if option == 1:
        assert rig.state() is S.FAULT
        assert rig.read(0x603F) == 0x8130


@pytest.mark.parametrize(("behaviour", "state"), [(0, 127), (1, 5), (2, 4)])
def test_error_behaviour_says_where_a_lost_heartbeat_leads(rig: Rig, behaviour: int, state: int) -> None:
    rig.write(0x1029, 1, bytes([behaviour]))
    rig.write(0x1016, 1, pack("<I", 126 << 16 | 100))
    rig.nmt(1)
    rig.send(0x77E, b"\x05")
    assert emergencies(rig.wait(0.2)) == [(0x8130, 0x11)]
    assert rig.drive.nmt == state


def test_an_rpdo_that_comes_after_the_loss_is_not_heard(rig: Rig) -> None:
    rig.write(0x1016, 1, pack("<I", 126 << 16 | 100))
    rig.nmt(1)
    rig.send(0x77E, b"\x05")
    rig.now += 1.0
    rig.send(0x205, pack("<H", 0x06))
    assert rig.state() is S.SWITCH_ON_DISABLED


@pytest.mark.parametrize("command", [2, 128, 130])
def test_leaving_operational_while_enabled_is_a_quick_stop(rig: Rig, command: int) -> None:
    rig.enable()
    rig.move(1e5)
    rig.nmt(command)
    assert rig.state() is S.QUICK_STOP_ACTIVE
    rig.wait(0.2)
    assert rig.state() is S.SWITCH_ON_DISABLED
    assert rig.servo.velocity == 0.0


def test_a_fault_outlives_a_reset_of_communication_but_not_of_the_node(rig: Rig) -> None:
    rig.drive.fail(0x2310)
    rig.wait(0.001)
    rig.nmt(130)
    assert rig.read(0x1001) == 0x03
    assert rig.state() is S.FAULT
    rig.nmt(129)
    assert rig.read(0x1001) == 0
    assert rig.state() is S.SWITCH_ON_DISABLED


def test_a_silent_drive_neither_hears_nor_speaks(rig: Rig) -> None:
    rig.write(0x1017, 0, pack("<H", 10))
    rig.drive.silent = True
    assert not rig.wait(1.0)
    assert not rig.nmt(1)
    assert rig.drive.nmt == 127


# The bus.


@pytest.fixture
def bus() -> Iterator[SimulatedBus]:
    section = config.Can("simulated", simulated=config.Simulated(start=(0.1, -0.2, 0.0)))
    a, _, c = alike()
    drives = config.Drives("cia402", a, config.Drive(2, 1e6, direction=-1, offset=0.05), c)
    with simulated_bus(section, drives, lambda: 0.0) as bus:
        yield bus


def received(bus: can.BusABC) -> list[Frame]:
    frames = []
    while (message := bus.recv(0.0)) is not None:
        assert message.timestamp > 0.0
        frames.append((message.arbitration_id, bytes(message.data)))
    return frames


def test_three_drives_boot_up_at_their_configured_counts(bus: SimulatedBus) -> None:
    assert received(bus) == [(0x701, b"\0"), (0x702, b"\0"), (0x703, b"\0")]
    for node, counts in ((1, 100_000), (2, 250_000), (3, 0)):
        bus.send(frame(0x600 + node, pack("<BHB4x", 0x40, 0x6064, 0)))
        assert received(bus) == [(0x580 + node, pack("<BHBi", 0x43, 0x6064, 0, counts))]


def test_the_sender_does_not_hear_itself(bus: SimulatedBus) -> None:
    received(bus)
    bus.send(frame(0x080))
    bus.send(frame(0x601, bytes(8), is_extended_id=True))
    assert received(bus) == []


def test_drives_hear_one_another(bus: SimulatedBus) -> None:
    received(bus)
    bus.send(frame(0x602, pack("<BHBI", 0x23, 0x1016, 1, 1 << 16 | 100)))
    bus.send(frame(0x601, pack("<BHBHxx", 0x2B, 0x1017, 0, 1000)))
    received(bus)
    bus.drives[1].poll(0.2)
    assert (0x82, pack("<HB5x", 0x8130, 0x11)) in received(bus)
