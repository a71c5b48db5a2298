"""Keeping a robot in motion while something is measured."""

from __future__ import annotations

import random
import sys
import time

from trirail.client.client import Robot
from trirail.errors import TrirailError

SPAN = (0.05, 0.05, 0.4)
"""Goals lie so far from the middle [m, m, rad]."""
EVERY = 0.3
"""Time between goals: less than one takes [s]."""


def keep_moving(robot: Robot, seconds: float) -> None:
    """Send goal after goal; at a terminal, say how long it takes yet."""
    choice = random.Random(1)
    shown = sys.stderr.isatty()
    end = time.monotonic() + seconds
    while (left := end - time.monotonic()) > 0.0:
        if shown:
            print(f"\r{left:4.0f} s left ", end="", file=sys.stderr, flush=True)
        x, y, phi = (choice.uniform(-span, span) for span in SPAN)
        try:
            robot.move_to(x=x, y=y, phi=phi)
        except TrirailError as error:
            print(error, file=sys.stderr)
        time.sleep(EVERY)
    if shown:
        print("\r", end="", file=sys.stderr)
