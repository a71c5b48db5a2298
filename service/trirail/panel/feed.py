"""What the service publishes, gathered once for all tabs: the newest state and the last events."""

from __future__ import annotations

import contextlib
import itertools
import threading
import time
from collections import deque

import msgspec
from trirail_drivers.interface import Triple

from trirail.client.client import Robot
from trirail.errors import TrirailError
from trirail.panel import path_check
from trirail.panel.description import describe, shown
from trirail.wire.looks import AlignmentLook
from trirail.wire.state import Info

SILENT = 1.0
"""After so long without a state the service is taken for gone [s]."""
EVENTS = 200
"""So many events are kept for tabs that come later."""
LOOKS = 50
"""And so many of the last alignment's."""


class Feed:
    """Hears one robot from its start until it is closed. Raises ServiceError where that does not answer at first.

    What a tab has not sent yet is read under `changed`, which is notified whenever there is something new.
    """

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self.changed = threading.Condition()
        self._pose: Triple | None = None
        self._take(robot.info())
        self.poses = self._ask_poses()
        """The names of its poses, as JSON."""
        self.state: bytes | None = None
        """The newest state, as JSON with its stamp; None where the service is silent."""
        self.stamp = 0
        """When that came: milliseconds of this process's monotonic clock."""
        self._closed = False
        self._events: deque[tuple[int, bytes]] = deque(maxlen=EVENTS)
        self._aligned: list[tuple[int, bytes]] = []
        """Those of the last alignment, however many have come since."""
        self._alignment = ("", "")

    def start(self) -> None:
        """Begin to hear."""
        for hear in (self._hear_states, self._hear_events):
            threading.Thread(target=hear, name=hear.__name__.strip("_"), daemon=True).start()

    def close(self) -> None:
        """Gather no more states; what hears events ends with the robot's connection."""
        self._closed = True

    def events(self, after: int) -> list[tuple[int, bytes]]:
        """Return the events that came after that number, numbered as they came, as JSON."""
        return [event for event in sorted({*self._aligned, *self._events}) if event[0] > after]

    def _hear_states(self) -> None:
        while not self._closed:
            for state in self._robot.states(SILENT):
                if self._closed:
                    return
                if self.state is None:
                    self._describe()
                stamp = now()
                content = msgspec.json.encode({"tell": "state", "stamp": stamp, "state": state})
                with self.changed:
                    self.state, self.stamp, self._pose = content, stamp, state.pose
                    self.changed.notify_all()
            with self.changed:
                self.state = None
                self.changed.notify_all()

    def _describe(self) -> None:
        """Ask again what robot it is: a service that was silent may have been started anew."""
        poses = self._ask_poses()
        with contextlib.suppress(TrirailError):  # the old description stands until it answers
            told = self._robot.info()
            with self.changed:
                self._take(told)
                self.poses = poses

    def _take(self, told: Info) -> None:
        """Take in what robot it is. Raises ServiceError where the service is of another version."""
        self._shown = shown(told)
        self.robot = msgspec.json.encode(describe(told, self._shown, self._robot.user))
        """What a tab must know of the robot before it can draw it, as JSON."""

    def problem(self, pose: Triple) -> str:
        """Return what keeps the robot from going from where it is measured to a pose, as problem of path_check."""
        return path_check.problem(self._shown, self._pose if self._pose is not None else pose, pose)

    def _ask_poses(self) -> bytes:
        try:
            poses = self._robot.poses()
        except TrirailError:
            poses = {}  # a service that knows none
        taught = [name for name, pose in poses.items() if pose.taught]
        return msgspec.json.encode({"tell": "poses", "names": list(poses), "taught": taught})

    def _hear_events(self) -> None:
        for number, event in zip(itertools.count(1), self._robot.events(history=True), strict=False):
            content = msgspec.json.encode({"tell": "event", "event": event})
            poses = self._ask_poses() if event.kind == "pose" else self.poses
            with self.changed:
                self.poses = poses
                self._events.append((number, content))
                if event.alignment is not None:
                    self._keep(event.alignment, (number, content))
                self.changed.notify_all()

    def _keep(self, look: AlignmentLook, event: tuple[int, bytes]) -> None:
        """Keep a look beside those of the same alignment."""
        name = look.id, look.purpose
        self._aligned = [*(self._aligned if name == self._alignment else ()), event][-LOOKS:]
        self._alignment = name


def now() -> int:
    """Return the time of stamps: milliseconds of the monotonic clock."""
    return time.monotonic_ns() // 1_000_000
