"""What drives an alignment: the user's camera and a connection to the robot, with a thread or in an event loop."""

from __future__ import annotations

import asyncio
import inspect
import time
from collections.abc import Awaitable, Callable, Generator, Iterator
from typing import TYPE_CHECKING, TypeVar

from msgspec import structs
from trirail_drivers.interface import Triple

from trirail.alignment.camera_calibration import Marks
from trirail.alignment.wishes import LookReport, Sighting, StageMotion, Wish
from trirail.client.goal import Result
from trirail.client.look_reports import LookReports
from trirail.errors import RefusalCode, RefusedError, TrirailError
from trirail.wire.goals import Goal, MoveGoal, PoseGoal

if TYPE_CHECKING:
    from trirail.client.async_client import AsyncRobot
    from trirail.client.client import Robot

T = TypeVar("T")
Look = Callable[[], Marks | Awaitable[Marks]]
"""Takes a picture, or one of each camera, and returns where it shows the marks, {name: (u, v)} [pixel]; in an event
loop it may be a coroutine function."""
NOTHING_SEEN = Sighting({}, (0.0, 0.0, 0.0), 0.0)
GOAL_WITHIN = 60.0
"""How long one motion may take [s]."""
STANDS = ("done", "unsettled")
"""Outcomes with which the robot stands where it was to be, or nearly: the next look tells."""


def drive(robot: Robot, look: Look, wishes: Generator[Wish, Sighting, T], speed: float, wait: float) -> T:
    """Do what a conversation wishes, and return what it ends with.

    `wait` is how long a camera needs after a motion until it shows what is [s]. Whatever ends it before, as Ctrl-C,
    stops the motion. Raises RefusedError where a motion is refused or ends otherwise, and what `look` raises.
    """
    sight = NOTHING_SEEN
    reports = LookReports()
    ids = reports.goal_ids()
    try:
        wish = next(wishes)
        while True:
            if isinstance(wish, LookReport):
                _report(robot, reports, reports.message(wish))
            else:
                if isinstance(wish, StageMotion):
                    for goal in goals(wish, speed):
                        _go(robot, goal, next(ids))
                    time.sleep(wait)
                    marks = sight.marks
                else:
                    marks = _marks(look)
                sight = Sighting(marks, robot.state().pose, time.monotonic())
            wish = wishes.send(sight)
    except StopIteration as end:
        return end.value  # type: ignore[no-any-return]
    except BaseException as error:
        _report(robot, reports, reports.failure(error))
        raise


def _marks(look: Look) -> Marks:
    seen = look()
    if inspect.isawaitable(seen):
        raise TypeError("look is a coroutine function: it is for AsyncRobot")
    return seen


def _report(robot: Robot, reports: LookReports, message: bytes | None) -> None:
    if message is None:
        return
    try:
        robot._report_look(message)
    except TrirailError as error:
        reports.lost(error)


def _go(robot: Robot, goal: Goal, goal_id: str) -> None:
    handle = robot.send(structs.replace(goal, id=goal_id))
    try:
        check(handle.wait(GOAL_WITHIN))
    except BaseException:
        if handle.result is None:
            robot.stop()
        raise


async def drive_async(
    robot: AsyncRobot, look: Look, wishes: Generator[Wish, Sighting, T], speed: float, wait: float
) -> T:
    """Do the same in an event loop; `look` may be a coroutine function. A call that is cancelled stops the motion."""
    sight = NOTHING_SEEN
    reports = LookReports()
    ids = reports.goal_ids()
    try:
        wish = next(wishes)
        while True:
            if isinstance(wish, LookReport):
                await _report_async(robot, reports, reports.message(wish))
            else:
                if isinstance(wish, StageMotion):
                    for goal in goals(wish, speed):
                        await _go_async(robot, goal, next(ids))
                    await asyncio.sleep(wait)
                    marks = sight.marks
                else:
                    seen = look()
                    marks = await seen if inspect.isawaitable(seen) else seen
                sight = Sighting(marks, (await robot.state()).pose, time.monotonic())
            wish = wishes.send(sight)
    except StopIteration as end:
        return end.value  # type: ignore[no-any-return]
    except BaseException as error:
        await _report_async(robot, reports, reports.failure(error))
        raise


async def _report_async(robot: AsyncRobot, reports: LookReports, message: bytes | None) -> None:
    if message is None:
        return
    try:
        await robot._report_look(message)
    except TrirailError as error:
        reports.lost(error)


async def _go_async(robot: AsyncRobot, goal: Goal, goal_id: str) -> None:
    handle = await robot.send(structs.replace(goal, id=goal_id))
    try:
        check(await handle.wait(GOAL_WITHIN))
    except BaseException:
        if handle.result is None:
            await robot.stop()
        raise


def goals(motion: StageMotion, speed: float) -> Iterator[Goal]:
    """Yield the goals of a motion: one, or with an approach one beyond its end first."""
    by, tool, beyond = motion.by, motion.tool, motion.approach
    first = by if beyond is None else _sum(by, beyond)
    if tool is None:
        yield PoseGoal(*first, speed=speed)
    else:
        yield MoveGoal(*first, tool=tool, origin="measured", speed=speed)
    if beyond is not None:
        yield PoseGoal(*by, speed=speed) if tool is None else MoveGoal(*_negative(beyond), tool=tool, speed=speed)


def check(result: Result) -> None:
    """Raise RefusedError for a motion after which the robot does not stand where it was to be."""
    if result.outcome not in STANDS:
        raise RefusedError(RefusalCode.FAILED, f"a motion of the alignment ended {result.outcome}: {result.message}")


def _sum(a: Triple, b: Triple) -> Triple:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def _negative(a: Triple) -> Triple:
    return -a[0], -a[1], -a[2]
