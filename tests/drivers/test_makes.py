"""Simulated drives with other makers' dictionaries: units, modes, inhibit times, watches, and what they lack."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from canopen import SdoAbortedError
from edsfiles import MAKES, eds, make_eds, rows
from hypothesis import given, settings
from hypothesis import strategies as st
from rigs import DeviceRig
from trirail_drivers.interface import PowerState
from trirail_drivers.simulated import Mechanics, Servo, SimulatedDrive

NODE = 5
PERIOD = 0.001
COUNTS_PER_METRE = 1e6
COUNTS_PER_REVOLUTION = 4000.0
VELOCITY = 0.1 * COUNTS_PER_METRE
"""0.1 m/s [counts/s]."""
DECELERATION = 2.0 * COUNTS_PER_METRE
"""2 m/s² [counts/s²]."""
MECHANICS = Mechanics(COUNTS_PER_METRE, COUNTS_PER_REVOLUTION)
Values = Mapping[tuple[int, int], int]


class Rig(DeviceRig[SimulatedDrive]):
    """A drive of some make, whose motor lags 10 ms behind what feed-forward leaves."""

    def __init__(self, path: Path, mechanics: Mechanics = MECHANICS, start: float = 20_000) -> None:
        servo = Servo(start, time_constant=0.01, max_velocity=2e6, max_acceleration=1e8)
        super().__init__(SimulatedDrive(NODE, servo, eds=path, mechanics=mechanics))

    def put(self, index: int, value: int, subindex: int = 0) -> None:
        """Write an object as the bus would."""
        self.drive.objects[index, subindex].write(value)

    def get(self, index: int, subindex: int = 0) -> int:
        return self.drive.objects[index, subindex].value

    def sync(self) -> list[tuple[int, bytes]]:
        self.now += PERIOD
        return self.send(0x080)

    def enabled(self, mode: int) -> None:
        """Operational in a mode, with power, 60C2h set where it is there."""
        if (0x60C2, 1) in self.drive.objects:
            self.put(0x60C2, -3, 2)
            self.put(0x60C2, 1, 1)
        self.send(0x000, bytes([1, NODE]))
        self.put(0x6060, mode)
        for word in (0x06, 0x07, 0x0F):
            self.put(0x6040, word)
        self.sync()
        assert self.drive.state is PowerState.OPERATION_ENABLED

    def abort(self, request: bytes) -> int:
        """The abort code that a request by SDO meets."""
        answer = next(
            data for can_id, data in self.send(0x600 + NODE, request.ljust(8, b"\0")) if can_id == 0x580 + NODE
        )
        assert answer[0] == 0x80, answer.hex()
        return int(struct.unpack_from("<I", answer, 4)[0])


# ---------------------------------------------------------------------- units

RPM = COUNTS_PER_REVOLUTION / 60.0
UNITS: tuple[tuple[str, Values, Mechanics, float, float], ...] = (
    # make, what its dictionary says, its axis, and units of velocity [counts/s] and acceleration [counts/s²] by hand
    ("elmo_gold", {}, MECHANICS, 1.0, 1.0),
    ("elmo_gold", {(0x6096, 1): 60, (0x6096, 2): 4000}, MECHANICS, RPM, RPM),
    ("maxon_epos4_compact50_5", {}, MECHANICS, RPM, RPM),
    ("maxon_epos4_compact50_5", {(0x60A9, 0): 0xFDB44700}, MECHANICS, 1e-3 * RPM, RPM),
    ("maxon_epos4_compact50_5", {(0x60A9, 0): 0xFD010300, (0x60AA, 0): 0xFD015700}, MECHANICS, 1e3, 1e3),
    ("maxon_epos4_compact50_5", {(0x60A9, 0): 0x00410300, (0x60AA, 0): 0x00410300}, MECHANICS, 4000 / 360, 4000 / 360),
    ("technosoft_ipos", {}, Mechanics(COUNTS_PER_METRE, velocity=0.1, acceleration=25.0), 0.1, 25.0),
)  # fmt: skip


@pytest.mark.parametrize(("make", "values", "mechanics", "velocity", "acceleration"), UNITS)
def test_the_servo_believes_the_units_of_its_dictionary(
    make: str, values: Values, mechanics: Mechanics, velocity: float, acceleration: float, tmp_path: Path
) -> None:
    """0.1 m/s in its own units is told as 0.1 m/s; the quick-stop ramp is as long as the one that was asked for."""
    rig = Rig(make_eds(tmp_path, make, {(0x6502, 0): 0x3ED, **values}), mechanics)
    rig.put(0x6085, round(DECELERATION / acceleration))
    rig.put(0x6065, 100_000)
    rig.enabled(8)
    begin = rig.get(0x6064)
    offset = (0x60B1, 0) in rig.drive.objects
    for tick in range(1, 301):
        rig.put(0x607A, begin + round(tick * VELOCITY * PERIOD))
        if offset:
            rig.put(0x60B1, round(VELOCITY / velocity))
        rig.sync()
    assert rig.get(0x606C) == pytest.approx(VELOCITY / velocity, rel=0.02, abs=1.0)
    lag = rig.get(0x607A) - rig.get(0x6064)
    # Without feed-forward the servo lags by velocity times time constant; with it, by what its unit rounds away.
    rounded = abs(VELOCITY - round(VELOCITY / velocity) * velocity) * 0.01
    assert lag == pytest.approx(0.0 if offset else VELOCITY * 0.01, abs=rounded + 2.0 + 0.02 * VELOCITY * 0.01)
    stopped_at = rig.get(0x6064)
    rig.put(0x6040, 0x02)
    while rig.drive.state is PowerState.QUICK_STOP_ACTIVE and rig.drive.servo.velocity:
        rig.sync()
    way = VELOCITY**2 / (2.0 * DECELERATION)
    assert rig.get(0x6064) - stopped_at == pytest.approx(way, rel=0.03)


def test_units_of_position_that_are_set_anew(tmp_path: Path) -> None:
    """60A8h from increments to µm, with 2 counts a µm; and 6092h: 2000 units a revolution become 500."""
    mechanics = Mechanics(2e6, COUNTS_PER_REVOLUTION)
    rig = Rig(make_eds(tmp_path, "maxon_epos4_compact50_5"), mechanics)
    assert rig.get(0x6064) == 20_000
    rig.put(0x60A8, 0xFA010000)
    rig.sync()
    rig.enabled(8)
    assert rig.get(0x6064) == 10_000
    (tmp_path / "nanotec").mkdir()
    rig = Rig(make_eds(tmp_path / "nanotec", "nanotec_pd4n"))
    rig.put(0x6092, 500, 1)
    rig.enabled(7)
    assert rig.get(0x6064) == 5_000


# ---------------------------------------------------------------------- modes


@pytest.mark.parametrize("make", ["nanotec_pd4n", "pilz_prbt"])
def test_drives_without_csp_interpolate(make: str, tmp_path: Path) -> None:
    """Mode 7: they follow 60C1:01 while bit 4 of the controlword is set, and tell it by bit 12 of the statusword."""
    rig = Rig(make_eds(tmp_path, make))
    assert rig.abort(bytes([0x2F, 0x60, 0x60, 0, 8])) == 0x06090030
    rig.enabled(7)
    begin = rig.get(0x6064)
    rig.put(0x60C1, begin + 100, 1)
    for _ in range(50):
        rig.sync()
    assert (rig.get(0x6064), rig.get(0x6041) & 0x1000) == (begin, 0)
    rig.put(0x6040, 0x1F)
    for tick in range(1, 101):
        rig.put(0x60C1, begin + 100 * tick, 1)
        rig.sync()
    assert rig.get(0x6041) & 0x1000
    assert rig.get(0x6064) - begin == pytest.approx(100 * 100, abs=100 * 10 + 200)
    rig.put(0x6040, 0x0F)
    for _ in range(2000):  # down its own ramp, as slow as 0.1 m/s²
        rig.sync()
    assert (rig.drive.servo.velocity, rig.get(0x6041) & 0x1000) == (0.0, 0)


@pytest.mark.parametrize("make", MAKES)
def test_modes_are_those_of_6502(make: str, tmp_path: Path) -> None:
    rig = Rig(make_eds(tmp_path, make))
    supported = rig.get(0x6502)
    for mode in (6, 7, 8):
        request = bytes([0x2F, 0x60, 0x60, 0, mode])
        if supported >> (mode - 1) & 1:
            assert rig.send(0x600 + NODE, request.ljust(8, b"\0"))[-1][1][0] == 0x60
        else:
            assert rig.abort(request) == 0x06090030


@settings(max_examples=20)
@given(value=st.integers(0, 0xFFFF))
def test_technosofts_mode_7_is_linear_with_bit_8_of_208e(value: int) -> None:
    """iPOS CANopen Programming, 9.2.1: else it is PT, where a position without its time moves nothing."""
    with TemporaryDirectory() as folder:
        rig = Rig(make_eds(Path(folder), "technosoft_ipos", {(0x208E, 0): value, (0x6065, 0): 1_000_000}))
    rig.enabled(7)
    begin = rig.get(0x6064)
    rig.put(0x6040, 0x1F)
    for tick in range(1, 101):
        rig.put(0x60C1, begin + 10 * tick, 1)
        rig.sync()
    moved = rig.get(0x6064) - begin
    assert moved == pytest.approx(1000, abs=120) if value >> 8 & 1 else moved == 0


@pytest.mark.parametrize(("make", "waits"), [("technosoft_ipos", True), ("nanotec_pd4n", False)])
def test_technosofts_show_their_mode_in_operation_enabled_alone(make: str, waits: bool, tmp_path: Path) -> None:
    """iPOS CANopen Programming, 6061h: in a state below it takes the value of 6060h only once it is reached."""
    rig = Rig(make_eds(tmp_path, make))
    rig.put(0x6060, 7)
    assert rig.get(0x6061) == (0 if waits else 7)
    rig.enabled(7)
    assert rig.get(0x6061) == 7
    rig.put(0x6060, 6)
    assert rig.get(0x6061) == 6
    rig.put(0x6040, 0)
    rig.put(0x6060, 7)
    assert rig.get(0x6061) == (6 if waits else 7)


@pytest.mark.parametrize(("exponent", "taken"), [(-3, True), (-2, False), (-4, False), (0, False)])
def test_nanotecs_interpolation_is_in_milliseconds(exponent: int, taken: bool, tmp_path: Path) -> None:
    """Manual of the PD4-C, 60C2h:02: must hold -3."""
    rig = Rig(make_eds(tmp_path, "nanotec_pd4n"))
    if taken:
        rig.put(0x60C2, exponent, 2)
    else:
        with pytest.raises(SdoAbortedError):
            rig.put(0x60C2, exponent, 2)
        assert rig.get(0x60C2, 2) == -3


def test_without_60c2_the_drive_moves_as_syncs_come(tmp_path: Path) -> None:
    path = tmp_path / "without.eds"
    path.write_text(eds(rows("elmo_gold"), lacks=(0x60C2, 0x1006, 0x6065)))
    rig = Rig(path)
    rig.enabled(8)
    begin = rig.get(0x6064)
    for tick in range(1, 201):
        rig.put(0x607A, begin + 100 * tick)
        rig.put(0x60B1, 100_000)
        rig.sync()
    assert rig.get(0x6064) - begin == pytest.approx(100 * 200, abs=400)
    assert rig.abort(bytes([0x40, 0xC2, 0x60, 1])) == 0x06020000


# ---------------------------------------------------------------------- watches


def remote(rig: Rig, can_id: int) -> list[tuple[int, bytes]]:
    rig.drive.receive_remote(can_id, rig.now)
    return rig.take()


def test_node_guarding_where_there_are_no_heartbeats(tmp_path: Path) -> None:
    """CiA 301: the answer has the NMT state, and bit 7 alternates; with a heartbeat there is no guarding."""
    rig = Rig(make_eds(tmp_path, "technosoft_ipos"))
    rig.take()
    answers = [remote(rig, 0x700 + NODE) for _ in range(3)]
    assert answers == [[(0x705, b"\x7f")], [(0x705, b"\xff")], [(0x705, b"\x7f")]]
    rig.send(0x000, bytes([1, NODE]))
    assert (0x705, b"\x85") in remote(rig, 0x700 + NODE)
    rig.put(0x1017, 100)
    rig.wait(PERIOD)
    assert all(can_id != 0x705 for can_id, _ in remote(rig, 0x700 + NODE))


def test_life_guarding_stops_a_drive_that_nobody_guards(tmp_path: Path) -> None:
    """100Ch and 100Dh: 3 * 20 ms after the last request EMCY 8130h, and what 6007h asks for."""
    rig = Rig(make_eds(tmp_path, "technosoft_ipos", {(0x6085, 0): 1_000_000}))
    rig.put(0x100C, 20)
    rig.put(0x100D, 3)
    rig.put(0x6007, 3)
    rig.enabled(7)
    remote(rig, 0x700 + NODE)
    assert not [data for can_id, data in rig.wait(0.055) if can_id == 0x085]
    told = [data for can_id, data in rig.wait(0.01) if can_id == 0x085]
    assert [data[:2] for data in told] == [b"\x30\x81"]
    assert rig.drive.state is not PowerState.OPERATION_ENABLED
    assert (0x085, bytes(8)) in remote(rig, 0x700 + NODE)


def test_an_inhibit_time_holds_the_statusword_back(tmp_path: Path) -> None:
    """Nanotec's 1800:03 is 100 ms: of two changes within it the second one goes out when it has passed."""
    rig = Rig(make_eds(tmp_path, "nanotec_pd4n"))
    rig.send(0x000, bytes([1, NODE]))
    rig.wait(0.2)
    begin = rig.now
    heard: list[tuple[float, int]] = []
    for word in (0x06, 0x07):
        rig.put(0x6040, word)
        heard += [(rig.now - begin, data[0] & 0x6F) for can_id, data in rig.wait(1e-6) if can_id == 0x185]
    while len(heard) < 2 and rig.now < begin + 0.3:
        heard += [(rig.now - begin, data[0] & 0x6F) for can_id, data in rig.wait(PERIOD) if can_id == 0x185]
    assert [status for _, status in heard] == [0x21, 0x23]
    assert [at for at, _ in heard] == pytest.approx([0.0, 0.1], abs=0.002)


# ---------------------------------------------------------------------- the configuration
