"""What a configuration gives a drive of its maker's own objects, and what it may not."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

import pytest
from drivers.foreign import Habits
from drivers.test_foreign import MAKES, PERIOD, Rig
from edsfiles import rows
from hypothesis import given, settings
from hypothesis import strategies as st
from rigs import Closing
from trirail.config import SIM, load
from trirail.errors import ConfigError
from trirail_drivers.cia402 import inspection
from trirail_drivers.cia402.makers_objects import address, owned
from trirail_drivers.cia402.objects import USES
from trirail_drivers.config import DigitalIo, Drive, Homing, ObjectWrite
from trirail_drivers.errors import ConfigurationRefused, DriveError

KINDS = {"i8": 0x02, "i16": 0x03, "i32": 0x04, "u8": 0x05, "u16": 0x06, "u32": 0x07}
"""CiA 301 data types."""
BRAKE = ObjectWrite(object=0x208E, value=0x100, type="u16", why="the brake opens late")
COMMANDED = {(0x6040, 0)}
"""Command of the set-up, which is no parameter."""
ROWS = ((0x208E, 0, 6, "rw", 0, False), (0x2090, 1, 4, "rw", 7, False))


@settings(max_examples=20)
@given(kind=st.sampled_from(sorted(KINDS)), data=st.data())
def test_a_value_of_every_type_is_written_and_read_back(kind: str, data: st.DataObject) -> None:
    bits = int(kind[1:])
    low = -(1 << bits - 1) if kind[0] == "i" else 0
    value = data.draw(st.integers(low, low + (1 << bits) - 1))
    write = ObjectWrite(object=0x208E, value=value, type=kind, why="x")  # type: ignore[arg-type]
    rig = Rig("elmo_gold", Habits(more=((0x208E, 0, KINDS[kind], "rw", 0, False),)), write=(write,))
    try:
        rig.drives.configure(PERIOD)
        assert [node.value(0x208E) & (1 << bits) - 1 for node in rig.nodes] == [value & (1 << bits) - 1] * 3
    finally:
        rig.drives.close()


def test_it_is_written_before_mapping_and_only_where_it_differs(closing: Closing) -> None:
    rig = closing(Rig("elmo_gold", Habits(more=ROWS), write=(BRAKE, ObjectWrite(0x2090, 7, "i32", "as it is", sub=1))))
    rig.ready()
    for node in rig.nodes:
        written = [index for index, *_ in node.written]
        assert written.index(0x208E) < min(written.index(index) for index in (0x1600, 0x1601, 0x1A01))
        assert 0x2090 not in written


def test_it_is_shown_with_its_reason(closing: Closing) -> None:
    rig = closing(Rig("elmo_gold", Habits(more=ROWS), write=(BRAKE,)))
    for each in inspection.inspect(rig.wires, rig.config, PERIOD, rig.clock, apply=False):
        (shown,) = [found for found in each["differences"] if found["object"] == "208E:00"]
        assert (shown["found"], shown["wanted"], shown["why"]) == ("0", "256", BRAKE.why)
    assert not any(node.written for node in rig.nodes)


@pytest.mark.parametrize(
    ("habits", "write", "said"),
    [
        (Habits(), BRAKE, r"drives\.A\.write: object 208E:00: the drive has no such object"),
        (
            Habits(more=((0x208E, 0, 7, "rw", 0, False),)),
            BRAKE,
            r'drives\.A\.write: object 208E:00 has 32 bits in the drive, but type = "u16"',
        ),
        (Habits(more=((0x208E, 0, 6, "ro", 0, False),)), BRAKE, r"drive A: cannot write 256 to object 208E:00"),
        (
            Habits(more=((0x2000, 0, 5, "rw", 1, False),), values={(0x1018, 1): 0xFB}),
            ObjectWrite(0x2000, 5, "u8", "another node id"),
            r"drives\.A\.write: object 2000:00 changes node id or bitrate",
        ),
    ],
)
def test_what_the_drive_cannot_take_is_refused(closing: Closing, habits: Habits, write: ObjectWrite, said: str) -> None:
    rig = closing(Rig("elmo_gold", habits, write=(write,)))
    with pytest.raises(DriveError, match=said):
        rig.drives.configure(PERIOD)


@pytest.mark.parametrize(
    ("vendor", "index", "refused"),
    [
        # maxon, EPOS4 Firmware Specification: 2000h Node-ID, 2001h CAN bit rate.
        (0xFB, 0x2000, True), (0xFB, 0x2001, True), (0xFB, 0x2005, False),
        # Nanotec, manuals, description of the object dictionary: 2005h CANopen Baudrate, 2009h CANopen NodeID.
        (0x26C, 0x2005, True), (0x26C, 0x2009, True), (0x26C, 0x2000, False),
        # Other makes have other things there.
        (0x9A, 0x2000, False), (0x9A, 0x2009, False),
    ],
)  # fmt: skip
def test_node_id_and_bitrate_are_refused_by_their_makers_numbers(
    closing: Closing, vendor: int, index: int, refused: bool
) -> None:
    habits = Habits(more=((index, 0, 5, "rw", 1, False),), values={(0x1018, 1): vendor})
    rig = closing(Rig("elmo_gold", habits, write=(ObjectWrite(index, 5, "u8", "x"),)))
    if refused:
        with pytest.raises(DriveError, match=rf"object {index:04X}:00 changes node id or bitrate"):
            rig.drives.configure(PERIOD)
        assert not any(written[0] == index for node in rig.nodes for written in node.written)
    else:
        rig.drives.configure(PERIOD)
        assert [node.value(index) for node in rig.nodes] == [5] * 3


def test_a_value_that_does_not_stick_is_refused(closing: Closing) -> None:
    rig = closing(Rig("elmo_gold", Habits(more=ROWS), write=(BRAKE,)))
    keep: Any = rig.nodes[1].local.set_data

    def set_data(index: int, subindex: int, data: bytes, check_writable: bool = False) -> None:
        keep(index, subindex, b"\1\0" if index == 0x208E else data, check_writable)

    vars(rig.nodes[1].local).update(set_data=set_data)
    with pytest.raises(ConfigurationRefused, match=r"drive B: object 208E:00 .*: expected 256, found 1 after 0\.05"):
        rig.drives.configure(PERIOD)


def configured(folder: Path, lines: str, example: str = "elmo_gold") -> Path:
    path = folder / "robot.toml"
    path.write_text((SIM.parent / f"drives/{example}.toml").read_text() + f"\n[[drives.B.write]]\n{lines}\n")
    return path


WHY = 'why = "…"'
HOMING = {"605D", "607C", "6098", "6099", "609A"}
OWNED = sorted(
    {name[:4] for name in USES} - HOMING | {"1010", "1011", "100B", "1600", "1A03", "60A9", "60AA", "60B0", "60B2"}
)


@pytest.mark.parametrize("index", OWNED)
def test_what_the_set_up_owns_and_what_stores_is_refused(tmp_path: Path, index: str) -> None:
    path = configured(
        tmp_path,
        f'object = 0x{index}\nvalue = 1\ntype = "u8"\n{WHY}'
        + "\nsub = 5" * (index[0] == "1" and index[:2] in ("14", "18")),
    )
    with pytest.raises(
        ConfigError, match=rf"drives\.B\.write: object {index}:0\d (is written by the set-up|would|changes)"
    ):
        load(path)


@pytest.mark.parametrize(
    ("lines", "example", "said"),
    [
        (f'object = 0x208E\nvalue = 256\ntype = "u8"\n{WHY}', "elmo_gold", "value 256 is not a valid u8"),
        (f'object = 0x208E\nvalue = -1\ntype = "u8"\n{WHY}', "elmo_gold", "value -1 is not a valid u8"),
        ('object = 0x208E\nvalue = 1\ntype = "u8"', "elmo_gold", "why"),
        (f'object = 0x208E\nvalue = 1\ntype = "u8"\n{WHY}', "odrive_s1", "has no object dictionary"),
    ],
)
def test_what_is_no_object_is_refused_with_the_key(tmp_path: Path, lines: str, example: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        load(configured(tmp_path, lines, example))


def test_what_may_be_written_is_read(tmp_path: Path) -> None:
    found = load(configured(tmp_path, f'object = 0x208E\nvalue = 0x100\ntype = "u16"\n{WHY}')).drives.B.write
    assert found == (ObjectWrite(0x208E, 256, "u16", "…"),)


@pytest.mark.parametrize("index", sorted(HOMING))
@pytest.mark.parametrize("homes", [False, True])
def test_objects_of_homing_are_the_set_ups_only_with_homing(index: str, homes: bool) -> None:
    homing = Homing(method=19, speed_switch=0.02, speed_zero=0.005, acceleration=0.5) if homes else None
    reason = owned((int(index, 16), 0), Drive(node=1, counts_per_metre=1e6, homing=homing))
    assert reason.startswith("is written by the set-up") == homes


@settings(max_examples=20)
@given(make=st.sampled_from(sorted(MAKES)), data=st.data(), homes=st.booleans(), outputs=st.integers(0, 3))
def test_what_the_set_up_writes_is_refused_and_not_restored(
    make: str, data: st.DataObject, homes: bool, outputs: int
) -> None:
    """Whatever a drive holds at first."""
    held = data.draw(
        st.fixed_dictionaries(
            {},
            optional={
                (row[0], row[1]): st.integers(0, 200)
                for row in rows(make)
                if row[3].startswith("rw") and row[2] in (2, 3, 4, 5, 6, 7) and row[0] not in (0x6040, 0x6060)
            },
        )
    )
    more = ((0x60B0, 0, 4, "rw", 3, False), (0x60B2, 0, 3, "rw", 4, False), (0x6066, 0, 6, "rw", 150, False))
    there = {row[0] for row in rows(make)}
    homing = Homing(method=37, speed_switch=0.02, speed_zero=0.005, acceleration=0.5) if homes else None
    habits = Habits(values=held, more=tuple(row for row in more if row[0] not in there))
    rig = Rig(make, habits, homing=homing, io=3 * (DigitalIo(outputs << 16, 0, 0),))
    try:
        with contextlib.suppress(DriveError):
            rig.drives.configure(PERIOD)
        drive = rig.config.A
        written = {(index, subindex) for node in rig.nodes for index, subindex, *_ in node.written} - COMMANDED
        assert {key for key in written if not owned(key, drive)} == set()
    finally:
        rig.drives.close()


@pytest.mark.parametrize(
    "name",
    [
        *("CANaddress", "CAN node number", "Node address", "CAN address", "Station address", "Device ID", "CAN_ID"),
        *("Bit timing", "Node-ID", "CANopen NodeID", "Baudrate", "CAN bit rate", "Node Number", "Bus address"),
        *("Node.ID", "CANopen device.Address", "Communication.Node-ID", "Node-ID.Value", "RS485/CAN baud rate"),
        *("Motor controller.Node ID", "CAN settings.Encoder and bus bit rate"),
    ],
)
def test_an_object_with_the_name_of_an_address_is_left(name: str) -> None:
    assert "node id or bitrate" in address((0x3041, 0), name, 1)


@pytest.mark.parametrize(
    "name",
    [
        *("Device identification", "Encoder ID", "Motor number", "Scan address", "Bus voltage", "Cancel number"),
        *("Motor device.Number of pole pairs", "Node.Number of turns", "Slave number of the master", "Motor device.ID"),
        *("RS232 bit rate", "Encoder.Baud rate", "USB device ID", "Modbus node address", "SSI bit rate"),
    ],
)
def test_an_object_with_another_name_is_none(name: str) -> None:
    assert address((0x3041, 0), name, 1) == ""


@pytest.mark.parametrize("index", [0x1028, 0x1F81, 0x6404, 0x6503])
def test_no_object_of_the_standards_is_an_address(index: int) -> None:
    assert address((index, 1), "Node-ID of a consumer", 1) == address((index, 1), "Bus address", 1) == ""
