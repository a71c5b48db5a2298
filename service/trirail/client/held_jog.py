"""Hold-to-run jog, which moves the robot while the operator holds a key and ends when no more key events arrive."""

from __future__ import annotations

import threading
import time
import uuid
from collections.abc import Callable

from trirail.client.blocking import GoalHandle
from trirail.client.call_time import called
from trirail.client.goal import BRAKE_RENEWAL_S, Velocity
from trirail.errors import RefusalCode, RefusedError, TrirailError
from trirail.wire.goals import Goal, Tool, VelocityGoal

TIMEOUT = 0.2
"""Time-out after which the service brakes a jog that is not renewed [s]."""

SPEEDS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
"""Speeds that an operator can choose, as fractions of the platform's velocity limits."""
USUAL = 3
"""Index of the initial speed in SPEEDS."""


class HeldJog:
    """Hold-to-run control, in which a thread sends a short velocity goal for each key event.

    Only key events renew the jog. If the program or the network fails, no more key events arrive, and the service
    brakes the robot after TIMEOUT. A key event older than TIMEOUT is discarded. The service may refuse or end a jog,
    for example because of a stop, a limit, or another user's goal. A new jog then begins only after the operator has
    released the key.

    Parameters
    ----------
    send
        Function that sends a goal with an id, such as Robot.send.
    ended
        Function that is called when the service refuses or ends a jog, with the reason in one line.

    """

    def __init__(self, send: Callable[[Callable[[str], Goal], str], GoalHandle], ended: Callable[[str], None]) -> None:
        self._send_goal = send
        self._ended = ended
        self._changed = threading.Condition()
        self._sign: tuple[Velocity, Tool | None, float] | None = None
        self._let_go = False
        self._closed = False
        self._goal: GoalHandle | None = None
        self._tool: Tool | None = None
        self._over = False
        self.error: TrirailError | None = None
        """Error that ended the last jog; None if the service reported the end of the jog without an error."""
        self._thread = threading.Thread(target=self._run, name="held jog", daemon=True)
        self._thread.start()

    def hold(self, velocity: Velocity, tool: Tool | None = None) -> None:
        """Begin or renew the jog because of a key event, with the requested velocity of the tool."""
        with self._changed:
            self._sign = velocity, tool, time.monotonic()
            self._changed.notify()

    def release(self) -> None:
        """End the jog because the key was released; the robot brakes immediately.

        The next key event begins a new jog.
        """
        with self._changed:
            self._sign, self._let_go = None, True
            self._changed.notify()

    def close(self) -> None:
        """End the jog and the thread."""
        with self._changed:
            self._closed = True
        self.release()
        self._thread.join()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._let_go or self._sign is not None)
                let_go, sign = self._let_go, self._sign
                self._let_go, self._sign = False, None
                closed = self._closed
            if let_go:
                self._brake()
            if sign is not None:
                self._renew(*sign)
            if closed:
                return

    def _renew(self, velocity: Velocity, tool: Tool | None, at: float) -> None:
        if self._over or time.monotonic() - at > TIMEOUT:
            return
        if self._goal is not None and self._goal.result is not None:
            self._end(self._goal.result.message, None)
            return
        self._tool = tool
        try:
            with called(at):
                self._goal = self._send(velocity, TIMEOUT)
        except RefusedError as refusal:
            begun = self._goal is not None and refusal.code in (RefusalCode.JOG_OVER, RefusalCode.DUPLICATE_ID)
            self._end("the jog has ended: release, then press again" if begun else str(refusal), refusal)
        except TrirailError as error:
            self._end(str(error), error)

    def _brake(self) -> None:
        goal, self._goal, self._over = self._goal, None, False
        if goal is not None and goal.result is None:
            try:
                self._send((0.0, 0.0, 0.0), BRAKE_RENEWAL_S, goal.id)
            except TrirailError:
                return  # the jog has ended, or its time-out will end it

    def _send(self, velocity: Velocity, timeout: float, goal_id: str | None = None) -> GoalHandle:
        goal_id = goal_id or (self._goal.id if self._goal is not None else uuid.uuid4().hex[:12])
        return self._send_goal(lambda name: VelocityGoal(*velocity, timeout=timeout, id=name, tool=self._tool), goal_id)

    def _end(self, why: str, error: TrirailError | None) -> None:
        self._goal, self._over, self.error = None, True, error
        self._ended(why)
