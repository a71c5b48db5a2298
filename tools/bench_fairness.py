"""What one user's flood costs another: how long goals and stops take to be answered, quiet and flooded by turns.

The flood is eve's, from processes of her own that give way to all else on this machine: as if she were on another. She
sends goals that are planned and refused, commands, questions and junk, with so many messages without an answer at a
time as she gets away with. Ann sends a goal from standstill, stops the robot, and stops it again: the first answer is
that the goal is accepted, the last one, of a robot that stands, that the stop is carried out.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import random
import threading
import time
from collections.abc import Callable, Iterator
from multiprocessing.synchronize import Event
from typing import Any

import zenoh
from bench_rig import QUANTILES, Rig, quantiles
from trirail.client.client import Robot
from trirail.wire import zenoh_session

FLOODERS = 2
SESSIONS = 8
"""Of each of them."""
PENDING = 100
"""Messages of each of them that may be without an answer."""
ROUNDS = 10
"""How often quiet and flood take turns, so that what else the machine does is in both."""
SETTLE = 0.5
"""From the beginning or end of a flood until it is measured [s]."""

MESSAGES: tuple[tuple[str, bytes], ...] = (
    ("goal/eve", b'{"kind": "pose", "x": 0.14, "y": 0.14, "phi": 0.5}'),
    ("goal/eve", b'{"kind": "sliders", "position": [9.0, 0.0, 0.0]}'),
    ("goal/eve", b"junk"),
    ("cmd/eve/resume", b""),
    ("cmd/eve/dance", b""),
    ("info", b""),
)
"""None of them moves the robot: what it does meanwhile would be measured too."""


def flood(locator: str, on: Event, sent: Any) -> None:
    """Flood while `on` is set, until this process is ended; count in `sent`."""
    os.nice(19)
    choice, pending = random.Random(os.getpid()), threading.Semaphore(PENDING)
    sessions = [zenoh_session.open_client(locator) for _ in range(SESSIONS)]
    while on.wait():
        key, payload = choice.choice(MESSAGES)
        pending.acquire()
        answered: zenoh.handlers.Callback[zenoh.Reply] = zenoh.handlers.Callback(
            lambda _: None, drop=pending.release, indirect=False
        )
        with contextlib.suppress(zenoh.ZError):
            choice.choice(sessions).get(f"trirail/demo/{key}", answered, payload=payload, timeout=10.0)
        with sent.get_lock():
            sent.value += 1


@contextlib.contextmanager
def flooders(locator: str) -> Iterator[tuple[Event, Any]]:
    """The processes that flood, at first silent; give what sets them on, and the count of what they have sent."""
    context = multiprocessing.get_context("spawn")
    on, sent = context.Event(), context.Value("Q", 0)
    processes = [context.Process(target=flood, args=(locator, on, sent), daemon=True) for _ in range(FLOODERS)]
    for process in processes:
        process.start()
    try:
        yield on, sent
    finally:
        for process in processes:
            process.kill()
            process.join()


def measure(made: Rig, goals: int, rounds: int = ROUNDS) -> dict[str, Any]:
    """Measure so many goals and stops, half of them flooded; return milliseconds at QUANTILES."""
    choice = random.Random(7)
    took: dict[str, list[float]] = {
        f"{what}_{when}_ms": [] for what in ("goal", "stop") for when in ("quiet", "flooded")
    }
    flooded_for = 0.0
    with flooders(made.locator) as (on, sent):
        _each(made.robot, choice)
        for number in range(2 * rounds):
            when = "flooded" if number % 2 else "quiet"
            if number % 2:
                on.set()
            began = time.monotonic()
            time.sleep(SETTLE)
            for _ in range(max(1, goals // (2 * rounds))):
                goal, stop = _each(made.robot, choice)
                took[f"goal_{when}_ms"].append(1e3 * goal)
                took[f"stop_{when}_ms"].append(1e3 * stop)
            flooded_for += (time.monotonic() - began) * (number % 2)
            on.clear()
        messages = sent.value / flooded_for
    spread = {key: quantiles(values) for key, values in took.items()}
    ratios = {
        f"{what}_p99_ratio": spread[f"{what}_flooded_ms"][1] / spread[f"{what}_quiet_ms"][1]
        for what in ("goal", "stop")
    }
    return {"quantiles": QUANTILES, "messages_per_second": messages, **spread, **ratios}


def _each(robot: Robot, choice: random.Random) -> tuple[float, float]:
    """Send a goal from standstill and stop it; return how long its acceptance took, and a stop at standstill [s]."""
    time.sleep(choice.uniform(0.0, 0.01))  # at any phase of the cycle, and of the flood
    accepted = _timed(lambda: robot.move_to(x=choice.uniform(-0.05, 0.05), y=choice.uniform(-0.05, 0.05), phi=0.0))
    robot.stop()
    return accepted, _timed(robot.stop)


def _timed(do: Callable[[], object]) -> float:
    began = time.monotonic()
    do()
    return time.monotonic() - began
