"""Effect of one user's flood of messages on another user: response times to goals and stops with and without the flood.

The flood comes from user eve. Its processes have the lowest priority, as if they ran on another machine. They send
goals that are planned and refused, commands, queries and junk, with as many unanswered messages at a time as the
service permits. User ann sends a goal from standstill, stops the robot, and stops it again. Measured are the times
until the goal is accepted and until the second stop, of a robot at rest, is executed. Phases with and without flood
alternate.
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
"""Number of sessions of each flooding process."""
PENDING = 100
"""Maximum number of unanswered messages of each flooding process."""
ALTERNATIONS = 10
"""Number of phases without and with flood, which alternate so that other load of the machine affects both equally."""
SETTLE = 0.5
"""Time from the beginning or end of a flood to the measurement [s]."""
BEGIN = 60.0
"""Time limit for the first message after the start of the flood [s]."""

MESSAGES: tuple[tuple[str, bytes], ...] = (
    ("goal/eve", b'{"kind": "pose", "x": 0.14, "y": 0.14, "phi": 0.5}'),
    ("goal/eve", b'{"kind": "sliders", "position": [9.0, 0.0, 0.0]}'),
    ("goal/eve", b"junk"),
    ("cmd/eve/resume", b""),
    ("cmd/eve/dance", b""),
    ("info", b""),
)
"""Messages of the flood. None moves the robot, because its motion would affect the measurement."""


def flood(locator: str, on: Event, sent: Any) -> None:
    """Flood the service while `on` is set, until this process is killed; count the messages in `sent`."""
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
    """Run the flooding processes, which wait at first; yield the event that starts them and the count of messages."""
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


def measure(made: Rig, goals: int, rounds: int = ALTERNATIONS) -> dict[str, Any]:
    """Measure `goals` goals and stops, half of them during the flood; return the times at QUANTILES [ms]."""
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
                _set_on(on, sent)
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


def _set_on(on: Event, sent: Any) -> None:
    """Start the flood and wait for its first message: on a busy machine, processes of low priority start late."""
    before, deadline = sent.value, time.monotonic() + BEGIN
    on.set()
    while sent.value == before:
        if time.monotonic() > deadline:
            raise TimeoutError(f"no message of the flood was sent within {BEGIN:g} s: is the machine busy?")
        time.sleep(0.01)


def _each(robot: Robot, choice: random.Random) -> tuple[float, float]:
    """Send a goal from standstill, and stop twice; return the times of the acceptance and of the second stop [s]."""
    time.sleep(choice.uniform(0.0, 0.01))  # at any phase of the cycle, and of the flood
    accepted = _timed(lambda: robot.move_to(x=choice.uniform(-0.05, 0.05), y=choice.uniform(-0.05, 0.05), phi=0.0))
    robot.stop()
    return accepted, _timed(robot.stop)


def _timed(do: Callable[[], object]) -> float:
    began = time.monotonic()
    do()
    return time.monotonic() - began
