"""What the service publishes, gathered once for all tabs: the newest state, the last events, the robot itself."""

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
from trirail.panel.path_check import CheckedPath
from trirail.panel.permissions import permissions
from trirail.wire.looks import AlignmentLook
from trirail.wire.state import Info
from trirail.wire.vocabulary import Role

SILENT = 1.0
"""After so long without a state the service is taken for gone [s]."""
USERS_EVERY = 2.0
"""How often it is looked who is connected [s]."""
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
        self.told: dict[str, bytes] = {}
        """What a tab is told once, and again where it changes, as JSON: the robot, before anything can be drawn, and
        the names of its poses; who is connected."""
        self._learn_robot(robot.info())
        self.told["poses"] = self._ask_poses()
        self.state: bytes | None = None
        """The newest state, as JSON with its stamp; None where the service is silent."""
        self.stamp = 0
        """When that came: milliseconds of this process's monotonic clock."""
        self._over = threading.Event()
        self._events: deque[tuple[int, bytes]] = deque(maxlen=EVENTS)
        self._aligned: list[tuple[int, bytes]] = []
        """Those of the last alignment, however many have come since."""
        self._alignment = ("", "")

    def start(self) -> None:
        """Begin to hear."""
        for hear in (self._hear_states, self._hear_events, self._look_for_users):
            threading.Thread(target=hear, name=hear.__name__.strip("_"), daemon=True).start()

    def close(self) -> None:
        """Gather no more states; what hears events ends with the robot's connection."""
        self._over.set()

    def events(self, after: int) -> list[tuple[int, bytes]]:
        """Return the events that came after that number, numbered as they came, as JSON."""
        return [event for event in sorted({*self._aligned, *self._events}) if event[0] > after]

    def problem(self, pose: Triple, tool: str | None, frame: str) -> tuple[str, bool]:
        """Return what keeps the robot from going from where it is measured to a pose, as path_check.problem."""
        if self._pose is None:
            return "nobody knows where the robot is", False
        return path_check.problem(self._shown, self._pose, pose, tool, frame)

    def checked_path(self, name: str, text: str, stretch: bool) -> CheckedPath:
        """Return what a file's path comes to."""
        return path_check.checked_path(self._shown, name, text, stretch)

    def _hear_states(self) -> None:
        while not self._over.is_set():
            for state in self._robot.states(SILENT):
                if self._over.is_set():
                    return
                if self.state is None:
                    self._describe()
                stamp = now()
                content = msgspec.json.encode({"tell": "state", "stamp": stamp, "state": state})
                with self.changed:
                    self.state, self.stamp, self._pose = content, stamp, state.pose
                    self.changed.notify_all()
            with self.changed:
                self.state = self._pose = None
                self.changed.notify_all()

    def _look_for_users(self) -> None:
        while not self._over.wait(USERS_EVERY):
            with contextlib.suppress(TrirailError):
                users = msgspec.json.encode({"tell": "users", "names": self._robot.users()})
                with self.changed:
                    self.told["users"] = users
                    self.changed.notify_all()

    def _describe(self) -> None:
        """Ask again what robot it is: a service that was silent may have been started anew."""
        poses = self._ask_poses()
        with contextlib.suppress(TrirailError):  # the old description stands until it answers
            told = self._robot.info()
            with self.changed:
                self._learn_robot(told)
                self.told["poses"] = poses

    def _learn_robot(self, told: Info) -> None:
        """Take in what robot it is, and what may be done. Raises ServiceError where it is of another version."""
        self._shown = shown(told)
        self.recordings = told.recordings
        """The folder of the service's recordings, on its machine."""
        role = self._robot.role()
        self.permissions = permissions(role, Role(told.takeover))
        """What the panel's user may."""
        self.told["robot"] = msgspec.json.encode(describe(told, self._shown, self._robot.user, role))

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
            poses = self._ask_poses() if event.kind == "pose" else self.told["poses"]
            with self.changed:
                self.told["poses"] = poses
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
