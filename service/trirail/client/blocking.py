"""Event loop in its own thread, and blocking goals, jogs, leases and tracks for other threads."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import AsyncGenerator, Callable, Coroutine, Iterator, Sequence
from concurrent.futures import CancelledError, Future
from typing import Any, Generic, Self, TypeVar

from trirail.client.connection import CLOSED
from trirail.client.goal import AsyncGoalHandle, AsyncJog, Result
from trirail.client.lease import AsyncLease
from trirail.client.outgoing import seconds
from trirail.client.track import AsyncTrack
from trirail.errors import ServiceError, TrirailError
from trirail.wire.messages import GoalReply
from trirail.wire.vocabulary import Command, CommandContent, Stop

T = TypeVar("T")
Held = TypeVar("Held", bound=AsyncJog | AsyncLease | AsyncTrack)


class LoopThread:
    """Event loop in its own thread that runs coroutines for other threads."""

    def __init__(self) -> None:
        self._loop = asyncio.new_event_loop()
        self._lock = threading.Lock()
        self._closed = False
        self._over = asyncio.Event()
        # A daemon, so that a program that never closes its robot still ends.
        self._thread = threading.Thread(target=self._run, name="robot", daemon=True)
        self._thread.start()

    def call(self, coroutine: Coroutine[Any, Any, T]) -> T:
        """Run a coroutine and return its result; an interrupt of the waiting thread, such as Ctrl-C, cancels it.

        Raises ServiceError if the loop is closed before the coroutine ends.
        """
        future = self._submit(coroutine)
        try:
            return future.result()
        except CancelledError:
            raise ServiceError(CLOSED) from None
        except BaseException:
            future.cancel()
            raise

    def start(self, coroutine: Coroutine[Any, Any, object]) -> Future[object]:
        """Run a coroutine in the background and log its errors. Cancelling the future cancels the coroutine.

        Raises ServiceError if the loop is closed.
        """
        future = self._submit(coroutine)
        future.add_done_callback(lambda done: None if done.cancelled() else done.result())
        return future

    def iterate(self, items: AsyncGenerator[T]) -> Iterator[T]:
        """Yield the items of an asynchronous generator; the loop closes it when the caller stops iterating."""

        async def next_item() -> T | None:
            return await anext(items, None)

        while (item := self.call(next_item())) is not None:
            yield item

    def close(self) -> None:
        """End the running coroutines and the thread."""
        with self._lock:
            if not self._closed:
                self._closed = True
                self._loop.call_soon_threadsafe(self._over.set)
        self._thread.join()

    def _submit(self, coroutine: Coroutine[Any, Any, T]) -> Future[T]:
        with self._lock:  # the end of the loop also ends every call that was submitted before
            if self._closed:
                problem = CLOSED
            elif threading.current_thread() is self._thread:
                problem = "a function that the robot calls must not call the robot: call it from another thread"
            else:
                return asyncio.run_coroutine_threadsafe(coroutine, self._loop)
        coroutine.close()
        raise ServiceError(problem)

    def _run(self) -> None:
        with asyncio.Runner(loop_factory=lambda: self._loop) as runner:
            runner.run(self._wait_for_end())

    async def _wait_for_end(self) -> None:
        await self._over.wait()


class GoalHandle:
    """Handle of an accepted goal; discarding the handle does not stop the goal."""

    def __init__(
        self, goal: AsyncGoalHandle, loop: LoopThread, command: Callable[[str, CommandContent], object]
    ) -> None:
        """Set `command`, which sends a command with its content: Robot.command."""
        self._goal = goal
        self._loop = loop
        self._command = command

    def __repr__(self) -> str:
        """Return class, id and, once there is one, the outcome."""
        return repr(self._goal).replace(type(self._goal).__name__, type(self).__name__, 1)

    @property
    def id(self) -> str:
        """Id of the goal."""
        return self._goal.id

    @property
    def reply(self) -> GoalReply:
        """Reply of the service to the goal."""
        return self._goal.reply

    @property
    def result(self) -> Result | None:
        """Result of the goal; None before its end."""
        return self._goal.result

    @property
    def duration(self) -> float | None:
        """Expected time from acceptance to the end of the path, without settling [s]; None at override zero."""
        return self._goal.duration

    @property
    def expected(self) -> str:
        """Expected duration, for people."""
        return self._goal.expected

    def cancel(self) -> None:
        """Stop this goal, whether it is running or queued; return when the robot is at rest or the goal has ended.

        Other goals continue, except those that wait for this one. Raises RefusedError (`no_goal`) if the goal has
        ended, and ServiceError if the service does not answer.
        """
        self._command(Command.STOP, Stop(self.id))

    def wait(self, timeout: float | None = None) -> Result:
        """Wait until the goal ends; return its result, whose `outcome` tells success from failure.

        Raises WaitTimeoutError, a TimeoutError, after `timeout` seconds; the goal itself continues.
        """
        within = seconds(timeout)
        return self._goal.result or self._loop.call(self._goal.wait(within))


class Blocking(Generic[Held]):
    """Blocking wrapper with which other threads can enter and leave a context manager of the event loop."""

    def __init__(self, held: Held, loop: LoopThread) -> None:
        self._held = held
        self._loop = loop

    def __enter__(self) -> Self:
        self._loop.call(self._held.__aenter__())
        return self

    def __exit__(self, *_: object) -> None:
        self._loop.call(self._held.__aexit__())


class Jog(Blocking[AsyncJog]):
    """Jog at a velocity while the context lasts; `result` is available afterwards.

    The client renews the jog three times per time-out, which counts real time at every override: if the program hangs
    or dies, the robot brakes. A jog that was paused or has timed out has ended; begin a new one. Leaving the context
    brakes immediately and waits until the robot is at rest.

    Raises RefusedError on entering if the service refuses the jog, and TimeoutError on leaving if the service does not
    report the jog's end.
    """

    @property
    def reply(self) -> GoalReply | None:
        """Latest reply of the service, with `slowed` for one; None before the first."""
        return self._held.reply

    @property
    def result(self) -> Result | None:
        """Result of the goal; None before its end."""
        return self._held.result

    @property
    def error(self) -> Exception | None:
        """Error of the last renewal, if it failed."""
        return self._held.error


class Lease(Blocking[AsyncLease]):
    """Lease held while the context lasts; `lost` is the error if it was taken over, released or timed out earlier.

    Entering returns when the motions of other users have stopped. If the program hangs or dies, the lease is not
    renewed; the robot then stops and the lease is released. Leaving releases the lease, and returns when the robot is
    at rest.

    Raises RefusedError on entering if another client holds the lease.
    """

    @property
    def lost(self) -> TrirailError | None:
        """Error that ended the lease; None while it is held."""
        return self._held.lost

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until the lease is lost, for at most `timeout` seconds; return whether it is."""
        return self._loop.call(self._held.wait(timeout))

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(ServiceError):  # the connection is closed, so the wait ends with its time-out
            super().__exit__()


class Track(Blocking[AsyncTrack]):
    """Sender of a target's pose, 10 to 200 times a second; the robot follows the target.

    Only `update` sends messages. If its calls cease for any reason, the robot brakes on its path after the time-out.
    """

    @property
    def id(self) -> str:
        """Id of the track's goal."""
        return self._held.id

    @property
    def lag(self) -> float | None:
        """Greatest distance between a point of the platform and its place at the target, in the latest reply [m]."""
        return self._held.lag

    @property
    def result(self) -> Result | None:
        """Result of the goal; None before its end."""
        return self._held.result

    def update(
        self, pose: Sequence[float], velocity: Sequence[float] = (0.0, 0.0, 0.0), time: float | None = None
    ) -> None:
        """Send the target's pose x, y [m], phi [rad] and its velocity [m/s, m/s, rad/s] at a time.

        `time` is wall-clock time [s since 1970] and defaults to now; the clocks must agree if the service runs on
        another machine. The robot keeps the velocity until the next call. The first call returns when the service
        accepts the track. Later calls return immediately, so the next call raises an earlier refusal. Raises
        RefusedError, also if the track has ended because of a stop, a pause, another goal or a time-out, and
        ServiceError if the service does not answer.
        """
        self._loop.call(self._held.update(pose, velocity, time))

    def close(self) -> None:
        """Brake on the path if the robot still follows; return when it is at rest."""
        self._loop.call(self._held.close())
