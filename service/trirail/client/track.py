"""Client side of tracking, which sends updates of a moving target that the platform follows."""

from __future__ import annotations

import contextlib
import functools
import itertools
import time as clocks
from collections.abc import Awaitable, Callable, Sequence
from typing import Self

from trirail.client.goal import STANDS_WITHIN, AsyncGoalHandle, Result
from trirail.errors import RefusalCode, RefusedError, ServiceError, TrirailError
from trirail.wire.goals import Goal, TrackGoal
from trirail.wire.messages import GoalReply

Taker = Callable[[GoalReply | TrirailError], None]
"""Callback that gets the reply to a goal or the error; it is called once, in the event loop."""


class AsyncTrack:
    """Context manager in which the robot follows a moving target; the program calls `update` 10 to 200 times a second.

    `begin` is a function that sends a goal and returns its handle once the service accepts the goal, such as
    AsyncRobot.send. `post` sends a goal and returns immediately. Only `update` sends messages. If the program stops
    calling `update` for any reason, the robot brakes on its path after the time-out.
    """

    def __init__(
        self,
        begin: Callable[[Callable[[str], Goal], str], Awaitable[AsyncGoalHandle]],
        post: Callable[[Goal, Taker], None],
        goal_id: str,
        timeout: float,
    ) -> None:
        self.id = goal_id
        self._begin = begin
        self._post = post
        self._timeout = timeout
        self._goal: AsyncGoalHandle | None = None
        self._numbers = itertools.count(1)
        self._answered = 0
        """Number of the newest update that got a reply."""
        self._error: TrirailError | None = None
        self._lag: float | None = None

    @property
    def lag(self) -> float | None:
        """Greatest distance of a point of the platform from its place at the target [m], from the latest reply."""
        return self._lag

    @property
    def result(self) -> Result | None:
        """Result of the goal; None before its end."""
        return self._goal.result if self._goal else None

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def update(
        self, pose: Sequence[float], velocity: Sequence[float] = (0.0, 0.0, 0.0), time: float | None = None
    ) -> None:
        """Send the target's pose x, y [m], phi [rad] and its velocity [m/s, m/s, rad/s] at a time.

        `time` is wall-clock time [s since 1970] and defaults to now. If the service runs on another machine, the clocks
        of the two machines must agree. Until the next call, the service assumes that the target moves at this velocity.

        The first call returns when the service accepts the track. Later calls return immediately, and the error of such
        a call is raised by a later call. Raises RefusedError if the service refuses an update, or if a stop, a pause,
        another goal or a time-out has ended the track. Raises ServiceError if the service does not answer.
        """
        self._check()
        goal = self._goal_of(pose, velocity, clocks.time() if time is None else time)
        if self._goal is None:
            self._goal = await self._begin(lambda _: goal, self.id)
            self._lag = self._goal.reply.lag
        else:
            self._post(goal, functools.partial(self._on_answer, next(self._numbers)))

    async def close(self) -> None:
        """Brake on the path if the robot still follows the target; return when the robot is at rest."""
        if self._goal is None:
            return
        if self._goal.result is None:
            with contextlib.suppress(RefusedError):  # the track has just ended
                await self._goal.cancel()
        await self._goal.wait(STANDS_WITHIN)

    def _goal_of(self, pose: Sequence[float], velocity: Sequence[float], time: float) -> TrackGoal:
        try:
            (x, y, phi), (vx, vy, w) = pose, velocity
            return TrackGoal(x, y, phi, velocity=(vx, vy, w), time=time, id=self.id, timeout=self._timeout)
        except (TypeError, ValueError) as error:
            raise RefusedError(RefusalCode.MALFORMED, f"not a target: {error}") from error

    def _check(self) -> None:
        """Raise the error of an earlier update, if there is one. Raises RefusedError if the track has ended."""
        if (ended := self.result) is not None:
            raise RefusedError(RefusalCode.JOG_OVER, f"the track has ended: {ended.message}")
        error, self._error = self._error, None
        if error is not None:
            raise error

    def _on_answer(self, number: int, answer: GoalReply | TrirailError) -> None:
        """Handle the reply to an update; ignore a missing reply if the reply to a later update has arrived."""
        if isinstance(answer, ServiceError) and number < self._answered:
            return
        self._answered = max(self._answered, number)
        if isinstance(answer, TrirailError):
            self._error = answer
        elif answer.lag is not None:
            self._lag = answer.lag
