"""Goals of a stage: sets of several axes that arrive together become one goal."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Mapping
from contextlib import aclosing
from dataclasses import dataclass, field

from trirail.client.async_client import AsyncRobot
from trirail.client.goal import AsyncGoalHandle, Result
from trirail.errors import RefusalCode, RefusedError, ServiceError, TrirailError
from trirail.wire.state import Pose

GATHERING_S = 0.005
"""Time after the first set in which others join its goal [s]; sets of one message group are within a millisecond."""
SILENCE_S = 5.0
"""Time without a state after which a goal in progress is given up [s]."""
PROGRESS_S = 0.1
"""Interval of progress reports [s]."""


class UnfinishedError(TrirailError):
    """Raised when a goal ends with an outcome other than done; `result` is its result."""

    def __init__(self, result: Result) -> None:
        super().__init__(result.message)
        self.result = result


def check_done(result: Result) -> None:
    """Raise UnfinishedError if a goal is not done."""
    if result.outcome != "done":
        raise UnfinishedError(result)


@dataclass(eq=False, slots=True)
class AxisMove:
    """A set of some axes."""

    targets: Mapping[int, float]
    """Target of each axis, by its index: x, y [m] and phi [rad]."""
    end: asyncio.Future[None]

    def shares_axis(self, other: AxisMove) -> bool:
        """Return whether both sets move the same axis."""
        return not self.targets.keys().isdisjoint(other.targets)

    def finish(self, error: Exception | None = None) -> None:
        """End the set, if it has not ended."""
        if self.end.done():
            return
        if error is None:
            self.end.set_result(None)
        else:
            self.end.set_exception(error)


@dataclass(eq=False, slots=True)
class _Motion:
    """A goal and the sets that it carries out."""

    target: Pose
    goal: AsyncGoalHandle
    moves: list[AxisMove] = field(default_factory=list)
    interrupted: bool = False
    """Whether the goal's stop was requested and is therefore not a failure."""

    def finish(self, result: Result) -> None:
        """Finish the sets of this goal with the goal's result."""
        failed = result.outcome != "done" and not self.interrupted
        end_all(self.moves, UnfinishedError(result) if failed else None)


class Mover:
    """Sender of one goal for all sets that arrive together; the goal's end finishes them. Uses one event loop.

    A set of other axes during a goal replaces it by a new goal to all targets, so that each axis arrives as it would
    with independent motors. A set of the same axis preempts the earlier set.
    """

    def __init__(self, robot: AsyncRobot) -> None:
        self._robot = robot
        self._gathered: list[AxisMove] = []
        """Sets that later sets may still join; replacing the list ends that."""
        self._unsent: list[AxisMove] = []
        """The gathered sets, and sets that wait for their turn; a stop ends all of these before their goal is sent."""
        self._motion: _Motion | None = None
        self._sending = asyncio.Lock()
        self._tasks: set[asyncio.Task[None]] = set()
        self.pose: Pose | None = None
        """Measured pose in the newest state during a goal."""

    def start(self, targets: Mapping[int, float]) -> AxisMove:
        """Start to move axes to their targets; sets that follow within GATHERING_S join the goal."""
        move = AxisMove(targets, asyncio.get_running_loop().create_future())
        move.end.add_done_callback(lambda end: end.cancelled() or end.exception())  # a set need not be waited for
        if any(move.shares_axis(other) for other in self._gathered):
            self._start_task()  # a goal of the earlier sets goes first
        self._gathered.append(move)
        self._unsent.append(move)
        if len(self._gathered) == 1:
            self._start_task(GATHERING_S)
        return move

    async def progress(self, move: AxisMove) -> AsyncIterator[Pose]:
        """Yield measured poses until a set has ended. Raises the set's error.

        Cancelling the iteration cancels a set whose goal has not been sent; a goal in progress continues.
        """
        try:
            while not move.end.done():
                await asyncio.wait({move.end}, timeout=PROGRESS_S)
                if self.pose is not None:
                    yield self.pose
        finally:
            move.end.cancel()  # has no effect on a set that has ended
        move.end.result()

    async def stop(self, success: bool) -> None:
        """Stop the goal in progress; return when the robot is at rest. Goals of other clients continue.

        With `success`, the sets end as if they had arrived: a plan that pauses repeats them.
        """
        unsent, self._unsent, self._gathered = self._unsent, [], []
        end_all(unsent, None if success else TrirailError("the motion was stopped before its goal was sent"))
        async with self._sending:  # a goal that is being sent is first accepted
            motion = self._motion
        if motion is None or motion.goal.result is not None:
            return
        motion.interrupted |= success
        await cancel(motion.goal)

    async def settle(self, goal: AsyncGoalHandle) -> Result:
        """Wait for the end of a goal. Raises ServiceError if the service is lost or restarts during the wait."""
        ended, lost = asyncio.create_task(goal.wait()), asyncio.create_task(self._watch())
        try:
            await asyncio.wait({ended, lost}, return_when=asyncio.FIRST_COMPLETED)
            return ended.result() if ended.done() else _raise(lost.result())
        finally:
            ended.cancel()
            lost.cancel()
            await asyncio.gather(ended, lost, return_exceptions=True)  # neither task may outlive this call

    def _start_task(self, delay: float = 0.0) -> None:
        task = asyncio.create_task(self._send_later(self._gathered, delay))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        if not delay:
            self._gathered = []

    async def _send_later(self, moves: list[AxisMove], delay: float) -> None:
        """Send a goal for sets that are gathered during a delay, and finish them when it ends."""
        if delay:
            await asyncio.sleep(delay)
            if moves is not self._gathered:
                return  # sent or stopped meanwhile
            self._gathered = []
        try:
            async with self._sending:
                self._unsent = [move for move in self._unsent if move not in moves]
                moves = [move for move in moves if not move.end.done()]
                if not moves:
                    return  # stopped or cancelled meanwhile
                motion = self._motion = await self._send_goal(moves, self._motion)
        except Exception as error:  # noqa: BLE001 - whatever it is, those who wait for the sets get it
            end_all(moves, error)
            return
        try:
            result = await self.settle(motion.goal)
        except Exception as error:  # noqa: BLE001 - as above
            if self._motion is motion:
                self._motion = None  # it is unknown whether the goal is still in progress
            end_all(motion.moves, error)
            return
        motion.finish(result)

    async def _send_goal(self, moves: list[AxisMove], before: _Motion | None) -> _Motion:
        """Send the goal for new sets and for the sets in progress whose axes the new sets do not move."""
        carried: list[AxisMove] = []
        pose = (await self._robot.state()).commanded.pose
        if before is not None and before.goal.result is None:
            # Taken over before the goal is sent: its acceptance ends the goal before, and the sets left with that.
            carried = [old for old in before.moves if not any(old.shares_axis(new) for new in moves)]
            before.moves = [old for old in before.moves if old not in carried]
            pose = before.target
        target = list(pose)
        for move in moves:
            for axis, value in move.targets.items():
                target[axis] = value
        try:
            goal = await self._robot.move_to(*target)
        except BaseException:
            if before is not None:
                before.moves += carried
                if before.goal.result is not None:
                    before.finish(before.goal.result)
            raise
        return _Motion(Pose(*target), goal, [*carried, *moves])

    async def _watch(self) -> ServiceError:
        """Store the measured pose of each state; return the error when the service is lost."""
        cycle, self.pose = -1, None
        async with aclosing(self._robot.states(SILENCE_S)) as states:
            async for state in states:
                if state.seq < cycle:
                    return ServiceError("the service has restarted: the end of the goal is unknown")
                cycle, self.pose = state.seq, state.pose
        return ServiceError(f"no state of the robot for {SILENCE_S:g} s: the end of the goal is unknown")


def end_all(moves: list[AxisMove], error: Exception | None) -> None:
    """End the sets, with an error or without."""
    for move in moves:
        move.finish(error)


async def cancel(goal: AsyncGoalHandle) -> None:
    """Stop a goal, unless it has already ended."""
    try:
        await goal.cancel()
    except RefusedError as error:
        if error.code != RefusalCode.NO_GOAL:
            raise
    with contextlib.suppress(TimeoutError):  # the end is reported when the robot is at rest
        await goal.wait(SILENCE_S)


def _raise(error: ServiceError) -> Result:
    raise error
