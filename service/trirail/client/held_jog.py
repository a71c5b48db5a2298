"""Hold-to-run jog: it runs while the operator's key is held, and ends when key events cease."""

from __future__ import annotations

import threading
import time
import uuid
from collections.abc import Callable

from trirail.client.blocking import GoalHandle
from trirail.client.goal import BRAKE_RENEWAL_S, Velocity
from trirail.errors import RefusalCode, RefusedError, TrirailError
from trirail.wire.goals import Goal, Tool, VelocityGoal

TIMEOUT = 0.2
"""Time-out after which the service brakes a jog that is not renewed [s]."""

SPEEDS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
"""Speeds that an operator can choose: shares of the platform's velocity limits."""
USUAL = 3
"""Index of the initial speed."""


class HeldJog:
    """Hold-to-run control: a thread sends a short velocity goal for each key event.

    Only key events renew the jog. When the key is released or the program or the network fails, the service's time-out
    brakes the robot. A key event older than that time-out is discarded. After the service has refused or ended a jog
    (with a stop, at a limit, or for another user's goal), a new jog begins only after the key was released.

    Parameters
    ----------
    send
        Function that sends a goal with an id, such as Robot.send.
    ended
        Function that is called with the reason for the end, in one line.

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
        """Error that ended the last jog; None if the service ended it for another reason."""
        self._thread = threading.Thread(target=self._run, name="held jog", daemon=True)
        self._thread.start()

    def hold(self, velocity: Velocity, tool: Tool | None = None) -> None:
        """Extend the jog on a key event, with the requested velocity of the tool."""
        with self._changed:
            self._sign = velocity, tool, time.monotonic()
            self._changed.notify()

    def release(self) -> None:
        """End the jog on release: the robot brakes immediately, and the next key event begins a new jog."""
        with self._changed:
            self._sign, self._let_go = None, True
            self._changed.notify()

    def close(self) -> None:
        """Release the jog, and end the thread."""
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
                return  # it has ended, or will by its time-out

    def _send(self, velocity: Velocity, timeout: float, goal_id: str | None = None) -> GoalHandle:
        goal_id = goal_id or (self._goal.id if self._goal is not None else uuid.uuid4().hex[:12])
        return self._send_goal(lambda name: VelocityGoal(*velocity, timeout=timeout, id=name, tool=self._tool), goal_id)

    def _end(self, why: str, error: TrirailError | None) -> None:
        self._goal, self._over, self.error = None, True, error
        self._ended(why)
