"""A moving target that the platform follows, from the side of who sees it."""

from __future__ import annotations

import contextlib
import functools
import itertools
import threading
import time as clocks
from collections.abc import Callable, Sequence
from typing import Generic, Self, TypeVar

from trirail.client.goal import STANDS_WITHIN, AcceptedGoal, GoalHandle, Result
from trirail.errors import RefusalCode, RefusedError, ServiceError, TrirailError
from trirail.wire.goals import Goal, TrackGoal
from trirail.wire.messages import GoalReply

Handle = TypeVar("Handle", bound=AcceptedGoal)
Taker = Callable[[GoalReply | TrirailError], None]
"""What takes the answer to a goal later; called once, by any thread."""


class FollowedTarget(Generic[Handle]):
    """What is known of a target that was sent: how far the robot is behind, and what became of it."""

    def __init__(self, post: Callable[[Goal, Taker], None], goal_id: str, timeout: float) -> None:
        self.id = goal_id
        self._post = post
        self._timeout = timeout
        self._goal: Handle | None = None
        self._lock = threading.Lock()
        self._numbers = itertools.count(1)
        self._answered = 0
        """The newest update that has been answered."""
        self._error: TrirailError | None = None
        self._lag: float | None = None

    @property
    def lag(self) -> float | None:
        """How far a point of the platform was at most from where the target had it [m], as the service last said."""
        return self._lag

    @property
    def result(self) -> Result | None:
        """How it ended, None while it has not."""
        return self._goal.result if self._goal else None

    def _goal_of(self, pose: Sequence[float], velocity: Sequence[float], time: float) -> TrackGoal:
        try:
            (x, y, phi), (vx, vy, w) = pose, velocity
            return TrackGoal(x, y, phi, velocity=(vx, vy, w), time=time, id=self.id, timeout=self._timeout)
        except (TypeError, ValueError) as error:
            raise RefusedError(RefusalCode.MALFORMED, f"not a target: {error}") from error

    def _check(self) -> None:
        """Raise what has become of what was sent before."""
        if (ended := self.result) is not None:
            raise RefusedError(RefusalCode.JOG_OVER, f"the track is over: {ended.message}")
        with self._lock:
            error, self._error = self._error, None
        if error is not None:
            raise error

    def _send(self, goal: Goal) -> None:
        """Send what is not the first, and have its answer taken later."""
        self._post(goal, functools.partial(self._on_answer, next(self._numbers)))

    def _on_answer(self, number: int, answer: GoalReply | TrirailError) -> None:
        """Take what has come of an update; that one was lost on the way is no matter where a later one was answered."""
        with self._lock:
            if isinstance(answer, ServiceError) and number < self._answered:
                return
            self._answered = max(self._answered, number)
            if isinstance(answer, TrirailError):
                self._error = answer
            elif answer.lag is not None:
                self._lag = answer.lag


class Track(FollowedTarget[GoalHandle]):
    """Tells the service where a target is, 10 to 200 times a second; the robot follows it.

    `begin` sends the goal that it is given and returns its handle once it is accepted, as Robot.send does; `post`
    sends one and has what comes of it taken later. Nothing is sent but by `update`: who no longer calls it, for
    whatever reason, has the robot brake on its path after the time-out.
    """

    def __init__(
        self,
        begin: Callable[[Callable[[str], Goal], str], GoalHandle],
        post: Callable[[Goal, Taker], None],
        goal_id: str,
        timeout: float,
    ) -> None:
        super().__init__(post, goal_id, timeout)
        self._begin = begin

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def update(
        self, pose: Sequence[float], velocity: Sequence[float] = (0.0, 0.0, 0.0), time: float | None = None
    ) -> None:
        """Tell where the target was at a time, and how fast it moved: x, y [m], phi [rad], and per second.

        `time` is that of the wall clock [s since 1970], now if absent; on another machine than the service's the
        clocks must agree. Until the next call the robot goes on with that velocity. The first call returns when the
        track is accepted, the others at once: what was refused is raised by the next one. Raises RefusedError, also
        once the track has ended (a stop, a pause, another goal, a time-out), and ServiceError where nobody answers.
        """
        self._check()
        goal = self._goal_of(pose, velocity, clocks.time() if time is None else time)
        if self._goal is None:
            self._goal = self._begin(lambda _: goal, self.id)
            self._lag = self._goal.reply.lag
        else:
            self._send(goal)

    def close(self) -> None:
        """Brake on the path, if the robot still follows; return when it stands."""
        if self._goal is None:
            return
        if self._goal.result is None:
            with contextlib.suppress(RefusedError):  # it has just ended
                self._goal.cancel()
        self._goal.wait(STANDS_WITHIN)
