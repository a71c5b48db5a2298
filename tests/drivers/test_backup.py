"""All parameters of a drive, saved, compared and given back: dictionaries of real drives, and generated ones."""

from __future__ import annotations

import itertools
import os
import random
import re
import string
import struct
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import can
import canopen
import pytest
from canopen.objectdictionary import ODVariable
from drivers.foreign import DISABLED, ENABLED, FITTED, QUICK_STOP, ForeignDrive, Habits, Truth, Wires, three
from drivers.slow import Slowness, three_slow
from edsfiles import MAKES, Row, eds, make_eds, rows
from hypothesis import example, given, settings
from hypothesis import strategies as st
from msgspec.structs import replace as replacement_refusal
from rigs import Bus, Clock, alike, frame, ideal_servo
from trirail_drivers.cia402 import backup, inspection, other_masters, parameter_file
from trirail_drivers.cia402 import eds as eds_file
from trirail_drivers.cia402.backup import RestoreResult
from trirail_drivers.cia402.eds import SERVO
from trirail_drivers.cia402.objects import USES, Key
from trirail_drivers.cia402.parameter_file import SavedParameters
from trirail_drivers.cia402.parameters import named, parameter, variables
from trirail_drivers.cia402.sdo import Remote
from trirail_drivers.cia402.sdo_client import Client
from trirail_drivers.config import NO_IO, DigitalIo, Drives
from trirail_drivers.errors import DriveError, FileError
from trirail_drivers.protocols import CIA402
from trirail_drivers.simulated import SimulatedDrive
from trirail_drivers.simulated.dictionary import Dictionary, ObjectEntry

UNSIGNED = {0x05: 1, 0x06: 2, 0x16: 3, 0x07: 4, 0x18: 5, 0x1A: 7, 0x1B: 8}
SIGNED = {0x02: 1, 0x03: 2, 0x10: 3, 0x04: 4, 0x14: 7, 0x15: 8}
OCTETS = {0x08: 4, 0x11: 8, 0x0C: 6}
TEXT, OCTET_STRING, DOMAIN = 0x09, 0x0A, 0x0F
"""CiA 301 data types."""
VOLATILE = {0x1003, 0x1010, 0x1011, 0x1013, 0x1023, 0x1F50, 0x1F51, 0x6040, 0x6042, 0x6060, 0x6071, 0x607A, 0x60B0,
            0x60B1, 0x60B2, 0x60B8, 0x60C1, 0x60FF}  # fmt: skip
"""What these dictionaries let be written that no drive keeps: targets, offsets, controlwords, commands."""
HOMING = {0x605D, 0x607C, 0x6098, 0x6099, 0x609A}
"""Objects that set-up writes only where a drive has homing, which these have not."""
OUTPUT_MASK = 0x60FE, 2
OWNED = {int(name[:4], 16) for name in USES} - HOMING | {0x60B0, 0x60B2}


def set_ups(key: Key) -> bool:
    """Whether set-up gives an object; these robots use no outputs, whose mask is 60FEh:02."""
    return key != OUTPUT_MASK and (0x1400 <= key[0] < 0x1C00 or key[0] in OWNED)


class Kept:
    """Three drives on a bus, of which A is saved and restored."""

    bus: can.BusABC
    drives: Drives
    clock: Clock

    def save(self) -> SavedParameters:
        found = backup.save(self.bus, self.drives, self.clock, ["A"])["A"]
        assert isinstance(found, SavedParameters), found
        return found

    def restore(self, saved: SavedParameters, **options: Any) -> RestoreResult:
        return backup.restore(self.bus, self.drives, self.clock, "A", saved, **options)


class Line(Kept):
    """Drive A of a dictionary, two others, and the bus between."""

    def __init__(self, path: Path) -> None:
        a, b, c = alike()
        self.drives = Drives("cia402", replacement_refusal(a, eds=str(path)), b, c, sdo_timeout=0.01)
        self.clock = Clock()
        devices = [
            SimulatedDrive(each.node, ideal_servo(a, 0), eds=Path(each.eds or SERVO)) for each in self.drives.each
        ]
        self.bus = Bus(devices, self.clock, CIA402.fault_frames)
        self.objects: Dictionary = devices[0].objects

    def __enter__(self) -> Line:
        return self

    def __exit__(self, *_: object) -> None:
        self.bus.shutdown()


def other(entry: ObjectEntry, chance: random.Random) -> None:
    """Have the device itself hold something else."""
    was = entry.value, entry.content
    while (entry.value, entry.content) == was:
        if entry.integer:
            bits = 8 * (entry.size or 0)
            signed = entry.format.islower() and not entry.format.endswith("s")
            entry.value = chance.randrange(-(1 << bits - 1) if signed else 0, 1 << bits - signed)
        elif entry.size:
            entry.content = chance.randbytes(entry.size)
        else:
            entry.content = chance.randbytes(chance.randrange(1, 12))


def own() -> SavedParameters:
    """The parameters of the simulated drive's own dictionary."""
    with Line(SERVO) as line:
        return line.save()


def kept(facts: Iterable[Row]) -> list[Key]:
    """What of a dictionary a drive keeps: by hand, for it was written by others."""
    return [
        (index, subindex)
        for index, subindex, kind, access, *_ in facts
        if access.startswith("rw") and index not in VOLATILE and kind != DOMAIN and (index, subindex) != (0x60FE, 1)
    ]


@pytest.mark.generated(0, 1, 2)
@pytest.mark.parametrize("make", MAKES)
def test_what_was_altered_is_named_and_comes_back(make: str, seed: int, tmp_path: Path) -> None:
    chance, path = random.Random(seed), tmp_path / "drive.dcf"
    with Line(make_eds(tmp_path, make)) as line:
        alter_and_restore(make, line, chance, path)


def alter_and_restore(make: str, line: Line, chance: random.Random, path: Path) -> None:
    saved = line.save()
    assert not saved.unread
    mappings = {key for key in saved.parameters if 0x1400 <= key[0] < 0x1C00}
    assert set(saved.parameters) == set(kept(rows(make))) | mappings
    parameter_file.write(path, saved)
    assert parameter_file.read(path) == saved
    # The simulated drive refuses homing methods with index pulse, which some dictionaries have as their default.
    altered = set(chance.sample(sorted(set(saved.parameters) - mappings - {(0x6098, 0)}), 12))
    for key in altered:
        other(line.objects[key], chance)
    assert {each.key for each in parameter_file.compare(saved, line.save())} == altered
    done = line.restore(parameter_file.read(path))
    assert set(done.written) == {key for key in altered if not set_ups(key)}
    assert {each.different.key for each in done.left} == {key for key in altered if set_ups(key)}
    assert all(each.intended for each in done.left)
    assert done.ok
    assert {each.key for each in parameter_file.compare(saved, line.save())} == {key for key in altered if set_ups(key)}


KINDS = st.sampled_from([*UNSIGNED, *SIGNED, *OCTETS, TEXT, OCTET_STRING, DOMAIN])
ROWS = st.dictionaries(
    st.tuples(st.integers(0x2000, 0x2010), st.integers(1, 4)),
    st.tuples(KINDS, st.sampled_from(["rw", "rww", "rwr", "ro", "wo", "const"]), st.booleans()),
    max_size=20,
)


def made(found: dict[Key, tuple[int, str, bool]]) -> list[Row]:
    heads = {index for index, _ in found}
    facts: list[Row] = [(index, 0, 0x05, "const", 4, False) for index in heads]
    return facts + [(*key, kind, access, None, mappable) for key, (kind, access, mappable) in found.items()]


BASE = [row for row in rows("elmo_gold") if row[0] < 0x1400 or row[0] in (0x6040, 0x6041)]


@settings(max_examples=40)
@given(ROWS, st.randoms(use_true_random=False), st.data())
def test_a_dictionary_of_any_kind(
    tmp_path_factory: pytest.TempPathFactory, found: dict[Key, tuple[int, str, bool]], chance: random.Random, data: Any
) -> None:
    folder = tmp_path_factory.mktemp("eds")
    (folder / "any.eds").write_text(eds([*BASE, *made(found)]))
    with Line(folder / "any.eds") as line:
        alter_any(found, line, chance, data, folder / "a.dcf")


def alter_any(
    found: dict[Key, tuple[int, str, bool]], line: Line, chance: random.Random, data: Any, path: Path
) -> None:
    wanted = {
        key
        for key, (kind, access, mappable) in found.items()
        if access in ("rw", "rww") or (access == "rwr" and not mappable)
        if kind != DOMAIN
    }
    for key in wanted:
        other(line.objects[key], chance)
    saved = line.save()
    assert {key for key in saved.parameters if key[0] >= 0x2000} == wanted
    parameter_file.write(path, saved)
    assert parameter_file.read(path) == saved
    altered = data.draw(st.sets(st.sampled_from(sorted(wanted)))) if wanted else set()
    before = {key: line.objects[key].encode() for key in wanted}
    for key in altered:
        other(line.objects[key], chance)
    assert [each.key for each in parameter_file.compare(saved, line.save())] == sorted(altered)
    done = line.restore(parameter_file.read(path))
    assert (sorted(done.written), done.left) == (sorted(altered), ())
    assert {key: line.objects[key].encode() for key in wanted} == before


@given(
    st.text(string.printable, min_size=1, max_size=20),
    st.floats(),
    st.integers(0, 2**64 - 1),
    st.integers(-(2**23), 2**23 - 1),
    st.binary(min_size=1, max_size=9),
)
def test_a_file_has_every_value_to_the_last_bit(
    tmp_path_factory: pytest.TempPathFactory, text: str, number: float, large: int, medium: int, octets: bytes
) -> None:
    path = tmp_path_factory.mktemp("file") / "a.dcf"
    parameters = {
        (0x2000, 0): parameter(TEXT, text.encode(), 'a "name"'),
        (0x2001, 0): parameter(0x11, struct.pack("<d", number), "f64"),
        (0x2002, 0): parameter(0x1B, large.to_bytes(8, "little"), "é"),
        (0x2003, 0): parameter(0x10, medium.to_bytes(3, "little", signed=True), "i24"),
        (0x2004, 0): parameter(TEXT, octets, "text"),
        (0x2005, 0): parameter(0x04, octets, "i32"),
        (0x2006, 0): parameter(0x0B, octets, "unicode"),
    }
    objects = canopen.ObjectDictionary()  # type: ignore[no-untyped-call]
    for (index, _), each in parameters.items():
        variable = ODVariable(each.name, index)
        variable.data_type = each.data_type
        objects.add_object(variable)
    saved = SavedParameters(parameter_file.Origin(1, serial=0xFFFF_FFFF), parameters, {}, objects)
    parameter_file.write(path, saved, 1_000_000)
    assert parameter_file.read(path) == saved


@pytest.mark.parametrize("make", MAKES)
def test_a_drive_read_without_its_eds_is_compared_only_where_it_was_asked(make: str, tmp_path: Path) -> None:
    with Line(make_eds(tmp_path, make)) as line:
        parameter_file.write(tmp_path / "saved.dcf", line.save())
        saved = parameter_file.read(tmp_path / "saved.dcf")
        line.drives = replacement_refusal(line.drives, A=replacement_refusal(line.drives.A, eds=None))
        again = line.save()
        compared = parameter_file.comparable(saved, again)
        assert compared == sorted(saved.parameters.keys() & again.parameters.keys())
        assert parameter_file.compare(saved, again) == []
        key = random.Random(make).choice(compared)
        other(line.objects[key], random.Random(make))
        assert [each.key for each in parameter_file.compare(saved, line.save())] == [key]


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("NodeID=1", "NodeID=128", "node"),
        ("NodeID=1", "NodeID=first", "first"),
        ("[6065]", "[6065", "already exists"),
        ("[6065]", "[6066]", "section '6066' already exists"),
        ("[6065]", "[605a]", "section '605A' already exists"),
        ("[6099sub2]", "[6099Sub1]", "section '6099SUB1' already exists"),
        ("ParameterValue=4294967295", "ParameterValue=4294967296", "object 6065:00: 4294967296 is not a value"),
        ("ParameterValue=4294967295", "ParameterValue=-1", "object 6065:00: -1 is not a value"),
        ("ParameterValue=4294967295", "ParameterValue=1.5", "object 6065:00: '1.5' is not a value"),
        ("ParameterValue=4294967295", "ParameterValue=9\nLowLimit=10\nHighLimit=0x14", "9 is not within its limits"),
        ("ParameterValue=", "Parameter=", "no object has a ParameterValue"),
        ("[6065]", "[606x]", "a ParameterValue belongs to no object"),
    ],
)
def test_what_is_no_file_of_parameters_is_refused(tmp_path: Path, old: str, new: str, said: str) -> None:
    path = tmp_path / "a.dcf"
    parameter_file.write(path, own())
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(DriveError, match=f"(?s)a.dcf is not a parameter file of a drive.*{said}"):
        parameter_file.read(path)


@pytest.mark.generated(*range(8))
def test_a_file_that_was_cut_off_is_refused(seed: int, tmp_path: Path) -> None:
    """Its last value has lost digits."""
    path = tmp_path / "a.dcf"
    parameter_file.write(path, own())
    text = path.read_text()
    cuts = [found.end() for found in re.finditer("ParameterValue=.", text) if "[1005]" in text[: found.start()]]
    path.write_text(text[: random.Random(seed).choice(cuts)])
    with pytest.raises(DriveError, match=r"a.dcf .*: it ends within a value"):
        parameter_file.read(path)
    path.write_text(path.read_text() + "\n")
    said = r"a.dcf( .*: it lists object \w{4} but does not describe it|: it ends within object \w{4}, with)"
    with pytest.raises(DriveError, match=said):
        parameter_file.read(path)


@pytest.mark.parametrize("make", MAKES)
def test_a_file_that_ends_within_its_last_value_is_refused(make: str, tmp_path: Path) -> None:
    """The last object may be the maker's, of which the lists say nothing more."""
    path = tmp_path / "a.dcf"
    with Line(make_eds(tmp_path, make)) as line:
        parameter_file.write(path, line.save())
    text = path.read_text()
    for found in [*re.finditer("ParameterValue=.+", text)][-8:]:
        for end in (found.end(), found.end() - 1):
            path.write_text(text[:end])
            with pytest.raises(DriveError):
                parameter_file.read(path)


@pytest.mark.parametrize(
    "end",
    [
        "[OptionalObjects]",
        "SupportedObjects=48",
        "1=0x1003",
        "[ManufacturerObjects]",
        "SupportedObjects=0",
        "0\n\n",
    ],
)
def test_a_file_that_was_cut_off_between_two_lists_is_refused(end: str, tmp_path: Path) -> None:
    """Every object is described that it still lists."""
    path = tmp_path / "a.dcf"
    parameter_file.write(path, own())
    before, found, _ = path.read_text().rpartition(end)
    assert found
    path.write_text(before)
    with pytest.raises(DriveError, match=r"a\.dcf .*: its list \[\w+Objects\] is missing or too short"):
        parameter_file.read(path)


@pytest.mark.parametrize("cut", ["[3000sub1]", "[3000sub2]"])
def test_a_file_that_ends_within_a_record_is_refused(cut: str, tmp_path: Path) -> None:
    """The list of objects names the record, which is there."""
    facts = [*rows("elmo_gold"), *((0x3000, sub, 5, "rw", 7, False) for sub in range(3))]
    facts = [row for row in facts if not 0x3000 < row[0] < 0x6000]
    path, source = tmp_path / "a.dcf", tmp_path / "a.eds"
    source.write_text(eds(facts))
    with Line(source) as line:
        parameter_file.write(path, line.save())
    text = path.read_text()
    last = text[text.index("[3000]") :]
    assert not re.findall(r"\n\[(?!3000)", last)
    path.write_text(text[: text.index(cut)])
    with pytest.raises(DriveError, match=rf"a\.dcf: it ends within object 3000, with {cut[-2]} of 3 sub-objects"):
        parameter_file.read(path)


@pytest.mark.parametrize("spelt", [str.upper, str.lower])
def test_lists_may_have_names_in_letters_of_either_case(spelt: Callable[[str], str], tmp_path: Path) -> None:
    path = tmp_path / "a.dcf"
    parameter_file.write(path, own())
    text = re.sub(r"\[\w+Objects\]|SupportedObjects", lambda found: spelt(found[0]), path.read_text())
    path.write_text(text)
    assert parameter_file.read(path) == own()


@pytest.mark.parametrize("name", ["a.dcf", "a.eds", "a.toml"])
@pytest.mark.parametrize(
    ("made", "said"), [(lambda path: None, "No such file"), (Path.mkdir, "a folder"), (os.mkfifo, "a FIFO")]
)
def test_a_file_that_cannot_be_read_is_named(
    name: str, made: Callable[[Path], None], said: str, tmp_path: Path
) -> None:
    made(tmp_path / name)
    with pytest.raises(FileError, match=f"{name}: {said}"):
        parameter_file.read(tmp_path / name)


def test_a_file_that_cannot_be_written_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(FileError):
        parameter_file.write(tmp_path / "nowhere" / "a.dcf", own())
    assert not list(tmp_path.iterdir())


OLD = """# The parameters of one drive, as trirail drives save has read them; for compare and restore.

[drive]
axis = "A"
node = 1
device_type = 0x00020192
saved = "2025-11-25T16:16:51+00:00"
dictionary = "servo.eds, the built-in one"
vendor = 0x00000000
product = 0x33505250
revision = 0x00010000
serial = 0x00000001

[parameters]
"1017:00" = { type = "u16", value = 100, name = "Producer heartbeat time" }
"6065:00" = { type = "u32", value = 1000, name = "Following error window" }
"6066:00" = { type = "u16", value = 77, name = "Following error time out" }
"607D:01" = { type = "i32", value = -5, name = "Software position limit.Min" }
"607D:02" = { type = "bytes", value = "05 00 00 00", name = "Software position limit.Max" }

[unread]
"6067:00" = "no answer within 0.5 s"
"""
"""A file of an earlier version."""


def test_a_file_of_an_earlier_version_is_restored(tmp_path: Path) -> None:
    path = tmp_path / "drive-A.toml"
    path.write_text(OLD)
    saved = parameter_file.read(path)
    assert saved.origin == parameter_file.Origin(1, 0x2_0192, None, 0x3350_5250, 0x1_0000, 1)
    with Line(make_eds(tmp_path, "elmo_gold")) as line:
        done = line.restore(replace(saved, origin=line.save().origin))
        held = {key: line.objects[key].value for key in ((0x607D, 1), (0x607D, 2))}
    assert set(done.written) == set(held)
    assert list(held.values()) == [-5, 5]
    assert {each.different.key for each in done.left} == {(0x1017, 0), (0x6065, 0), (0x6066, 0)}, (
        "they are the set-up's own"
    )


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("[drive]", "[other]", "drive"),
        ("node = 1", "node = 128", "node"),
        ('"6065:00"', '"6065"', "not enough values"),
        ('type = "u32", value = 1000', 'type = "u8", value = 1000', "6065:00: 1000 is not a value"),
        ('type = "u32"', 'type = "u33"', "u33"),
        ("value = 1000", "value = 1.5", "1.5 is not a value"),
        ("[parameters]", "[parameters", "Expected"),
    ],
)
def test_a_damaged_file_of_an_earlier_version_is_refused(tmp_path: Path, old: str, new: str, said: str) -> None:
    path = tmp_path / "a.toml"
    assert old in OLD
    path.write_text(OLD.replace(old, new))
    with pytest.raises(DriveError, match=f"(?s)a.toml is not a parameter file of a drive.*{re.escape(said)}"):
        parameter_file.read(path)


def test_our_files_open_in_another_program(tmp_path: Path) -> None:
    with Line(make_eds(tmp_path, "elmo_gold")) as line:
        line.objects[0x607D, 1].value = -100
        line.objects[0x1018, 4].value = 1
        saved = line.save()
    parameter_file.write(tmp_path / "a.dcf", saved, 500_000)
    opened = canopen.import_od(str(tmp_path / "a.dcf"))
    assert (opened.node_id, opened.bitrate) == (1, 500_000)
    values = {key: each.encode_raw(each.value) for key, each in variables(opened) if each.value is not None}
    identity = {key for name, key in parameter_file.IDENTITY.items() if getattr(saved.origin, name) is not None}
    assert {key: data for key, data in values.items() if key not in identity} == {
        key: each.data for key, each in saved.parameters.items()
    }
    assert set(values) == {*identity, *saved.parameters}
    assert (values[0x1018, 4], values[0x607D, 1]) == (b"\1\0\0\0", struct.pack("<i", -100))


@pytest.mark.generated(0, 1)
@pytest.mark.parametrize("make", MAKES)
def test_of_a_file_by_another_program_only_parameters_are_written(make: str, seed: int, tmp_path: Path) -> None:
    chance, eds_file, path = random.Random(seed), make_eds(tmp_path, make), tmp_path / "other.dcf"
    objects = canopen.import_od(str(eds_file), 1)
    wanted = {}
    for key, each in variables(objects):
        if each.writable and each.fixed_size and key[0] not in (0x1000, 0x1018, 0x6098):  # drives refuse most methods
            # A number that is not negative in any type, and another than the drive holds.
            each.value = wanted[key] = chance.randrange(1, 2 if each.data_type == 1 else 128)
    with Line(eds_file) as line:
        before = {key: line.objects[key].encode() for key, _ in variables(objects)}
        objects.node_id = 1
        canopen.export_od(objects, str(path), "dcf")
        due = {key for key in kept(rows(make)) if key in wanted and not set_ups(key)}
        done = line.restore(parameter_file.read(path, 1), replace=True)
        now = {key: line.objects[key].encode() for key, _ in variables(objects)}
    changed = {key for key in before if now[key] != before[key]}
    assert changed <= due
    assert set(done.written) == changed
    assert {each.different.key for each in done.left if not each.intended} == set()
    assert due <= changed | {key for key in due if int.from_bytes(before[key], "little") == wanted[key]}


# ---------------------------------------------------------------------- drives that others made

SPEED, LOW, HIGH, NODE_ID = (0x6081, 0), (0x607D, 1), (0x607D, 2), (0x2000, 0)


class Foreign(Kept):
    """Three drives of a make."""

    def __init__(self, folder: Path, make: str = "maxon_epos4_compact50_5", habits: Habits | None = None) -> None:
        habits = habits or Habits()
        habits.values = {(0x1018, at): at for at in range(1, 5)} | habits.values
        self.wires, self.clock = three(make, dict.fromkeys((1, 2, 3), Truth()), habits=habits)
        self.bus = self.wires
        path = folder / "make.eds"
        path.write_text(eds([*rows(make), *habits.more], FITTED[make]))
        self.drives = drives(path)

    @property
    def a(self) -> ForeignDrive:
        return self.wires.nodes[0]


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Foreign]:
    made = Foreign(tmp_path)
    yield made
    made.wires.shutdown()


def drives(path: Path) -> Drives:
    return Drives("cia402", *alike(eds=str(path)), sdo_timeout=0.05)


@pytest.mark.parametrize("make", MAKES)
def test_the_parameters_of_a_foreign_drive(make: str, tmp_path: Path) -> None:
    rig = Foreign(tmp_path, make)
    saved = rig.save()
    assert saved.origin.serial == 4 or (0x1018, 4) not in {row[:2] for row in rows(make)}
    assert set(saved.parameters) | set(saved.unread) == set(kept(rows(make)))
    assert not rig.a.written
    index, subindex = chosen = next(key for key in saved.parameters if key[0] >= 0x2000 and not set_ups(key))
    rig.a.local.data_store[index] = {subindex: bytes(b ^ 1 for b in saved.parameters[chosen].data)}
    assert [each.key for each in parameter_file.compare(saved, rig.save())] == [chosen]
    done = rig.restore(saved)
    assert done == RestoreResult((chosen,), (), False, "")
    assert rig.a.written == [(index, subindex, saved.parameters[chosen].data)]
    rig.wires.shutdown()


@pytest.mark.parametrize("state", [ENABLED, QUICK_STOP, 0x23, 0x6F])
def test_nothing_is_written_to_a_drive_with_power(state: int, tmp_path: Path) -> None:
    rig = Foreign(tmp_path)
    saved = rig.save()
    rig.a.put(0x6081, 5)
    rig.a.state = state
    with pytest.raises(
        DriveError, match="drive A: parameters can only be restored while the drive has no power; its state is"
    ):
        rig.restore(saved)
    assert not rig.a.written
    rig.wires.shutdown()


def test_nothing_more_is_written_once_a_drive_has_power(tmp_path: Path) -> None:
    rig = Foreign(tmp_path)
    saved = rig.save()
    rig.a.put(0x6081, 5)
    rig.a.put(0x6083, 5)

    def enabled(index: int, **_: Any) -> None:
        rig.a.state = ENABLED

    rig.a.local.add_write_callback(enabled)  # type: ignore[no-untyped-call]
    with pytest.raises(DriveError, match="operation enabled"):
        rig.restore(saved)
    assert len(rig.a.written) == 1
    rig.wires.shutdown()


MASTERS: list[tuple[int, bytes, bool]] = [
    (0x000, b"\x01\x00", False),
    (0x080, b"", False),
    (0x201, b"\x0f\x00", False),
    (0x302, bytes(8), False),
    (0x603, bytes(8), False),
    (0x77E, b"\x05", False),
    (0x701, b"", True),
]


class Overheard(Wires):
    """A bus on which another master speaks at a time."""

    speaks: tuple[float, can.Message] | None = None

    def pump(self) -> None:
        if self.speaks is not None and self.turn.now >= self.speaks[0]:
            message, self.speaks = self.speaks[1], None
            self.nodes[2].bus.send(message)
        super().pump()


@pytest.mark.parametrize(("identifier", "data", "remote"), MASTERS)
@pytest.mark.parametrize("doing", ["save", "restore"])
def test_no_other_master_may_be_on_the_bus(
    doing: str, identifier: int, data: bytes, remote: bool, tmp_path: Path
) -> None:
    rig = Foreign(tmp_path)
    saved = rig.save()
    rig.a.put(0x6081, 5)
    message = frame(identifier, data, is_remote_frame=remote)
    rig.wires.__class__ = Overheard
    assert isinstance(rig.wires, Overheard)
    rig.wires.speaks = (rig.clock.now + 0.3, message)
    sent = len(rig.wires.sent)
    with pytest.raises(DriveError, match=rf"another master is on the bus and .*\(identifier {identifier:03X}\)"):
        rig.save() if doing == "save" else rig.restore(saved)
    assert len(rig.wires.sent) == sent
    rig.wires.shutdown()


@pytest.mark.parametrize(("identifier", "data", "remote"), [each for each in MASTERS if each[0] != 0x80])
@pytest.mark.parametrize("doing", ["apply", "check"])
def test_no_drive_is_set_up_beside_another_master(
    doing: str, identifier: int, data: bytes, remote: bool, tmp_path: Path
) -> None:
    rig = Foreign(tmp_path)
    rig.wires.__class__ = Overheard
    assert isinstance(rig.wires, Overheard)
    rig.wires.speaks = (rig.clock.now + 0.3, frame(identifier, data, is_remote_frame=remote))
    apply = partial(inspection.inspect, rig.wires, rig.drives, 0.001, rig.clock, apply=True)
    check = partial(other_masters.check_exclusive, rig.wires, rig.drives, rig.clock)
    with pytest.raises(DriveError, match=rf"another master.*\(identifier {identifier:03X}\); stop the service"):
        (apply if doing == "apply" else check)()
    assert not rig.wires.sent
    rig.wires.shutdown()


class Echoing(Bus):
    """A bus that returns this end's frames with a mark, as gs_usb does."""

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        self._arrived.append(frame(msg.arbitration_id, bytes(msg.data), is_rx=False))
        super().send(msg, timeout)


def test_its_own_requests_are_not_those_of_another_master() -> None:
    with Line(SERVO) as line:
        line.bus.__class__ = Echoing
        saved = line.save()
        assert line.restore(saved).ok
        assert isinstance(line.bus, Echoing)
        line.bus.inject(0x601, bytes(8))
        with pytest.raises(DriveError, match="another master is on the bus and accesses drives by SDO"):
            line.save()


def test_another_master_ends_it_on_the_way(tmp_path: Path) -> None:
    rig = Foreign(tmp_path)
    saved = rig.save()
    rig.a.put(0x6081, 5)
    rig.a.put(0x6083, 5)
    rig.a.local.add_write_callback(lambda **_: rig.a.bus.send(frame(0x80)))  # type: ignore[no-untyped-call]
    with pytest.raises(DriveError, match="another master is on the bus and sends SYNC"):
        rig.restore(saved)
    assert len(rig.a.written) == 1
    rig.wires.shutdown()


@pytest.mark.parametrize(
    ("changes", "refused", "replaceable"),
    [
        ({"product": 9}, "product is 00000002h, but the file has 00000009h; use a file for the same product", False),
        ({"vendor": 9}, "vendor is 00000001h, but the file has 00000009h; use a file for the same product", False),
        ({"vendor": None}, r"drive A has vendor 00000001h \(the file's unknown\).*--replace", True),
        ({"device_type": 401}, "device_type is .*; use a file for the same product", False),
        ({"serial": 9}, r"drive A has serial 00000004h \(the file's 00000009h\).*--replace", True),
        ({"revision": 9}, r"drive A has revision 00000003h \(the file's 00000009h\).*--replace", True),
        ({"node": 2}, r"drive A has node 1 \(the file's 2\).*--replace", True),
    ],
)
def test_a_file_of_another_drive(changes: dict[str, int], refused: str, replaceable: bool, tmp_path: Path) -> None:
    rig = Foreign(tmp_path)
    saved = rig.save()
    saved = replace(saved, origin=replacement_refusal(saved.origin, **changes))
    rig.a.put(0x6081, 5)
    with pytest.raises(DriveError, match=refused):
        rig.restore(saved)
    assert not rig.a.written
    if replaceable:
        assert rig.restore(saved, replace=True).written == (SPEED,)
    else:
        with pytest.raises(DriveError, match=refused):
            rig.restore(saved, replace=True)
    rig.wires.shutdown()


def test_what_is_in_the_way_of_another_is_written_first(tmp_path: Path) -> None:
    rig = Foreign(tmp_path)
    rig.a.put(0x607D, -100, 1)
    rig.a.put(0x607D, 100, 2)
    saved = rig.save()
    rig.a.put(0x607D, -900, 1)
    rig.a.put(0x607D, -800, 2)
    rig.a.habits.refuses = {
        LOW: lambda value: value >= rig.a.value(*HIGH),
        HIGH: lambda value: value <= rig.a.value(*LOW),
    }
    assert rig.restore(saved) == RestoreResult((HIGH, LOW), (), False, "")
    rig.wires.shutdown()


@pytest.mark.parametrize(("unit", "factory"), [(0xFFB44700, 0x00B44700), (0x00B44700, 0xFFB44700)])
def test_numbers_are_restored_with_their_units(tmp_path: Path, unit: int, factory: int) -> None:
    """The unit of velocity, object 60A9h, is 0.1 rpm or rpm. It is written before the speeds."""
    make = next(make for make in MAKES if "maxon" in make)
    with Line(make_eds(tmp_path, make)) as line:
        values = {(0x60A9, 0): unit, (0x607F, 0): 30_000, (0x6080, 0): 50_000}
        for key, value in values.items():
            line.objects.internal(*key).value = value
        saved = line.save()
        for key, value in {(0x60A9, 0): factory, (0x607F, 0): 3_000, (0x6080, 0): 5_000}.items():
            line.objects.internal(*key).value = value
        done = line.restore(saved)
        assert (done.written[0], set(done.written), done.left) == ((0x60A9, 0), set(values), ())
        assert {key: line.objects.internal(*key).value for key in values} == values
        line.objects.internal(0x60A9, 0).value = factory
        line.objects.internal(0x607F, 0).value = 3_000
        line.objects.internal(0x60A9, 0)._limits = None  # not writable
        with pytest.raises(DriveError, match=r"60A9.*was not accepted.*no other value was written$") as refused:
            line.restore(saved)
        assert not isinstance(refused.value, backup.RestoreAbortedError), "nothing has changed"
        assert line.objects.internal(0x607F, 0).value == 3_000


def test_what_a_drive_changes_with_another_is_given_back_too(tmp_path: Path) -> None:
    rig = Foreign(tmp_path)
    saved = rig.save()
    first, second = (key for key in sorted(saved.parameters) if key in (SPEED, (0x6083, 0)))

    def resets(index: int, **_: Any) -> None:
        if index == second[0]:
            rig.a.put(first[0], 77)

    rig.a.put(second[0], 5)
    rig.a.local.add_write_callback(resets)  # type: ignore[no-untyped-call]
    done = rig.restore(saved)
    assert (set(done.written), done.left) == ({first, second}, ())
    rig.wires.shutdown()


@pytest.mark.parametrize("store", [False, True])
@pytest.mark.parametrize("kept_back", [False, True])
def test_what_differs_still_is_told_and_not_stored(store: bool, kept_back: bool, tmp_path: Path) -> None:
    rig = Foreign(tmp_path)
    saved = rig.save()
    rig.a.put(0x6081, 5)
    rig.a.put(0x6083, 5)
    if kept_back:
        rig.a.habits.refuses = {SPEED: lambda _value: True}
    done = rig.restore(saved, store=store)
    assert ([each.different.key for each in done.left] == [SPEED]) is kept_back
    assert all("(SDO abort 06090030)" in each.why and not each.intended for each in done.left)
    assert done.stored is (store and not kept_back)
    assert ((0x1010, 1, b"save") in rig.a.written) is done.stored
    assert done.ok is not kept_back
    rig.wires.shutdown()


def test_node_id_and_bitrate_are_left_as_they_are(tmp_path: Path) -> None:
    more = ((0x2000, 0, 5, "rw", 1, False), (0x2001, 0, 5, "rw", 0, False))
    rig = Foreign(tmp_path, habits=Habits(values={(0x1018, 1): 0xFB, (0x1018, 2): 2}, more=more))
    saved = rig.save()
    rig.a.put(0x2000, 5)
    done = rig.restore(saved)
    assert [(each.different.key, each.intended) for each in done.left] == [(NODE_ID, True)]
    assert (done.written, done.ok) == ((), True)
    rig.wires.shutdown()


def test_parameters_whose_names_only_resemble_an_address_are_restored(tmp_path: Path) -> None:
    """Those of the bus are left, each with its reason."""
    names = {1: "Number of pole pairs", 2: "Node-ID", 3: "Device ID", 4: "RS232 bit rate"}
    more = tuple((0x3000, sub, 5, "rw", 7, False) for sub in names)
    rig = Foreign(tmp_path, habits=Habits(more=more))
    eds_path = Path(str(rig.drives.A.eds))
    text = eds_path.read_text().replace("=Object 3000\n", "=Motor device\n")
    for sub, name in names.items():
        text = text.replace(f"=Object 3000sub{sub}\n", f"={name}\n")
    eds_path.write_text(text)
    saved = rig.save()
    for sub in names:
        rig.a.put(0x3000, 5, sub)
    done = rig.restore(saved)
    assert set(done.written) == {(0x3000, 1), (0x3000, 4)}
    assert [each.different.key for each in done.left] == [(0x3000, 2), (0x3000, 3)]
    assert all(each.intended and not each.by_setup and "node id" in each.why for each in done.left)
    rig.wires.shutdown()


@pytest.mark.parametrize("outputs", [0, 1 << 16])
def test_the_mask_of_outputs_is_restored_unless_the_robot_has_outputs(outputs: int, tmp_path: Path) -> None:
    rig = Foreign(tmp_path, "elmo_gold")
    saved = rig.save()
    held = saved.parameters[OUTPUT_MASK].value
    rig.a.put(0x60FE, 5, 2)
    done = rig.restore(saved, io=(DigitalIo(outputs), *NO_IO[1:]))
    assert rig.a.value(0x60FE, 2) == (5 if outputs else held)
    assert [(each.different.key, each.by_setup) for each in done.left] == ([(OUTPUT_MASK, True)] if outputs else [])
    rig.wires.shutdown()


FOREIGN = """; as an editor of another company writes it
[FileInfo]
FileName=axis_1.dcf
CreatedBy=somebody
[DeviceInfo]
VendorName=
VendorNumber=0xFB
ProductNumber=
RevisionNumber=0x00000000
NrOfRxPDO=4
[DeviceCommissioning]
NodeId=0x01
NodeName=axis
Baudrate=1000
LSS_SerialNumber=4
[DummyUsage]
Dummy0002=1
[Comments]
Line1=without the number of lines
[MandatoryObjects]
SupportedObjects=1
1=0x1018
[1018]
ParameterName=Identity
ObjectType=0x9
SubNumber=2
[1018Sub2]
ParameterName=Product code
DataType=0x0007
AccessType=ro
DefaultValue=0x00000002
[1010]
ParameterName=Store
ObjectType=0x8
SubNumber=2
[1010sub1]
ParameterName=Save all
DataType=0x0007
AccessType=rw
ParameterValue=0x65766173
[1017]
ParameterName=Heartbeat
DataType=0x0006
AccessType=rw
ParameterValue=100
[1400]
ParameterName=RPDO
ObjectType=0x9
SubNumber=2
[1400sub1]
ParameterName=COB-ID
DataType=0x0007
AccessType=RW
DefaultValue=$NodeID + 0x200
ParameterValue=$NODEID+0x200
[1a00]
ParameterName=TPDO mapping
ObjectType=0x9
SubNumber=1
[1a00sub0]
ParameterName=Number
DataType=0x0005
AccessType=rw
ParameterValue=0
[1201]
ParameterName=Second SDO
ObjectType=0x9
SubNumber=2
[1201sub1]
ParameterName=COB-ID
DataType=0x0007
AccessType=rw
ParameterValue=$NODEID+0x680
[2000]
ParameterName=Adresse
DataType=0x0005
AccessType=rw
ParameterValue=77
[6040]
ParameterName=Controlword
ObjectType=0x7
DataType=0x0006
AccessType=rww
ParameterValue=0x000F
[607A]
ParameterName=Target
DataType=0x0004
AccessType=rww
ParameterValue=5
[607d]
ParameterName=Limits
ObjectType=0x8
DataType=0x0004
AccessType=rw
CompactSubObj=2
[607dValue]
NrOfEntries=2
1=0xFFFFFF9C
2=100
[6081]
ParameterName=Profile velocity
ObjectType=0x7
DataType=0x0007
AccessType=rw
LowLimit=1
HighLimit=25000
ParameterValue= 0x1388 ; counts/s
ObjFlags=0x0
[6083]
ParameterName=Profile acceleration
DataType=0x0007
AccessType=rw
DefaultValue=10000
ParameterValue=
"""


class TestFileOfAnotherProgram:
    """What others write: other spellings, entries without a value, values of arrays in a section of their own."""

    held: SavedParameters
    """What the drive held before."""

    def restore(self, tmp_path: Path, text: str, **options: bool) -> tuple[Foreign, RestoreResult | DriveError]:
        """Restore a file; the drive holds other values, and has node id and bitrate in objects of its own."""
        more = ((0x2000, 0, 5, "rw", 1, False), (0x1201, 1, 7, "rw", 0, False))
        rig = Foreign(tmp_path, habits=Habits(values={(0x1018, 1): 0xFB, (0x1018, 2): 2}, more=more))
        rig.a.put(0x607D, -7, 1)
        rig.a.put(0x6081, 7)
        self.held = rig.save()
        path = tmp_path / "axis_1.DCF"
        path.write_text(text)
        try:
            return rig, rig.restore(parameter_file.read(path, 1), **options)
        except DriveError as error:
            return rig, error
        finally:
            rig.wires.shutdown()

    def test_is_restored_without_commands_targets_and_addresses(self, tmp_path: Path) -> None:
        rig, done = self.restore(tmp_path, FOREIGN)
        assert isinstance(done, RestoreResult), done
        assert set(done.written) == {SPEED, LOW, HIGH, (0x1201, 1)}
        assert {(index, sub) for index, sub, _ in rig.a.written} == set(done.written)
        values = [rig.a.value(*key) for key in (SPEED, LOW, HIGH, (0x1201, 1))]
        assert values == [5000, -100, 100, 0x681]
        assert NODE_ID in {each.different.key for each in done.left}
        assert all(each.intended for each in done.left)

    def test_is_compared_where_it_has_values(self, tmp_path: Path) -> None:
        _rig, done = self.restore(tmp_path, FOREIGN)
        assert isinstance(done, RestoreResult), done
        saved = parameter_file.read(tmp_path / "axis_1.DCF", 1)
        assert saved.origin == parameter_file.Origin(1, None, 0xFB, 2, None, 4)
        assert saved.unread == dict.fromkeys(((0x607D, 0), (0x6083, 0)), "the file has no value")
        assert set(parameter_file.comparable(saved, self.held)) == set(saved.parameters)
        differing = {each.key for each in parameter_file.compare(saved, self.held)}
        assert differing == {SPEED, LOW, HIGH, NODE_ID, (0x1017, 0), (0x1201, 1), (0x1A00, 0)}

    @pytest.mark.parametrize(
        ("old", "new", "said"),
        [
            ("NodeId=0x01", "NodeId=0x02", "--replace"),
            ("NodeId=0x01", "NodeId=200", "not a parameter file of a drive"),
            ("VendorNumber=0xFB", "VendorNumber=0x7", "same product"),
            ("DefaultValue=0x00000002", "DefaultValue=0x00000003", "same product"),
            ("DefaultValue=0x00000002", "ParameterValue=3", "same product"),
            ("ProductNumber=", "ProductNumber=8", "same product"),
            ("VendorNumber=0xFB", "VendorNumber=0", r"vendor .* unknown.*--replace"),
            ("LSS_SerialNumber=4", "LSS_SerialNumber=5", "--replace"),
            ("RevisionNumber=0x00000000", "RevisionNumber=9", "--replace"),
            ("0x1388 ; counts/s", "25001", "6081:00: 25001 is not within its limits, 1 to 25000"),
            ("0x1388 ; counts/s", "0x1FFFFFFFF", "6081:00"),
            ("0x1388 ; counts/s", "fast", "6081:00: 'fast' is not a value"),
            ("2=100", "2=0x1FFFFFFFF", "607D:02"),
            ("[6083]", "[6081]", "already exists"),
            ("[6081]", "[6081SUB1]", "was not found"),
            ("LowLimit=1", "DataType=0x0006", "already exists"),
            (
                "DataType=0x0007\nAccessType=rw\nLowLimit=1",
                "DataType=0x0006\nAccessType=rw",
                "has 4 bytes, but 2 in the file",
            ),
        ],
    )
    def test_is_refused_whole_where_anything_is_wrong(self, old: str, new: str, said: str, tmp_path: Path) -> None:
        assert FOREIGN.count(old) == 1
        rig, refused = self.restore(tmp_path, FOREIGN.replace(old, new))
        assert isinstance(refused, DriveError), refused
        assert re.search(said, str(refused))
        assert not rig.a.written

    def test_of_another_node_has_no_identifiers_for_this_one(self, tmp_path: Path) -> None:
        _, done = self.restore(tmp_path, FOREIGN.replace("NodeId=0x01", "NodeId=0x02"), replace=True)
        assert isinstance(done, RestoreResult), done
        assert set(done.written) == {SPEED, LOW, HIGH}


@pytest.mark.parametrize(("effect", "held"), [(0.03, True), (60.0, False)])
def test_what_is_written_has_a_time_to_be_held(effect: float, held: bool, tmp_path: Path) -> None:
    make = "elmo_gold"
    wires, clock = three_slow(make, Truth(), lambda _node: Slowness(answer=lambda: 0.01, effect=lambda: effect))
    config = drives(make_eds(tmp_path, make, FITTED[make]))
    saved = backup.save(wires, config, clock, ["A"])["A"]
    assert isinstance(saved, SavedParameters)
    wires.nodes[0].put(0x6081, 5)
    done = backup.restore(wires, config, clock, "A", saved)
    assert [each.why.partition(",")[0] for each in done.left] == ([] if held else ["it keeps another value"])
    wires.shutdown()


@pytest.mark.parametrize("answers", [0, 40])
def test_a_drive_that_falls_silent(answers: int, tmp_path: Path) -> None:
    rig = Foreign(tmp_path)
    serve: Callable[..., None] = rig.a.local.sdo.on_request
    left = [answers]

    def served(*request: Any) -> None:
        left[0] -= 1
        if left[0] >= 0:
            serve(*request)

    vars(rig.a.local.sdo).update(on_request=served)
    ends = backup.save(rig.wires, rig.drives, rig.clock)
    assert isinstance(ends["A"], DriveError)
    assert "no answer for object" in str(ends["A"])
    assert isinstance(ends["B"], SavedParameters)
    assert isinstance(ends["C"], SavedParameters)
    rig.wires.shutdown()


def test_what_a_drive_does_not_tell_is_said_with_the_reason(rig: Foreign) -> None:
    vars(rig.a.local.object_dictionary[0x6081]).update(access_type="wo")
    saved = rig.save()
    assert saved.unread == {SPEED: "Attempt to read a write only object (SDO abort 06010001)"}
    assert named(SPEED) not in {named(key) for key in saved.parameters}
    assert rig.a.state == DISABLED


def listed(count: int, kind: int = 0x07, name: str = "Value") -> str:
    """Sections of an EDS with a manufacturer's objects."""
    return "".join(
        f"\n[{0x2100 + number:04X}]\nParameterName={name} {number}\nObjectType=0x7\nDataType={kind}\n"
        f"AccessType=rw\nDefaultValue={number}\nPDOMapping=0\n"
        for number in range(count)
    )


class AlteredBus(can.BusABC):
    """Bus on which the answers of drive A are altered or lost."""

    def __init__(self, inner: can.BusABC, alter: Callable[[can.Message], can.Message | None]) -> None:
        self._inner = inner
        self._alter = alter
        super().__init__(channel="altered")
        self.channel_info = "altered"

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        self._inner.send(msg, timeout)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        frame = self._inner.recv(timeout)
        return self._alter(frame) if frame is not None and frame.arbitration_id == 0x581 else frame

    def shutdown(self) -> None:
        super().shutdown()
        self._inner.shutdown()


class ExtendedBus(AlteredBus):
    """Bus on which another device sends frames with 29 bits of identifier before each answer of drive A."""

    def __init__(self, inner: can.BusABC) -> None:
        super().__init__(inner, lambda answer: answer)
        self._due: list[can.Message] = []

    def recv(self, timeout: float | None = None) -> can.Message | None:
        if self._due:
            return self._due.pop(0)
        answer = super().recv(timeout)
        if answer is None or answer.arbitration_id != 0x581:
            return answer
        abort = bytes([0x80, *answer.data[1:4], *struct.pack("<I", 0x0602_0000)])
        self._due += [frame(0x581, abort, is_extended_id=True), answer]
        return frame(0x701, b"\0", is_extended_id=True)


def test_frames_with_29_bits_of_identifier_are_neither_answers_nor_boot_up_messages() -> None:
    with Line(SERVO) as line:
        saved = line.save()
        line.bus = ExtendedBus(line.bus)
        again = line.save()
    assert (again.parameters, again.unread) == (saved.parameters, saved.unread)


def losing(lost: set[int]) -> Callable[[can.Message], can.Message | None]:
    """Lose the answers of these numbers."""
    numbers = itertools.count()
    return lambda frame: None if next(numbers) in lost else frame


@settings(max_examples=40)
@given(lost=st.sets(st.integers(0, 250), max_size=8))
def test_single_lost_frames_end_neither_a_save_nor_a_restore(
    tmp_path_factory: pytest.TempPathFactory, lost: set[int]
) -> None:
    lost = {number for number in lost if not {number + 1, number + 2} & lost}
    path = tmp_path_factory.mktemp("eds") / "a.eds"
    path.write_text(SERVO.read_text() + listed(20))
    with Line(path) as line:
        saved = line.save()
    with Line(path) as line:
        line.bus = AlteredBus(line.bus, losing(lost))
        again = line.save()
        assert (again.parameters, again.unread) == (saved.parameters, {})
        for number in range(20):
            line.objects[0x2100 + number, 0].value = 1000
        line.bus = AlteredBus(line.bus, losing(lost))
        assert line.restore(saved).ok
        assert [line.objects[0x2100 + number, 0].value for number in range(20)] == list(range(20))


class SignalToEnd(BaseException):
    """As the command line raises for SIGTERM and for a closed terminal."""


@pytest.mark.parametrize(
    "interruption", [None, KeyboardInterrupt(), SignalToEnd(15)], ids=["lost", "Ctrl-C", "SIGTERM"]
)
@pytest.mark.parametrize("answers", [140, 170, 200])
def test_a_restore_that_ends_early_tells_what_it_has_written(
    tmp_path: Path, answers: int, interruption: BaseException | None
) -> None:
    path = tmp_path / "a.eds"
    path.write_text(SERVO.read_text() + listed(20))
    with Line(path) as line:
        saved = line.save()
        for number in range(20):
            line.objects[0x2100 + number, 0].value = 1000
        left = itertools.count()

        def end(frame: can.Message) -> can.Message | None:
            if next(left) < answers:
                return frame
            if interruption is not None:
                raise interruption
            return None

        line.bus = AlteredBus(line.bus, end)
        with pytest.raises(
            backup.RestoreAbortedError, match=r"\d+ of 20 parameters were written: restore it again"
        ) as ended:
            line.restore(saved)
    held = [line.objects[0x2100 + number, 0].value == number for number in range(20)]
    assert 0 <= sum(held) - len(ended.value.written) <= 1
    assert ended.value.intended == 20
    assert str(ended.value).startswith("interrupted; ") is (interruption is not None)


def test_a_restart_while_parameters_are_read_is_no_restart_of_a_set_up(rig: Foreign) -> None:
    booted = can.Message(arbitration_id=0x701, data=b"\0", is_extended_id=False)
    answers = itertools.count()
    rig.bus = AlteredBus(rig.wires, lambda frame: booted if next(answers) == 9 else frame)
    end = backup.save(rig.bus, rig.drives, rig.clock, ["A"])["A"]
    assert str(end) == "drive A: the drive restarted meanwhile; check its power supply"


SEGMENT, TOGGLE, LAST = 0, 0x10, 1


def altered(change: str, frame: can.Message) -> can.Message:
    """An answer with a segment that contradicts the transfer."""
    first = frame.data[0]
    if first >> 5 == SEGMENT and first & TOGGLE:
        frame.data[0] = first & ~TOGGLE if change == "toggle" else first | LAST
    return frame


@pytest.mark.parametrize(("change", "said"), [("toggle", "Toggle bit"), ("cut off", "14 bytes received, 26 announced")])
def test_a_wrong_transfer_costs_one_object(tmp_path: Path, change: str, said: str) -> None:
    path = tmp_path / "a.eds"
    path.write_text(SERVO.read_text() + listed(1, TEXT))
    with Line(path) as line:
        line.objects[0x2100, 0].content = b"abcdefghijklmnopqrstuvwxyz"
        line.bus = AlteredBus(line.bus, partial(altered, change))
        saved = line.save()
    assert {key: said in why for key, why in saved.unread.items()} == {(0x2100, 0): True}
    assert not saved.unanswered
    assert (0x6065, 0) in saved.parameters


def test_an_object_without_an_answer_is_known_as_such(tmp_path: Path) -> None:
    path = tmp_path / "a.eds"
    path.write_text(SERVO.read_text() + listed(2))
    with Line(path) as line:
        line.bus = AlteredBus(line.bus, lambda frame: None if frame.data[1:3] == b"\1\x21" else frame)
        saved = line.save()
    assert saved.unanswered == set(saved.unread) == {(0x2101, 0)}


@pytest.mark.parametrize("text", ["0x-1", "0x-", "0x-x", "0X-1"])
def test_a_text_like_a_negative_number_is_kept(tmp_path: Path, text: str) -> None:
    eds_path, path = tmp_path / "a.eds", tmp_path / "a.dcf"
    eds_path.write_text(SERVO.read_text() + listed(1, TEXT))
    with Line(eds_path) as line:
        line.objects[0x2100, 0].content = text.encode()
        saved = line.save()
    parameter_file.write(path, saved)
    assert parameter_file.read(path).parameters[0x2100, 0].value == text


@settings(max_examples=20)
@given(sub=st.sampled_from(["sub", "Sub", "SUB", "sUB"]), upper=st.booleans())
def test_sections_of_sub_objects_are_found_in_any_spelling(
    tmp_path_factory: pytest.TempPathFactory, sub: str, upper: bool
) -> None:
    path = tmp_path_factory.mktemp("eds") / "a.eds"
    spelt = re.sub(
        r"\[([0-9A-Fa-f]{4})sub([0-9A-Fa-f]+)\]",
        lambda found: f"[{found[1].upper() if upper else found[1].lower()}{sub}{found[2]}]",
        SERVO.read_text(),
    )
    path.write_text(spelt)
    objects, note = eds_file.load("A", path, 1)
    assert note == ""
    assert [key for key, _ in variables(objects)] == [key for key, _ in variables(eds_file.read(SERVO, 1))]


@pytest.mark.parametrize("spelt", [str.lower, str.upper])
def test_keywords_of_an_eds_may_have_letters_of_either_case(tmp_path: Path, spelt: Callable[[str], str]) -> None:
    """CiA 306: the names of sections and of entries are not case-sensitive."""
    text = re.sub(r"^\w+(?==)", lambda found: spelt(found[0]), SERVO.read_text(), flags=re.MULTILINE)
    (tmp_path / "a.eds").write_text(text)
    objects, note = eds_file.load("A", tmp_path / "a.eds", 1)
    assert note == ""
    facts = ("name", "data_type", "access_type", "default", "min", "max", "pdo_mappable")

    def described(of: canopen.ObjectDictionary) -> dict[Key, list[object]]:
        return {key: [getattr(variable, fact) for fact in facts] for key, variable in variables(of)}

    assert described(objects) == described(eds_file.read(SERVO, 1))


@pytest.mark.parametrize("name", ["0x1018sub1", "1018 sub1", "1018sub", "1018.1", "101"])
def test_a_section_that_looks_like_an_object_is_noted(tmp_path: Path, name: str) -> None:
    path = tmp_path / "a.eds"
    path.write_text(SERVO.read_text() + f"\n[{name}]\nParameterName=X\nDataType=7\n")
    assert f"[{name}] in line" in eds_file.load("A", path, 1)[1]


SERVO_OBJECTS = eds_file.read(SERVO, 5)


class FourBytes(Client):
    """Client of a drive that answers with four bytes, whose number it tells (43h) or not (42h)."""

    def __init__(self, content: bytes, command: int) -> None:
        super().__init__(Bus([], Clock(), {}), 5, SERVO_OBJECTS, 0.5, Clock())
        self._content = bytes([command]), content

    async def _request(self, request: bytes, key: Key | None = None) -> bytes:
        command, content = self._content
        return command + request[1:4] + content


def value_of(key: Key, content: bytes, command: int = 0x43) -> object:
    remote = Remote("A", FourBytes(content, command))
    variable = remote.client.od.get_variable(*key)
    assert variable is not None
    with pytest.raises(StopIteration) as end:
        remote.content(key).send(None)
    return parameter(variable.data_type, end.value.value, variable.qualname).value


@given(value=st.integers(-(2**31), 2**32 - 1))
@example(90000)
@example(-40000)
def test_a_value_that_is_longer_than_its_eds_says_keeps_every_bit(value: int) -> None:
    """As after an update of a drive's firmware; only padding is cut."""
    content = (value % 2**32).to_bytes(4, "little")
    if value >= 0:
        assert value_of((0x6066, 0), content) == value, "UNSIGNED16"
    if value < 2**15:
        assert value_of((0x605A, 0), content) == value, "INTEGER16"


@given(value=st.integers(0, 2**16 - 1), rest=st.binary(min_size=2, max_size=2))
def test_bytes_beyond_a_size_that_was_not_told_are_no_value(value: int, rest: bytes) -> None:
    assert value_of((0x6066, 0), value.to_bytes(2, "little") + rest, 0x42) == value
