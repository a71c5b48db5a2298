"""Time from the sending of a goal to the first setpoint that the goal changes, as seen by a listener on the bus.

The time is measured at rest and in motion. In motion, the robot moves along a straight line at constant speed, so that
the velocity feed-forward of each slider is constant until a goal reverses the motion. The process of the drives
forwards the setpoints to the listener, where the kernel records the time of arrival. The time of a goal is that before
the client's call.
"""

from __future__ import annotations

import contextlib
import random
import socket
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

from bench_rig import QUANTILES, Rig, quantiles
from trirail.client.client import Robot
from trirail.errors import TrirailError
from trirail_drivers.bus.can_frame import CAN_FRAME, CAPTURED
from trirail_drivers.bus.capture import Capture
from trirail_drivers.bus.frame_io import SocketFrames
from trirail_drivers.bus.unixbus import UnixBus
from trirail_drivers.cia402 import canopen_frames as layout
from trirail_drivers.interface import NAMES

SETPOINTS = {layout.RPDO2 + node for node in range(1, 1 + len(NAMES))}
STEADY = 20
"""Maximum change of the feed-forward by rounding, at constant speed and 1e7 counts per metre [counts/s]."""
CHANGE_TIMEOUT_S = 0.1
"""Time limit for a change of the setpoints [s]. Goals without a change in this time are counted but not averaged."""
END = 0.08
"""Largest x coordinate of the goals, between -END and END [m]."""


class Setpoint(NamedTuple):
    """Setpoint that was sent on the bus."""

    t: float
    """Time since 1970 [s]."""
    identifier: int
    velocity: int
    """Velocity feed-forward [counts/s]."""


class Listener:
    """Listener on the bus, which stores every frame with its time of arrival."""

    def __init__(self, path: str) -> None:
        self._bus = UnixBus(path)
        if self._bus.carrier is None:
            raise SystemExit(f"{path}: nobody listens there")
        self._bus.carrier.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
        self._capture = Capture()
        self._frames = SocketFrames(self._bus.carrier, self._capture)
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._listen)
        self._thread.start()

    def _listen(self) -> None:
        while not self._over.is_set():
            self._frames.receive(0.1)

    def setpoints(self) -> list[Setpoint]:
        """Return the setpoints that have arrived since the last call."""
        return [
            Setpoint(t, identifier, layout.SETPOINT.unpack(data)[1])
            for t, identifier, data in self._new_frames()
            if identifier in SETPOINTS
        ]

    def _new_frames(self) -> Iterator[tuple[float, int, bytes]]:
        for chunk in self._capture.drain():
            for t, frame in CAPTURED.iter_unpack(chunk):
                identifier, _, data = CAN_FRAME.unpack(frame)
                yield t, identifier, data

    def close(self) -> None:
        """Leave the bus."""
        self._over.set()
        self._thread.join()
        self._bus.shutdown()


@contextlib.contextmanager
def listener(path: str) -> Iterator[Listener]:
    """Run a listener on the bus at `path`."""
    made = Listener(path)
    try:
        yield made
    finally:
        made.close()


Measured = Callable[[Robot, Listener, random.Random], float | None]
"""Function that measures the time for one goal [s]; it returns None if the goal changed no setpoint in time."""


def measure(made: Rig, goals: int) -> dict[str, Any]:
    """Send `goals` goals at rest, and as many in motion; return the times at QUANTILES [ms]."""
    chance = random.Random(3)
    with listener(made.bus) as heard:
        at_rest = _each(goals, made.robot, heard, chance, _at_rest)
        in_motion = _each(goals, made.robot, heard, chance, _in_motion)
    return {
        "quantiles": QUANTILES,
        "at_rest_ms": quantiles_ms(at_rest),
        "in_motion_ms": quantiles_ms(in_motion),
        "goals": goals,
        "without_effect": at_rest.count(None) + in_motion.count(None),
    }


def quantiles_ms(latencies: list[float | None]) -> list[float]:
    """Return the times at QUANTILES [ms]. A goal without effect counts with the longest time, CHANGE_TIMEOUT_S."""
    return quantiles([1e3 * (CHANGE_TIMEOUT_S if value is None else value) for value in latencies])


def _each(goals: int, robot: Robot, heard: Listener, chance: random.Random, measured: Measured) -> list[float | None]:
    """Measure `goals` goals. A goal counts as without effect if a stall of the machine causes a fault of the drives."""
    latencies: list[float | None] = []
    ready = False
    for _ in range(goals):
        try:
            if not ready:
                if robot.state().mode == "fault":
                    robot.reset()
                    robot.enable()
                robot.move_to(x=-END, y=0.0, phi=0.0).wait(10.0)
                ready = True
            latencies.append(measured(robot, heard, chance))
        except TrirailError:
            latencies.append(None)
            ready = False
    return latencies


def _at_rest(robot: Robot, heard: Listener, chance: random.Random) -> float | None:
    """Measure a small goal from standstill, and wait for its end."""
    heard.setpoints()
    time.sleep(chance.uniform(0.02, 0.04))  # at any phase of the cycle, and after some earlier setpoints
    put = time.time()
    goal = robot.move_to(x=-END + chance.uniform(0.0, 0.004), y=chance.uniform(-0.004, 0.004), phi=0.0)
    time.sleep(CHANGE_TIMEOUT_S)
    latency = first_change(heard.setpoints(), put)
    goal.wait(10.0)
    return latency


def _in_motion(robot: Robot, heard: Listener, chance: random.Random) -> float | None:
    """Measure a goal that reverses the motion of a previous goal."""
    state = robot.state()
    side = 1.0 if state.commanded.pose[0] < 0.0 else -1.0
    robot.move_to(x=side * END, y=0.0, phi=0.0)
    time.sleep(0.32 + chance.uniform(0.0, 0.02))
    heard.setpoints()
    time.sleep(0.02)
    put = time.time()
    goal = robot.move_to(x=-side * END, y=0.0, phi=0.0)
    time.sleep(CHANGE_TIMEOUT_S)
    latency = first_change(heard.setpoints(), put)
    with contextlib.suppress(TrirailError):
        goal.wait(10.0)
    return latency


def first_change(setpoints: list[Setpoint], put: float) -> float | None:
    """Return the time from `put` to the first setpoint with a different feed-forward [s]; None if there is none."""
    steady = {one.identifier: one.velocity for one in setpoints if one.t <= put}
    for one in setpoints:
        if one.t <= put or one.identifier not in steady:
            continue
        if abs(one.velocity - steady[one.identifier]) > STEADY:
            return one.t - put if one.t - put <= CHANGE_TIMEOUT_S else None
    return None
