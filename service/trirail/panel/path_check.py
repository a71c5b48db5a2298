"""Whether a pose can be gone to from where the robot stands, said while it is typed or dragged; the service decides."""

from __future__ import annotations

import threading
from collections.abc import Callable

import numpy as np
from trirail_drivers.interface import Triple

from trirail.errors import KinematicsError
from trirail.telemetry.shown_robot import ShownRobot

LOOKS = 40
"""Poses on the way, straight in pose space, that are looked at, its end first."""
Asked = tuple[Triple, int]
"""A pose, x, y [m] and phi [rad], and the number of the question."""


def problem(robot: ShownRobot, start: Triple, end: Triple) -> str:
    """Return what is in the way from one pose to another, straight in pose space; empty where nothing is known to be.

    Poses are x, y [m] and phi [rad] in the base frame. Positions, passive travel and the singular margin are looked
    at, at LOOKS places; speeds and what the planner finds between them are the service's to judge.
    """
    from trirail.workspace.violations import violations

    for place, share in enumerate(np.linspace(1.0, 0.0, LOOKS, endpoint=False)):
        pose = share * np.asarray(end) + (1.0 - share) * np.asarray(start)
        try:
            found = violations(robot.geometry, robot.limits, pose)
        except KinematicsError as error:
            return f"{error}" if place == 0 else f"on the way: {error}"
        if found:
            return str(found[0]) if place == 0 else f"on the way: {found[0]}"
    return ""


class PathCheck:
    """Answers the newest question of a tab in a thread of its own, that begins with the first one."""

    def __init__(self, find: Callable[[Triple], str], answer: Callable[[int, str], None]) -> None:
        self._find = find
        self._answer = answer
        self._changed = threading.Condition()
        self._asked: Asked | None = None
        self._thread: threading.Thread | None = None
        self._closed = False

    def ask(self, pose: Triple, number: int) -> None:
        """Have it answered; one that still waits is left out for it."""
        with self._changed:
            self._asked = pose, number
            self._changed.notify()
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="path check", daemon=True)
            self._thread.start()

    def close(self) -> None:
        """Answer no more."""
        with self._changed:
            self._closed = True
            self._changed.notify()

    def _run(self) -> None:
        while True:
            with self._changed:
                while self._asked is None and not self._closed:
                    self._changed.wait()
                if self._closed:
                    return
                (pose, number), self._asked = self._asked, None  # type: ignore[misc]
            self._answer(number, self._find(pose))
