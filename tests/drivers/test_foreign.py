"""Drives that others made come into motion by configuration alone: canopen's SDO server, makers' dictionaries."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import can
import msgspec
import pytest
from drivers.foreign import ForeignDrive, Habits, Truth, three
from edsfiles import rows
from hypothesis import given, settings
from hypothesis import strategies as st
from rigs import STANDSTILL, Closing, Cycles, alike
from trirail.config import SIM, load
from trirail.errors import ConfigError
from trirail_drivers.cia402 import sdo_client
from trirail_drivers.cia402.canopen_frames import CONTROLWORD, ENABLE_OPERATION, INTERPOLATE
from trirail_drivers.cia402.drives import Cia402
from trirail_drivers.cia402.objects import FOLLOWING_BIT, USES
from trirail_drivers.config import NO_IO, DigitalIo, Drives
from trirail_drivers.errors import DriveError, DriveTimeout
from trirail_drivers.interface import Feedback, PowerState, Triple
from trirail_drivers.protocols import PROTOCOLS
from trirail_drivers.timing import BusTiming

PERIOD = 0.002
COUNTS = 819_200.0
TURNS = 200.0
"""Per metre: a screw of 5 mm lead and an encoder of 4096 counts."""
RPM = 60.0 * TURNS
IN_COUNTS = Truth(COUNTS, COUNTS, COUNTS)
IN_RPM = Truth(COUNTS, RPM, RPM)


class Make(msgspec.Struct):
    """What one has to say of a make to drive it, and what is true of it."""

    truth: Truth
    keys: dict[str, Any] = {}
    mode: int = 8
    offset: bool = False
    """It takes a velocity offset, so that it follows without a lag."""


MAKES = {
    "elmo_gold": Make(IN_COUNTS, offset=True),
    "maxon_epos4_compact50_5": Make(IN_RPM, {"revolutions_per_metre": TURNS, "accept_without": ("1006",)}, offset=True),
    "nanotec_pd4n": Make(
        IN_COUNTS,
        {"acceleration_unit": "counts/s2", "accept_without": ("1006", "6007", "605E")},
        7,
    ),
    "pilz_prbt": Make(IN_COUNTS, {"accept_without": ("1006", "6007", "605A", "605E", "6085")}, 7),
    "ros2_cia402_slave": Make(IN_COUNTS, {"acceleration_unit": "counts/s2", "accept_without": ("1006", "6007")}),
    "technosoft_ipos": Make(IN_COUNTS, {"acceleration_unit": "counts/s2"}, 7),
}


class Rig(Cycles[Cia402]):
    """Three drives of a make, the driver under test, and a loop that turns the clock."""

    period = PERIOD

    def __init__(
        self,
        name: str,
        habits: Habits | None = None,
        truth: Truth | None = None,
        *,
        rebased: bool = True,
        io: Sequence[DigitalIo] = NO_IO,
        **keys: Any,
    ) -> None:
        make = MAKES[name]
        drives = alike(**{"counts_per_metre": COUNTS, **make.keys, **keys})
        self.config = Drives("cia402", *drives, sdo_timeout=0.05, quick_stop_deceleration=2.0)
        self.wires, self.clock = three(
            name, dict.fromkeys((1, 2, 3), truth or make.truth), habits=habits, rebased=rebased
        )
        self.drives = Cia402(self.wires, BusTiming(1_000_000), self.config, self.clock, io=io)
        self.warnings: list[str] = []

    @property
    def nodes(self) -> list[ForeignDrive]:
        return self.wires.nodes

    def cycle(self, position: Triple | None = None, velocity: Triple = STANDSTILL) -> Feedback:
        feedback = super().cycle(position, velocity)
        self.warnings += feedback.warnings
        return feedback

    def ready(self) -> None:
        self.drives.configure(PERIOD)
        self.feedback = self.cycle()

    def enable(self) -> None:
        self.drives.enable()
        for _ in range(40):
            self.feedback = self.cycle(self.feedback.position)
            assert self.feedback.fault is None, self.feedback.fault
            if set(self.feedback.state) == {PowerState.OPERATION_ENABLED}:
                self.target = self.feedback.position
                return
        raise AssertionError(f"not enabled: {self.feedback}")

    def go(self, speed: float, cycles: int) -> None:
        """Setpoints at a constant speed, from where the sliders were sent last; none of it is a fault."""
        self.feedback = self.move(cycles, (speed, speed, speed))
        assert self.feedback.fault is None, self.feedback.fault


@pytest.mark.parametrize("name", MAKES)
def test_a_drive_moves_as_fast_as_it_is_told(closing: Closing, name: str) -> None:
    rig = closing(Rig(name))
    rig.ready()
    assert {node.mode for node in rig.nodes} == {MAKES[name].mode}
    rig.enable()
    rig.go(0.1, 100)
    start = [node.servo.position for node in rig.nodes]
    rig.go(0.1, 100)
    for node, place in zip(rig.nodes, start, strict=True):
        assert (node.servo.position - place) / (100 * PERIOD) == pytest.approx(0.1, rel=0.01)
    lag = 0.0 if MAKES[name].offset else rig.nodes[0].servo.LAG
    for node, target in zip(rig.nodes, rig.target, strict=True):
        # What is written now is taken up a SYNC later, and reached by the one after that.
        assert target - node.servo.position == pytest.approx(0.1 * (lag + 2 * PERIOD), abs=0.1 * PERIOD)
    assert rig.feedback.position == pytest.approx([node.servo.position for node in rig.nodes], abs=2e-3)


@pytest.mark.parametrize("name", MAKES)
def test_position_limits_of_a_drive_as_it_is_delivered_are_no_reason_to_refuse_it(closing: Closing, name: str) -> None:
    rig = closing(Rig(name))
    rig.drives.configure(PERIOD, 0.2, travel=((-1.0, 1.0), (-0.5, 0.2), (0.1, 0.3)))
    rig.feedback = rig.cycle()
    assert not [warning for warning in rig.warnings if "607" in warning]


def test_a_drive_that_returns_with_limits_that_exclude_some_of_the_travel_is_not_ready(closing: Closing) -> None:
    rig = closing(Rig("elmo_gold"))
    rig.drives.configure(PERIOD, 0.2, travel=((-1.0, 1.0), (-1.0, 1.0), (-1.0, 1.0)))
    rig.feedback = rig.cycle()
    node = rig.nodes[1]
    node.boot()
    node.put(0x607B, 100_000, 2)
    for _ in range(2000):
        rig.feedback = rig.cycle(rig.feedback.position)
        if "607B" in str(rig.feedback.unready[1]):
            break
    assert "drive B: object 607B (position range limit) is -1000000000 to 100000 counts" in str(rig.feedback.unready[1])


ACTIONS = {0x6040, 0x60C4}
"""What is written in any case: a controlword that takes power off, and what empties the buffer of mode 7."""


@pytest.mark.parametrize("name", MAKES)
def test_a_drive_that_is_set_up_is_only_read_and_nothing_is_ever_stored_in_it(closing: Closing, name: str) -> None:
    rig = closing(Rig(name))
    rig.ready()
    for node in rig.nodes:
        assert {index for index, *_ in node.written} - ACTIONS
        assert 0x1010 not in {index for index, *_ in node.written}
        node.written.clear()
    rig.drives.configure(PERIOD)
    for node in rig.nodes:
        again = {index for index, *_ in node.written} - ACTIONS
        assert again == ({0x1401, 0x1601} if name == "ros2_cia402_slave" else set()), "a mapping that it refuses"


def test_the_tables_of_objects_are_those_of_the_guide() -> None:
    guide = (Path(__file__).parents[2] / "drivers" / "requirements.md").read_text()
    for need in ("protection", "replaceable"):
        table = guide.partition(f"| {need} | what for | without it |")[2].partition("\n\n")[0]
        rows = re.findall(r"^\| ([0-9A-F]{4}(?::\d\d)?) (.+) \| (.+) \| (.+) \|$", table, re.MULTILINE)
        assert rows == [(key, use.name, use.purpose, use.without) for key, use in USES.items() if use.need == need]
    needed = guide.partition("- *Needed*")[2].partition("\n- ")[0]
    assert set(re.findall(r"\b\d[0-9A-F]{3}\b", needed)) == {key for key, use in USES.items() if use.need == "needed"}


@pytest.mark.parametrize(
    ("name", "keys", "said"),
    [
        ("maxon_epos4_compact50_5", {"accept_without": ()}, r"drive A lacks protections: 1006, its monitoring of SYNC"),
        ("nanotec_pd4n", {"accept_without": ("1006",)}, r'accept_without = \["1006", "6007", "605E"\]'),
        ("technosoft_ipos", {"acceleration_unit": None}, r"its unit of acceleration \(object 60AA\)"),
        (
            "technosoft_ipos",
            {"acceleration_unit": "rpm/s"},
            r"is in revolutions, .* set drives.A.rev",
        ),
        ("elmo_gold", {"velocity_unit": "rpm"}, r'A.velocity_unit = "rpm" contradicts the drive: object 6096'),
        ("maxon_epos4_compact50_5", {"velocity_unit": "counts/s"}, r"object 60A9 = 00B44700h is rev/min"),
        ("nanotec_pd4n", {"revolutions_per_metre": 100.0}, r"= 100 contradicts .* 409.6 \(object 6092"),
    ],
)
def test_what_a_drive_lacks_or_contradicts_is_refused_by_name(
    closing: Closing, name: str, keys: dict[str, Any], said: str
) -> None:
    rig = closing(Rig(name, **keys))
    with pytest.raises(DriveError, match=said):
        rig.ready()
    assert all(index == 0x6040 for node in rig.nodes for index, *_ in node.written)


@pytest.mark.parametrize("lost", [0, 1, 2])
@pytest.mark.parametrize("shown", [True, False], ids=["bit 12", "no bit 12"])
@pytest.mark.parametrize("name", [name for name, make in MAKES.items() if make.mode == 7])
def test_lost_commands_to_interpolate_are_repeated(
    closing: Closing, monkeypatch: pytest.MonkeyPatch, name: str, shown: bool, lost: int
) -> None:
    accepted = (*MAKES[name].keys.get("accept_without", ()), *(() if shown else (FOLLOWING_BIT,)))
    rig = closing(Rig(name, accept_without=accepted))
    rig.ready()
    identifier = rig.drives._axes[1].exchange.controlword
    send, word, left = rig.wires.send, ENABLE_OPERATION | INTERPOLATE, iter(range(lost))

    def lose(message: can.Message, timeout: float | None = None) -> None:
        starts = message.arbitration_id == identifier and message.data[:2] == CONTROLWORD.pack(word)
        if not starts or next(left, None) is None:
            send(message, timeout)

    monkeypatch.setattr(rig.wires, "send", lose)
    rig.enable()
    rig.cycles(10)
    rig.go(0.05, 60)
    node = rig.nodes[1]
    assert node.servo.position == pytest.approx(rig.nodes[0].servo.position, abs=1.0)


@pytest.mark.parametrize(
    ("left", "values"),
    [
        pytest.param((0x1007, 0, 7, "rw", 500, False), {}, id="a window for PDOs"),
        pytest.param((0x1019, 0, 5, "rw", 10, False), {}, id="a counter in SYNC"),
        pytest.param((0x1019, 0, 5, "rw", 10, False), {(0x1006, 0): 2000}, id="a counter, while SYNC is watched"),
        pytest.param((0x1400, 5, 6, "rw", 50, False), {}, id="a deadline"),
        pytest.param((0x1401, 5, 6, "rw", 1, False), {}, id="a short deadline"),
    ],
)
def test_what_another_master_has_left_in_a_drive_does_not_disturb_the_cycle(
    closing: Closing, left: tuple[int, int, int, str, int, bool], values: dict[tuple[int, int], int]
) -> None:
    """Seen with lely-core's slave: objects that the dictionaries of real drives have, as a master with a SYNC of
    another kind would leave them."""
    rig = closing(Rig("elmo_gold", Habits(more=(left,), values=values)))
    rig.ready()
    rig.enable()
    for _ in range(100):
        a, b, c = rig.target
        rig.target = a + 1e-4, b + 1e-4, c + 1e-4
        rig.drives.sync()
        rig.clock.now += PERIOD / 2  # as long as it takes until the positions are in
        rig.feedback = rig.drives.read()
        rig.drives.write(rig.target, (0.05, 0.05, 0.05))
        rig.clock.now += PERIOD / 2
        assert rig.feedback.fault is None, rig.feedback.fault
    assert rig.feedback.position == pytest.approx(rig.target, abs=1e-3)


@pytest.mark.parametrize("index", [0x1005, 0x1007, 0x1019])
def test_a_drive_that_keeps_a_sync_of_another_kind_is_refused(closing: Closing, index: int) -> None:
    kind = 5 if index == 0x1019 else 7
    rig = closing(Rig("elmo_gold", Habits(without=frozenset({index}), more=((index, 0, kind, "ro", 0x81, False),))))
    with pytest.raises(DriveError, match=f"drive A: cannot write 0.* to object {index:04X}:00 .*; it keeps "):
        rig.ready()


def test_a_drive_that_answers_no_guarding_is_not_watched_by_it(closing: Closing) -> None:
    rig = closing(Rig("technosoft_ipos", Habits(answers_guarding=False)))
    before = [(node.value(0x100C), node.value(0x100D)) for node in rig.nodes]
    with pytest.raises(DriveError, match="drive A lacks protections: 1016, its monitoring of this service"):
        rig.ready()
    assert [(node.value(0x100C), node.value(0x100D)) for node in rig.nodes] == before
    rig = closing(Rig("technosoft_ipos", Habits(answers_guarding=False), accept_without=("1016",)))
    rig.ready()
    rig.enable()
    rig.go(0.05, 60)


OF_EARLIER = (
    b"\x60\x40\x60\x00\x00\x00\x00\x00",  # a controlword was taken
    b"\x80\x40\x60\x00\x21\x00\x00\x08",  # or was not
    b"\x4b\x77\x60\x00\x00\x00\x00\x00",  # an object was read that the set-up does not ask for
    b"\x80\x77\x60\x00\x00\x00\x04\x05",  # the drive has given up waiting for a segment
    b"\x01\x00\x00\x00\x00\x00\x00\x00",  # a segment
    b"\x20\x00\x00\x00\x00\x00\x00\x00",  # a segment was taken
    b"\x60\x40\x60",  # no frame of an SDO server's
)
"""What a drive may send in answer to those who asked before; of 6040h only what is no answer to reading it."""


@settings(max_examples=20)
@given(late=st.lists(st.sampled_from(OF_EARLIER), min_size=1, max_size=20))
def test_late_answers_to_earlier_requests_are_not_taken_for_others(late: list[bytes]) -> None:
    rig = Rig("elmo_gold")
    recv, held = rig.wires.recv, list[can.Message]()

    def late_ones_first(timeout: float | None = None) -> can.Message | None:
        if held:
            return held.pop()
        message = recv(timeout)
        if message is None or message.arbitration_id != 0x581 or not late or message.data[1:3] == b"\x40\x60":
            return message
        held.append(message)
        return can.Message(arbitration_id=0x581, data=late.pop(), is_extended_id=False)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rig.wires, "recv", late_ones_first)
        try:
            rig.ready()
        finally:
            rig.drives.close()
    assert not late
    assert rig.feedback.fault is None


def test_an_answer_against_the_rules_is_not_told_as_silence(closing: Closing, monkeypatch: pytest.MonkeyPatch) -> None:
    """A segment whose toggle bit is wrong (CiA 301, 7.2.4.3.6)."""
    rig = closing(Rig("elmo_gold"))
    served = rig.nodes[0].local.sdo
    answer: Callable[[bytes], None] = served.send_response

    def in_segments(data: bytes) -> None:
        answer(b"\x41\x00\x10\x00\x04\0\0\0" if data[0] == 0x43 else b"\x10" + bytes(7))

    monkeypatch.setattr(served, "send_response", in_segments)
    with pytest.raises(DriveError, match=r"drive A: cannot read object 1000:00 .*: Toggle bit") as told:
        rig.ready()
    assert not isinstance(told.value, DriveTimeout)


@pytest.mark.parametrize("piece", [b"1234567", b""], ids=["full", "empty"])
@pytest.mark.parametrize("size", [10, None])
def test_a_transfer_that_never_ends_is_refused(
    closing: Closing, monkeypatch: pytest.MonkeyPatch, size: int | None, piece: bytes
) -> None:
    rig = closing(Rig("elmo_gold"))
    served, toggles = rig.nodes[0].local.sdo, itertools.cycle((0, 0x10))
    answer: Callable[[bytes], None] = served.send_response

    def endless(data: bytes) -> None:
        if data[0] == 0x43:
            answer(b"\x40\x00\x10\x00" + bytes(4) if size is None else b"\x41\x00\x10\x00" + bytes([size, 0, 0, 0]))
        else:
            answer(bytes([next(toggles) | (7 - len(piece)) << 1]) + piece.ljust(7, b"\0"))

    monkeypatch.setattr(sdo_client, "MAX_UPLOAD", 64)
    monkeypatch.setattr(served, "send_response", endless)
    announced = size or "no size"
    with pytest.raises(DriveError, match=rf"A: cannot read object 1000:00 .* without an end, {announced} announced"):
        rig.ready()


def test_a_segment_that_is_not_answered_is_aborted_by_its_object(
    closing: Closing, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = closing(Rig("elmo_gold"))
    served, sent = rig.nodes[0].local.sdo, list[bytes]()
    answer: Callable[[bytes], None] = served.send_response
    send = rig.wires.send

    def begun(data: bytes) -> None:
        if data[0] == 0x43:
            answer(b"\x41\x00\x10\x00\x04\0\0\0")

    def recorded(message: can.Message, timeout: float | None = None) -> None:
        sent.append(bytes(message.data))
        send(message, timeout)

    monkeypatch.setattr(served, "send_response", begun)
    monkeypatch.setattr(rig.wires, "send", recorded)
    with pytest.raises(DriveTimeout):
        rig.ready()
    aborts = {data for data in sent if len(data) == 8 and data[0] == 0x80}
    assert aborts == {bytes.fromhex("80 00 10 00 00 00 04 05")}


LACKABLE = [name for name, use in USES.items() if use.need == "protection" and name != "1016"]
"""Protections whose place nothing takes; for 1016 there is guarding."""


@settings(max_examples=20)
@given(lacking=st.sets(st.sampled_from(LACKABLE)), more=st.sets(st.sampled_from(LACKABLE)), bit_12=st.booleans())
def test_what_drives_do_without_is_known_by_drive_and_object(lacking: set[str], more: set[str], bit_12: bool) -> None:
    """What is only named, and is there, is not told to be missing; bit 12, once named, is not looked at."""
    accepted = tuple(lacking | more) + ((FOLLOWING_BIT,) if bit_12 else ())
    rig = Rig("elmo_gold", Habits(without=frozenset(int(name, 16) for name in lacking)), accept_without=accepted)
    try:
        rig.ready()
        missing = lacking | ({FOLLOWING_BIT} if bit_12 else set())
        told = rig.drives.missing_protections
        assert sorted((each.drive, each.object) for each in told) == sorted(
            (d, name) for d in "ABC" for name in missing
        )
        for each in told:
            assert each.means == PROTOCOLS["cia402"].protections[each.object]
            assert any(f"lacks {each.object} (" in warning for warning in rig.warnings)
    finally:
        rig.drives.close()


@pytest.mark.parametrize(
    ("example", "name", "known"),
    [("elmo_gold", "6040", "1006, "), ("elmo_gold", "1001", "1006, "), ("odrive_s1", "1006", "endpoints, ")],
)
def test_what_is_no_protection_cannot_be_accepted_to_be_missing(
    tmp_path: Path, example: str, name: str, known: str
) -> None:
    text = (SIM.parent / f"drives/{example}.toml").read_text()
    path = tmp_path / "robot.toml"
    path.write_text(text.replace("[drives.B]", f'[drives.B]\naccept_without = ["{name}"]'))
    with pytest.raises(
        ConfigError, match=rf'drives.B.accept_without: "{name}" is not a known protection; choose from {known}'
    ):
        load(path)


# 60A8h, 60A9h, 60AAh (CiA 303-2), and what they are of a metre: 819 200 counts and 200 revolutions.
UNITS = [
    (0x00B5_0000, 0x00B5_0300, 0x00B5_5700, Truth(COUNTS, COUNTS, COUNTS)),
    (0x00B5_0000, 0x00B4_4700, 0x00C0_0300, Truth(COUNTS, 60 * TURNS, 60 * TURNS)),
    (0x00B5_0000, 0xFDB4_4700, 0x00B4_5700, Truth(COUNTS, 60e3 * TURNS, TURNS)),
    (0xFF41_0000, 0x0041_0300, 0xFF41_5700, Truth(3600 * TURNS, 360 * TURNS, 3600 * TURNS)),
    (0xFD10_0000, 0xFD10_0300, 0x0010_5700, Truth(1e3 * math.tau * TURNS, 1e3 * math.tau * TURNS, math.tau * TURNS)),
    (0xFA01_0000, 0xFD01_0300, 0xFD01_5700, Truth(1e6, 1e3, 1e3)),
    (0xFB01_0000, 0xFD01_4700, 0x0001_5700, Truth(1e5, 60e3, 1.0)),
    (0xFCB4_0000, 0x00B4_0300, 0x00B4_0300, Truth(1e4 * TURNS, TURNS, TURNS)),
]


def assert_a_tenth_of_a_metre_a_second(rig: Rig, truth: Truth, within: float) -> None:
    """Assert that drives go as they are told, and that the ramp of a quick stop is right but for a share of it."""
    rig.ready()
    rig.enable()
    rig.go(0.1, 150)
    for node, target in zip(rig.nodes, rig.target, strict=True):
        # A velocity offset of 1 rpm is a step of 0.08 mm/s; in the wrong unit the lag would be millimetres.
        assert target - node.servo.position == pytest.approx(0.1 * PERIOD, abs=5e-5)
        assert node.value(0x6085) / truth.acceleration == pytest.approx(2.0, rel=within)


def test_the_factors_6096_and_6097_go_as_makers_have_them(closing: Closing) -> None:
    """Beckhoff's AX8000 as it comes: 2^20 counts a turn, velocities in 0.0001 rpm, accelerations in degrees/s²."""
    factors = {(0x6096, 1): 600_000, (0x6096, 2): 2**20, (0x6097, 1): 360, (0x6097, 2): 600_000}
    truth = Truth(2**20 * TURNS, 60e4 * TURNS, 360 * TURNS)
    rig = closing(Rig("elmo_gold", Habits(values=factors), truth, counts_per_metre=truth.position))
    assert_a_tenth_of_a_metre_a_second(rig, truth, 1e-3)


@pytest.mark.parametrize(("position", "velocity", "acceleration", "truth"), UNITS)
def test_a_tenth_of_a_metre_a_second_is_that_in_every_unit(
    closing: Closing, position: int, velocity: int, acceleration: int, truth: Truth
) -> None:
    values = {(0x60A8, 0): position, (0x60A9, 0): velocity, (0x60AA, 0): acceleration}
    turns = TURNS if truth.position == COUNTS else None
    keys: dict[str, Any] = {"counts_per_metre": truth.position, "revolutions_per_metre": turns}
    rig = closing(Rig("maxon_epos4_compact50_5", Habits(values=values), truth, **keys))
    assert_a_tenth_of_a_metre_a_second(rig, truth, 0.3 if truth.acceleration == 1.0 else 0.01)
    for node in rig.nodes:
        assert node.value(0x6065) / truth.position == pytest.approx(0.005, rel=1e-3)
    rig.drives.quick_stop()
    at = [node.servo.position for node in rig.nodes]
    rig.cycles(60)
    for node, place in zip(rig.nodes, at, strict=True):
        # v²/2a, and what is left of the lag.
        assert node.servo.velocity == 0.0
        assert node.servo.position - place == pytest.approx(0.1**2 / 2 / 2.0, abs=1e-3)


def test_a_unit_that_nobody_says_of_a_metre_is_set_to_counts(closing: Closing) -> None:
    rig = closing(Rig("maxon_epos4_compact50_5", None, IN_COUNTS, revolutions_per_metre=None))
    rig.ready()
    assert [(node.value(0x60A9), node.value(0x60AA)) for node in rig.nodes] == [(0x00B5_0300, 0x00B5_5700)] * 3
    assert rig.nodes[0].value(0x6085) == round(2.0 * COUNTS)


def test_a_unit_that_cannot_be_set_and_that_nobody_says_is_refused(closing: Closing) -> None:
    refuses = {(0x60A9, 0): lambda value: value & 0xFFFFFF != 0xB44700}
    rig = closing(Rig("maxon_epos4_compact50_5", Habits(refuses=refuses), revolutions_per_metre=None))
    with pytest.raises(DriveError, match=r"object 60A9 is rev/min and cannot be set .*set drives.A.rev"):
        rig.ready()


def test_drives_whose_fixed_identifiers_are_the_same_are_refused(closing: Closing) -> None:
    """All three as node 1 has them by default: one setpoint would move them all."""
    values = dict.fromkeys([(0x1600, 0), (0x1601, 0), (0x1A00, 0), (0x1A01, 0)], 1)
    values |= {(0x1601, 1): 0x607A_0020, (0x1A01, 1): 0x6064_0020}
    rig = closing(Rig("elmo_gold", Habits(fixed_pdos=True, values=values), rebased=False))
    with pytest.raises(DriveError, match=r"drive B: shares with drive A the identifier \d+h that cannot be"):
        rig.ready()


@pytest.mark.parametrize("name", MAKES)
def test_dictionaries_whose_identifiers_are_those_of_node_1(closing: Closing, name: str) -> None:
    """They can be written; drives whose EMCYs keep one identifier are refused."""
    if any(index == 0x1014 and access != "rw" for index, _, _, access, *_ in rows(name)):
        with pytest.raises(DriveError, match=r"drive B: shares with drive A the identifier 081h .* \(1014, "):
            closing(Rig(name, rebased=False)).ready()
    rig = closing(Rig(name, Habits(access={(0x1014, 0): "rw"}), rebased=False))
    rig.ready()
    rig.enable()
    rig.go(0.1, 20)
