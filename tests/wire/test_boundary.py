"""What is taken from outside, to the last byte and number, and what is not any more."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from trirail.errors import RefusalCode, RefusedError
from trirail.wire import boundary, records
from trirail.wire.goals import Goal, PoseGoal
from trirail.wire.records import DTYPE
from trirail.wire.sizes import MAX_MESSAGE, MAX_NAME
from trirail.wire.text import check_new_pose
from trirail.wire.vocabulary import MODES
from trirail_drivers.interface import PowerState

PREFIX = "trirail/demo/goal"


def refused(call: Callable[[], object]) -> RefusalCode | None:
    """Return why a call is refused; None where it is not."""
    try:
        call()
    except RefusedError as error:
        return error.code
    return None


@pytest.mark.parametrize("user", ["ann", "Ann-2_b", "x" * MAX_NAME])
def test_a_key_names_a_user(user: str) -> None:
    assert boundary.names(f"{PREFIX}/{user}", PREFIX, ("user",)) == [user]


@pytest.mark.parametrize("user", ["", "a b", "ann\n", "änn", "x" * (MAX_NAME + 1)])
def test_a_key_whose_user_no_name_can_be_is_refused(user: str) -> None:
    assert refused(lambda: boundary.names(f"{PREFIX}/{user}", PREFIX, ("user",))) is RefusalCode.BAD_NAME


@pytest.mark.parametrize("name", ["5mm", "10", "a b", "../../etc"])
def test_a_pose_is_not_taught_by_what_is_no_name_or_a_quantity(name: str) -> None:
    assert refused(lambda: check_new_pose(name)) is RefusalCode.BAD_NAME
    assert check_new_pose("p5mm") == "p5mm"


def test_a_message_is_decoded_up_to_its_size_and_not_a_byte_beyond() -> None:
    goal = b'{"kind":"pose","x":0.1,"y":0,"phi":0}'
    assert boundary.decode(goal.ljust(MAX_MESSAGE), Goal, "not a goal") == PoseGoal(0.1, 0.0, 0.0)
    longer = goal.ljust(MAX_MESSAGE + 1)
    assert refused(lambda: boundary.decode(longer, Goal, "not a goal")) is RefusalCode.TOO_LARGE


POSE = b'"x":0.1,"y":0,"phi":0'


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b'{"kind":"pose","x":-0.1,%b}' % POSE, "not a goal: key x is given twice; give it once"),
        (b'{"kind":"pose","x":-0.1,"x":0,%b}' % POSE, "not a goal: key x is given 3 times; give it once"),
        (b'{"kind":"pose","\\u0078":-0.1,%b}' % POSE, "not a goal: key x is given twice; give it once"),
        (b'{"kind":"pose","kind":"pose",%b}' % POSE, "not a goal: key kind is given twice; give it once"),
        (
            b'{"kind":"trajectory","points":[{"t":0,%b},{"t":1,"t":2,%b}]}' % (POSE, POSE),
            "not a goal: key t is given twice; give it once",
        ),
        (b'{"kind":"pose","limits":{"velocity":[1,1,1],"velocity":[2,2,2]},%b}' % POSE, "key velocity is given twice"),
    ],
)
def test_a_key_that_stands_twice_is_refused_by_name(content: bytes, said: str) -> None:
    with pytest.raises(RefusedError, match=said) as caught:
        boundary.decode(content, Goal, "not a goal")
    assert caught.value.code is RefusalCode.MALFORMED


def test_the_same_key_in_several_objects_and_strings_that_look_like_keys_are_taken() -> None:
    both = b'{"kind":"trajectory","points":[{"t":0,%b},{"t":1,%b}]}' % (POSE, POSE)
    assert len(boundary.decode(both, Goal, "not a goal").points) == 2
    odd = b'{"kind":"pose","id":"\\"x\\":1,\\"x\\":2",%b}' % POSE
    assert boundary.decode(odd, Goal, "not a goal").id == '"x":1,"x":2'


@pytest.mark.parametrize(
    ("cycles", "taken"),
    [
        ([0], True),
        ([0, 1], True),
        ([7, 8, 9], True),
        ([-1], False),
        ([-1, 0], False),
        ([7, 9], False),
        ([7, 7], False),
        ([8, 7], False),
    ],
)
def test_records_are_of_cycles_one_after_the_other(cycles: list[int], taken: bool) -> None:
    rows = np.zeros(len(cycles), DTYPE)
    rows["cycle"] = cycles
    assert refused(lambda: records.checked(rows.tobytes())) is (None if taken else RefusalCode.MALFORMED)


@pytest.mark.parametrize(("field", "known"), [("mode", len(MODES)), ("drive_state", len(PowerState))])
@pytest.mark.parametrize("row", [0, 1])
def test_records_have_modes_and_states_that_there_are(field: str, known: int, row: int) -> None:
    """One number of one record is enough to refuse them."""
    rows = np.zeros(2, DTYPE)
    rows["cycle"] = 1, 2
    numbers = rows[field].reshape(2, -1)
    for number, taken in ((known - 1, True), (known, False), (255, False)):
        numbers[row, -1] = number
        assert refused(lambda: records.checked(rows.tobytes())) is (None if taken else RefusalCode.MALFORMED)
