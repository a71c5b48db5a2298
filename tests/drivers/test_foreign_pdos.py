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


def test_a_fixed_mapping_that_does_not_fit_is_refused_by_its_object(closing: Closing) -> None:
    rig = closing(Rig("elmo_gold", Habits(fixed_pdos=True, values=FIXED)))
    with pytest.raises(DriveError, match=r"drive A: object 1601 .*no PDO fits setpoints 607A: it has 1601 = 60FF0020h"):
        rig.ready()
