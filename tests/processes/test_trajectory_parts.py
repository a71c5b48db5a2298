"""Trajectories that come in several messages: whole, or refused with the part that is missing."""

from __future__ import annotations

import contextlib
import random

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from trirail.errors import RefusedError
from trirail.processes.incoming import Incoming
from trirail.processes.memory_budget import Budget
from trirail.processes.trajectory_parts import PARTS_WITHIN, TrajectoryParts
from trirail.wire.call_mark import CallMark
from trirail.wire.goals import TrajectoryGoal, TrajectoryPoint
from trirail.wire.kinds.trajectory import TrajectoryPart, parts
from trirail.wire.marks import Mark, StopAt
from trirail.wire.packed_trajectory import PackedTrajectory, packed
from trirail.wire.packets import GoalRequest, decode_request, message
from trirail.wire.sizes import MAX_PART, MAX_POINTS


class Rig:
    """Parts as the gateway reads them."""

    def __init__(self) -> None:
        self.now = 100.0
        self.number = 0
        self.refused: list[tuple[Incoming, RefusedError]] = []
        self.parts = TrajectoryParts(lambda *refused: self.refused.append(refused), lambda: self.now)
        self.budget = Budget(10**6, 10**6)

    def add(
        self, goal: TrajectoryGoal, user: str = "ann", mark: CallMark | None = None
    ) -> tuple[Incoming, PackedTrajectory] | None:
        self.number += 1
        key = f"trirail/demo/goal/{user}"
        hold = self.budget.hold(user, 1000)
        came = Incoming("goal", key, 1000, b"x" * 1000, "", None, self.number, number=self.number, hold=hold, mark=mark)
        return self.parts.add(came, user, goal)


def trajectory(chance: random.Random, points: int, name: str = "g") -> TrajectoryGoal:
    def triple() -> tuple[float, float, float] | None:
        return (chance.gauss(0, 1), chance.gauss(0, 1), 0.1) if chance.random() < 0.7 else None

    begins = chance.choice((0.0, -3.0, 1.7e9))
    made = [TrajectoryPoint(begins + 0.3 * n, chance.random(), 0.0, 0.1, triple(), triple()) for n in range(points)]
    return TrajectoryGoal(tuple(made), name, chance.random() < 0.5, chance.random() < 0.5, chance.choice((None, 3.0)))


@pytest.mark.generated(0, 1, 2)
def test_parts_in_any_order_and_mixed_with_others_are_the_trajectory_that_was_cut(seed: int) -> None:
    chance, rig = random.Random(seed), Rig()
    goals = {(user, name): trajectory(chance, chance.randint(2, MAX_POINTS), name) for user in "ab" for name in "gh"}
    sent = [(user, part) for (user, _), goal in goals.items() for part in parts(goal)]
    chance.shuffle(sent)
    whole = {}
    for user, part in sent:
        assert len(part.points) <= MAX_PART
        if (done := rig.add(msgspec.json.decode(msgspec.json.encode(part), type=TrajectoryGoal), user)) is not None:
            whole[user, str(part.id)] = done
    assert whole.keys() == goals.keys()
    for key, (incoming, goal) in whole.items():
        assert goal == packed(goals[key])
        assert goal.unpacked() == goals[key]
        answered = (incoming, *incoming.alike)
        assert len(answered) == len(parts(goals[key]))
        assert {each.user for each in answered} == {key[0]}
        assert incoming.number == min(each.number for each in answered)  # a stop that came later withdraws it
        assert incoming.size == 1000 * len(answered)
        assert not any(each.payload for each in answered)
        request = GoalRequest(1, "ann", "g", goal, 0)
        assert decode_request(message(request)[1:]) == request
        assert msgspec.json.decode(msgspec.json.encode(request), type=GoalRequest) == request
    assert not rig.refused
    assert not list(rig.parts)


@pytest.mark.generated(0, 1)
def test_what_is_missing_is_named_when_its_time_is_over_and_all_memory_is_free_again(seed: int) -> None:
    chance, rig = random.Random(seed), Rig()
    sent = parts(trajectory(chance, chance.randint(MAX_PART + 1, MAX_POINTS)))
    lost = set(chance.sample(range(len(sent)), chance.randint(1, len(sent) - 1)))
    for number, part in enumerate(sent):
        if number not in lost:
            rig.now += 0.9 * PARTS_WITHIN
            assert rig.add(part) is None
            rig.parts.poll()
    assert not rig.refused
    assert rig.budget.held == 1000 * (len(sent) - len(lost))
    rig.now += 1.1 * PARTS_WITHIN
    rig.parts.poll()
    ((incoming, refusal),) = rig.refused
    assert len(incoming.alike) + 1 == len(sent) - len(lost)
    assert refusal.code == "expired"
    assert f"part{'s' if len(lost) > 1 else ''} {min(lost) + 1}" in str(refusal)
    assert f"of {len(sent)} not received within {PARTS_WITHIN:g} s" in str(refusal)
    del incoming
    rig.refused.clear()
    assert rig.budget.held == 0
    assert rig.add(sent[0]) is None  # the id is free again


def test_a_part_that_does_not_go_with_the_others_is_refused_and_says_why() -> None:
    sent = parts(trajectory(random.Random(0), 3 * MAX_PART))
    for other, problem in (
        (sent[0], "part 1 has already been received"),
        (
            msgspec.structs.replace(sent[1], part=TrajectoryPart(2, 4)),
            "part 2 states a total of 4 parts, the other parts state 3",
        ),
        (msgspec.structs.replace(sent[1], stretch=not sent[1].stretch), "part 2 has other options"),
        (msgspec.structs.replace(sent[1], stop_at=StopAt("probe")), "part 2 has other options"),
        (msgspec.structs.replace(sent[1], marks=(Mark("pump", after_start=0.01),)), "part 2 has other options"),
    ):
        rig = Rig()
        rig.add(sent[0])
        with pytest.raises(RefusedError, match=problem) as refused:
            rig.add(other)
        assert refused.value.code == "malformed"
        ((earlier, why),) = rig.refused
        assert (earlier.number, why) == (1, refused.value)
        assert rig.add(sent[1]) is None
        assert rig.add(sent[2]) is None  # part 1 must come again


@given(lost=st.integers(0, 2), marked=st.booleans())
def test_parts_of_two_calls_with_the_same_id_are_never_joined(lost: int, marked: bool) -> None:
    """The first call has lost a part, or its program has ended; the same program sends its goal again."""
    rig = Rig()
    first, second = (trajectory(random.Random(seed), 3 * MAX_PART) for seed in (0, 1))
    second = msgspec.structs.replace(second, stretch=first.stretch, settle=first.settle, valid_for=first.valid_for)
    marks = (CallMark("0" * 12, 1), CallMark("0" * 12, 2)) if marked else (None, None)
    whole = []
    for call, (goal, mark) in enumerate(zip((first, second), marks, strict=True)):
        for number, part in enumerate(parts(goal)):
            if (call, number) == (0, lost):
                continue
            with contextlib.suppress(RefusedError):
                whole += [done[1] for done in [rig.add(part, mark=mark)] if done is not None]
    assert whole in ([packed(second)], []) if not marked else whole == [packed(second)]


def test_more_points_than_may_be_are_refused_with_the_part_that_has_them() -> None:
    rig, number = Rig(), MAX_POINTS // MAX_PART + 1
    each = parts(trajectory(random.Random(0), number * MAX_PART))
    for part in each[:-1]:
        rig.add(part)
    with pytest.raises(
        RefusedError, match=f"part {number} makes {number * MAX_PART} points in total, the maximum is {MAX_POINTS}"
    ):
        rig.add(each[-1])


def test_times_that_fall_from_one_part_to_the_next_refuse_the_whole() -> None:
    rig = Rig()
    first, second = parts(trajectory(random.Random(0), 2 * MAX_PART))
    assert rig.add(msgspec.structs.replace(first, points=second.points)) is None
    assert rig.add(second) is None
    ((incoming, refusal),) = rig.refused
    assert len(incoming.alike) == 1
    assert "times must rise" in str(refusal)


def test_a_part_without_an_id_is_none() -> None:
    points = trajectory(random.Random(0), 2).points
    with pytest.raises(ValueError, match="all parts of a trajectory need the same id"):
        TrajectoryGoal(points, part=TrajectoryPart(1, 2))
    with pytest.raises(ValueError, match="number 3 exceeds the number of parts, 2"):
        TrajectoryPart(3, 2)
