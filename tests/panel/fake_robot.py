"""A robot without a service, as the panel and the pendant know one: it moves as it is told, in real time."""

from __future__ import annotations

import contextlib
import math
import queue
import threading
import time
from collections.abc import Callable, Iterator
from typing import cast

import msgspec
from trirail.client.client import GoalHandle, Result, Robot
from trirail.client.lease import Lease
from trirail.config import SIM, load
from trirail.errors import RefusalCode, RefusedError
from trirail.kinematics.geometry import Geometry
from trirail.kinematics.robot import inverse
from trirail.processes.publications import info
from trirail.wire.goals import Goal, TrajectoryPoint, VelocityGoal
from trirail.wire.messages import CommandReply, Event
from trirail.wire.state import (
    Commanded,
    FrameCounts,
    GoalState,
    Info,
    LoopState,
    NamedPose,
    Percentiles,
    Sliders,
    State,
)
from trirail.wire.vocabulary import Command, Role
from trirail_drivers.interface import Triple

PERIOD = 0.02
ZERO = (0.0, 0.0, 0.0)
STEADY = Percentiles(10.0, 20.0, 30.0, 40.0)
LOOP = LoopState(1000, 0, 0, STEADY, STEADY, 0.5, 0.4, ())


class FakeRobot:
    """Stands in for trirail.client.client.Robot: without inertia, but with the dead man's time-out."""

    user = "ann"
    name = "demo"

    def __init__(self, homes: tuple[str, ...] = ()) -> None:
        self.mode = "disabled"
        self.pose: Triple = (0.01, 0.005, 0.1)
        self.velocity: Triple = ZERO
        self.goal: GoalState | None = None
        self.faults: tuple[str, ...] = ()
        self.share = 1.0
        self.holder: str | None = None
        self.granted: Role | None = Role.MAINTAINER
        self.moved_to: list[tuple[Triple, str | None, str]] = []
        self.followed: list[tuple[TrajectoryPoint, ...]] = []
        self.connected = ["ann", "bob"]
        self.warnings: tuple[str, ...] = ()
        self.forced: list[bool] = []
        self.named = {"park": (0.0, 0.05, 0.0)}
        self.gone_to: list[str] = []
        self.sent: list[VelocityGoal] = []
        self.commands: list[str] = []
        self.refusal: RefusedError | None = None
        self.silent = threading.Event()
        self.told = msgspec.structs.replace(info(load(SIM)), homes=homes)
        self._hanging: dict[str, threading.Event] = {}
        self._handles: dict[str, GoalHandle] = {}
        self._ended: set[str] = set()
        self._alive_until = 0.0
        self._events: list[Event] = []
        self._listeners: list[queue.Queue[Event]] = []
        self._lock = threading.RLock()
        self._last = 0.0
        self.state()  # the kinematics is compiled now, not in the first state
        self.say("the loop turns at 1000 Hz")

    def robot(self) -> Robot:
        return cast(Robot, self)

    # ------------------------------------------------------------------ what a client asks

    def info(self) -> Info:
        return self.told

    def role(self) -> Role | None:
        return self.granted

    def users(self) -> list[str]:
        return self.connected

    def send(self, make: Callable[[str], Goal], goal_id: str) -> GoalHandle:
        goal = make(goal_id)
        assert isinstance(goal, VelocityGoal)
        self.sent.append(goal)
        if "goal" in self._hanging:
            self._hanging["goal"].wait()
        with self._lock:
            if self.refusal is not None:
                raise self.refusal
            if self.mode not in ("holding", "moving"):
                raise RefusedError(RefusalCode.NOT_ENABLED, "the robot is disabled: send enable first")
            if goal_id in self._ended:
                raise RefusedError(RefusalCode.DUPLICATE_ID, f"goal id {goal_id!r} has been used")
            self._advance()
            self.mode, self.velocity = "moving", (goal.x, goal.y, goal.phi)
            self._alive_until = time.monotonic() + goal.timeout
            self.goal = GoalState(goal_id, 0.0, 0.0)
            return self._handles.setdefault(goal_id, GoalHandle(goal_id, self.robot().command))

    def poses(self) -> dict[str, NamedPose]:
        return {name: NamedPose(name, *pose, taught=name != "park") for name, pose in self.named.items()}

    def move_to_named(self, name: str) -> GoalHandle:
        if name not in self.named:
            raise RefusedError(RefusalCode.UNKNOWN_POSE, f"no pose {name!r}")
        self.gone_to.append(name)
        if "goal" in self._hanging:
            self._hanging["goal"].wait()
        return GoalHandle(name, self.robot().command)

    def move_to(self, x: float, y: float, phi: float, tool: str | None = None, frame: str = "base") -> GoalHandle:
        with self._lock:
            if self.refusal is not None:
                raise self.refusal
            self.moved_to.append(((x, y, phi), tool, frame))
            self.pose = (x, y, phi)
        return GoalHandle("there", self.robot().command)

    def move(self, x: float, y: float, phi: float, tool: str | None = None, frame: str = "base") -> GoalHandle:
        at, by = self.pose, (x, y, phi)
        return self.move_to(at[0] + by[0], at[1] + by[1], at[2] + by[2], tool=tool, frame=frame)

    def follow(self, points: tuple[TrajectoryPoint, ...], *, stretch: bool) -> GoalHandle:
        with self._lock:
            if self.refusal is not None:
                raise self.refusal
            self.followed.append(tuple(points))
            self.goal = GoalState("followed", 0.25, 3.0, target=self.pose)
            self.mode, self._alive_until = "moving", math.inf
        return self._handles.setdefault("followed", GoalHandle("followed", self.robot().command))

    def teach(self, name: str) -> NamedPose:
        self.named[name] = self.pose
        self.say(f"pose {name} taught by ann", kind="pose")
        return NamedPose(name, *self.pose, taught=True)

    def forget(self, name: str) -> NamedPose:
        if name not in self.named:
            raise RefusedError(RefusalCode.UNKNOWN_POSE, f"no pose {name!r}")
        self.say(f"pose {name} removed by ann", kind="pose")
        return NamedPose(name, *self.named.pop(name), taught=True)

    def lease(self, *, force: bool = False) -> Lease:
        self.forced.append(force)
        return Lease(self.command, force=force, timeout=0.2)

    def command(self, name: str, _content: bytes = b"") -> CommandReply:
        with self._lock:
            self.commands.append(name)
        if name in self._hanging:
            self._hanging[name].wait()
        with self._lock:
            if self.refusal is not None:
                raise self.refusal
            self._advance()
            if name == Command.STOP:
                self._stand("stopped", "stop of ann")
            self.mode = {"enable": "holding", "disable": "disabled", "reset": "disabled"}.get(name, self.mode)
            self.faults = () if name == "reset" else self.faults
            self.holder = {"acquire": self.user, "release": None}.get(name, self.holder)
            return CommandReply(name, self.mode, 0)

    def stop(self) -> None:
        self.command(Command.STOP)

    def override(self, percent: float) -> None:
        self.commands.append(f"override {percent:g}")
        self.share = percent / 100.0

    def states(self, timeout: float | None = None) -> Iterator[State]:
        while not self.silent.wait(PERIOD):
            with self._lock:
                state = self.state()
            yield state
        assert timeout is not None
        with contextlib.suppress(queue.Empty):
            queue.Queue[None]().get(timeout=PERIOD)

    def events(self, history: bool = False) -> Iterator[Event]:
        listener: queue.Queue[Event] = queue.Queue()
        with self._lock:
            for event in self._events if history else ():
                listener.put(event)
            self._listeners.append(listener)
        while True:
            yield listener.get()

    # ------------------------------------------------------------------ what happens to it

    def say(self, message: str, level: str = "info", **fields: object) -> None:
        with self._lock:
            seq = len(self._events) + 1
            base = {"seq": seq, "t": seq * 1.0, "cycle": seq, "time": 1.7e9 + seq, "kind": "service"}
            event = msgspec.convert(base | {"level": level, "message": message} | fields, Event)
            self._events.append(event)
            for listener in self._listeners:
                listener.put(event)

    @contextlib.contextmanager
    def hanging(self, command: str) -> Iterator[None]:
        """Let a command, or any goal, be answered only when the context ends."""
        self._hanging[command] = threading.Event()
        yield
        self._hanging.pop(command).set()

    def fault(self, reason: str) -> None:
        with self._lock:
            self._stand("faulted", reason)
            self.mode, self.faults = "fault", (reason,)
            self.say(f"fault: {reason}", "error")

    def state(self) -> State:
        with self._lock:
            self._advance()
        x, y, phi = self.pose
        found = inverse(Geometry.symmetric(0.3), self.pose)
        a, b, c = (float(value) for value in found.position)
        counts = FrameCounts(0, 0, 0, 0)
        power = "switch on disabled" if self.mode in ("disabled", "fault") else "operation enabled"
        sliders = Sliders((a, b, c), ZERO, ZERO, ZERO, (power,) * 3, (counts,) * 3)
        commanded = Commanded(self.pose, self.velocity, ZERO, (a, b, c), ZERO, ZERO)
        seq = int(time.monotonic() * 1000)
        return State(
            seq=seq,
            t=seq / 1e3,
            mode=self.mode,
            pose=(x, y, phi),
            velocity=self.velocity,
            acceleration=ZERO,
            commanded=commanded,
            sliders=sliders,
            goal=self.goal,
            override=self.share,
            faults=self.faults,
            loop=LOOP,
            settled=True,
            lease=self.holder,
            warnings=self.warnings,
        )

    def _advance(self) -> None:
        """Move on to now; stand where a jog was not renewed in time."""
        now = time.monotonic()
        passed = min(now, self._alive_until) - self._last
        if passed > 0.0 and self.mode == "moving":
            x, y, phi = (at + v * passed for at, v in zip(self.pose, self.velocity, strict=True))
            self.pose = x, y, phi
        self._last = now
        if self.mode == "moving" and now >= self._alive_until:
            self._stand("done", "not renewed")

    def _stand(self, outcome: str, message: str) -> None:
        if self.goal is not None:
            self._ended.add(self.goal.id)
            self._handles[self.goal.id].end(Result(self.goal.id, outcome, message))
            self.goal = None
        if self.mode == "moving":
            self.mode = "holding"
        self.velocity = ZERO
