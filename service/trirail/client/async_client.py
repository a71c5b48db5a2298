"""A client of the service for asyncio, with the names of trirail.client.client.Robot.

async with AsyncRobot("demo") as robot:
    await robot.enable()
    goal = await robot.move_to(x=0.02, y=-0.01, phi=0.1)
    result = await goal.wait(timeout=10)
"""

from __future__ import annotations

import asyncio
import functools
import uuid
from collections.abc import AsyncGenerator, Awaitable, Callable, Coroutine
from contextlib import AbstractContextManager, AsyncExitStack, aclosing
from pathlib import Path
from typing import Any, Concatenate, ParamSpec, Self, TypeVar, cast

import msgspec

from trirail.client.async_connection import AsyncConnection
from trirail.client.async_goal import AsyncGoalHandle, AsyncJog
from trirail.client.async_lease import AsyncLease
from trirail.client.async_track import AsyncTrack
from trirail.client.client import HOME_WITHIN, REPORT_WITHIN, Robot, identity, result_of
from trirail.client.connection import REPLY_WITHIN
from trirail.client.goal import GoalHandle
from trirail.client.outgoing import content_message, goal_message, id_of, seconds
from trirail.client.track import Taker
from trirail.client.trajectory import check_arrived
from trirail.errors import RefusedError, ServiceError
from trirail.wire.goals import Goal, Tool
from trirail.wire.looks import AlignmentLook
from trirail.wire.messages import CommandReply, Event, GoalReply, RoleReply
from trirail.wire.state import Info, NamedPose, NamedPoses, State
from trirail.wire.stop_protocol import STOPS
from trirail.wire.text import check_name, check_new_pose
from trirail.wire.vocabulary import AcquireLease, Command, CommandContent, Role, Stop

P = ParamSpec("P")
T = TypeVar("T")


class _Draft:
    """Stands in for Robot: keeps what one of its methods would send, a goal with one before it, or a command, or do."""

    before: Callable[[str], Goal] | None = None

    def _arrive(self, make: Callable[[str], Goal]) -> None:
        self.before = make

    def send(self, make: Callable[[str], Goal], id: str | None = None) -> None:  # noqa: A002 - as Robot's
        self.goal = make, id

    def command(self, name: Command, content: CommandContent | bytes | None = None) -> None:
        self.order = name, content

    def _converse(self, *conversation: Any) -> None:
        self.conversation = conversation


def _goal(
    method: Callable[Concatenate[Robot, P], GoalHandle],
) -> Callable[Concatenate[AsyncRobot, P], Coroutine[Any, Any, AsyncGoalHandle]]:
    """Return the twin of a method of Robot that sends a goal."""

    @functools.wraps(method)
    async def send(robot: AsyncRobot, /, *args: P.args, **kwargs: P.kwargs) -> AsyncGoalHandle:
        draft = _Draft()
        method(cast(Robot, draft), *args, **kwargs)
        if draft.before is not None:
            check_arrived(await (await robot.send(draft.before)).wait())
        return await robot.send(*draft.goal)

    return send


def _order(
    method: Callable[Concatenate[Robot, P], None],
) -> Callable[Concatenate[AsyncRobot, P], Coroutine[Any, Any, None]]:
    """Return the twin of a method of Robot that sends a command."""

    @functools.wraps(method)
    async def order(robot: AsyncRobot, /, *args: P.args, **kwargs: P.kwargs) -> None:
        draft = _Draft()
        method(cast(Robot, draft), *args, **kwargs)
        await robot.command(*draft.order)

    return order


def _conversation(method: Callable[Concatenate[Robot, P], T]) -> Callable[Concatenate[AsyncRobot, P], Awaitable[T]]:
    """Return the twin of a method of Robot that looks and moves; its `look` may be a coroutine function."""

    @functools.wraps(method)
    async def converse(robot: AsyncRobot, /, *args: P.args, **kwargs: P.kwargs) -> T:
        from trirail.client.alignment import drive_async  # numpy

        draft = _Draft()
        method(cast(Robot, draft), *args, **kwargs)
        return cast(T, await drive_async(robot, *draft.conversation))

    return converse


class AsyncRobot:
    """A connection to one robot's service while its context lasts; for the tasks of one event loop.

    Arguments, names and errors are those of Robot. A call that is cancelled leaves nothing behind: a goal that was
    being sent is stopped if the service has taken it. A goal that was accepted goes on, whoever waits for it or not.
    """

    def __init__(
        self,
        name: str | None = None,
        connect: str | None = None,
        user: str | None = None,
        tls: Path | str | None = None,
    ) -> None:
        self.name, self._connect, self.user, self._credentials = identity(name, connect, user, tls)
        self._opened = AsyncExitStack()
        self._open: AsyncConnection | None = None
        self._goals: dict[str, AsyncGoalHandle] = {}

    async def __aenter__(self) -> Self:
        self._open = await AsyncConnection.open(self.name, self._connect, self._credentials, self.user)
        self._opened.push_async_callback(self._open.close)
        self._opened.enter_context(self._open.subscribe_to_events(self._on_event, history=True))
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def close(self) -> None:
        """End the connection; goals under way go on."""
        self._open = None
        await self._opened.aclose()

    @property
    def skipped(self) -> int:
        """How often something was published on this robot's keys that was none of its messages."""
        return self._connection.skipped

    move_to = _goal(Robot.move_to)
    move_to_named = _goal(Robot.move_to_named)
    move = _goal(Robot.move)
    move_sliders = _goal(Robot.move_sliders)
    follow = _goal(Robot.follow)

    enable = _order(Robot.enable)
    disable = _order(Robot.disable)
    stop = _order(Robot.stop)
    quick_stop = _order(Robot.quick_stop)
    reset = _order(Robot.reset)
    home = _order(Robot.home)
    pause = _order(Robot.pause)
    resume = _order(Robot.resume)
    override = _order(Robot.override)
    release = _order(Robot.release)

    calibrate_camera = _conversation(Robot.calibrate_camera)
    align = _conversation(Robot.align)

    async def _report_look(self, look: bytes) -> None:
        await self._connection.fetch(("alignment", self.user), AlignmentLook, look, REPORT_WITHIN)

    def jog(
        self, x: float = 0.0, y: float = 0.0, phi: float = 0.0, *, timeout: float = 0.2, tool: Tool | None = None
    ) -> AsyncJog:
        """Move the platform at a velocity [m/s, rad/s] while the context lasts, renewed before each `timeout` [s].

        It is that of a `tool`, about which the platform turns; of the centre where there is none.

        async with robot.jog(x=0.01):
            await the_key_is_released()
        """
        return AsyncJog(self.send, (x, y, phi), timeout, tool)

    def track(self, *, timeout: float = 0.25, id: str | None = None) -> AsyncTrack:  # noqa: A002
        """Follow a moving target while the context lasts, as Robot.track does.

        async with robot.track() as track:
            async for pose, velocity, time in camera:
                await track.update(pose, velocity, time)
        """

        goal_id = id or uuid.uuid4().hex[:12]

        def post(goal: Goal, deliver: Taker) -> None:
            self._connection.post(("goal", self.user), GoalReply, goal_message(lambda _: goal, goal_id), deliver)

        return AsyncTrack(self.send, post, goal_id, timeout)

    async def send(self, make: Goal | Callable[[str], Goal], id: str | None = None) -> AsyncGoalHandle:  # noqa: A002
        """Send a goal, or the one that `make` makes for an id, as Robot.send does."""
        goal_id = id or id_of(make)
        content = goal_message(make, goal_id)
        renews = goal_id in self._goals  # a jog: what it has is not forgotten or stopped for one renewal's sake
        goal = self._goals.setdefault(goal_id, AsyncGoalHandle(goal_id, self.command))
        try:
            goal.reply = await self._connection.fetch(("goal", self.user), GoalReply, content)
        except asyncio.CancelledError:
            if not renews:
                self._goals.pop(goal_id, None)
                self._connection.query_unanswered(("cmd", self.user, Command.STOP), msgspec.json.encode(Stop(goal_id)))
            raise
        except (RefusedError, ServiceError):
            self._goals.pop(goal_id, None)
            raise
        return goal

    async def command(self, name: str, content: CommandContent | bytes | None = None) -> CommandReply:
        """Send a command by its name on the wire, as Robot.command does."""
        payload = content_message(name, content)
        if name in STOPS:
            return await self._connection.stop(self.user, name, payload, REPLY_WITHIN)
        within = HOME_WITHIN if name == Command.HOME else REPLY_WITHIN
        return await self._connection.fetch(("cmd", self.user, name), CommandReply, payload, within)

    def lease(self, *, force: bool = False, timeout: float = 1.0) -> AsyncLease:
        """Have the robot for oneself while the context lasts, as Robot.lease does.

        async with robot.lease():
            await robot.enable()
        """
        return AsyncLease(self.command, force=force, timeout=timeout)

    async def acquire(self, lease: AcquireLease | None = None) -> CommandReply:
        """Take the lease, or keep it by one sign of life; `lease` keeps it for as long as signs come."""
        return await self.command(Command.ACQUIRE, lease)

    async def info(self) -> Info:
        """Ask for geometry, limits, rates and versions."""
        return await self._connection.fetch(("info",), Info)

    async def role(self) -> Role | None:
        """Ask what this user may, as Robot.role does."""
        role = (await self._connection.fetch(("role", self.user), RoleReply)).role
        return None if role is None else Role(role)

    async def users(self) -> list[str]:
        """Return who is connected, as Robot.users does."""
        return await self._connection.users()

    async def poses(self) -> dict[str, NamedPose]:
        """Ask for the named poses, as Robot.poses does."""
        return {pose.name: pose for pose in (await self._connection.fetch(("poses",), NamedPoses)).poses}

    async def teach(self, name: str) -> NamedPose:
        """Keep where the robot is measured to stand as the pose of a name, as Robot.teach does."""
        return await self._connection.fetch(("teach", self.user, check_new_pose(name)), NamedPose)

    async def forget(self, name: str) -> NamedPose:
        """Remove a taught pose, as Robot.forget does."""
        return await self._connection.fetch(("forget", self.user, check_name(name, "pose")), NamedPose)

    async def state(self, timeout: float = 2.0) -> State:
        """Return the next state that is published, as Robot.state does."""
        async with aclosing(self.states(timeout)) as states:
            async for state in states:
                if not self._connection.overtaken(state):
                    return state
        raise await self._connection.nobody("state")

    def states(self, timeout: float | None = None) -> AsyncGenerator[State]:
        """Yield states as they come, the newest where this is too slow; end after `timeout` seconds without one."""
        return self._connection.states(seconds(timeout))

    def events(self, history: bool = False, timeout: float | None = None) -> AsyncGenerator[Event]:
        """Yield events in order, each once, with `history` the past first; end after `timeout` seconds without one."""
        return self._connection.events(history, seconds(timeout))

    def records(self, deliver: Callable[[bytes], None]) -> AbstractContextManager[Any]:
        """Have every batch of records taken in the event loop, until the context ends, as Robot.records does."""
        return self._connection.records(deliver)

    @property
    def _connection(self) -> AsyncConnection:
        if self._open is None:
            raise ServiceError("not connected: use it within `async with AsyncRobot(…) as robot`")
        return self._open

    def _on_event(self, event: Event) -> None:
        result = result_of(event)
        goal = self._goals.pop(result.id, None) if result is not None else None
        if goal is not None and result is not None:
            goal.end(result)
