"""Plans of two processors: what differs by rounding is the same, and whatever else differs is not."""

from __future__ import annotations

import struct
from dataclasses import dataclass

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from trirail.analysis.plan_comparison import ROUNDING, is_same_plan
from trirail.motion.marks import SWITCH
from trirail.wire.messages import GoalReply
from trirail.wire.plan_packets import NotPlanned, PackedPath, PackedRun, PathExtension, PreemptingMotion

NUMBERS = st.floats(-1e6, 1e6)


@dataclass
class Numbers:
    """What a plan is made of."""

    knots: list[float]
    target: float
    seam: float
    s: float
    width: float
    mark: int

    def plan(self) -> PreemptingMotion:
        path = PackedPath(np.array(self.knots).tobytes(), b"", tools=bytes(16))
        run = PackedRun(path, path, self.target, seams=(self.seam,))
        switches = np.array([(self.s, self.width, self.mark, 1)], SWITCH).tobytes()
        return PreemptingMotion(1, 2, 3, run, GoalReply("g-1", 1.0), switches=switches)


@st.composite
def made(draw: st.DrawFn) -> Numbers:
    knots = draw(st.lists(NUMBERS, min_size=1, max_size=8))
    width = draw(NUMBERS | st.just(float("nan")))
    return Numbers(knots, draw(NUMBERS), draw(NUMBERS), draw(NUMBERS), width, draw(st.integers(0, 9)))


def nearly(value: float, by: float) -> float:
    return value + by * max(1.0, abs(value))


@given(numbers=made(), by=st.floats(-0.4 * ROUNDING, 0.4 * ROUNDING))
def test_what_differs_by_rounding_is_the_same(numbers: Numbers, by: float) -> None:
    plan = numbers.plan()
    rounded = Numbers(
        [nearly(each, by) for each in numbers.knots],
        nearly(numbers.target, by),
        nearly(numbers.seam, by),
        nearly(numbers.s, by),
        nearly(numbers.width, by),
        numbers.mark,
    )
    assert is_same_plan(plan, plan)
    assert is_same_plan(plan, rounded.plan())


@given(numbers=made(), by=st.floats(4.0 * ROUNDING, 1.0), sign=st.sampled_from([-1, 1]), data=st.data())
def test_one_number_that_differs_by_more_is_another_plan(
    numbers: Numbers, by: float, sign: int, data: st.DataObject
) -> None:
    plan = numbers.plan()
    changed = data.draw(st.sampled_from(["knots", "target", "seam", "s", "mark"]))
    if changed == "knots":
        place = data.draw(st.integers(0, len(numbers.knots) - 1))
        numbers.knots[place] = nearly(numbers.knots[place], sign * by)
    elif changed == "mark":
        numbers.mark += 1
    else:
        setattr(numbers, changed, nearly(getattr(numbers, changed), sign * by))
    assert not is_same_plan(plan, numbers.plan())


def test_other_shapes_are_other_plans() -> None:
    plan = Numbers([0.0, 1.0], 1.0, 0.5, 0.2, 0.1, 0).plan()
    replace = msgspec.structs.replace
    longer = replace(plan.run.path, knots=plan.run.path.knots + struct.pack("d", 2.0))
    others: list[object] = [
        None,
        NotPlanned(1, 2, "LIMIT", "too far"),  # type: ignore[arg-type]  # any text
        PathExtension(1, 2, 0.0, plan.run.path, plan.reply),
        replace(plan, first=None),
        replace(plan, switches=b""),
        *(replace(plan, switches=np.array([each], SWITCH).tobytes()) for each in ((0.2, 0.1, 1, 1), (0.2, 0.1, 0, 0))),
        replace(plan, run=replace(plan.run, path=longer)),
        replace(plan, run=replace(plan.run, seams=())),
        replace(plan, reply=plan.reply.with_duration(2.0)),
    ]
    for other in others:
        assert not is_same_plan(plan, other)
        assert not is_same_plan(other, plan)


@pytest.mark.parametrize("message", ["too far", "too near"])
def test_refusals_are_compared_word_by_word(message: str) -> None:
    one = NotPlanned(1, 2, "LIMIT", "too far")  # type: ignore[arg-type]
    other = NotPlanned(1, 2, "LIMIT", message)  # type: ignore[arg-type]
    assert is_same_plan(one, other) == (message == "too far")
