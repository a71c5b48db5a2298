"""Handles of accepted goals, and jogs."""

from __future__ import annotations

import asyncio
import contextlib
import uuid
from collections import Counter
from collections.abc import Awaitable, Callable, Iterable
from typing import NamedTuple, Self

import msgspec

from trirail.client.outgoing import number, seconds
from trirail.errors import RefusalCode, RefusedError, TrirailError, WaitTimeoutError
from trirail.wire.goals import Goal, Tool, VelocityGoal
from trirail.wire.marks import Switch
from trirail.wire.messages import Event, GoalReply, Residual
from trirail.wire.vocabulary import Command, Stop

STANDS_WITHIN = 10.0
"""Time that the end of a jog may take beyond its own time-out [s]."""
BRAKE_RENEWAL_S = 0.05
"""Time-out of a jog's last renewal, whose velocity is zero [s]."""

Velocity = tuple[float, float, float]
"""Velocity of x, y [m/s] and phi [rad/s], in the base frame."""


class Result(NamedTuple):
    """End of a goal; every goal has exactly one."""

    id: str
    outcome: str
    """One of done, rejected, preempted, stopped, expired, faulted and unsettled."""
    message: str
    """Reason, in one line for people."""
    settle: float | None = None
    """Time of a goal that is done from the end of its path until the robot was in position, to the first cycle of the
    dwell [s]. None, as the two below, for goals that do not settle: a jog, a goal that was passed on the way to the
    next, a trajectory with `settle` False."""
    residual: Residual | None = None
    """Distance from the target at its end, done or unsettled: `sliders` [m], and `pose` [m, m, rad]."""
    overshoot: tuple[float, float, float] | None = None
    """Greatest overshoot of the sliders A, B, C since the end of the path [m]."""
    marks: tuple[Switch, ...] = ()
    """Switches of outputs on its path, in the order in which they happened."""


def result_of(event: Event) -> Result | None:
    """Return the result in an event of a goal's end; None for any other event."""
    if event.id is None or event.outcome is None:
        return None
    return Result(event.id, event.outcome, event.message, event.settle, event.residual, event.overshoot)


class AsyncGoalHandle:
    """Handle of a goal that the service has accepted; dropping the handle does not stop the goal.

    `command` sends a command with its content: AsyncRobot.command.
    """

    def __init__(self, goal_id: str, command: Callable[[Command, bytes], Awaitable[object]]) -> None:
        self.id = goal_id
        self.reply = GoalReply(goal_id, 0.0)
        """Reply of the service to the goal."""
        self._command = command
        self._result: Result | None = None
        self._ended = asyncio.Event()

    def __repr__(self) -> str:
        """Return class, id and, once there is one, the outcome."""
        outcome = f" {self._result.outcome}" if self._result is not None else ""
        return f"<{type(self).__name__} {self.id}{outcome}>"

    @property
    def result(self) -> Result | None:
        """Result of the goal; None before its end."""
        return self._result

    @property
    def duration(self) -> float | None:
        """Expected time from acceptance to the end of its path [s], to which settling adds; None while the override is
        zero."""
        return self.reply.duration

    @property
    def expected(self) -> str:
        """Expected duration, for people."""
        return f"{self.duration:.2f} s" if self.duration is not None else "no expected end while the override is 0"

    async def cancel(self) -> None:
        """Stop this goal, whether it is under way or waits; return when the robot is at rest, or the goal has ended.

        Other goals continue, except those that wait for this one. Raises RefusedError (`no_goal`) if it has ended,
        ServiceError if nobody answers. Cancelling a task that waits for it does not stop it.
        """
        await self._command(Command.STOP, msgspec.json.encode(Stop(self.id)))

    async def wait(self, timeout: float | None = None) -> Result:
        """Wait for the end of the goal and return its result, whose `outcome` tells success from failure.

        Raises WaitTimeoutError, a TimeoutError, after `timeout` seconds; the goal itself continues.
        """
        within = seconds(timeout)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(within):
                await self._ended.wait()
        if self._result is None:
            raise WaitTimeoutError(f"goal {self.id} has not ended within {within:g} s")
        return self._result

    def end(self, result: Result) -> None:
        """Set the result, and wake the waiting tasks."""
        self._result = result
        self._ended.set()


class OpenGoals:
    """Registry of the handles of goals that a client has sent and that have not ended yet.

    Calls with one id share one handle: renewals of a jog, and goals that the service refuses because their id has been
    used. A refusal concerns its own call alone, so a handle is kept while another call with its id is under way or has
    been accepted.
    """

    def __init__(self) -> None:
        self._handles: dict[str, AsyncGoalHandle] = {}
        self._calls: Counter[str] = Counter()
        self._accepted: set[str] = set()
        self._switches: dict[str, list[Switch]] = {}

    def __len__(self) -> int:
        return len(self._handles)

    def open(self, handle: AsyncGoalHandle) -> AsyncGoalHandle:
        """Register a goal that is about to be sent; return its handle, or the existing one with the same id."""
        self._calls[handle.id] += 1
        return self._handles.setdefault(handle.id, handle)

    def accept(self, handle: AsyncGoalHandle, reply: GoalReply) -> None:
        """Keep the handle of an accepted goal until the goal ends."""
        handle.reply = reply
        self._end_call(handle.id)
        if self._handles.get(handle.id) is handle:  # else it has ended already
            self._accepted.add(handle.id)

    def refuse(self, goal_id: str) -> bool:
        """Forget a call that was refused or not answered; return whether its handle is forgotten with it."""
        self._end_call(goal_id)
        if goal_id in self._accepted or goal_id in self._calls:
            return False
        self._switches.pop(goal_id, None)
        return self._handles.pop(goal_id, None) is not None

    def end(self, result: Result) -> None:
        """End the handle of a goal, if it is one of these."""
        self._accepted.discard(result.id)
        if (handle := self._handles.pop(result.id, None)) is not None:
            handle.end(result._replace(marks=tuple(self._switches.pop(result.id, ()))))

    def note_switches(self, switches: Iterable[Switch]) -> None:
        """Add switches to the results of their goals, of those that are followed here."""
        for switch in switches:
            if switch.goal in self._handles:
                self._switches.setdefault(switch.goal, []).append(switch)

    def _end_call(self, goal_id: str) -> None:
        self._calls[goal_id] -= 1
        if self._calls[goal_id] == 0:
            del self._calls[goal_id]


class AsyncJog:
    """Jog at a velocity inside the context; `result` is its result afterwards.

    A task renews the jog three times per time-out; see trirail.client.blocking.Jog.

    Parameters
    ----------
    send
        Function that sends a goal with an id: AsyncRobot.send.
    velocity
        Velocity of the tool: x, y [m/s] and phi [rad/s] in the base frame.
    timeout
        Time-out of the jog [s].

    """

    def __init__(
        self,
        send: Callable[[Callable[[str], Goal], str], Awaitable[AsyncGoalHandle]],
        velocity: Velocity,
        timeout: float,
        tool: Tool | None = None,
    ) -> None:
        self._send_goal = send
        self._velocity = velocity
        self._timeout = number(timeout, "timeout")
        self._tool = tool
        self._id = uuid.uuid4().hex[:12]
        self._goal: AsyncGoalHandle | None = None
        self._over = asyncio.Event()
        self._renewing: asyncio.Task[None] | None = None
        self.error: Exception | None = None
        """Error of the last renewal, if it failed."""

    @property
    def reply(self) -> GoalReply | None:
        """Latest reply of the service, with `slowed` for one; None before the first."""
        return self._goal.reply if self._goal else None

    @property
    def result(self) -> Result | None:
        """Result of the goal; None before its end."""
        return self._goal.result if self._goal else None

    async def __aenter__(self) -> Self:
        self._goal = await self._send(self._velocity, self._timeout)
        self._renewing = asyncio.create_task(self._renew(), name="jog")
        return self

    async def __aexit__(self, *_: object) -> None:
        self._over.set()
        if self._renewing is not None:
            await self._renewing  # a renewal that has been sent is not cancelled
        if self._goal is not None and self.result is None and self.error is None:
            with contextlib.suppress(TrirailError):  # it has ended, or will by its time-out
                await self._send((0.0, 0.0, 0.0), BRAKE_RENEWAL_S)
            await self._goal.wait(self._timeout + STANDS_WITHIN)

    async def _send(self, velocity: Velocity, timeout: float) -> AsyncGoalHandle:
        return await self._send_goal(
            lambda name: VelocityGoal(*velocity, timeout=timeout, id=name, tool=self._tool), self._id
        )

    async def _renew(self) -> None:
        while not await self._is_over(self._timeout / 3.0):
            try:
                await self._send(self._velocity, self._timeout)
            except TrirailError as error:
                at_limit = isinstance(error, RefusedError) and error.code is RefusalCode.AT_LIMIT
                self.error = None if at_limit else error  # the end at a limit is regular
                return

    async def _is_over(self, within: float) -> bool:
        try:
            async with asyncio.timeout(within):
                return await self._over.wait()
        except TimeoutError:
            return False
