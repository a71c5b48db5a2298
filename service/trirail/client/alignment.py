"""Alignment procedures that use the user's camera and a connection to the robot.

The client reports each look to the service, which adds the look to recordings, reports and panels. If reports fail, the
client warns once and continues the alignment.
"""

from __future__ import annotations

import asyncio
import contextlib
import inspect
import itertools
import time
import uuid
import warnings
from collections.abc import Awaitable, Callable, Coroutine, Generator, Iterator
from typing import Any, Protocol, TypeVar, cast

import msgspec
from msgspec import structs
from trirail_drivers.interface import Triple

from trirail.alignment.alignment_request import AlignmentRequest, LookReport, Observation, StageMotion
from trirail.alignment.arguments import check_speed, check_wait
from trirail.alignment.camera_calibration import Marks
from trirail.alignment.results import Measurement
from trirail.client.call_time import called, called_at
from trirail.client.goal import Result
from trirail.errors import RefusalCode, RefusedError, TrirailError, WaitTimeoutError
from trirail.quantities import worded
from trirail.wire.goals import Goal, MoveGoal, PoseGoal
from trirail.wire.looks import AlignmentLook, LookEnd, LookError, SeenMark
from trirail.wire.state import State
from trirail.wire.text import quoted
from trirail.wire.vocabulary import Mode

T = TypeVar("T")
Look = Callable[[], Marks | Awaitable[Marks]]
"""Function that takes one picture with each camera and returns the pixels of the marks, {name: (u, v)} [pixel].

A coroutine function is allowed with AsyncRobot only."""
EMPTY_OBSERVATION = Observation({}, (0.0, 0.0, 0.0), 0.0)
PROGRESS_WITHIN = 60.0
"""Time in which a motion must make progress, unless it is paused or the override is 0 [s]."""
SAME_POSE = 1e-9
"""Greatest difference of two commanded poses of a robot that holds its position [m, rad]."""
ENDS_AT_TARGET = ("done", "unsettled")
"""Outcomes of a goal that leave the robot at or near its target. The next look measures the remaining distance."""


class MotionHandle(Protocol):
    """Handle of a goal that the service has accepted: GoalHandle or AsyncGoalHandle."""

    @property
    def result(self) -> Result | None:
        """Result of the goal; None before its end."""

    def wait(self, timeout: float | None = None) -> Result | Awaitable[Result]:
        """Wait for the end of the goal."""


class StageRobot(Protocol):
    """Methods of Robot or AsyncRobot that an alignment calls."""

    def send(self, make: Goal, /) -> MotionHandle | Awaitable[MotionHandle]:
        """Send a goal."""

    def stop(self) -> Awaitable[None] | None:
        """Stop the robot."""

    def state(self) -> State | Awaitable[State]:
        """Return the newest state."""

    def _report_look(self, look: bytes, /) -> Awaitable[None] | None: ...

    def _begin_call(self, began: float, /) -> Awaitable[None] | None: ...


def drive(
    robot: StageRobot, look: Look, requests: Generator[AlignmentRequest, Observation, T], speed: float, wait: float
) -> T:
    """Carry out the requests of a procedure with a blocking Robot; return the procedure's result.

    The parameters and errors are those of `drive_async`, but no event loop is needed. Ctrl-C stops the motion.
    """

    def call_look() -> Marks:
        seen = look()
        if inspect.isawaitable(seen):
            raise TypeError("look is a coroutine function: it is for AsyncRobot")
        return seen

    return finish(drive_async(robot, call_look, requests, speed, wait, time.sleep))


def finish(coroutine: Coroutine[Any, Any, T]) -> T:
    """Run a coroutine without an event loop; return its result. All calls of the coroutine must block, not suspend."""
    try:
        coroutine.send(None)
    except StopIteration as end:
        return cast(T, end.value)
    coroutine.close()
    raise RuntimeError("it waits for an event loop, and there is none")


async def drive_async(
    robot: StageRobot,
    look: Look,
    requests: Generator[AlignmentRequest, Observation, T],
    speed: float,
    wait: float,
    sleep: Callable[[float], Awaitable[None] | None] = asyncio.sleep,
) -> T:
    """Carry out the requests of a procedure; return the procedure's result. Cancelling the task stops the motion.

    Parameters
    ----------
    requests
        Procedure that yields requests for looks and motions, and receives observations.
    speed
        Fraction of full speed.
    wait
        Waiting time after a motion, after which the camera's next picture shows the robot at rest [s].
    sleep
        Function that waits for a number of seconds, either a coroutine function or a blocking one.

    Raises
    ------
    RefusedError
        If a motion is refused or does not reach its target, or if another motion moves the robot meanwhile.
    Exception
        If `look` raises it.

    """
    check_speed(speed)
    check_wait(wait)
    began = called_at()
    sight = EMPTY_OBSERVATION
    reports = LookReports()
    ids = reports.goal_ids()
    try:
        await completed(robot._begin_call(began))
        rest = _rest(await completed(robot.state()))
        request = next(requests)
        while True:
            if isinstance(request, LookReport):
                await _report(robot, reports, reports.message(request))
            else:
                if isinstance(request, StageMotion):
                    _check_rest(rest, await completed(robot.state()))
                    for goal in goals(request, speed):
                        await _move(robot, goal, next(ids), began)
                    rest = _rest(await completed(robot.state()))
                    await completed(sleep(wait))
                    marks = sight.marks
                else:
                    marks = await _marks_from(look)
                _check_rest(rest, state := await completed(robot.state()))
                sight = Observation(marks, state.pose, time.monotonic(), state.sliders.position)
            request = requests.send(sight)
    except StopIteration as end:
        return cast(T, end.value)
    except BaseException as error:
        await _report(robot, reports, reports.failure(error))
        raise


def _rest(state: State) -> Triple | None:
    """Return the commanded pose, which changes only with a motion; None if it follows the measured pose."""
    return state.commanded.pose if state.mode in (Mode.HOLDING, Mode.MOVING, Mode.STOPPING) else None


def _check_rest(rest: Triple | None, state: State) -> None:
    """Raise RefusedError if the commanded pose is no longer `rest`: the next motion would surprise another user."""
    now = state.commanded.pose
    if rest is not None and max(abs(a - b) for a, b in zip(rest, now, strict=True)) > SAME_POSE:
        x, y, phi = (each - before for each, before in zip(now, rest, strict=True))
        raise RefusedError(
            RefusalCode.FAILED,
            f"another motion has moved the robot since the alignment's last one, by x {worded(x, 'm')}, "
            f"y {worded(y, 'm')}, phi {worded(phi, 'rad')}: begin again when no other user moves the robot",
        )


async def _marks_from(look: Look) -> Marks:
    """Call `look`. Raises RuntimeError for a StopIteration, which would count as the end of the procedure."""
    try:
        marks: Marks = await completed(look())
    except StopIteration as error:
        raise RuntimeError("look raised StopIteration: it has no more pictures") from error
    return marks


async def completed(called: Any) -> Any:
    """Return a value; if the value is awaitable, await it and return its result."""
    return await called if inspect.isawaitable(called) else called


async def _report(robot: StageRobot, reports: LookReports, message: bytes | None) -> None:
    if message is None:
        return
    try:
        await completed(robot._report_look(message))
    except TrirailError as error:
        reports.lost(error)


async def _move(robot: StageRobot, goal: Goal, goal_id: str, began: float) -> None:
    """Carry out a goal of a procedure that began at the time `began` [s], unless a stop has been called since then."""
    handle: MotionHandle | None = None
    try:
        with called(began):
            handle = await completed(robot.send(structs.replace(goal, id=goal_id)))
        check(await _wait_for_end(robot, handle, goal_id))
    except RefusedError:  # the goal was refused or has ended
        raise
    except BaseException:  # even without a reply, the goal may have been accepted
        if handle is None or handle.result is None:
            await completed(robot.stop())
        raise


async def _wait_for_end(robot: StageRobot, handle: MotionHandle, goal_id: str) -> Result:
    """Wait for the end of a goal, for as long as it makes progress, is paused, or the override is 0.

    Raises WaitTimeoutError if the goal makes no progress for another reason.
    """
    before: float | None = None
    while True:
        with contextlib.suppress(WaitTimeoutError):
            result: Result = await completed(handle.wait(PROGRESS_WITHIN))
            return result
        state: State = await completed(robot.state())
        is_present = state.goal is not None and state.goal.id == goal_id
        progress = state.goal.progress if state.goal is not None and is_present else -1.0
        if is_present and (state.mode != Mode.MOVING or state.override == 0.0):
            before = None
        elif progress == before:
            status = f"it is at {progress:.0%} of its path" if is_present else "it is not the present goal"
            raise WaitTimeoutError(
                f"goal {goal_id} has made no progress for {PROGRESS_WITHIN:g} s, without a pause: {status}, and the "
                f"robot is {state.mode}"
            )
        else:
            before = progress


def goals(motion: StageMotion, speed: float) -> Iterator[Goal]:
    """Yield the goals of a motion; with an approach, a first goal overshoots the target and a second returns to it."""
    by, tool, beyond = motion.by, motion.tool, motion.approach
    first = by if beyond is None else _sum(by, beyond)
    if tool is None:
        yield PoseGoal(*first, speed=speed)
    else:
        yield MoveGoal(*first, tool=tool, origin="measured", speed=speed)
    if beyond is not None:
        yield PoseGoal(*by, speed=speed) if tool is None else MoveGoal(*_negative(beyond), tool=tool, speed=speed)


def check(result: Result) -> None:
    """Raise RefusedError if a motion has not reached its target."""
    if result.outcome not in ENDS_AT_TARGET:
        raise RefusedError(
            RefusalCode.FAILED, f"a motion of the alignment ended with the outcome {result.outcome}: {result.message}"
        )


def _sum(a: Triple, b: Triple) -> Triple:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def _negative(a: Triple) -> Triple:
    return -a[0], -a[1], -a[2]


class UnrecordedAlignmentWarning(UserWarning):
    """Warning that the service did not accept a report of an alignment, so recordings do not contain the alignment."""


class LookReports:
    """Builder of the look messages and goal ids of one alignment; each goal id begins with the alignment's id."""

    def __init__(self) -> None:
        self.id = f"align-{uuid.uuid4().hex[:8]}"
        self._goals = itertools.count(1)
        self._last: LookReport | None = None
        self._number = 0
        self._began = 0.0
        self._lost = False

    def goal_ids(self) -> Iterator[str]:
        """Yield the ids of the alignment's goals."""
        return (f"{self.id}-{number}" for number in self._goals)

    def message(self, report: LookReport) -> bytes | None:
        """Return the message that reports a look.

        Return None if the message cannot be encoded, or if an earlier message could not be encoded or was not accepted.
        """
        if self._last is None or self._last.purpose != report.purpose:
            self._number, self._began = 0, _time(report)
        self._number = max(1, self._number + (report.observation is not None))
        self._last = report
        try:
            return None if self._lost else msgspec.json.encode(self._message(report))
        except (ValueError, TypeError) as error:
            self.lost(error)
            return None

    def failure(self, error: BaseException) -> bytes | None:
        """Return the message that reports that an error ended the alignment.

        Return None if no look has been reported yet, or if the end has already been reported.
        """
        if self._last is None or self._last.end is not None:
            return None
        return self.message(LookReport(self._last.purpose, end="failed", words=str(error) or type(error).__name__))

    def lost(self, error: Exception) -> None:
        """Warn that the service does not accept the reports; do nothing after the first call."""
        if not self._lost:
            self._lost = True
            words = f"this alignment is not in the service's recording: {error}"
            warnings.warn(words, UnrecordedAlignmentWarning, stacklevel=4)

    def _message(self, report: LookReport) -> AlignmentLook:
        observation, measured = report.observation, report.measurement
        return AlignmentLook(
            id=self.id,
            purpose=report.purpose,
            number=self._number,
            marks=() if observation is None else tuple(_marks(observation, measured)),
            error=None if measured is None else _error(measured),
            pose=None if observation is None else observation.pose,
            correction=report.correction,
            end=cast(LookEnd | None, report.end and str(report.end)),  # tests/wire/test_looks.py compares the values
            words=quoted(report.words),
            noise=report.noise,
            seconds=max(0.0, _time(report) - self._began),
        )


def _time(report: LookReport) -> float:
    return time.monotonic() if report.observation is None else report.observation.time


def _marks(observation: Observation, measured: Measurement | None) -> Iterator[SeenMark]:
    to_go = {} if measured is None else measured.errors
    for name, pixel in observation.marks.items():
        yield SeenMark(str(name), pixel, to_go.get(name))


def _error(measured: Measurement) -> LookError:
    return LookError(measured.worst, measured.shift, measured.turn, measured.misfit, measured.distance)
