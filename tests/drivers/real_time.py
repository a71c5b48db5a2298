"""Cycles of drives in the machine's own time, each as slow as the answers to its SYNC."""

from __future__ import annotations

import os
import time
from collections.abc import Callable

from trirail_drivers.interface import DriveGroup, Feedback
from waiting import WITHIN


def cycle(drives: DriveGroup, position: float = 0.0, *, heard: bool = True) -> Feedback:
    """Run one; where nothing is `heard`, without waiting for answers."""
    drives.sync()
    deadline = time.monotonic() + WITHIN
    while True:
        feedback = drives.read()
        answered = feedback.age == (0, 0, 0)
        if answered or not heard or feedback.fault or time.monotonic() > deadline:
            drives.write((position,) * 3, (0.0,) * 3)
            return feedback
        os.sched_yield()


def cycle_until(drives: DriveGroup, condition: Callable[[Feedback], bool], position: float = 0.0) -> None:
    """Run cycles until something holds."""
    deadline = time.monotonic() + WITHIN
    while not condition(feedback := cycle(drives, position)):
        assert feedback.fault is None, feedback.fault
        assert time.monotonic() < deadline, feedback
