"""What a client tells of an alignment: every look, what follows and how it ended; it never ends because of that."""

from __future__ import annotations

import asyncio
import math
import warnings
from collections.abc import Callable, Iterator, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from alignment.cameras import Stage, camera, part_at
from hypothesis import given
from hypothesis import strategies as st
from trirail.alignment.images import Pair
from trirail.alignment.procedure import Alignment, AlignmentTask, StageMotion, align, calibrate_by_moves, measure_part
from trirail.client.alignment import UnrecordedAlignmentWarning, drive, drive_async, finish, goals
from trirail.errors import AlignmentError, RefusalCode, RefusedError, ServiceError, WaitTimeoutError
from trirail.wire import boundary
from trirail.wire.looks import AlignmentLook
from trirail_drivers.interface import Triple

PART: dict[str, Pair] = {"left": (-0.06, 0.01), "right": (0.06, 0.01)}


class Told:
    """A robot that is an ideal stage, and keeps what it is told of alignments."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.stage = Stage({name: camera(rng, place) for name, place in PART.items()}, PART, rng, 0.05)
        self.looks: list[AlignmentLook] = []
        self.trouble: ServiceError | None = None
        self.begun: list[float] = []
        """Times at which procedures were announced [s]."""
        self.progress: Sequence[tuple[str, float, float | None]] = ()
        """Mode, override and progress of the goal after each of its time-outs; then it is done."""
        self._goal = ""
        self._states: Iterator[tuple[str, float, float | None]] = iter(())
        self._shown: tuple[str, float, float | None] = ("holding", 1.0, None)
        self.stops = 0

    def state(self) -> Any:
        mode, override, progress = self._shown
        goal = None if progress is None else SimpleNamespace(id=self._goal, progress=progress)
        sliders, commanded = SimpleNamespace(position=(0.0, 0.0, 0.0)), SimpleNamespace(pose=self.stage.pose)
        return SimpleNamespace(
            pose=self.stage.pose, commanded=commanded, sliders=sliders, mode=mode, override=override, goal=goal
        )

    def send(self, goal: Any) -> Any:
        motion = (goal.x, goal.y, goal.phi)
        self.stage.go(StageMotion(motion, getattr(goal, "tool", None)))
        self._goal, self._states = goal.id, iter(self.progress)
        return SimpleNamespace(wait=self._wait, result=None)

    def _wait(self, timeout: float) -> Any:
        if (shown := next(self._states, None)) is not None:
            self._shown = shown
            raise WaitTimeoutError(f"not ended within {timeout:g} s")
        return SimpleNamespace(outcome="done")

    def stop(self) -> None:
        self.stops += 1

    def _begin_call(self, began: float) -> None:
        self.begun.append(began)

    def _report_look(self, message: bytes) -> None:
        if self.trouble is not None:
            raise self.trouble
        self.looks.append(boundary.decode(message, AlignmentLook, "no look"))

    def drive(self, wishes: Any, look: Callable[[], Any] | None = None) -> Any:
        number, looks = len(self.begun), look or self.stage.look

        def check_begun() -> Any:  # a stop while the first picture is taken already ends the procedure
            assert len(self.begun) == number + 1
            return looks()

        return drive(self, check_begun, wishes, 1.0, 0.0)


@pytest.mark.parametrize(
    "progress",
    [
        [("moving", 0.01, share) for share in (0.0, 0.1, 0.2, 0.3)],
        [("holding", 1.0, 0.5)] * 9,
        [("moving", 1.0, 0.3), *[("holding", 1.0, 0.5)] * 3, ("moving", 1.0, 0.5), ("moving", 1.0, 0.6)],
        [("stopping", 1.0, 0.5), ("holding", 1.0, 0.5), ("holding", 1.0, 0.5), ("moving", 0.0, 0.5)],
        [("moving", 0.0, 0.5)] * 9,
        [("holding", 1.0, None)],
    ],
    ids=["slow", "paused", "paused and resumed", "paused at override 0", "override 0", "just ended"],
)
def test_a_motion_has_its_time_while_it_makes_progress_or_is_paused(
    progress: Sequence[tuple[str, float, float | None]],
) -> None:
    told = Told(1)
    told.progress = progress
    assert told.drive(calibrate_by_moves()).marks.keys() == PART.keys()
    assert not told.stops


@pytest.mark.parametrize(
    ("progress", "words"),
    [
        ([("moving", 1.0, 0.5)] * 2, "no progress for 60 s, .*: it is at 50% of its path, and the robot is moving"),
        ([("holding", 1.0, 0.5), *[("moving", 0.5, 0.5)] * 2], "at 50% of its path"),
        ([("holding", 1.0, None)] * 2, "it is not the present goal, and the robot is holding"),
    ],
)
def test_a_motion_that_makes_no_progress_without_a_pause_ends_it_and_stops(
    progress: Sequence[tuple[str, float, float | None]], words: str
) -> None:
    told = Told(1)
    told.progress = progress
    with pytest.raises(WaitTimeoutError, match=words):
        told.drive(calibrate_by_moves())
    assert told.stops == 1
    assert told.looks[-1].end == "failed"


@given(st.integers(1, 7), st.sampled_from(["look", "wait", "report"]))
def test_another_motion_at_any_look_ends_it_and_is_not_stopped(number: int, place: str) -> None:
    class Shared(Told):
        def park(self, at: str) -> None:
            if at == place and self.stage.motions == number - (place != "wait"):
                self.stage.go(StageMotion((0.02, 0.0, 0.0)))
                self.parked = self.stage.motions

        def _report_look(self, message: bytes) -> None:
            super()._report_look(message)
            self.park("report")

    told = Shared(1)

    def look() -> Any:
        told.park("look")
        return told.stage.look()

    with pytest.raises(RefusedError, match=r"another motion has moved the robot .* by x (19|20|21) mm, "):
        finish(drive_async(told, look, calibrate_by_moves(), 1.0, 0.0, lambda _: told.park("wait")))
    assert (told.stage.motions, told.stops) == (told.parked, 0)
    assert [look.end for look in told.looks[-1:]] in ([], ["failed"])


def test_the_pose_of_a_disabled_robot_may_change_between_looks() -> None:
    told = Told(1)
    wanted = task(told, (1e-4, -2e-4, 1e-3))._replace(looks=4)
    told._shown = ("disabled", 1.0, None)

    def look() -> Any:
        told.stage.go(StageMotion((1e-8 * told.stage.motions, 0.0, 0.0)))
        return told.stage.look()

    assert told.drive(measure_part(wanted), look).worst > 1e-4


def task(told: Told, error: Triple) -> AlignmentTask:
    calibration = told.drive(calibrate_by_moves())
    targets = told.stage.look()
    told.stage.part = part_at(PART, error)
    told.looks.clear()
    return AlignmentTask(calibration, targets, tolerance=5e-6, angle=1e-4)


@given(st.integers(0, 2**32 - 1))
def test_every_look_is_told_with_what_each_mark_has_to_go_and_what_follows(seed: int) -> None:
    told = Told(seed)
    x, y, phi = np.random.default_rng(seed).uniform(-1.0, 1.0, 3) * (5e-4, 5e-4, 4e-3)
    wanted = task(told, (x, y, phi))
    found: Alignment = told.drive(align(wanted))
    assert len(told.looks) == len(found.measurements)
    assert len({look.id for look in told.looks}) == 1
    for number, (look, measured) in enumerate(zip(told.looks, found.measurements, strict=True), 1):
        assert (look.number, look.purpose, look.pose) == (number, "alignment", measured.pose)
        assert {mark.name: mark.pixel for mark in look.marks} == measured.marks
        assert {mark.name: mark.to_go for mark in look.marks} == measured.errors
        assert look.error is not None
        assert (look.error.worst, look.error.turn) == (measured.worst, measured.turn)
    assert [look.correction for look in told.looks[:-1]] == [each.by for each in found.corrections]
    assert [look.end for look in told.looks] == [None] * len(found.corrections) + [found.why]


def test_a_calibration_is_told_look_by_look_and_with_its_noise_at_the_end() -> None:
    told = Told(1)
    calibration = told.drive(calibrate_by_moves())
    *looks, last = told.looks
    assert [look.number for look in looks] == [1, 2, 3, 4, 5, 6, 7]
    assert all(set(PART) == {mark.name for mark in look.marks} for look in looks)
    assert (last.number, last.end, last.noise) == (7, "calibrated", calibration.noise)


def test_a_check_and_a_refusal_are_told() -> None:
    told = Told(2)
    wanted = task(told, (1e-4, 0.0, 0.0))
    told.drive(measure_part(wanted))
    told.stage.part = {"left": (-0.06, 0.01), "right": (0.061, 0.01)}
    with pytest.raises(AlignmentError):
        told.drive(align(wanted))
    with pytest.raises(AlignmentError):
        told.drive(align(wanted), dict)
    assert [(look.purpose, look.end, len(look.marks)) for look in told.looks] == [
        ("check", "checked", 2),
        ("alignment", "distance", 2),
        ("alignment", "missing", 0),
    ]
    assert "ppm" in told.looks[1].words


class Interrupted:
    """Looks so often, then raises."""

    def __init__(self, told: Told, looks: int, error: BaseException) -> None:
        self._told, self._left, self._error = told, looks, error

    def __call__(self) -> Any:
        if self._left == 0:
            raise self._error
        self._left -= 1
        return self._told.stage.look()


@pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError("no picture"), ServiceError("gone")])
@pytest.mark.parametrize("looks", [0, 1, 3])
def test_whatever_ends_it_is_told_once_it_has_looked(looks: int, error: BaseException) -> None:
    told = Told(3)
    with pytest.raises(type(error)):
        told.drive(calibrate_by_moves(), Interrupted(told, looks, error))
    assert [look.end for look in told.looks] == [None] * looks + ["failed"] * (looks > 0)
    assert all(look.words == (str(error) or "KeyboardInterrupt") for look in told.looks[looks:])


@pytest.mark.parametrize("looks", [0, 1, 3])
def test_a_look_without_more_pictures_is_an_error_and_no_result(looks: int) -> None:
    told = Told(3)
    pictures = [told.stage.look()] * looks
    with pytest.raises(RuntimeError, match="no more pictures"):
        told.drive(calibrate_by_moves(), iter(pictures).__next__)
    assert [look.end for look in told.looks] == [None] * looks + ["failed"] * (looks > 0)


def test_a_service_that_takes_nothing_is_warned_of_once_and_the_result_is_the_same() -> None:
    told = Told(4)
    wanted = task(told, (1e-4, -2e-4, 1e-3))
    told.trouble = ServiceError("nobody answers")
    with pytest.warns(UnrecordedAlignmentWarning, match="nobody answers") as warned:
        assert told.drive(align(wanted)).reached
    assert len(warned) == 1
    assert told.looks == []


@pytest.mark.parametrize("what", ["speed", "wait"])
@pytest.mark.parametrize("value", [math.nan, math.inf, -1.0, "fast", None, 1e300])
def test_an_impossible_speed_or_wait_is_refused_in_one_line_before_the_first_look(what: str, value: Any) -> None:
    told = Told(7)
    with pytest.raises(RefusedError, match=f"^{what} is .*: expected a (number|fraction) .* to [0-9]+$"):
        drive(told, told.stage.look, calibrate_by_moves(), **{"speed": 1.0, "wait": 0.0, what: value})
    assert not told.begun
    assert not told.stage.motions


ODD: dict[str, Callable[[], dict[Any, Pair]]] = {
    "a name that cannot be shown": lambda: {"a\x1b": (1.0, 2.0)},
    "a name that is none": lambda: {"": (1.0, 2.0)},
}


@pytest.mark.parametrize("marks", ODD.values(), ids=ODD)
def test_a_name_that_cannot_be_told_is_warned_of_and_ends_nothing(marks: Callable[[], dict[Any, Pair]]) -> None:
    told = Told(5)
    wanted = task(told, (1e-4, -2e-4, 1e-3))
    with pytest.warns(UnrecordedAlignmentWarning):
        assert told.drive(align(wanted), lambda: marks() | told.stage.look()).reached


def test_an_event_loop_tells_the_same() -> None:
    told = Told(6)
    wanted = task(told, (1e-4, -2e-4, 1e-3))

    class Robot:
        async def state(self) -> Any:
            return told.state()

        async def send(self, goal: Any) -> Any:
            told.send(goal)
            return SimpleNamespace(wait=self._done, result=None, duration=1.0)

        async def _done(self, _: float) -> Any:
            return SimpleNamespace(outcome="done")

        async def _report_look(self, message: bytes) -> None:
            told._report_look(message)

        async def _begin_call(self, began: float) -> None:
            told._begin_call(began)

    async def look() -> Any:
        return told.stage.look()

    found = asyncio.run(drive_async(Robot(), look, align(wanted), 1.0, 0.0))  # type: ignore[arg-type]
    assert [look.end for look in told.looks] == [None] * len(found.corrections) + ["reached"]


@pytest.fixture(autouse=True)
def no_other_warnings() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


@given(
    st.integers(0, 5),
    st.sampled_from(["reply", "wait"]),
    st.sampled_from([KeyboardInterrupt(), asyncio.CancelledError(), ServiceError("no reply"), TimeoutError("late")]),
)
def test_an_interrupted_motion_is_stopped_and_waited_for(motion: int, place: str, error: BaseException) -> None:
    stops: list[int] = []
    sent = 0

    class Stopped(Told):
        def send(self, goal: Any) -> Any:
            nonlocal sent
            sent += 1
            handle = super().send(goal)
            if sent <= motion:
                return handle
            if place == "reply":
                raise error

            def wait(_: float) -> Any:
                raise error

            return SimpleNamespace(wait=wait, result=None, duration=1.0)

        def stop(self) -> None:
            stops.append(sent)

    told = Stopped(3)
    with pytest.raises(type(error)):
        told.drive(calibrate_by_moves())
    assert stops == [motion + 1]


def test_a_refused_motion_stops_nothing() -> None:
    class Refusing(Told):
        def send(self, goal: Any) -> Any:
            raise RefusedError(RefusalCode.NOT_ENABLED, "the robot is disabled")

        def stop(self) -> None:
            raise AssertionError("another user's motion would be stopped")

    with pytest.raises(RefusedError, match="disabled"):
        Refusing(4).drive(calibrate_by_moves())


TRIPLES = st.tuples(*[st.floats(-1e-2, 1e-2)] * 3)


@given(TRIPLES, st.none() | TRIPLES, st.booleans())
def test_the_goals_of_a_motion_end_at_its_end_whatever_the_approach(
    by: Triple, approach: Triple | None, is_relative: bool
) -> None:
    """A relative motion adds up; an absolute one goes beyond its end first, and then there."""
    made: list[Any] = list(goals(StageMotion(by, (0.0, 0.0) if is_relative else None, approach), 0.5))
    found = [(goal.x, goal.y, goal.phi) for goal in made]
    assert len(found) == 1 + (approach is not None)
    end = np.sum(found, axis=0) if is_relative else found[-1]
    assert end == pytest.approx(by, abs=1e-15)
    if approach is not None:
        assert found[0] == pytest.approx(np.add(by, approach), abs=1e-15)
