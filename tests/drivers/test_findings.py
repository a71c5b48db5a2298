"""What drives have of their own, seen at set-up: what is said of it, and what goes on all the same."""

from __future__ import annotations

import dataclasses
from typing import Any

import can
import pytest
from canopen import SdoAbortedError
from drivers.foreign import Habits
from drivers.test_backup import Line
from drivers.test_foreign import PERIOD, Rig
from edsfiles import rows
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace
from rigs import Closing
from trirail_drivers.cia402 import inspection
from trirail_drivers.cia402.eds import SERVO
from trirail_drivers.cia402.objects import title
from trirail_drivers.cia402.one_drive import SetUp
from trirail_drivers.cia402.setup import check_identifiers, survey
from trirail_drivers.config import Homing
from trirail_drivers.driver.scaling import scale_of
from trirail_drivers.errors import DriveError
from trirail_drivers.simulated.dictionary import ObjectEntry

Key = tuple[int, int]
MASTER = 126


def test_a_drive_that_takes_8_ms_only_is_refused_with_the_rate_that_it_has(closing: Closing) -> None:
    refuses = {(0x60C2, 1): lambda value: value != 8, (0x60C2, 2): lambda exponent: exponent != -3}
    rig = closing(Rig("elmo_gold", Habits(values={(0x60C2, 1): 8, (0x60C2, 2): -3}, refuses=refuses)))
    with pytest.raises(DriveError, match=r"60C2:0\d .*; it holds 8 ms: set loop\.rate_hz = 125") as refused:
        rig.drives.configure(PERIOD)
    assert str(refused.value).endswith("; the same for drive B; the same for drive C")
    rig.drives.configure(0.008)


def test_what_is_found_of_one_drive_does_not_hide_what_is_found_of_another(closing: Closing) -> None:
    rig = closing(Rig("elmo_gold"))
    a, b, c = rig.nodes
    a.put(0x1000, 0x191)
    for node in (b, c):
        node.put(0x6502, 0x2D)
    with pytest.raises(DriveError) as refused:
        rig.drives.configure(PERIOD)
    said = str(refused.value)
    assert said.startswith("drive A: object 1000:00 (device type) is 00000191")
    assert "; drive B: object 6502:00 (supported drive modes) is 0000002D: neither" in said
    assert said.endswith("; the same for drive C")
    assert all(index == 0x6040 for node in rig.nodes for index, *_ in node.written)


def test_an_emcy_that_is_switched_off_is_not_told_as_the_predefined_one(closing: Closing) -> None:
    rig = closing(Rig("elmo_gold", Habits(values={(0x1014, 0): 0x8000_0081}, access={(0x1014, 0): "ro"})))
    rig.ready()
    (said,) = [line for line in rig.warnings if "1014" in line and "drive A" in line]
    assert "its EMCY is off" in said
    assert "predefined" not in said
    rig.nodes[0].habits.tells_error_reset = False
    rig.enable()


def test_an_emcy_that_is_switched_off_is_switched_on(closing: Closing) -> None:
    rig = closing(Rig("elmo_gold", Habits(values={(0x1014, 0): 0x8000_0081}, access={(0x1014, 0): "rw"})))
    rig.ready()
    assert [node.value(0x1014) for node in rig.nodes] == [0x80 + node.node for node in rig.nodes]


def test_an_event_timer_that_is_read_only_keeps_the_statuswords_pdo(closing: Closing) -> None:
    rig = closing(Rig("elmo_gold", Habits(access={(0x1800, 5): "ro"}, values={(0x1800, 5): 0})))
    rig.ready()
    for node in rig.nodes:
        assert node.value(0x1800, 1) & 0x8000_07FF == 0x180 + node.node
        assert (node.value(0x1A00, 0), node.value(0x1A00, 1)) == (1, 0x6041_0010)
    assert any("1800:05" in line and "cannot be set" in line for line in rig.warnings)
    assert any("also requested by SDO" in line for line in rig.warnings)
    rig.enable()
    rig.go(0.05, 200)


SECOND = ((0x1016, 2, 7, "rw", 0, False),)
ANOTHER = 5 << 16 | 1000
"""What watches the heartbeat of a node that is no business of this service's."""


@pytest.mark.parametrize(
    ("held", "access", "used"),
    [
        ({(0x1016, 1): ANOTHER}, {}, 2),
        ({(0x1016, 1): 0}, {(0x1016, 1): "ro"}, 2),
        ({(0x1016, 1): ANOTHER, (0x1016, 2): ANOTHER + (1 << 16)}, {}, 1),
        ({(0x1016, 2): MASTER << 16 | 77}, {}, 2),
        ({}, {}, 1),
    ],
    ids=["watches another", "read-only", "all taken", "it watches this service already", "free"],
)
def test_the_entry_of_1016_that_is_free_watches_this_service(
    closing: Closing, held: dict[Key, int], access: dict[Key, str], used: int
) -> None:
    rig = closing(Rig("elmo_gold", Habits(more=SECOND, values={(0x1016, 0): 2, **held}, access=access)))
    rig.ready()
    for node in rig.nodes:
        watched = {entry: node.value(0x1016, entry) for entry in (1, 2)}
        assert watched[used] == MASTER << 16 | 300
        assert watched[3 - used] == held.get((0x1016, 3 - used), 0)


def test_a_mapping_that_fits_with_another_transmission_type_says_so(closing: Closing) -> None:
    values = {
        (0x1400, 1): 0x201, (0x1600, 0): 1, (0x1600, 1): 0x6040_0010,
        (0x1401, 1): 0x301, (0x1401, 2): 255, (0x1601, 0): 1, (0x1601, 1): 0x607A_0020,
    }  # fmt: skip
    rig = closing(Rig("elmo_gold", Habits(fixed_pdos=True, values=values, access={(0x1401, 2): "ro"})))
    said = r"1601 = 607A0020h, which fits, but its transmission type 1401:02 stays 255; expected 1"
    with pytest.raises(DriveError, match=said):
        rig.drives.configure(PERIOD)


HOMING = Homing(method=37, speed_switch=0.01, speed_zero=0.001, acceleration=0.1)
KEEPS: dict[Key, tuple[str, int]] = {
    (0x1005, 0): ("refused", 0x81),
    (0x1007, 0): ("refused", 500),
    (0x607C, 0): ("refused", 5000),
    (0x1029, 1): ("protection", 1),
    (0x605D, 0): ("protection", 0),
    (0x6066, 0): ("protection", 500),
    (0x1800, 3): ("noted", 50),
    (0x609A, 0): ("noted", 7),
}
"""What becomes of a drive with an object of another value than the set-up needs, and such a value."""


def fit(line: Line, key: Key, value: int) -> ObjectEntry:
    """Have drive A hold a value in an object that its dictionary may lack, and set up its homing."""
    line.drives = replace(line.drives, A=replace(line.drives.A, homing=HOMING))
    entry = line.objects[key]
    entry.value = value
    return entry


def set_up(line: Line, *, apply: bool) -> dict[str, object]:
    """What the set-up of drive A finds, or why it is refused."""
    nothing: dict[str, object] = {"notes": [], "lacking": [], "differences": []}
    try:
        return nothing | inspection.inspect(line.bus, line.drives, 0.001, line.clock, 0.2, apply=apply)[0]
    except DriveError as error:
        return nothing | {"refused": str(error)}


@pytest.mark.parametrize("apply", [False, True])
@pytest.mark.parametrize("key", KEEPS)
def test_a_value_that_a_drive_keeps_is_not_told_as_a_missing_object(key: Key, apply: bool) -> None:
    end, value = KEEPS[key]
    with Line(SERVO) as line:
        fit(line, key, value)._limits = None  # it is read-only
        found = set_up(line, apply=apply)
    refused, notes = str(found["refused"]), [str(each) for each in found["notes"]]  # type: ignore[attr-defined]
    if end == "noted":
        (note,) = [each for each in notes if each.startswith(title(key))]
        assert not refused
        assert str(value) in note
        assert "there is none" not in note
        return
    assert not any(title(key) in each for each in notes)
    assert ("lacks protections" in refused) == (end == "protection")
    assert f"{key[0]:04X}" in refused
    if end == "protection":
        with Line(SERVO) as line:
            fit(line, key, value)._limits = None
            line.drives = replace(line.drives, A=replace(line.drives.A, accept_without=(f"{key[0]:04X}",)))
            assert set_up(line, apply=apply)["lacking"] == [f"{key[0]:04X}"]


@pytest.mark.parametrize("key", [(0x6007, 0), (0x605E, 0)])
@pytest.mark.parametrize("apply", [False, True])
def test_a_drive_that_can_only_coast_is_told_of(key: Key, apply: bool) -> None:
    """6007h = 2 and 605Eh = 0 are accepted where the drive accepts nothing better."""
    with Line(SERVO) as line:
        fit(line, key, 2 if key[0] == 0x6007 else 0)._limits = None
        found = set_up(line, apply=apply)
    assert not found["refused"]
    assert [title(key) in str(each) and "the drive coasts" in str(each) for each in found["notes"]] == [True]  # type: ignore[attr-defined]


@pytest.mark.parametrize(("held", "then"), [(0, 1), (1, 1), (2, 2), (4, 4), (None, None)])
def test_a_halt_of_homing_brakes(held: int | None, then: int | None) -> None:
    """605Dh; a drive without the object has a stop of its own."""
    with Line(SERVO) as line:
        entry = fit(line, (0x605D, 0), held or 0)
        if held is None:
            del line.objects._entries[0x605D, 0]
        found = set_up(line, apply=True)
    assert not found["refused"]
    assert held is None or entry.value == then
    assert any("605D" in str(each) for each in found["notes"]) == (held is None)  # type: ignore[attr-defined]


@pytest.mark.parametrize("held", [2, 3, 4])
def test_a_drive_may_keep_another_halt_that_brakes(held: int) -> None:
    with Line(SERVO) as line:
        fit(line, (0x605D, 0), held)._limits = None
        found = set_up(line, apply=True)
    assert not found["refused"]
    assert not found["lacking"]


@pytest.mark.parametrize("held", [0, 2])
def test_a_drive_that_acknowledges_another_halt_but_keeps_its_own_may_do_so_if_it_brakes(held: int) -> None:
    with Line(SERVO) as line:
        entry = fit(line, (0x605D, 0), held)

        def kept(entry: ObjectEntry, _before: object) -> None:
            entry.value = held

        entry.on_write = kept
        found = set_up(line, apply=True)
    assert ("605D" in str(found["refused"]) and "accept_without" in str(found["refused"])) == (held == 0)
    assert bool(found["refused"]) == (held == 0)


def test_a_drive_without_homing_keeps_its_halt() -> None:
    with Line(SERVO) as line:
        line.objects[0x605D, 0].value = 0
        assert not set_up(line, apply=True)["refused"]
        assert line.objects[0x605D, 0].value == 0


@settings(max_examples=20)
@given(held=st.integers(0, 0xFFFF), step=st.integers(1, 300), keeps=st.booleans())
def test_any_time_out_of_the_following_error_up_to_100_ms_is_accepted(held: int, step: int, keeps: bool) -> None:
    """A drive may round the time down to a multiple of its own cycle, or keep what it has."""

    def write(entry: ObjectEntry, old: int) -> None:
        entry.value = old if keeps else entry.value // step * step

    with Line(SERVO) as line:
        fit(line, (0x6066, 0), held).on_write = write
        refused, now = set_up(line, apply=True)["refused"], line.objects[0x6066, 0].value
    assert now <= 100 or "6066" in str(refused)
    assert not refused or now > 100


@pytest.mark.parametrize("identifier", [0x80, 0x81, 0x4000_0080, 0x2000_0080])
def test_bit_31_of_the_identifier_of_sync_means_nothing(identifier: int) -> None:
    with Line(SERVO) as line:
        entry = line.objects[0x1005, 0]
        entry._limits = None, None

        def keep_bit(entry: ObjectEntry, old: int) -> None:
            if old & 0x4000_0000 and entry.value & 0x7FF != old & 0x7FF:
                raise SdoAbortedError(0x0609_0030)
            entry.value |= 0x8000_0000

        entry.value, entry.on_write = 0x8000_0000 | identifier, keep_bit
        assert not set_up(line, apply=True)["refused"]
        assert entry.value == 0x8000_0080


def keep_on(entry: ObjectEntry, old: int) -> None:
    """Ignore a write of the identifier, as a drive that stays on does."""
    if entry.subindex == 1:
        entry.value = old


def map_pdo(line: Line, index: int, identifier: int, kind: int, *entries: int) -> None:
    """Map a PDO of drive A as its manufacturer would."""
    objects = line.objects
    objects[index, 1].write(1 << 31 | identifier)
    objects[index + 0x200, 0].write(0)
    for position, entry in enumerate(entries, start=1):
        objects[index + 0x200, position].write(entry)
    objects[index + 0x200, 0].write(len(entries))
    objects[index, 2].write(kind)
    objects[index, 1].write(identifier)


@pytest.mark.parametrize("ignores", [False, True])
@pytest.mark.parametrize("apply", [False, True])
@settings(max_examples=25)
@given(
    identifier=st.one_of(
        st.sampled_from([0x181, 0x182, 0x202, 0x281, 0x282, 0x301, 0x303, 0x201, 0x82, 0x401]),
        st.integers(0x181, 0x57F),
    ),
)
def test_a_pdo_that_stays_on_shares_no_identifier_with_a_used_one(ignores: bool, apply: bool, identifier: int) -> None:
    used = {each + node for each in (0x80, 0x180, 0x200, 0x280, 0x300) for node in (1, 2, 3)}
    with Line(SERVO) as line:
        map_pdo(line, 0x1402, identifier, 1, 0x607A_0020)
        if ignores:
            line.objects[0x1402, 1].on_write = keep_on
        else:
            line.objects[0x1402, 1]._limits = None
        found = set_up(line, apply=apply)
    refused, notes = str(found["refused"]), str(found["notes"])
    if ignores and not apply:
        return  # only a write shows it
    if identifier in used:
        assert f"identifier {identifier:03X}h that cannot be changed" in refused
    else:
        assert not refused
        assert "PDO 1402 cannot be switched off" in notes
        assert not [each for each in found["differences"] if each["object"] == "1402:01"]  # type: ignore[attr-defined]


def mapping_of(line: Line, index: int) -> list[int]:
    """What the parameters of a PDO hold."""
    objects = line.objects
    keys = [(index, 1), (index, 2), *((index + 0x200, position) for position in range(9))]
    return [objects[key].value for key in keys]


@pytest.mark.parametrize("apply", [False, True])
@settings(max_examples=25)
@given(
    fixed=st.sampled_from(["entries are read-only", "other entries are refused", "no entry is accepted"]),
    entries=st.sampled_from([(0x6040_0010, 0x607A_0020), (0x607A_0020,), (0x607A_0020, 0x6040_0010)]),
    identifier=st.integers(0x301, 0x57F).filter(lambda each: each not in (0x302, 0x303)),
    kind=st.sampled_from([0, 1, 255]),
)
def test_a_mapping_that_a_drive_does_not_change_is_used_as_it_was(
    apply: bool, fixed: str, entries: tuple[int, ...], identifier: int, kind: int
) -> None:
    def refuse(entry: ObjectEntry, old: int) -> None:
        suits = entry.subindex <= len(entries) and entry.value == (0, *entries)[entry.subindex]
        if fixed == "no entry is accepted" or not suits:
            raise SdoAbortedError(0x0604_0041)

    with Line(SERVO) as line:
        map_pdo(line, 0x1401, identifier, kind, *entries)
        for position in range(1, 9):
            if fixed == "entries are read-only":
                line.objects[0x1601, position]._limits = None
            else:
                line.objects[0x1601, position].on_write = refuse
        before = mapping_of(line, 0x1401)
        found = set_up(line, apply=apply)
        after = mapping_of(line, 0x1401)
    assert not found["refused"]
    if entries == (0x607A_0020,):
        assert after[2:] == before[2:]
    elif apply and (entries[0] != 0x607A_0020 or fixed != "other entries are refused"):
        assert after == [before[0], 1, *before[2:]]
        assert any("PDO 1401 is used as it is mapped" in str(each) for each in found["notes"])  # type: ignore[attr-defined]


@pytest.mark.parametrize("apply", [False, True])
@pytest.mark.parametrize("access", ["read-only", "writable"])
@pytest.mark.parametrize("mappable", [False, True])
@pytest.mark.parametrize("inhibit", [0, 50, 200, 201, 5000])
def test_an_inhibit_time_costs_no_pdo(inhibit: int, mappable: bool, access: str, apply: bool) -> None:
    with Line(SERVO) as line:
        objects = line.objects
        if not mappable:
            map_pdo(line, 0x1801, 0x281, 1, 0x6064_0020)
            for index in (0x1A00, 0x1A01):
                for position in range(9):
                    objects[index, position]._limits = None
        objects[0x1800, 3].value = inhibit
        if access == "read-only":
            objects[0x1800, 3]._limits = None
        found = set_up(line, apply=apply)
        cob_id, held = objects[0x1800, 1].value, objects[0x1800, 3].value
        assert not found["refused"]
        kept = access == "read-only" and inhibit != 0
        way = str(found["way"])
        if kept and mappable:
            assert "with the position" in way
        else:
            assert "statusword event-driven" in way
            assert ("polled" in way) == (kept and inhibit > 200)
        if apply and not (kept and mappable):
            assert cob_id & 0x8000_07FF == 0x181
        changes = {each["object"]: each for each in found["differences"]}  # type: ignore[attr-defined]
        if access == "writable" and inhibit:
            assert (changes["1800:03"]["found"], changes["1800:03"]["wanted"]) == (f"{inhibit:08X}h", "00000000h")
            assert held == (0 if apply else inhibit)
        assert "1800:01" not in changes or (kept and mappable)


IDENTIFIERS = st.frozensets(st.sampled_from([0x181, 0x182, 0x201, 0x301, 0x401, 0x402, 0x481]), max_size=2)


@given(unused=st.lists(st.tuples(IDENTIFIERS, IDENTIFIERS), min_size=2, max_size=2))
def test_an_identifier_that_is_sent_belongs_to_one_pdo(unused: list[tuple[frozenset[int], frozenset[int]]]) -> None:
    with Line(SERVO) as line:
        scales = scale_of("A", line.drives.A), scale_of("B", line.drives.B), scale_of("C", line.drives.C)
        made = [each for each in survey(line.bus, line.drives, scales, 0.001, line.clock) if isinstance(each, SetUp)]
    for number, (received, sent) in enumerate(unused):
        exchange = dataclasses.replace(made[number].exchange, unused_rpdos=received, unused_tpdos=sent)
        made[number] = made[number]._replace(exchange=exchange)
    taken = [identifier for each in made for identifier in (*each.exchange.identifiers, *each.exchange.unused_tpdos)]
    idle = {identifier for each in made for identifier in each.exchange.unused_rpdos}
    if len(taken) == len(set(taken)) and not idle & set(taken):
        check_identifiers(made)
    else:
        with pytest.raises(DriveError, match="that cannot be changed or switched off"):
            check_identifiers(made)


UNKNOWN = 0x00FE_0300
"""Code that no table has."""


@pytest.mark.parametrize("apply", [False, True])
@pytest.mark.parametrize("index", [0x60A9, 0x60AA])
@settings(max_examples=10)
@given(code=st.sampled_from([UNKNOWN, 0x00FE_5700, 0xFD00_0000, 0x00C1_FF00]), numerator=st.integers(1, 9))
def test_a_factor_does_not_stand_for_a_unit_that_is_not_known(
    apply: bool, index: int, code: int, numerator: int
) -> None:
    values = {(each, sub): value for each in (0x6096, 0x6097) for sub, value in ((1, numerator), (2, 1))}
    key, unit = ("velocity_unit", "rpm") if index == 0x60A9 else ("acceleration_unit", "rpm/s")
    habits = Habits(values=values, more=((index, 0, 7, "rw", code, False),))
    for configured in (None, unit):
        keys: dict[str, Any] = {key: configured}
        rig = Rig("elmo_gold", habits, revolutions_per_metre=200.0, **keys)
        try:
            found = inspection.inspect(rig.wires, rig.config, PERIOD, rig.clock, apply=False)[0]
        finally:
            rig.drives.close()
        if configured:
            assert (found["refused"], found[key]) == ("", unit)
        else:
            assert f"object {index:04X} = {code:08X}h is no known unit" in found["refused"]
            assert f"drives.A.{key}" in found["refused"]


def in_micrometres(feed: int | None) -> Rig:
    """Drives whose positions are in µm and whose velocities are in rpm, with the feed of one revolution [µm]."""
    units = ((0x60A8, 0xFA01_0000), (0x60A9, 0x00B4_4700), (0x60AA, 0x00C0_0300))
    values = {(0x6092, 1): feed, (0x6092, 2): 1} if feed else {}
    more = tuple((index, 0, 7, "rw", code, False) for index, code in units)
    habits = Habits(frozenset() if feed else frozenset({0x6092}), values, more=more)
    return Rig("elmo_gold", habits, counts_per_metre=1e6)


@settings(max_examples=20)
@given(feed=st.integers(2, 1_000_000))
def test_revolutions_per_metre_follow_from_a_feed_constant_in_micrometres(feed: int) -> None:
    rig = in_micrometres(feed)
    try:
        for found in inspection.inspect(rig.wires, rig.config, PERIOD, rig.clock, apply=False):
            assert (found["refused"], found["velocity_unit"]) == ("", "rev/min")
        scales = tuple(scale_of("A", drive) for drive in rig.config.each)
        made = [each for each in survey(rig.wires, rig.config, scales, PERIOD, rig.clock) if isinstance(each, SetUp)]
        assert made
        for each in made:
            assert each.units.velocity_per_metre == pytest.approx(60e6 / feed)
    finally:
        rig.drives.close()


def test_a_drive_in_micrometres_without_a_feed_constant_is_not_set_to_increments(closing: Closing) -> None:
    rig = closing(in_micrometres(None))
    with pytest.raises(DriveError, match=r"set drives\.A\.revolutions_per_metre"):
        rig.drives.configure(PERIOD)


@pytest.mark.parametrize("polarity", [0x00, 0x40, 0x80, 0xC0, 0x21])
def test_velocities_have_the_sign_of_positions(closing: Closing, polarity: int) -> None:
    row = (0x607E, 0, 5, "rw", 0, False)
    there = any(each[0] == 0x607E for each in rows("elmo_gold"))
    habits = Habits(values={(0x607E, 0): polarity}, more=() if there else (row,))
    rig = closing(Rig("elmo_gold", habits))
    if polarity in (0x40, 0x80):
        with pytest.raises(DriveError, match=rf"drive A: object 607E:00 \(polarity\) is {polarity:02X}h"):
            rig.drives.configure(PERIOD)
    else:
        rig.drives.configure(PERIOD)


@pytest.mark.parametrize("identifier", [0x601, 0x201, 0x302, 0x000, 0x700 + MASTER])
@pytest.mark.parametrize("apply", [False, True])
def test_drives_are_not_read_beside_another_master(identifier: int, apply: bool) -> None:
    """Its SDO requests would mix with these, and the robot may be moving."""
    with Line(SERVO) as line:
        line.bus._arrived.append(can.Message(arbitration_id=identifier, data=bytes(8), is_extended_id=False))  # type: ignore[attr-defined]
        line.bus.sent.clear()  # type: ignore[attr-defined]
        with pytest.raises(DriveError, match="another master is on the bus"):
            inspection.inspect(line.bus, line.drives, 0.001, line.clock, 0.2, apply=apply)
        assert not line.bus.sent  # type: ignore[attr-defined]


TRAVEL = (-0.02, 0.05)
"""Travel of drive A [m]; with 1e6 counts per metre and the direction -1, -50 000 to 20 000 counts."""
LIMITS = [
    (0x607B, 0, 0, ""),
    (0x607B, -50_000, 20_000, ""),
    (0x607B, -49_999, 20_000, "refused"),
    (0x607B, -50_000, 19_999, "refused"),
    (0x607B, 20_000, 20_000, "noted"),
    (0x607B, 20_000, -50_000, "noted"),
    (0x607B, -(2**31), 2**31 - 1, ""),
    (0x607D, 0, 0, ""),
    (0x607D, -50_000, 20_000, ""),
    (0x607D, -49_999, 20_000, "refused"),
    (0x607D, -50_000, 19_999, "refused"),
    (0x607D, 0, 20_000, "refused"),
    (0x607D, 1, -1, ""),
    (0x607D, 5, 5, "noted"),
    (0x607D, -(2**31), 2**31 - 1, ""),
]
"""Ends of a position limit, and what becomes of a drive with it."""


def limited(line: Line, limits: dict[int, tuple[int, int]], *, apply: bool, home_offset: int = 0) -> dict[str, Any]:
    """What the set-up of drive A finds if the drive has position limits."""
    line.drives = replace(line.drives, A=replace(line.drives.A, direction=-1))
    line.objects[0x607C, 0].value = home_offset
    for index, ends in limits.items():
        for subindex, end in enumerate(ends, 1):
            line.objects.add(index, subindex, 32, signed=True)
            line.objects[index, subindex].value = end
    travel = (TRAVEL, (-1.0, 1.0), (-1.0, 1.0))
    try:
        return {"notes": []} | inspection.inspect(line.bus, line.drives, 0.001, line.clock, apply=apply, travel=travel)[
            0
        ]
    except DriveError as error:
        return {"refused": str(error), "notes": []}


@pytest.mark.parametrize("apply", [False, True])
@pytest.mark.parametrize(("index", "least", "most", "end"), LIMITS)
def test_a_position_limit_of_a_drive_must_contain_the_travel(
    index: int, least: int, most: int, end: str, apply: bool
) -> None:
    with Line(SERVO) as line:
        found = limited(line, {index: (least, most)}, apply=apply)
    said = f"object {index:04X} ({'position range' if index == 0x607B else 'software position'} limit) is {least} to "
    assert [said in found["refused"], [said in each for each in found["notes"]]] == [
        end == "refused",
        [True] * (end == "noted"),
    ]
    if end == "refused":
        assert (
            f"{most} counts, but limits.slider.position = [-0.02, 0.05] is -50000 to 20000 counts" in found["refused"]
        )
    else:
        assert not found["refused"]


@pytest.mark.parametrize("homing", [False, True])
@pytest.mark.parametrize(
    ("offset", "least", "most", "end"),
    [
        (3_000, -47_000, 23_000, "noted"),  # shifted by the offset, as in the standard, it contains the travel
        (3_000, -50_000, 20_000, "noted"),
        (3_000, -50_000, 23_000, ""),
        (3_000, -40_000, 23_000, "refused"),
    ],
)
def test_a_software_limit_may_count_from_the_home(homing: bool, offset: int, least: int, most: int, end: str) -> None:
    """The set-up of a drive with homing makes the home offset zero."""
    with Line(SERVO) as line:
        if homing:
            line.drives = replace(line.drives, A=replace(line.drives.A, homing=HOMING))
        found = limited(line, {0x607D: (least, most)}, apply=True, home_offset=offset)
    notes = [each for each in found["notes"] if "607C, 3000, does not matter" in each]
    if homing:
        end = "" if least <= -50_000 and most >= 20_000 else "refused"
    assert ["607D" in found["refused"], len(notes)] == [end == "refused", end == "noted"]


def test_a_drive_without_position_limits_or_with_half_a_limit_is_accepted() -> None:
    with Line(SERVO) as line:
        assert not limited(line, {0x607B: (5,), 0x607D: (5,)}, apply=True)["refused"]  # type: ignore[dict-item]
