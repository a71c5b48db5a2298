"""A robot without a service, as the panel and the pendant know one: it moves as it is told, in real time."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import itertools
import math
import threading
import time
from collections.abc import AsyncGenerator, Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar, cast

import msgspec
from trirail.client.async_client import AsyncRobot
from trirail.client.blocking import GoalHandle, LoopThread
from trirail.client.client import Robot
from trirail.client.goal import AsyncGoalHandle, Result
from trirail.client.lease import AsyncLease
from trirail.config import SIM, load
from trirail.errors import RefusalCode, RefusedError
from trirail.kinematics.geometry import Geometry
from trirail.kinematics.robot import inverse
from trirail.processes.publications import info
from trirail.wire.goals import Goal, MoveGoal, NamedGoal, PoseGoal, Tool, TrajectoryPoint, VelocityGoal
from trirail.wire.messages import CommandReply, Event
from trirail.wire.state import (
    CommandedMotion,
    FrameCounts,
    GoalState,
    Info,
    LoopState,
    NamedPose,
    Percentiles,
    Pose,
    Sliders,
    State,
)
from trirail.wire.vocabulary import Command, Override, Role, SetOutput
from trirail_drivers.interface import Triple

T = TypeVar("T")
PERIOD = 0.02
ZERO = (0.0, 0.0, 0.0)
STEADY = Percentiles(10.0, 20.0, 30.0, 40.0)
LOOP = LoopState(1000, 0, 0, STEADY, STEADY, STEADY, 500.0, 0.5, 0.4, ())


async def no_command(*_: object) -> Any:
    raise AssertionError("nothing was to be commanded")


@functools.cache
def loop() -> LoopThread:
    return LoopThread()


class FakeRobot:
    """Stands in for trirail.client.client.Robot at the pendant: without inertia, but with the dead man's time-out."""

    user = "ann"
    name = "demo"

    def __init__(self, homes: tuple[str, ...] = ()) -> None:
        self.mode = "disabled"
        self.pose: Triple = (0.01, 0.005, 0.1)
        self.velocity: Triple = ZERO
        self.goal: GoalState | None = None
        self.faults: tuple[str, ...] = ()
        self.homed = (True, True, True)
        self.share = 1.0
        self.holder: str | None = None
        self.granted: Role | None = Role.MAINTAINER
        self.speeds: list[float] = []
        self.lasting = False
        """Whether a goal is under way until `arrive`; else it has ended when it is accepted."""
        self.moved_to: list[tuple[Triple, Tool | None, str]] = []
        self.followed: list[tuple[TrajectoryPoint, ...]] = []
        self.connected = ["ann", "bob"]
        self.outputs: dict[str, bool] = {}
        self.inputs: dict[str, bool] = {}
        self.warnings: tuple[str, ...] = ()
        self.forced: list[bool] = []
        self.named = {"park": (0.0, 0.05, 0.0)}
        self.foreign: set[str] = set()
        """Names of the poses that were taught with another geometry."""
        self.gone_to: list[str] = []
        self.sent: list[VelocityGoal] = []
        self.commands: list[str] = []
        self.refusal: RefusedError | None = None
        self.silent = threading.Event()
        self.told = msgspec.structs.replace(info(load(SIM)), homes=homes)
        self.began = 0.0
        """Time at which the service started, on this machine's monotonic clock [s]."""
        self._hanging: dict[str, threading.Event] = {}
        self._handles: dict[str, AsyncGoalHandle] = {}
        self._ended: set[str] = set()
        self._alive_until = 0.0
        self.told_events: list[Event] = []
        self._lock = threading.RLock()
        self._last = 0.0
        self.state()  # the kinematics is compiled now, not in the first state
        self.say("the loop turns at 1000 Hz")

    def at_pendant(self) -> Robot:
        return cast(Robot, self)

    def robot(self) -> AsyncRobot:
        """The same for the panel, in an event loop."""
        return cast(AsyncRobot, AsyncFakeRobot(self))

    # ------------------------------------------------------------------ what a client asks

    def info(self) -> Info:
        return self.told

    def role(self) -> Role | None:
        return self.granted

    def users(self) -> list[str]:
        return self.connected

    def send(self, make: Goal | Callable[[str], Goal], goal_id: str = "") -> GoalHandle:
        goal = make if isinstance(make, Goal) else make(goal_id)
        match goal:
            case NamedGoal(name, speed=speed):
                return self._move_to_named(name, speed)
            case MoveGoal(x, y, phi):
                at = self.pose
                return self._move_to((at[0] + x, at[1] + y, at[2] + phi), goal)
            case PoseGoal(x, y, phi):
                return self._move_to((x, y, phi), goal)
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
                raise RefusedError(RefusalCode.DUPLICATE_ID, f"goal id {goal_id!r} has already been used")
            self._advance()
            if goal_id not in self._handles:
                self._say_begun(goal_id)
            self.mode, self.velocity = "moving", (goal.x, goal.y, goal.phi)
            self._alive_until = time.monotonic() + goal.timeout
            self.goal = GoalState(goal_id, 0.0, 0.0)
            return self._handle(goal_id)

    def poses(self) -> dict[str, NamedPose]:
        return {
            name: NamedPose(name, *pose, taught=name != "park", other_geometry=name in self.foreign)
            for name, pose in self.named.items()
        }

    def _move_to_named(self, name: str, speed: float) -> GoalHandle:
        if name not in self.named:
            raise RefusedError(RefusalCode.UNKNOWN_POSE, f"no pose {name!r}")
        self.gone_to.append(name)
        if "goal" in self._hanging:
            self._hanging["goal"].wait()
        return self._begin(speed)

    def _move_to(self, pose: Triple, goal: PoseGoal | MoveGoal) -> GoalHandle:
        with self._lock:
            if self.refusal is not None:
                raise self.refusal
            self.moved_to.append((pose, goal.tool, goal.frame))
            self.pose = pose
        return self._begin(goal.speed)

    def _begin(self, speed: float) -> GoalHandle:
        """Take a goal up, and tell the events of it as the service does."""
        with self._lock:
            self.speeds.append(speed)
            goal_id = f"goal-{len(self.speeds)}"
            handle = self._handle(goal_id)
            self._say_begun(goal_id)
            self.goal = GoalState(goal_id, 0.25, 3.0, target=Pose(*self.pose))
            self.mode, self._alive_until = "moving", math.inf
            if not self.lasting:
                self.arrive()
        return handle

    def _say_begun(self, goal_id: str) -> None:
        self.say(f"moving: goal {goal_id} of ann", kind="mode", mode="moving", goal=goal_id)

    def arrive(self, outcome: str = "done") -> None:
        """End the goal under way."""
        with self._lock:
            assert self.goal is not None
            self._stand(outcome, "")

    def follow(self, points: Sequence[TrajectoryPoint], *, stretch: bool) -> GoalHandle:
        with self._lock:
            if self.refusal is not None:
                raise self.refusal
            self.followed.append(tuple(points))
            self.goal = GoalState("followed", 0.25, 3.0, target=Pose(*self.pose))
            self.mode, self._alive_until = "moving", math.inf
        return self._handle("followed")

    def teach(self, name: str) -> NamedPose:
        self.named[name] = self.pose
        self.say(f"pose {name} taught by ann", kind="pose")
        return NamedPose(name, *self.pose, taught=True)

    def forget(self, name: str) -> NamedPose:
        if name not in self.named:
            raise RefusedError(RefusalCode.UNKNOWN_POSE, f"no pose {name!r}")
        self.say(f"pose {name} removed by ann", kind="pose")
        return NamedPose(name, *self.named.pop(name), taught=True)

    def _handle(self, goal_id: str) -> GoalHandle:
        goal = self._handles.setdefault(goal_id, AsyncGoalHandle(goal_id, no_command, no_command, no_command))
        return GoalHandle(goal, loop(), lambda *_: None)

    def command(self, name: str, content: bytes | None = None) -> CommandReply:
        with self._lock:
            self.commands.append(name)
        if name in self._hanging:
            self._hanging[name].wait()
        with self._lock:
            if self.refusal is not None:
                raise self.refusal
            self._advance()
            if name == Command.OVERRIDE and content is not None:
                self.share = msgspec.json.decode(content, type=Override).percent / 100.0
            if name == Command.SET_OUTPUT and content is not None:
                wanted = msgspec.json.decode(content, type=SetOutput)
                self.outputs[wanted.output] = wanted.value
            if name == Command.STOP:
                self._stand("stopped", "stop of ann")
            self.mode = {"enable": "holding", "disable": "disabled", "reset": "disabled"}.get(name, self.mode)
            self.faults = () if name == "reset" else self.faults
            self.holder = {"acquire": self.user, "release": None}.get(name, self.holder)
            return CommandReply(name, self.mode, self._seq() + 1)

    def stop(self) -> None:
        self.command(Command.STOP)

    def states(self, timeout: float | None = None) -> Iterator[State]:
        while not self.silent.wait(PERIOD):
            with self._lock:
                state = self.state()
            yield state
        assert timeout is not None

    # ------------------------------------------------------------------ what happens to it

    def say(self, message: str, level: str = "info", **fields: object) -> None:
        with self._lock:
            seq = len(self.told_events) + 1
            base = {"seq": seq, "t": seq * 1.0, "cycle": self._seq(), "time": 1.7e9 + seq, "kind": "service"}
            event = msgspec.convert(base | {"level": level, "message": message} | fields, Event)
            self.told_events.append(event)

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
        sliders = Sliders((a, b, c), ZERO, ZERO, ZERO, (power,) * 3, (counts,) * 3, self.homed)
        commanded = CommandedMotion(Pose(*self.pose), self.velocity, ZERO, (a, b, c), ZERO, ZERO)
        seq = self._seq()
        return State(
            seq=seq,
            t=seq / 1e3,
            time=1.7e9 + self.began + seq / 1e3,
            mode=self.mode,
            pose=Pose(x, y, phi),
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
            outputs=dict(self.outputs),
            inputs=dict(self.inputs),
            warnings=self.warnings,
        )

    def _seq(self) -> int:
        return int((time.monotonic() - self.began) * 1000)

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
            told = {"kind": "goal", "id": self.goal.id, "outcome": outcome, "user": "ann"}
            self.say(f"goal {self.goal.id} {outcome}", **told)
            self.goal = None
        if self.mode == "moving":
            self.mode = "holding"
            self.say("holding: standstill", kind="mode", mode="holding")
        self.velocity = ZERO


class AsyncFakeRobot:
    """Stands in for trirail.client.async_client.AsyncRobot at the panel: what is asked is done in threads."""

    def __init__(self, robot: FakeRobot) -> None:
        self._robot = robot
        self._threads = ThreadPoolExecutor(max_workers=64)
        self.name, self.user = robot.name, robot.user

    async def __aenter__(self) -> AsyncFakeRobot:
        return self

    async def _twin(self) -> AsyncFakeRobot:
        return self

    async def close(self) -> None:
        self._threads.shutdown(wait=False)

    async def info(self) -> Info:
        return self._robot.info()

    async def role(self) -> Role | None:
        return self._robot.role()

    async def users(self) -> list[str]:
        return self._robot.users()

    async def poses(self) -> dict[str, NamedPose]:
        return self._robot.poses()

    async def teach(self, name: str) -> NamedPose:
        return await self._do(self._robot.teach, name)

    async def forget(self, name: str) -> NamedPose:
        return await self._do(self._robot.forget, name)

    async def command(self, name: str, content: bytes | None = None) -> CommandReply:
        return await self._do(self._robot.command, name, content)

    async def send(self, make: Goal | Callable[[str], Goal], goal_id: str = "") -> AsyncGoalHandle:
        return (await self._do(self._robot.send, make, goal_id))._goal

    async def follow(self, points: Sequence[TrajectoryPoint], *, stretch: bool) -> AsyncGoalHandle:
        return (await self._do(functools.partial(self._robot.follow, points, stretch=stretch)))._goal

    def lease(self, *, force: bool = False) -> AsyncLease:
        self._robot.forced.append(force)
        return AsyncLease(self.command, force=force, timeout=0.2)

    async def states(self, timeout: float) -> AsyncGenerator[State]:
        while not self._robot.silent.is_set():
            yield self._robot.state()
            period = 1.0 / self._robot.told.state_hz
            await asyncio.sleep(min(period, timeout))
            if period > timeout:
                return
        assert timeout is not None
        await asyncio.sleep(PERIOD)

    async def events(self, history: bool) -> AsyncGenerator[Event]:
        assert history
        for number in itertools.count():
            while len(self._robot.told_events) <= number:
                await asyncio.sleep(PERIOD / 4)
            yield self._robot.told_events[number]

    async def _do(self, do: Callable[..., T], *what: object) -> T:
        return await asyncio.get_running_loop().run_in_executor(self._threads, do, *what)
