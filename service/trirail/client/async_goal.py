"""What an asyncio program holds of a goal that the service has accepted."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Awaitable, Callable
from typing import Self

import msgspec

from trirail.client.goal import LETTING_GO, STANDS_WITHIN, AcceptedGoal, HeldVelocity, Result, Velocity
from trirail.client.outgoing import seconds
from trirail.errors import TrirailError
from trirail.wire.goals import Goal, Tool
from trirail.wire.vocabulary import Command, Stop


class AsyncGoalHandle(AcceptedGoal):
    """A goal that the service has accepted: this object only follows it.

    `command` sends a command with its content, as AsyncRobot.command does.
    """

    def __init__(self, goal_id: str, command: Callable[[Command, bytes], Awaitable[object]]) -> None:
        super().__init__(goal_id)
        self._command = command
        self._ended = asyncio.Event()

    async def cancel(self) -> None:
        """Stop it, as GoalHandle.cancel does. To cancel a task that waits for it does not stop it."""
        await self._command(Command.STOP, msgspec.json.encode(Stop(self.id)))

    async def wait(self, timeout: float | None = None) -> Result:
        """Wait for its end, however it ends; look at `outcome` of the result.

        Raises TimeoutError if that takes longer than `timeout` seconds; the goal itself goes on.
        """
        within = seconds(timeout)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(within):
                await self._ended.wait()
        if self._result is None:
            raise TimeoutError(f"goal {self.id} has not ended within {within:g} s")
        return self._result

    def end(self, result: Result) -> None:
        """Take in how it ended."""
        self._result = result
        self._ended.set()


class AsyncJog(HeldVelocity[AsyncGoalHandle]):
    """A velocity that is kept alive while the context lasts, as trirail.client.goal.Jog; renewed by a task."""

    def __init__(
        self,
        send: Callable[[Callable[[str], Goal], str], Awaitable[AsyncGoalHandle]],
        velocity: Velocity,
        timeout: float,
        tool: Tool | None = None,
    ) -> None:
        super().__init__(velocity, timeout, tool)
        self._send_goal = send
        self._over = asyncio.Event()
        self._renewing: asyncio.Task[None] | None = None

    async def __aenter__(self) -> Self:
        self._goal = await self._send(self._velocity, self._timeout)
        self._renewing = asyncio.create_task(self._renew(), name="jog")
        return self

    async def __aexit__(self, *_: object) -> None:
        self._over.set()
        if self._renewing is not None:
            await self._renewing  # a renewal that is on its way is not taken back
        if self._goal is not None and self._moves:
            with contextlib.suppress(TrirailError):  # it has ended, or does by its time-out
                await self._send((0.0, 0.0, 0.0), LETTING_GO)
            await self._goal.wait(self._timeout + STANDS_WITHIN)

    async def _is_over(self, within: float) -> bool:
        try:
            async with asyncio.timeout(within):
                return await self._over.wait()
        except TimeoutError:
            return False

    async def _send(self, velocity: Velocity, timeout: float) -> AsyncGoalHandle:
        return await self._send_goal(self._message(velocity, timeout), self._id)

    async def _renew(self) -> None:
        while not await self._is_over(self._timeout / 3.0):
            try:
                await self._send(self._velocity, self._timeout)
            except TrirailError as error:
                self._renewal_failed(error)
                return
