"""Every kind of goal is known wherever goals go, by its file in trirail.wire.kinds and that in trirail.motion.kinds."""

from __future__ import annotations

import inspect
import math
from pathlib import Path

import pytest
from msgspec.structs import FieldInfo, fields
from trirail.motion.goal_motion import GoalMotion
from trirail.motion.goal_planner import MOTIONS
from trirail.wire.goal_kind import GoalKind
from trirail.wire.goals import KINDS
from trirail.wire.packed_trajectory import PackedTrajectory

GUIDE = Path(__file__).parents[2] / "service/talking.md"
every_kind = pytest.mark.parametrize("kind", KINDS)


def given(kind: type[GoalKind]) -> dict[str, FieldInfo]:
    return {field.name: field for field in fields(kind)}


def tag(kind: type[GoalKind]) -> object:
    return kind.__struct_config__.tag


def test_the_motion_knows_every_kind_and_no_other() -> None:
    assert set(MOTIONS) == {*KINDS, PackedTrajectory}


@every_kind
def test_a_kind_has_one_file_of_its_name_in_either_room(kind: type[GoalKind]) -> None:
    assert kind.__module__ == f"trirail.wire.kinds.{tag(kind)}"
    assert MOTIONS[kind].__module__ == f"trirail.motion.kinds.{tag(kind)}"


@every_kind
def test_every_kind_can_be_named_and_can_expire_and_what_is_renewed_has_a_time_out(kind: type[GoalKind]) -> None:
    assert {"id", "valid_for"} <= set(given(kind))
    assert kind.renewed == ("timeout" in given(kind))
    assert kind.timed == ("time" in given(kind))
    assert kind.renewed >= kind.frequent
    assert kind.renewed >= kind.waits_at_end
    assert all(0.0 < example.greatest_rate <= math.inf for example in MOTIONS[kind].examples)


@every_kind
def test_a_kind_is_planned_or_said_in_other_words_and_never_both(kind: type[GoalKind]) -> None:
    motion = MOTIONS[kind]
    planned = motion.plan is not GoalMotion.plan
    other = inspect.signature(motion.resolve, eval_str=True).return_annotation not in (kind, GoalKind)
    assert planned != other
    assert all(type(example) is kind for example in motion.examples)


@every_kind
def test_the_guide_has_an_example_of_every_kind(kind: type[GoalKind]) -> None:
    assert f'"kind": "{tag(kind)}"' in GUIDE.read_text(encoding="utf-8")
