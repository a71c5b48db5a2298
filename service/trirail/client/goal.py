"""Handles and results of accepted goals, and asynchronous jogs."""

from __future__ import annotations

import asyncio
import contextlib
import time
import uuid
from collections import Counter
from collections.abc import Awaitable, Callable, Iterable
from contextvars import Context
from typing import NamedTuple, Self

import msgspec

from trirail.client.connection import CLOSED
from trirail.client.outgoing import number, seconds
from trirail.errors import RefusalCode, RefusedError, ServiceError, TrirailError, WaitTimeoutError
from trirail.wire.goals import Goal, Tool, VelocityGoal
from trirail.wire.marks import Switch
from trirail.wire.messages import Event, GoalReply, Residual
from trirail.wire.vocabulary import Command, Stop

STANDS_WITHIN = 10.0
"""Longest time from the time-out of a jog to the robot's rest [s]."""
BRAKE_RENEWAL_S = 0.05
"""Time-out of the last renewal of a jog, which sets the velocity to zero [s]."""
CHECK_PERIOD_S = 2.0
"""Period at which a wait for the end of a goal checks that the service answers [s]."""
MAX_CHECK_PERIODS = 2.0
"""Longest time between two such checks, in periods; a longer time means that the process was suspended."""
SILENT_AFTER_S = 15.0
"""Time without an answer after which such a wait ends [s]; a lost connection is often restored within this time."""

Velocity = tuple[float, float, float]
"""Velocity of x, y [m/s] and phi [rad/s], in the base frame."""


class Result(NamedTuple):
    """Result of a goal; every goal has exactly one."""

    id: str
    outcome: str
    """One of done, rejected, preempted, stopped, expired, faulted and unsettled."""
    message: str
    """Reason in one line, for people."""
    settle: float | None = None
    """Time from the end of the path to the first cycle of the dwell in position, for a goal that is done [s].

    This field and the next two fields are None for goals that do not settle: a jog, a goal that blends into the next
    goal, and a trajectory with `settle` False."""
    residual: Residual | None = None
    """Distance from the target at the end of a done or unsettled goal: `sliders` [m], and `pose` [m, m, rad]."""
    overshoot: tuple[float, float, float] | None = None
    """Greatest overshoot of the sliders A, B, C since the end of the path [m]."""
    marks: tuple[Switch, ...] = ()
    """Switches of outputs on the path, in the order in which they happened."""


def result_of(event: Event) -> Result | None:
    """Return the result that an event reports; None if the event does not report the end of a goal."""
    if event.id is None or event.outcome is None:
        return None
    return Result(event.id, event.outcome, event.message, event.settle, event.residual, event.overshoot)


class AsyncGoalHandle:
    """Handle of an accepted goal; discarding the handle does not stop the goal.

    `command` is a function that sends a command with its content, such as AsyncRobot.command. `check` is a function
    that raises ServiceError if the service does not answer. `is_present` is a function that returns whether the goal is
    the present goal in the state.
    """

    def __init__(
        self,
        goal_id: str,
        command: Callable[[Command, bytes], Awaitable[object]],
        check: Callable[[], Awaitable[object]],
        is_present: Callable[[], Awaitable[bool]],
    ) -> None:
        self.id = goal_id
        self.reply = GoalReply(goal_id, 0.0)
        """Reply of the service that accepted the goal."""
        self._command = command
        self._check = check
        self._is_present = is_present
        self._result: Result | None = None
        self._lost = ""
        """Reason why the result will remain unknown."""
        self._missed = ""
        """Events that the client has missed, and among which the end of the goal may be; empty if there are none."""
        self._ended = asyncio.Event()

    def __repr__(self) -> str:
        """Return the class name and id, and the outcome once the goal has ended."""
        outcome = f" {self._result.outcome}" if self._result is not None else ""
        return f"<{type(self).__name__} {self.id}{outcome}>"

    @property
    def result(self) -> Result | None:
        """Result of the goal; None until the goal ends."""
        return self._result

    @property
    def duration(self) -> float | None:
        """Expected time from acceptance to the end of the path, without settling [s]; None at override zero."""
        return self.reply.duration

    @property
    def expected(self) -> str:
        """Expected duration as text, for people."""
        return f"{self.duration:.2f} s" if self.duration is not None else "no expected end while the override is 0"

    async def cancel(self) -> None:
        """Stop this goal, running or queued; return when the robot is at rest or the goal has ended.

        Other goals continue, except goals that wait for this goal. If you cancel only a task that waits for the goal,
        the goal continues. Raises RefusedError (`no_goal`) if the goal has already ended, and ServiceError if the
        service does not answer.
        """
        await self._command(Command.STOP, msgspec.json.encode(Stop(self.id)))

    async def wait(self, timeout: float | None = None) -> Result:
        """Wait until the goal ends; return its result. The `outcome` of the result is "done" if the goal succeeded.

        Raises WaitTimeoutError, a TimeoutError, after `timeout` seconds; the goal itself continues. Raises ServiceError
        if the end of the goal is unknown, because the client is closed before the goal ends, the service does not
        answer for SILENT_AFTER_S, the client has missed events and the goal is not in progress, or the service has
        started again. After a silence, and if the goal is still queued, you may wait again.
        """
        within = seconds(timeout)
        ended, unknown = asyncio.create_task(self._ended.wait()), asyncio.create_task(self._wait_until_unknown())
        try:
            await asyncio.wait((ended, unknown), timeout=within, return_when=asyncio.FIRST_COMPLETED)
            if unknown.done() and not self._ended.is_set():
                raise ServiceError(f"the end of goal {self.id} is unknown: {unknown.result()}")
        finally:
            ended.cancel()
            unknown.cancel()
            await asyncio.wait((ended, unknown))
        if self._result is None and self._ended.is_set():
            raise ServiceError(self._lost)
        if self._result is None:
            raise WaitTimeoutError(f"goal {self.id} has not ended within {within:g} s")
        return self._result

    async def _wait_until_unknown(self) -> str:
        """Return the reason why the end of the goal is unknown, once it is.

        Either the service has not answered for SILENT_AFTER_S, or the end may be among events that were missed. Time in
        which this process was suspended does not count.
        """
        silent, since = 0.0, time.monotonic()
        while True:
            await asyncio.sleep(CHECK_PERIOD_S)
            try:
                await self._check()
                if self._missed and await self._is_present():
                    self._missed = ""  # the goal has not ended yet
            except ServiceError as error:
                now = time.monotonic()
                silent, since = silent + min(now - since, MAX_CHECK_PERIODS * CHECK_PERIOD_S), now
                if silent > SILENT_AFTER_S:
                    return str(error)
                continue
            except RefusedError:
                pass  # a refusal is an answer, too
            silent, since = 0.0, time.monotonic()
            if self._missed:
                return (
                    f"the client has missed {self._missed}, and the goal is not in progress; if it is queued, wait "
                    "again, otherwise it has ended: read its outcome in the service's recording"
                )

    def end(self, result: Result | None, reason: str = CLOSED) -> None:
        """Set the result, which is None if it remains unknown for a `reason`, and wake the tasks that wait for it."""
        self._result, self._lost = result, reason
        self._ended.set()


class OpenGoals:
    """Registry of the handles of all goals that a client has sent and that have not ended.

    Calls with the same goal id share a handle. Such calls are the renewals of a jog, and goals that the service refuses
    because their id is already in use. A refusal concerns only one call, so a handle stays registered while another
    call with the same id is pending or accepted.
    """

    def __init__(self) -> None:
        self._handles: dict[str, AsyncGoalHandle] = {}
        self._calls: Counter[str] = Counter()
        self._accepted: set[str] = set()
        self._switches: dict[str, dict[Switch, None]] = {}
        self._runs: list[str] = []
        """Runs of the service from which events have arrived; the newest is last."""

    def __len__(self) -> int:
        return len(self._handles)

    def open(self, handle: AsyncGoalHandle) -> AsyncGoalHandle:
        """Register a goal before it is sent; return its handle, or the existing handle with the same id."""
        self._calls[handle.id] += 1
        return self._handles.setdefault(handle.id, handle)

    def accept(self, handle: AsyncGoalHandle, reply: GoalReply) -> None:
        """Store the reply to an accepted goal; the handle remains registered until the goal ends.

        If the program has blocked the event loop, an event of the next run of the service may come before the reply.
        """
        handle.reply = reply
        self._end_call(handle.id)
        if self._handles.get(handle.id) is handle:  # otherwise the goal has already ended
            self._accepted.add(handle.id)
            if reply.run in self._runs[:-1]:
                self._lose(handle.id)

    def refuse(self, goal_id: str) -> bool:
        """Unregister a call that was refused or not answered. Return True if the handle was removed as well."""
        self._end_call(goal_id)
        if goal_id in self._accepted or goal_id in self._calls:
            return False
        self._switches.pop(goal_id, None)
        return self._handles.pop(goal_id, None) is not None

    def end(self, result: Result) -> None:
        """Set the result of a goal's handle, if the goal is registered."""
        self._accepted.discard(result.id)
        if (handle := self._handles.pop(result.id, None)) is not None:
            handle.end(result._replace(marks=tuple(self._switches.pop(result.id, ()))))

    def close(self) -> None:
        """End the waits for all goals, because no further event arrives."""
        for handle in self._handles.values():
            handle.end(None)

    def lose_others(self, run: str) -> None:
        """End the waits for the goals that an earlier run of the service has accepted, given its present run."""
        self._runs = [*(name for name in self._runs if name != run), run]
        for goal_id in [name for name in self._accepted if self._handles[name].reply.run not in ("", run)]:
            self._lose(goal_id)

    def _lose(self, goal_id: str) -> None:
        """End the wait for an accepted goal of an earlier run of the service."""
        self._accepted.discard(goal_id)
        self._switches.pop(goal_id, None)
        handle = self._handles.pop(goal_id)
        handle.end(None, f"the service has started again: the end of goal {goal_id} is unknown")

    def miss(self, first: int, last: int) -> None:
        """Note that the client has missed the events with the numbers from `first` to `last`."""
        for handle in self._handles.values():
            handle._missed = f"events {first} to {last}"

    def note_switches(self, switches: Iterable[Switch]) -> None:
        """Store output switches for the results of their goals; ignore switches of goals that are not registered.

        Each switch is stored once, although a restarted gateway repeats past events.
        """
        for switch in switches:
            if switch.goal in self._handles:
                self._switches.setdefault(switch.goal, {})[switch] = None

    def _end_call(self, goal_id: str) -> None:
        self._calls[goal_id] -= 1
        if self._calls[goal_id] == 0:
            del self._calls[goal_id]


class AsyncJog:
    """Context manager that moves the robot at a velocity; `result` is available after the context ends.

    A task renews the jog three times per time-out. See trirail.client.blocking.Jog for the time-out and the errors.

    Parameters
    ----------
    send
        Function that sends a goal with an id, such as AsyncRobot.send.
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
        """Error of the last renewal; None if the renewal succeeded or the jog ended at a limit."""

    @property
    def reply(self) -> GoalReply | None:
        """Latest reply of the service, which may contain `slowed`; None before the first reply."""
        return self._goal.reply if self._goal else None

    @property
    def result(self) -> Result | None:
        """Result of the jog; None until the jog ends."""
        return self._goal.result if self._goal else None

    async def __aenter__(self) -> Self:
        self._goal = await self._send(self._velocity, self._timeout)
        # Without the time of this call: after a later stop, the service itself refuses each renewal, with `jog_over`.
        self._renewing = asyncio.create_task(self._renew(), name="jog", context=Context())
        return self

    async def __aexit__(self, *_: object) -> None:
        self._over.set()
        if self._goal is None or self._renewing is None:
            return
        # The brake follows a renewal that has been sent. The reply to that renewal may be late, and this call may be
        # cancelled while it waits.
        braking = asyncio.create_task(self._brake())
        try:
            await asyncio.wait([self._renewing])
            await self._wait_for_end(self._goal, braking)
        finally:
            self._renewing.cancel()
            braking.cancel()

    async def _brake(self) -> None:
        if self.result is None:
            with contextlib.suppress(TrirailError):  # the jog has ended, or its time-out will end it
                await self._send((0.0, 0.0, 0.0), BRAKE_RENEWAL_S)

    async def _wait_for_end(self, goal: AsyncGoalHandle, braking: asyncio.Task[None]) -> None:
        """Wait until the robot is at rest; after a failed renewal, for as long as the jog can last."""
        longest = self._timeout + STANDS_WITHIN
        try:
            async with asyncio.timeout(longest if self.error else None):
                await braking
                await goal.wait(longest)
        except (TrirailError, TimeoutError):
            if self.error is None:
                raise

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
                self.error = None if at_limit else error  # reaching a limit is a regular end
                return

    async def _is_over(self, within: float) -> bool:
        try:
            async with asyncio.timeout(within):
                return await self._over.wait()
        except TimeoutError:
            return False
