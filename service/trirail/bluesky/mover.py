"""Conversion of Bluesky's sets of single axes to goals. Sets of several axes that arrive together become one goal."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Coroutine, Mapping
from contextlib import aclosing
from dataclasses import dataclass, field
from typing import Any

import msgspec

from trirail.client.async_client import AsyncRobot
from trirail.client.call_time import called, called_at
from trirail.client.goal import AsyncGoalHandle, Result
from trirail.errors import RefusalCode, RefusedError, ServiceError, TrirailError
from trirail.wire.state import Pose, State
from trirail.wire.vocabulary import Command, Stop

GATHERING_S = 0.005
"""Time after a set during which other sets join its goal [s]. Sets of a message group arrive within a millisecond."""
SILENCE_S = 5.0
"""Time without a state after which the service counts as lost during a goal [s]."""
ANSWERED_S = 1.0
"""Time after which a stop no longer waits for the service's answer to a goal that is being sent [s]."""
PROGRESS_S = 0.1
"""Interval between progress reports [s]."""


class UnfinishedError(TrirailError):
    """Error raised if a goal ends with an outcome other than done; `result` is the result of the goal."""

    def __init__(self, result: Result) -> None:
        super().__init__(result.message)
        self.result = result


def check_done(result: Result) -> None:
    """Raise UnfinishedError if the outcome of a goal is not done."""
    if result.outcome != "done":
        raise UnfinishedError(result)


@dataclass(eq=False, slots=True)
class AxisMove:
    """Set of one or more axes, a request of Bluesky to move them to target values."""

    targets: Mapping[int, float]
    """Target of each axis by the index of the axis, 0 to 2 for x, y [m] and phi [rad]."""
    end: asyncio.Future[None]

    def shares_axis(self, other: AxisMove) -> bool:
        """Return True if both sets move the same axis."""
        return not self.targets.keys().isdisjoint(other.targets)

    def finish(self, error: Exception | None = None) -> None:
        """End the set, with or without an error, if it has not ended."""
        if self.end.done():
            return
        if error is None:
            self.end.set_result(None)
        else:
            self.end.set_exception(error)


@dataclass(eq=False, slots=True)
class _Motion:
    """Goal, and the `set` calls of axes that end when this goal ends."""

    target: Pose
    goal: AsyncGoalHandle
    moves: list[AxisMove] = field(default_factory=list)
    interrupted: bool = False
    """Whether the goal was stopped on request, which is not a failure."""
    lost: bool = False
    """Whether it is unknown if the goal is still in progress. A stop then stops it; its sets have ended."""

    def finish(self, result: Result) -> None:
        """End the `set` calls of this goal, with an error if the goal has failed."""
        failed = result.outcome != "done" and not self.interrupted
        end_all(self.moves, UnfinishedError(result) if failed else None)


class Sending:
    """Lock under which a goal is sent, so that a stop waits for the answer of the service."""

    def __init__(self) -> None:
        self._lock = asyncio.Lock()
        self._call: asyncio.Task[AsyncGoalHandle] | None = None
        self._abandoned = False
        """Whether a stop did not wait for the end of the present sending."""

    async def __aenter__(self) -> None:
        await self._lock.acquire()
        self._abandoned = False

    async def __aexit__(self, *_: object) -> None:
        self._lock.release()

    async def send(self, call: Coroutine[Any, Any, AsyncGoalHandle]) -> AsyncGoalHandle:
        """Send a goal with a call of an AsyncRobot. Raises ServiceError if a stop has not waited for the answer."""
        self._call = task = asyncio.create_task(call)
        try:
            if self._abandoned:
                task.cancel()
            return await task
        except asyncio.CancelledError:
            if task.cancelled() and self._abandoned:
                raise ServiceError("the motion was stopped before the service had answered its goal") from None
            raise
        finally:
            self._call = None

    async def end(self) -> None:
        """Wait until no goal is being sent.

        If the service does not answer within ANSWERED_S, the client stops the goal, in case the service has received
        it, and ServiceError is raised.
        """
        try:
            async with asyncio.timeout(ANSWERED_S):
                await self._lock.acquire()
        except TimeoutError:
            self.abandon()
            raise ServiceError(
                "the service has not answered a goal, which was stopped in case it has arrived"
            ) from None
        self._lock.release()

    def abandon(self) -> None:
        """Do not wait for the answer to a goal that is being sent; the client stops the goal."""
        self._abandoned = True
        if self._call is not None:
            self._call.cancel()


class Mover:
    """Sender of goals for sets of axes, within one event loop.

    Sets that arrive together become one goal, and end with this goal. If a set of other axes arrives during a goal, a
    new goal to all targets replaces the goal, so that each axis reaches its target as with independent motors. A set of
    the same axis preempts the earlier set.
    """

    def __init__(self, robot: AsyncRobot) -> None:
        self._robot = robot
        self._loop = asyncio.get_running_loop()
        self._gathered: list[AxisMove] = []
        """Sets that later sets may still join. A new list begins with the next goal."""
        self._gathered_from = 0.0
        """Time at which the program called the first of these sets; a stop that was called later refuses their goal."""
        self._unsent: list[AxisMove] = []
        """Sets for which no goal has been sent yet. A stop ends these sets without sending a goal."""
        self._motion: _Motion | None = None
        self._sending = Sending()
        self._tasks: set[asyncio.Task[None]] = set()
        self.pose: Pose | None = None
        """Measured pose in the newest state during a goal; None before the first state."""

    def start(self, targets: Mapping[int, float]) -> AxisMove:
        """Start to move axes to their targets. Sets that follow within GATHERING_S join the same goal."""
        move = AxisMove(targets, asyncio.get_running_loop().create_future())
        # Retrieve the error, so that asyncio does not complain if no task waits for the set.
        move.end.add_done_callback(lambda end: end.cancelled() or end.exception())
        if any(move.shares_axis(other) for other in self._gathered):
            self._start_task()  # send a goal for the earlier sets first
        if not self._gathered:
            self._gathered_from = called_at()
        self._gathered.append(move)
        self._unsent.append(move)
        if len(self._gathered) == 1:
            self._start_task(GATHERING_S)
        return move

    async def progress(self, move: AxisMove) -> AsyncIterator[Pose]:
        """Yield measured poses until a set has ended. Raises the error with which the set ends.

        If the iteration is cancelled before the goal of the set is sent, the set is cancelled. A goal in progress
        continues.
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

        With `success`, the sets end without an error, as if the axes had reached their targets. A plan that pauses
        repeats these sets when it resumes.
        """
        self._end_unsent(success)
        try:
            await self._sending.end()
        finally:
            await self._stop_motion(success)

    async def _stop_motion(self, success: bool) -> None:
        motion = self._motion
        if motion is None or motion.goal.result is not None:
            return
        motion.interrupted |= success
        await cancel(motion.goal)
        if motion.lost and self._motion is motion:
            self._motion = None

    def interrupt(self, success: bool) -> AsyncGoalHandle | None:
        """Stop moving from another thread, whose event loop then stops the goal that is returned, if there is one.

        A goal that is being sent is stopped in case the service has received it.
        """
        with contextlib.suppress(RuntimeError):  # the event loop is closed, so nothing is being sent
            self._loop.call_soon_threadsafe(self._abandon_unsent, success)
        motion = self._motion
        if motion is None or motion.goal.result is not None:
            return None
        motion.interrupted |= success
        return motion.goal

    def forget(self) -> None:
        """Forget the goal, which was stopped elsewhere, if the event loop is closed: it would never get a result."""
        if self._loop.is_closed():
            self._motion = None

    @property
    def moves(self) -> bool:
        """Whether a goal is in progress, as far as is known."""
        return self._motion is not None and self._motion.goal.result is None

    def _abandon_unsent(self, success: bool) -> None:
        self._end_unsent(success)
        self._sending.abandon()

    def _end_unsent(self, success: bool) -> None:
        unsent, self._unsent, self._gathered = self._unsent, [], []
        end_all(unsent, None if success else TrirailError("the motion was stopped before its goal was sent"))

    async def settle(self, goal: AsyncGoalHandle) -> Result:
        """Wait for the end of a goal. Raises ServiceError if the service is lost or restarts before the goal ends."""
        ended, lost = asyncio.create_task(goal.wait()), asyncio.create_task(self._watch())
        try:
            await asyncio.wait({ended, lost}, return_when=asyncio.FIRST_COMPLETED)
            return ended.result() if ended.done() else _raise(lost.result())
        finally:
            ended.cancel()
            lost.cancel()
            await asyncio.gather(ended, lost, return_exceptions=True)  # both tasks must end before this call does

    def _start_task(self, delay: float = 0.0) -> None:
        with called(self._gathered_from):
            task = asyncio.create_task(self._send_later(self._gathered, delay))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        if not delay:
            self._gathered = []

    async def _send_later(self, moves: list[AxisMove], delay: float) -> None:
        """Send a goal for all sets that have been gathered after a delay, and end the sets when the goal ends."""
        if delay:
            await asyncio.sleep(delay)
            if moves is not self._gathered:
                return  # the sets were sent or stopped during the delay
            self._gathered = []
        try:
            async with self._sending:
                self._unsent = [move for move in self._unsent if move not in moves]
                moves = [move for move in moves if not move.end.done()]
                if not moves:
                    return  # all sets were stopped or cancelled
                motion = self._motion = await self._send_goal(moves, self._motion)
        except Exception as error:  # noqa: BLE001 - the tasks that wait for the sets must get every error
            end_all(moves, error)
            return
        try:
            result = await self.settle(motion.goal)
        except Exception as error:  # noqa: BLE001 - as above
            motion.lost = True
            end_all(motion.moves, error)
            return
        motion.finish(result)

    async def _send_goal(self, moves: list[AxisMove], before: _Motion | None) -> _Motion:
        """Send a goal for new sets, and for the sets in progress with axes that the new sets do not move."""
        carried: list[AxisMove] = []
        pose = setpoint_of(await self._robot.state())
        if before is not None and before.goal.result is None and not before.lost:
            # Move the sets of other axes to the new goal before it is sent. When the service accepts the new goal, the
            # earlier goal ends, and with it the sets that remain with it.
            carried = [old for old in before.moves if not any(old.shares_axis(new) for new in moves)]
            before.moves = [old for old in before.moves if old not in carried]
            pose = before.target
        target = list(pose)
        for move in moves:
            for axis, value in move.targets.items():
                target[axis] = value
        try:
            goal = await self._sending.send(self._robot.move_to(*target))
        except BaseException:
            if before is not None:
                before.moves += carried
                if before.goal.result is not None:
                    before.finish(before.goal.result)
            raise
        return _Motion(Pose(*target), goal, [*carried, *moves])

    async def _watch(self) -> ServiceError:
        """Store the measured pose of each state in `pose`; return the error when the service is lost or restarts."""
        cycle, self.pose = -1, None
        async with aclosing(self._robot.states(SILENCE_S)) as states:
            async for state in states:
                if state.seq < cycle:
                    return ServiceError("the service has restarted: the end of the goal is unknown")
                cycle, self.pose = state.seq, state.pose
        return ServiceError(f"no state of the robot for {SILENCE_S:g} s: the end of the goal is unknown")


def setpoint_of(state: State) -> Pose:
    """Return the target of the goal in progress; the commanded pose if there is no goal or the goal has no target."""
    target = state.goal.target if state.goal is not None else None
    return target or state.commanded.pose


def end_all(moves: list[AxisMove], error: Exception | None) -> None:
    """End sets with an error; without an error if `error` is None."""
    for move in moves:
        move.finish(error)


async def stop_elsewhere(robot: AsyncRobot, goal: AsyncGoalHandle) -> None:
    """Stop a goal that was sent in another event loop, which may be blocked or closed; return when it is stopped."""
    try:
        await robot.command(Command.STOP, msgspec.json.encode(Stop(goal.id)))
    except RefusedError as error:
        if error.code != RefusalCode.NO_GOAL:
            raise


async def cancel(goal: AsyncGoalHandle) -> None:
    """Stop a goal, unless it has already ended; return when the robot is at rest."""
    try:
        await goal.cancel()
    except RefusedError as error:
        if error.code != RefusalCode.NO_GOAL:
            raise
    # The robot is at rest, and the service reports the end of the goal, unless that event is late or was missed.
    with contextlib.suppress(TimeoutError, ServiceError):
        await goal.wait(SILENCE_S)


def _raise(error: ServiceError) -> Result:
    raise error
