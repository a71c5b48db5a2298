"""Data from the service that all tabs share: the newest state, the latest events and the description of the robot."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import math
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import aclosing

import msgspec
from trirail_drivers.interface import Triple

from trirail.client import path_check
from trirail.client.async_client import AsyncRobot
from trirail.client.blocking import LoopThread
from trirail.client.path_check import CheckedPath, Obstacle
from trirail.errors import TrirailError
from trirail.panel.description import describe
from trirail.panel.permissions import permissions
from trirail.processes.operating_system import is_here
from trirail.telemetry.drawn_robot import DrawnRobot
from trirail.wire.goals import PoseGoal
from trirail.wire.looks import AlignmentLook
from trirail.wire.state import State
from trirail.wire.vocabulary import Role

SILENCE_S = 1.0
"""Minimum time without a state after which the service counts as silent [s]."""
RESTART_S = 0.5
"""Minimum change of the service's start time that shows a restart [s].

A restart takes longer, and the start time also changes by the ticks that the loop misses between two states."""
MAX_DRIFT = 5e-3
"""Rate at which the shortest delay of states may grow. Clocks of two machines drift, and that of a virtual machine may
jump when the machine is paused.
"""
MAX_STATE_AGE_S = 0.5
"""Minimum of the limit of the age of the newest state on the page at which the page can move the robot [s].

If the state is older, the page or a connection has stalled, and the operator pressed the button some time ago."""
USERS_PERIOD_S = 2.0
"""Interval between queries of the connected users, and of a description that has not been answered [s]."""
MAX_EVENTS = 200
"""Maximum number of events that are stored for tabs that are opened later."""
MAX_LOOKS = 50
"""Maximum number of events of the latest alignment that are stored."""


class Feed:
    """Subscription to one robot that all tabs share.

    A tab must acquire the condition `changed` to read data; the condition is notified when there is new data. Raises
    ServiceError if the service does not answer.
    """

    def __init__(self, robot: AsyncRobot, loop: LoopThread) -> None:
        self._robot = robot
        self._loop = loop
        self.changed = threading.Condition()
        self._pose: Triple | None = None
        self.messages: dict[str, bytes] = {}
        """Messages for tabs as JSON: the robot, the names of its poses, and the connected users. Each tab gets a
        message when the tab is opened and when the message changes. The robot is first, because the page cannot draw
        anything without it.
        """
        loop.call(self._fetch_robot())
        self.messages["poses"] = loop.call(self._fetch_poses())
        self.state: bytes | None = None
        """Newest state and its stamp as JSON; None while the service is silent or its description is not known."""
        self.stamp = 0
        """Time of the newest state, in milliseconds of this process's monotonic clock: its arrival time, unless it was
        delayed more than others.
        """
        self._events: deque[tuple[int, bytes]] = deque(maxlen=MAX_EVENTS)
        self._alignment_events: list[tuple[int, bytes]] = []
        """Events of the latest alignment, which are stored even after MAX_EVENTS later events."""
        self._alignment = ("", "")
        self._subscriptions: list[Callable[[], None]] = []
        self.trouble = ""
        """Reason why the description could not be read since the service was last silent; empty if it was read."""

    def start(self) -> None:
        """Start the subscriptions."""
        self._subscriptions = [
            self._loop.start(hear()) for hear in (self._receive_states, self._receive_events, self._poll_users)
        ]

    def close(self) -> None:
        """Stop the subscriptions."""
        for cancel in self._subscriptions:
            cancel()

    def events(self, after: int) -> list[tuple[int, bytes]]:
        """Return the numbers and the JSON of the events with numbers higher than `after`, in order of arrival."""
        return [event for event in sorted({*self._alignment_events, *self._events}) if event[0] > after]

    def is_fresh(self, seen: int) -> bool:
        """Return whether the state with the stamp `seen` is new enough for what does more than reduce motion."""
        return now() - seen <= self._info.state_timeout(MAX_STATE_AGE_S) * 1e3

    def find_obstacle(self, goal: PoseGoal) -> Obstacle | None:
        """Return the obstacle between the measured pose and a goal; None if there is none.

        See trirail.client.path_check.find_obstacle.
        """
        if self._pose is None:
            return Obstacle("the position of the robot is unknown", code="unknown")
        end = (goal.x, goal.y, goal.phi)
        return path_check.find_obstacle(self._robot_drawing, self._pose, end, goal.tool, goal.frame)

    def check_path(self, name: str, text: str, stretch: bool) -> CheckedPath:
        """Check the path in a file; return the result. See trirail.client.path_check.check_path."""
        return path_check.check_path(self._robot_drawing, name, text, stretch)

    async def _receive_states(self) -> None:
        is_new = False
        started: float | None = None
        delay = Delay()
        while True:
            async with aclosing(self._robot.states(self._info.state_timeout(SILENCE_S))) as states:
                async for state in states:
                    # A service that was silent may have restarted. If this process was suspended meanwhile, or states
                    # are rare, only the start time shows the restart.
                    last, started = started, state.time - state.t
                    if is_new or (last is not None and abs(started - last) > RESTART_S):
                        await self._describe()
                        is_new, delay = False, Delay()
                    if self.trouble:  # the page would use the limits and the drawing of another robot
                        continue
                    stamp = round(delay.subtract(now(), state))
                    content = msgspec.json.encode({"tell": "state", "stamp": stamp, "state": state})
                    with self.changed:
                        self.state, self.stamp, self._pose = content, stamp, state.measured_pose
                        self.changed.notify_all()
            is_new = True
            with self.changed:
                self.state = self._pose = None
                self.trouble = ""
                self.changed.notify_all()

    async def _poll_users(self) -> None:
        while True:
            await asyncio.sleep(USERS_PERIOD_S)
            if self.trouble:
                await self._describe()
            with contextlib.suppress(TrirailError):
                self._publish("users", msgspec.json.encode({"tell": "users", "names": await self._robot.users()}))

    async def _describe(self) -> None:
        """Query the description of the robot and its poses; if that fails, set `trouble` to the reason."""
        poses = await self._fetch_poses()
        try:
            await self._fetch_robot()
        except (TrirailError, ValueError) as error:  # ValueError: a role or a drive of a later version
            trouble = str(error) or type(error).__name__
        else:
            self._publish("poses", poses)
            trouble = ""
        with self.changed:
            self.trouble = trouble
            self.changed.notify_all()

    async def _fetch_robot(self) -> None:
        """Query the description of the robot and the user's permissions, and publish the description to tabs.

        Raises ServiceError if the service has another version.
        """
        info, role = await self._robot.info(), await self._robot.role()
        robot = DrawnRobot.from_info(info)
        about = msgspec.json.encode(describe(info, robot, self._robot.user, role))
        self._robot_drawing = robot
        self._info = info
        self.recordings = info.recordings
        """Folder of the service's recordings on the service's machine."""
        self.is_here = is_here(info.machine)
        """Whether the service runs on the panel's machine."""
        self.permissions = permissions(role, Role(info.takeover))
        """Permissions of the panel's user."""
        self._publish("robot", about)

    async def _fetch_poses(self) -> bytes:
        """Query the named poses; return the message about them, or the last such message if there is no answer."""
        try:
            poses = await self._robot.poses()
        except TrirailError:
            if "poses" in self.messages:
                return self.messages["poses"]
            poses = {}
        taught = [name for name, pose in poses.items() if pose.taught]
        foreign = [name for name, pose in poses.items() if pose.other_geometry]
        return msgspec.json.encode({"tell": "poses", "names": list(poses), "taught": taught, "foreign": foreign})

    async def _receive_events(self) -> None:
        numbers = itertools.count(1)
        async with aclosing(self._robot.events(history=True)) as events:
            async for event in events:
                content = msgspec.json.encode({"tell": "event", "event": event})
                if event.kind == "pose":
                    self._publish("poses", await self._fetch_poses())
                with self.changed:
                    numbered = next(numbers), content
                    self._events.append(numbered)
                    if event.alignment is not None:
                        self._keep(event.alignment, numbered)
                    self.changed.notify_all()

    def _publish(self, name: str, content: bytes) -> None:
        with self.changed:
            self.messages[name] = content
            self.changed.notify_all()

    def _keep(self, look: AlignmentLook, event: tuple[int, bytes]) -> None:
        """Store an event of an alignment; an event of a new alignment replaces all events of the previous alignment."""
        name = look.id, look.purpose
        self._alignment_events = [*(self._alignment_events if name == self._alignment else ()), event][-MAX_LOOKS:]
        self._alignment = name


class Delay:
    """Delay of states on their way here, compared with the shortest one."""

    def __init__(self) -> None:
        self._shortest = math.inf
        self._last = 0.0

    def subtract(self, arrival: float, state: State) -> float:
        """Return the time at which a state would have arrived with the shortest delay, given its `arrival` [ms]."""
        # Missed ticks are not part of the service's nominal time.
        sent = (state.t + state.loop.overruns / state.loop.rate_hz) * 1e3
        self._shortest = min(arrival - sent, self._shortest + MAX_DRIFT * (arrival - self._last))
        self._last = arrival
        return sent + self._shortest


def now() -> int:
    """Return the present time on the monotonic clock [ms], which serves as the stamp of a state."""
    return time.monotonic_ns() // 1_000_000
