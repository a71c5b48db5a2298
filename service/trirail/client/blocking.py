"""Event loop in a separate thread, and blocking handles of goals, jogs, leases and tracks for other threads."""

from __future__ import annotations

import asyncio
import contextlib
import os
import threading
import weakref
from collections.abc import AsyncGenerator, Callable, Coroutine, Iterator, Sequence
from concurrent.futures import CancelledError, Future
from typing import Any, Generic, Self, TypeVar

from trirail.client.call_time import called, called_at
from trirail.client.connection import CLOSED, FORKED
from trirail.client.goal import AsyncGoalHandle, AsyncJog, Result
from trirail.client.lease import AsyncLease
from trirail.client.outgoing import seconds
from trirail.client.track import AsyncTrack
from trirail.errors import ServiceError, TrirailError
from trirail.wire.messages import GoalReply
from trirail.wire.vocabulary import Command, CommandContent, Stop

T = TypeVar("T")
Held = TypeVar("Held", bound=AsyncJog | AsyncLease | AsyncTrack)


CANCELLED_WITHIN = 1.0
"""Maximum time for which an interrupted call waits until its coroutine has ended or is undone [s]."""


_callback = threading.local()
"""Whether the thread is calling a function of the program, for which the connection waits."""


def callback(deliver: Callable[[bytes], None]) -> Callable[[bytes], None]:
    """Return a function that calls `deliver`, and in which calls of the robot raise ServiceError."""

    def call(data: bytes) -> None:
        _callback.runs = True
        try:
            deliver(data)
        finally:
            _callback.runs = False

    return call


class _Call(Generic[T]):
    """Coroutine that the event loop runs for another thread. The result is handed over in `future`, or undone."""

    def __init__(
        self,
        coroutine: Coroutine[Any, Any, T],
        undo: Callable[[], Coroutine[Any, Any, object]] | None = None,
        at: float | None = None,
    ) -> None:
        self.future: Future[T] = Future()
        self._coroutine = coroutine
        self._undo = undo
        self._task: asyncio.Task[T] | None = None
        self._called_at = called_at() if at is None else at

    def start(self) -> None:
        """Start the coroutine. Call this function in the event loop."""
        with called(self._called_at):
            self._task = asyncio.get_running_loop().create_task(self._coroutine)
        self._task.add_done_callback(self._set_outcome)

    def discard(self) -> None:
        """Close the coroutine, which has not been started."""
        self._coroutine.close()

    async def abandon(self) -> None:
        """Cancel the coroutine. If it was not started, or has already ended without an error, undo it."""
        if self._task is None:
            self.discard()
        else:
            self._task.cancel()
            await asyncio.wait([self._task])
            if self._task.cancelled() or self._task.exception() is not None:
                return
        if self._undo is not None:
            await self._undo()

    def _set_outcome(self, task: asyncio.Task[T]) -> None:
        if task.cancelled():
            self.future.cancel()
        elif (error := task.exception()) is not None:
            self.future.set_exception(error)
        else:
            self.future.set_result(task.result())


class LoopThread:
    """Separate thread with an event loop that runs coroutines for other threads, and for signal handlers."""

    def __init__(self) -> None:
        self._loop = asyncio.new_event_loop()
        self._lock = threading.RLock()  # a signal handler may call the robot while its thread holds the lock
        self._closed = False
        self._over = asyncio.Event()
        self._ended: Future[None] = Future()
        self._process = os.getpid()
        # A daemon, so that a program that never closes its robot still ends.
        self._thread = threading.Thread(target=self._run, name="robot", daemon=True)
        self._thread.start()

    def call(
        self,
        coroutine: Coroutine[Any, Any, T],
        undo: Callable[[], Coroutine[Any, Any, object]] | None = None,
        *,
        at: float | None = None,
    ) -> T:
        """Run a coroutine and return its result. An exception in the waiting thread, such as Ctrl-C, cancels it.

        `at` is the time at which the program called for the coroutine [s]; by default, that of `called_at`.

        If such an exception arrives before the coroutine starts or after it ends, the coroutine function `undo` is run
        instead, so that the result is either returned or undone. A cancelled coroutine may still send a stop, so the
        call waits a short time for its end. Raises ServiceError if the loop is closed before the coroutine ends.
        """
        call = _Call(coroutine, undo, at)
        if threading.current_thread() is self._thread or getattr(_callback, "runs", False):
            call.discard()
            raise ServiceError("a function that the robot calls must not call the robot: call it from another thread")
        try:
            self._submit(call)
            return call.future.result()
        except CancelledError:
            raise ServiceError(CLOSED) from None
        except BaseException:
            if not call.future.done() or call.future.exception() is None:
                with contextlib.suppress(TrirailError, TimeoutError, CancelledError):
                    abandoning = _Call(call.abandon())
                    self._submit(abandoning)
                    abandoning.future.result(CANCELLED_WITHIN)
            raise

    def start(self, coroutine: Coroutine[Any, Any, object]) -> Callable[[], None]:
        """Run a coroutine in the background and log its errors. Return a function that cancels the coroutine.

        Raises ServiceError if the loop is closed.
        """
        call = _Call(coroutine)
        call.future.add_done_callback(lambda done: None if done.cancelled() else done.result())
        self._submit(call)

        def cancel() -> None:
            with contextlib.suppress(ServiceError):  # the loop has ended, and the coroutine with it
                self._submit(_Call(call.abandon()))

        return cancel

    def iterate(self, items: AsyncGenerator[T]) -> Iterator[T]:
        """Yield the items of an asynchronous generator; the loop closes it when the caller stops iterating."""

        async def next_item() -> T | None:
            return await anext(items, None)

        while (item := self.call(next_item())) is not None:
            yield item

    def close(self) -> None:
        """End the running coroutines and the thread."""
        if os.getpid() != self._process:  # a forked process has no such thread
            return
        with self._lock:
            if not self._closed:
                self._closed = True
                self._loop.call_soon_threadsafe(self._over.set)
        self._ended.result()  # unlike Thread.join, it may be interrupted by a signal handler that calls this method

    def _submit(self, call: _Call[Any]) -> None:
        """Start a call in the event loop. If that is impossible, discard the call and raise ServiceError."""
        if os.getpid() != self._process:
            problem = FORKED
        else:
            with self._lock:  # the end of the loop also ends every call that was submitted before
                if not self._closed:
                    self._loop.call_soon_threadsafe(call.start)
                    return
            problem = CLOSED
        call.discard()
        raise ServiceError(problem)

    def _run(self) -> None:
        with asyncio.Runner(loop_factory=lambda: self._loop) as runner:
            runner.run(self._wait_for_end())
        self._ended.set_result(None)

    async def _wait_for_end(self) -> None:
        await self._over.wait()


class GoalHandle:
    """Handle of an accepted goal; discarding the handle does not stop the goal."""

    def __init__(
        self, goal: AsyncGoalHandle, loop: LoopThread, command: Callable[[str, CommandContent], object]
    ) -> None:
        """Create the handle; `command` is a function that sends a command with its content, such as Robot.command."""
        self._goal = goal
        self._loop = loop
        self._command = command

    def __repr__(self) -> str:
        """Return the class name and id, and the outcome once the goal has ended."""
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
        """Expected duration as text, for people."""
        return self._goal.expected

    def cancel(self) -> None:
        """Stop this goal, running or queued; return when the robot is at rest or the goal has ended.

        Other goals continue, except goals that wait for this goal. Raises RefusedError (`no_goal`) if the goal has
        already ended, and ServiceError if the service does not answer.
        """
        self._command(Command.STOP, Stop(self.id))

    def wait(self, timeout: float | None = None) -> Result:
        """Wait until the goal ends; return its result. The `outcome` of the result is "done" if the goal succeeded.

        Raises WaitTimeoutError, a TimeoutError, after `timeout` seconds; the goal itself continues. Raises ServiceError
        if the end of the goal is unknown, as in AsyncGoalHandle.wait.
        """
        within = seconds(timeout)
        return self._goal.result or self._loop.call(self._goal.wait(within))


class Blocking(Generic[Held]):
    """Wrapper with which other threads enter and leave a context manager of the event loop; both calls block."""

    def __init__(self, held: Held, loop: LoopThread) -> None:
        self._held = held
        self._loop = loop

    def __enter__(self) -> Self:
        self._loop.call(self._enter(), self._held.__aexit__)
        return self

    def __exit__(self, *_: object) -> None:
        self._loop.call(self._held.__aexit__(), self._held.__aexit__)
        self._discarded.detach()

    async def _enter(self) -> None:
        await self._held.__aenter__()
        # An exception such as Ctrl-C may prevent the call of __exit__. The context then ends when it is discarded.
        self._discarded = weakref.finalize(self, _leave, self._held, self._loop)
        self._discarded.atexit = False


def _leave(held: AsyncJog | AsyncLease | AsyncTrack, loop: LoopThread) -> None:
    """Leave a context without waiting for the robot's rest."""
    with contextlib.suppress(ServiceError):  # the connection is closed
        loop.start(held.__aexit__())


class Jog(Blocking[AsyncJog]):
    """Context manager that moves the robot at a velocity; `result` is available after the context ends.

    A thread of the client renews the jog three times per time-out, and the time-out counts real time whatever the
    override is. If the program dies or loses its connection, the robot brakes. If only the thread that entered the
    context hangs, the robot continues to move: use Robot.track, which brakes when the program stops calling `update`.

    A pause or a time-out ends a jog; begin a new jog afterwards. Leaving the context makes the robot brake immediately,
    and waits until the robot is at rest.

    Entering the context raises RefusedError if the service refuses the jog. Leaving the context raises TimeoutError if
    the service does not report the jog's end.
    """

    @property
    def reply(self) -> GoalReply | None:
        """Latest reply of the service, which may contain `slowed`; None before the first reply."""
        return self._held.reply

    @property
    def result(self) -> Result | None:
        """Result of the goal; None before its end."""
        return self._held.result

    @property
    def error(self) -> Exception | None:
        """Error of the last renewal; None if the renewal succeeded."""
        return self._held.error


class Lease(Blocking[AsyncLease]):
    """Context manager that holds the lease; `lost` is the error if the lease ends before the context does.

    A lease ends early if it is taken over, released or timed out. Entering the context waits until the motions of other
    users have stopped. A thread of the client renews the lease. If the program dies or loses its connection, the robot
    stops and the lease is released. If only the thread that entered the context hangs, the lease continues. Leaving the
    context releases the lease, and waits until the robot is at rest.

    Entering the context raises RefusedError if another client holds the lease.
    """

    @property
    def lost(self) -> TrirailError | None:
        """Error that ended the lease; None while it is held."""
        return self._held.lost

    def wait(self, timeout: float | None = None) -> bool:
        """Wait at most `timeout` seconds for the lease to end. Return True if it has ended."""
        return self._loop.call(self._held.wait(timeout))

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(ServiceError):  # the connection is closed, so the lease ends after its time-out
            super().__exit__()


class Track(Blocking[AsyncTrack]):
    """Context manager in which the robot follows a moving target; the program calls `update` 10 to 200 times a second.

    Only `update` sends messages. If the program stops calling `update` for any reason, the robot brakes on its path
    after the time-out.
    """

    @property
    def id(self) -> str:
        """Id of the track's goal."""
        return self._held.id

    @property
    def lag(self) -> float | None:
        """Greatest distance of a point of the platform from its place at the target [m], from the latest reply."""
        return self._held.lag

    @property
    def result(self) -> Result | None:
        """Result of the goal; None before its end."""
        return self._held.result

    def update(
        self, pose: Sequence[float], velocity: Sequence[float] = (0.0, 0.0, 0.0), time: float | None = None
    ) -> None:
        """Send the target's pose x, y [m], phi [rad] and its velocity [m/s, m/s, rad/s] at a time.

        `time` is wall-clock time [s since 1970] and defaults to now. If the service runs on another machine, the clocks
        of the two machines must agree. Until the next call, the service assumes that the target moves at this velocity.

        The first call returns when the service accepts the track. Later calls return immediately, and the error of such
        a call is raised by the call after it. Raises RefusedError if the service refuses an update, or if a stop, a
        pause, another goal or a time-out has ended the track. Raises ServiceError if the service does not answer.
        """
        self._loop.call(self._held.update(pose, velocity, time))

    def close(self) -> None:
        """Brake on the path if the robot still follows the target; return when the robot is at rest."""
        self._loop.call(self._held.close())
