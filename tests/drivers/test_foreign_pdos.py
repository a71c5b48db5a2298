"""PDOs of drives that others made, as the set-up leaves them: prompt, none beside those that are used, or refused."""

from __future__ import annotations

import pytest
from drivers.foreign import Habits
from drivers.test_foreign import MAKES, Rig
from rigs import Closing
from trirail_drivers.errors import DriveError

FIXED = {(0x1600, 0): 0, (0x1601, 0): 1, (0x1601, 1): 0x60FF_0020}
"""No controlword, and a target velocity where setpoints would be."""


@pytest.mark.parametrize("name", MAKES)
def test_no_pdo_is_on_but_those_that_are_used_and_none_of_them_waits(closing: Closing, name: str) -> None:
    rig = closing(Rig(name))
    rig.ready()
    for node, axis in zip(rig.nodes, rig.drives._axes, strict=True):
        way = axis.exchange
        used = {way.setpoints.identifier, way.controlword, way.feedback.identifier, way.status} - {None}
        on = [index for base in (0x1400, 0x1800) for index in node._pdos(base)]
        assert {node.value(index, 1) & 0x7FF for index in on} == used
        assert [node.value(index, 3) for index in on if index >= 0x1800] == [0] * (1 + (way.status is not None))


@pytest.mark.parametrize("name", MAKES)
@pytest.mark.parametrize("held_back", [False, True])
def test_no_frames_are_heard_but_those_of_the_set_up(closing: Closing, name: str, held_back: bool) -> None:
    """A drive whose statusword comes beside its position does not use the identifier of TPDO1, and another node may."""
    slow = Habits(values={(0x1800, 3): 1000}, access={(0x1800, 3): "ro"}) if held_back else Habits()
    rig = closing(Rig(name, slow))
    rig.ready()
    for axis in rig.drives._axes:
        way = axis.exchange
        used = {way.feedback.identifier, way.status, way.emergency, 0x700 + axis.node, 0x580 + axis.node} - {None}
        assert {number for number, (owner, _) in rig.drives._wire._handlers.items() if owner is axis} == used


def test_a_statusword_that_may_be_held_back_is_taken_from_beside_the_position(closing: Closing) -> None:
    rig = closing(Rig("elmo_gold", Habits(values={(0x1800, 3): 1000}, access={(0x1800, 3): "ro"})))
    rig.ready()
    for axis in rig.drives._axes:
        assert axis.exchange.feedback.has_status
        assert axis.exchange.status is None
    assert any("object 1800:03 (Inhibit time)" in warning for warning in rig.warnings)
    rig.enable()


@pytest.mark.parametrize(
    ("timers", "polled"), [((100, 0), True), ((0, 100), False), ((0, 20), False), ((0, 500), True)]
)
def test_a_statusword_in_a_fixed_tpdo_is_polled_unless_that_tpdo_repeats_it(
    closing: Closing, timers: tuple[int, int], polled: bool
) -> None:
    first, third = timers
    mapped = {(0x1A00, 0): 1, (0x1A00, 1): 0x60FD_0020, (0x1A02, 0): 1, (0x1A02, 1): 0x6041_0010}
    timed = {(0x1800, 5): first, (0x1802, 1): 0x381, (0x1802, 2): 255, (0x1802, 5): third}
    fixed = dict.fromkeys([(0x1800, 1), (0x1800, 5), (0x1802, 5), *mapped], "ro")
    rig = closing(Rig("elmo_gold", Habits(values=mapped | timed, access=fixed)))
    rig.ready()
    for axis in rig.drives._axes:
        assert (axis.exchange.status, axis.exchange.polled) == (0x380 + axis.node, polled)
    rig.enable()
    for _ in range(50):
        rig.cycle(rig.feedback.position)
    assert rig.drives.prepare_tables() == (not polled)  # compiled cycles send no requests


@pytest.mark.parametrize(("taken", "chosen", "coasts"), [((1, 2, 3), 3, False), ((1, 2), 1, False), ((2,), 2, True)])
def test_a_drive_without_its_master_has_a_ramp_if_it_accepts_any(
    closing: Closing, taken: tuple[int, ...], chosen: int, coasts: bool
) -> None:
    habits = Habits(values={(0x6007, 0): 0}, refuses={(0x6007, 0): lambda value: value not in taken})
    rig = closing(Rig("elmo_gold", habits))
    rig.ready()
    assert [node.value(0x6007) for node in rig.nodes] == [chosen] * 3
    assert any("the drive coasts" in warning for warning in rig.warnings) == coasts


@pytest.mark.parametrize(("held", "wanted"), [(0, 0), (20, 20), (100, 100), (101, 100), (65535, 100)])
def test_a_drive_reacts_soon_to_a_following_error(closing: Closing, held: int, wanted: int) -> None:
    rig = closing(Rig("elmo_gold", Habits(values={(0x6066, 0): held})))
    rig.ready()
    assert [node.value(0x6066) for node in rig.nodes] == [wanted] * 3


def test_a_fixed_mapping_that_does_not_fit_is_refused_by_its_object(closing: Closing) -> None:
    rig = closing(Rig("elmo_gold", Habits(fixed_pdos=True, values=FIXED)))
    with pytest.raises(DriveError, match=r"drive A: object 1601 .*no PDO fits setpoints 607A: it has 1601 = 60FF0020h"):
        rig.ready()
