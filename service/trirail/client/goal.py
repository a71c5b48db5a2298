"""What a client holds of a goal that the service has accepted: how it goes on, and how it ended."""

from __future__ import annotations

import contextlib
import threading
import uuid
from collections.abc import Callable
from typing import Generic, NamedTuple, Self, TypeVar

import msgspec

from trirail.client.outgoing import number, seconds
from trirail.errors import RefusalCode, RefusedError, TrirailError
from trirail.wire.goals import Goal, Tool, VelocityGoal
from trirail.wire.messages import GoalReply, Residual
from trirail.wire.vocabulary import Command, Stop

STANDS_WITHIN = 10.0
"""How long the end of a jog may take beyond its own time-out [s]."""
LETTING_GO = 0.05
"""The time-out of a jog's last renewal, whose velocity is zero: it brakes at once [s]."""

Velocity = tuple[float, float, float]
"""Of x, y [m/s] and phi [rad/s], in the base frame."""


class Result(NamedTuple):
    """How a goal ended; every goal does, exactly once."""

    id: str
    outcome: str
    """done, rejected, preempted, stopped, expired, faulted or unsettled."""
    message: str
    """One line for people: why."""
    settle: float | None = None
    """Where it is done: time from the end of its path until the robot was in position, to the first cycle of the dwell
    [s]. None, as the two below, where it was not to settle: a jog, a goal that was passed on the way to the next, a
    trajectory with `settle` False."""
    residual: Residual | None = None
    """How far the robot was from the target when it ended, done or unsettled: `sliders` [m], and `pose` [m, m, rad]."""
    overshoot: tuple[float, float, float] | None = None
    """How far the sliders A, B, C were beyond their targets at most since the end of the path [m]."""


class AcceptedGoal:
    """What is known of a goal that the service has accepted. It is the service's from then on."""

    def __init__(self, goal_id: str) -> None:
        self.id = goal_id
        self.reply = GoalReply(goal_id, 0.0)
        """What the service said of it."""
        self._result: Result | None = None

    @property
    def result(self) -> Result | None:
        """How it ended, None while it has not."""
        return self._result

    @property
    def duration(self) -> float | None:
        """Expected time from acceptance to the end of its path [s], to which settling adds; None while the override is
        zero."""
        return self.reply.duration

    @property
    def expected(self) -> str:
        """How long it is expected to take, for people."""
        return f"{self.duration:.2f} s" if self.duration is not None else "no expected end while the override is 0"


class GoalHandle(AcceptedGoal):
    """A goal that the service has accepted: this object only follows it.

    `command` sends a command with its content, as Robot.command does.
    """

    def __init__(self, goal_id: str, command: Callable[[Command, bytes], object]) -> None:
        super().__init__(goal_id)
        self._command = command
        self._ended = threading.Event()

    def cancel(self) -> None:
        """Stop it, if it is under way or waits for another one; return when the robot stands, or it waits no more.

        Other goals go on, but those that wait for this one. Raises RefusedError (`no_goal`) if it has ended,
        ServiceError if nobody answers.
        """
        self._command(Command.STOP, msgspec.json.encode(Stop(self.id)))

    def wait(self, timeout: float | None = None) -> Result:
        """Wait for its end, however it ends; look at `outcome` of the result.

        Raises TimeoutError if that takes longer than `timeout` seconds; the goal itself goes on.
        """
        within = seconds(timeout)
        if not self._ended.wait(within) or self._result is None:
            raise TimeoutError(f"goal {self.id} has not ended within {within:g} s")
        return self._result

    def end(self, result: Result) -> None:
        """Take in how it ended; the connection's own thread does that."""
        self._result = result
        self._ended.set()


Handle = TypeVar("Handle", bound=AcceptedGoal)


class HeldVelocity(Generic[Handle]):
    """A jog, whether a thread or a task renews it: what is sent of it, and what the service says."""

    def __init__(self, velocity: Velocity, timeout: float, tool: Tool | None) -> None:
        self._velocity = velocity
        self._timeout = number(timeout, "timeout")
        self._tool = tool
        self._id = uuid.uuid4().hex[:12]
        self._goal: Handle | None = None
        self.error: Exception | None = None
        """Why it could not be renewed any more."""

    @property
    def reply(self) -> GoalReply | None:
        """What the service last said of it, None before it was taken: how much it is `slowed`, for one."""
        return self._goal.reply if self._goal else None

    @property
    def result(self) -> Result | None:
        """How it ended, None while it has not."""
        return self._goal.result if self._goal else None

    @property
    def _moves(self) -> bool:
        return self._goal is not None and self.result is None and self.error is None

    def _message(self, velocity: Velocity, timeout: float) -> Callable[[str], Goal]:
        return lambda name: VelocityGoal(*velocity, timeout=timeout, id=name, tool=self._tool)

    def _renewal_failed(self, error: TrirailError) -> None:
        at_limit = isinstance(error, RefusedError) and error.code is RefusalCode.AT_LIMIT
        self.error = None if at_limit else error  # at a limit it has ended as it should


class Jog(HeldVelocity[GoalHandle]):
    """A velocity that is kept alive while the context lasts; `result` tells afterwards how it ended.

    It is renewed three times in each time-out, by a thread of its own. A program that hangs or dies renews it no more,
    and the robot brakes: the time-out is real time, at every override. What has run out or was paused is over; begin
    a new one. `error` tells whether it could not be renewed. Leaving the context brakes at once and waits for the
    standstill.

    `velocity` is that of x, y [m/s] and phi [rad/s] in the base frame, of a `tool`, `timeout` in seconds. Entering the
    context raises RefusedError where the service does not take it, leaving it TimeoutError where no end is heard.
    `send` sends a goal that it is given the id for, as Robot.send does.
    """

    def __init__(
        self,
        send: Callable[[Callable[[str], Goal], str], GoalHandle],
        velocity: Velocity,
        timeout: float,
        tool: Tool | None = None,
    ) -> None:
        super().__init__(velocity, timeout, tool)
        self._send_goal = send
        self._over = threading.Event()
        self._renewing = threading.Thread(target=self._renew, name="jog", daemon=True)

    def __enter__(self) -> Self:
        self._goal = self._send(self._velocity, self._timeout)
        self._renewing.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._renewing.join()
        if self._goal is not None and self._moves:
            with contextlib.suppress(TrirailError):  # it has ended, or does by its time-out
                self._send((0.0, 0.0, 0.0), LETTING_GO)
            self._goal.wait(self._timeout + STANDS_WITHIN)

    def _send(self, velocity: Velocity, timeout: float) -> GoalHandle:
        return self._send_goal(self._message(velocity, timeout), self._id)

    def _renew(self) -> None:
        while not self._over.wait(self._timeout / 3.0):
            try:
                self._send(self._velocity, self._timeout)
            except TrirailError as error:
                self._renewal_failed(error)
                return
