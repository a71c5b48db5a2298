"""What drives have of their own, seen at set-up: what is said of it, and what goes on all the same."""

from __future__ import annotations

import pytest
from drivers.foreign import Habits
from drivers.test_foreign import PERIOD, Rig
from rigs import Closing
from trirail_drivers.errors import DriveError

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
