"""A moving target that the platform follows, from the side of an asyncio program that sees it."""

from __future__ import annotations

import contextlib
import time as clocks
from collections.abc import Awaitable, Callable, Sequence
from typing import Self

from trirail.client.async_goal import AsyncGoalHandle
from trirail.client.goal import STANDS_WITHIN
from trirail.client.track import FollowedTarget, Taker
from trirail.errors import RefusedError
from trirail.wire.goals import Goal


class AsyncTrack(FollowedTarget[AsyncGoalHandle]):
    """Tells the service where a target is, as trirail.client.track.Track."""

    def __init__(
        self,
        begin: Callable[[Callable[[str], Goal], str], Awaitable[AsyncGoalHandle]],
        post: Callable[[Goal, Taker], None],
        goal_id: str,
        timeout: float,
    ) -> None:
        super().__init__(post, goal_id, timeout)
        self._begin = begin

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def update(
        self, pose: Sequence[float], velocity: Sequence[float] = (0.0, 0.0, 0.0), time: float | None = None
    ) -> None:
        """Tell where the target was at a time, and how fast it moved, as Track.update does."""
        self._check()
        goal = self._goal_of(pose, velocity, clocks.time() if time is None else time)
        if self._goal is None:
            self._goal = await self._begin(lambda _: goal, self.id)
            self._lag = self._goal.reply.lag
        else:
            self._send(goal)

    async def close(self) -> None:
        """Brake on the path, if the robot still follows; return when it stands."""
        if self._goal is None:
            return
        if self._goal.result is None:
            with contextlib.suppress(RefusedError):  # it has just ended
                await self._goal.cancel()
        await self._goal.wait(STANDS_WITHIN)
