"""A jog that an operator holds: it lasts while signs of the hand keep coming, and ends when they cease."""

from __future__ import annotations

import threading
import time
import uuid
from collections.abc import Callable

from trirail.client.goal import LETTING_GO, GoalHandle, Velocity
from trirail.errors import RefusalCode, RefusedError, TrirailError
from trirail.wire.goals import Goal, Tool, VelocityGoal

TIMEOUT = 0.2
"""Real time after which the service brakes a jog that is not renewed [s]."""

SPEEDS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
"""What an operator chooses from: shares of the platform's velocity limits."""
USUAL = 3
"""Which of them it is until another is chosen."""


class HeldJog:
    """Sends each sign of the hand on as a short velocity goal, in a thread of its own; the service is the dead man.

    Nothing is renewed without a sign: where the hand, the program or the network is gone, the service's own time-out
    brakes. A sign that has waited for longer than that time-out is thrown away. A jog that the service has refused or
    ended (a stop, a limit, a goal of somebody else) does not begin again before the hand has let go; `ended` is told
    why, in one line. `send` sends a goal that it is given the id for, as Robot.send does.
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
        self._thread = threading.Thread(target=self._run, name="held jog", daemon=True)
        self._thread.start()

    def hold(self, velocity: Velocity, tool: Tool | None = None) -> None:
        """Take a sign of the hand: it wants this velocity now, of this tool."""
        with self._changed:
            self._sign = velocity, tool, time.monotonic()
            self._changed.notify()

    def release(self) -> None:
        """Take in that the hand has let go: the robot brakes at once, and the next sign begins a new jog."""
        with self._changed:
            self._sign, self._let_go = None, True
            self._changed.notify()

    def close(self) -> None:
        """Let go, for good."""
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
            self._end(self._goal.result.message)
            return
        self._tool = tool
        try:
            self._goal = self._send(velocity, TIMEOUT)
        except RefusedError as refusal:
            begun = self._goal is not None and refusal.code in (RefusalCode.JOG_OVER, RefusalCode.DUPLICATE_ID)
            self._end("the jog has ended: let go, then press again" if begun else str(refusal))
        except TrirailError as error:
            self._end(str(error))

    def _brake(self) -> None:
        goal, self._goal, self._over = self._goal, None, False
        if goal is not None and goal.result is None:
            try:
                self._send((0.0, 0.0, 0.0), LETTING_GO, goal.id)
            except TrirailError:
                return  # it has ended, or does by its time-out

    def _send(self, velocity: Velocity, timeout: float, goal_id: str | None = None) -> GoalHandle:
        goal_id = goal_id or (self._goal.id if self._goal is not None else uuid.uuid4().hex[:12])
        return self._send_goal(lambda name: VelocityGoal(*velocity, timeout=timeout, id=name, tool=self._tool), goal_id)

    def _end(self, why: str) -> None:
        self._goal, self._over = None, True
        self._ended(why)
