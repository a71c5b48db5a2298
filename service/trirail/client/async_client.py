"""Asyncio client of the service: goals, commands and states over Zenoh.

async with AsyncRobot("demo") as robot:
    await robot.enable()
    goal = await robot.move_to(x=0.02, y=-0.01, phi=0.1)
    result = await goal.wait(timeout=10)
"""

from __future__ import annotations

import asyncio
import contextlib
import copy
import functools
import math
import uuid
from collections.abc import AsyncGenerator, Callable, Generator, Mapping, Sequence
from contextlib import AbstractContextManager, AsyncExitStack, aclosing
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Self, TypeVar

import msgspec
from trirail_drivers.interface import Triple

from trirail.client.async_connection import AsyncConnection
from trirail.client.call_time import called, called_at
from trirail.client.connection import REPLY_WITHIN, Connection
from trirail.client.goal import AsyncGoalHandle, AsyncJog, OpenGoals, result_of
from trirail.client.identity import identity
from trirail.client.lease import AsyncLease
from trirail.client.outgoing import (
    check_message,
    content_message,
    goal_message,
    goal_messages,
    id_of,
    made_content,
    number,
    seconds,
    stops_everything,
)
from trirail.client.track import AsyncTrack, Taker
from trirail.client.trajectory import Points, check_arrived, first_pose, points_of
from trirail.errors import RefusedError, ServiceError
from trirail.wire.goals import Goal, MoveGoal, NamedGoal, OwnLimits, PoseGoal, SlidersGoal, Tool, TrajectoryGoal
from trirail.wire.looks import AlignmentLook
from trirail.wire.marks import MarkLike, StopAtLike, marks_of, stop_at_of
from trirail.wire.messages import CommandReply, Event, GoalReply, RoleReply
from trirail.wire.state import Info, NamedPose, NamedPoses, State
from trirail.wire.text import check_name, check_new_pose
from trirail.wire.vocabulary import AcquireLease, Command, CommandContent, Override, Role, SetOutput, Stop

if TYPE_CHECKING:  # numpy, which most programs do not need
    from trirail.alignment.alignment_request import AlignmentRequest, Observation
    from trirail.alignment.camera_calibration import CameraCalibration
    from trirail.alignment.geometry_calibration import GeometryCalibration
    from trirail.alignment.images import Lens
    from trirail.alignment.procedure import Alignment
    from trirail.client.alignment import Look

REPORT_WITHIN = 2.0
"""Time-out of the reply to an alignment report [s]."""
HOME_WITHIN = 600.0
"""Time-out of homing [s]; it allows for three drives with the longest homing time-out."""
ENABLE_WITHIN = 75.0
"""Time-out of enabling [s]; it allows for the longest plausible `watchdogs.enable_timeout`, 60 s."""
T = TypeVar("T")


class AsyncRobot:
    """Asynchronous context manager for a connection to one robot's service, for the tasks of one event loop.

    The arguments, method names and errors are those of trirail.client.client.Robot, which offers the same calls to
    threads. If you cancel a call that sends a goal, or if no reply arrives, the client stops the goal in case the
    service has received it. An accepted goal continues even if no task waits for the goal.
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
        self._goals = OpenGoals()
        self._newest: dict[str, int] = {}
        """Number of the newest event that has arrived from each run of the service."""

    async def __aenter__(self) -> Self:
        loop = asyncio.get_running_loop()
        opening = loop.run_in_executor(None, self._connected)
        try:
            connection = await asyncio.shield(opening)
        except asyncio.CancelledError:  # if the connection opens after the cancellation, close it
            opening.add_done_callback(lambda done: None if done.exception() else done.result().close())
            raise
        self._opened.push_async_callback(asyncio.to_thread, connection.close)
        await self._use(connection)
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def close(self) -> None:
        """Close the connection; accepted goals continue. Calls of other tasks that wait raise ServiceError."""
        opened, self._open = self._open, None
        if opened is not None:
            opened.close()
        self._goals.close()
        await self._opened.aclose()

    def _connected(self) -> Connection:
        """Open a connection; this call blocks. Raises ServiceError if the locator cannot be reached."""
        return Connection(self.name, self._connect, self._credentials, self.user)

    async def _use(self, connection: Connection) -> None:
        """Use a connection for all later calls, and subscribe to its events in the running event loop."""
        self._open = AsyncConnection(connection)
        self._opened.enter_context(self._open.subscribe_to_events(self._on_event, history=True))

    async def _shared(self, connection: Connection) -> AsyncRobot:
        """Return a robot for the running event loop that shares the connection but registers its goals separately."""
        shared = copy.copy(self)
        shared._opened, shared._goals, shared._newest = AsyncExitStack(), OpenGoals(), {}
        await shared._use(connection)
        return shared

    async def _twin(self) -> AsyncRobot:
        """Return a robot for the running event loop that shares the connection and receives no events.

        The returned robot can send commands; the handles of its goals would never get a result.
        """
        twin = copy.copy(self)
        twin._open = self._connection.another()
        return twin

    @property
    def skipped(self) -> int:
        """Number of invalid messages received on this robot's keys."""
        return self._connection.skipped

    # ------------------------------------------------------------------ goals and commands

    async def move_to(
        self,
        x: float,
        y: float,
        phi: float,
        *,
        speed: float = 1.0,
        limits: OwnLimits | None = None,
        blend: float | None = None,
        valid_for: float | None = None,
        tool: Tool | None = None,
        frame: str = "base",
        marks: Sequence[MarkLike] = (),
        stop_at: StopAtLike | None = None,
        id: str | None = None,  # noqa: A002 - the field's name on the wire
    ) -> AsyncGoalHandle:
        """Send a goal to a pose x, y [m], phi [rad] in the base frame; return once the service accepts it.

        The platform moves on a straight line in pose space if its start allows this. `speed` is a fraction of full
        speed, (0, 1]: at 0.5 the motion takes twice as long on the same path. With `blend` [m], the next pose goal
        waits for this goal, and begins when every point of the platform is within this distance of its place at the
        target. Without `blend`, the next goal preempts this goal. `limits` may lower the platform's limits. A goal that
        has not begun within `valid_for` [s] of its arrival expires.

        `tool` is a point (u, v) [m] in the platform's frame, or the name of a point in [frames.tool]. This point then
        moves to x, y on a straight line, within the platform's limits, while the platform turns. `frame` names the
        frame of [frames.work] in which x, y and phi are given.

        `marks` switch outputs at places on the path. Each mark is a trirail.Mark, or a dict of the fields of a Mark.
        The result of the goal lists every switch. `stop_at` names the edge of an input at which the goal ends with a
        controlled stop. It is a trirail.StopAt, or a dict of the fields of a StopAt. The `id` must be new; by default,
        the client generates an id. Raises RefusedError, for example if the pose is out of reach or the robot is not
        enabled or is stopping.
        """
        return await self.send(
            lambda name: PoseGoal(
                x=x,
                y=y,
                phi=phi,
                id=name,
                speed=speed,
                valid_for=valid_for,
                limits=limits,
                blend=blend,
                tool=tool,
                frame=frame,
                marks=marks_of(marks),
                stop_at=stop_at_of(stop_at),
            ),
            id,
        )

    async def move(
        self,
        x: float = 0.0,
        y: float = 0.0,
        phi: float = 0.0,
        *,
        frame: str = "base",
        tool: Tool | None = None,
        origin: Literal["commanded", "measured"] = "commanded",
        speed: float = 1.0,
        limits: OwnLimits | None = None,
        blend: float | None = None,
        valid_for: float | None = None,
        marks: Sequence[MarkLike] = (),
        stop_at: StopAtLike | None = None,
        id: str | None = None,  # noqa: A002 - the field's name on the wire
    ) -> AsyncGoalHandle:
        """Move the platform by x, y [m] and turn it by phi [rad]; return once the service accepts the goal.

        The platform turns about the `tool`, or about the platform's centre if no tool is given. x and y are along the
        axes of `frame`: base, platform (with the orientation that it has at the start of the move), or a frame of
        [frames.work]. `origin` selects the start of the move. "commanded" is the end of the preceding goals, so moves
        add up no matter when they are sent. "measured" is the robot's measured pose. The other arguments are those of
        move_to.
        """
        return await self.send(
            lambda name: MoveGoal(
                x=x,
                y=y,
                phi=phi,
                frame=frame,
                tool=tool,
                origin=origin,
                id=name,
                speed=speed,
                valid_for=valid_for,
                limits=limits,
                blend=blend,
                marks=marks_of(marks),
                stop_at=stop_at_of(stop_at),
            ),
            id,
        )

    async def move_to_named(
        self,
        name: str,
        *,
        speed: float = 1.0,
        limits: OwnLimits | None = None,
        blend: float | None = None,
        valid_for: float | None = None,
        marks: Sequence[MarkLike] = (),
        stop_at: StopAtLike | None = None,
        id: str | None = None,  # noqa: A002 - the field's name on the wire
    ) -> AsyncGoalHandle:
        """Move the platform to a named pose; `poses` returns the names. The other arguments are those of move_to.

        The service looks the name up when it receives the goal. Raises RefusedError `unknown_pose` for an unknown name.
        """
        return await self.send(
            lambda goal_id: NamedGoal(
                name=check_name(name, "pose"),
                id=goal_id,
                speed=speed,
                valid_for=valid_for,
                limits=limits,
                blend=blend,
                marks=marks_of(marks),
                stop_at=stop_at_of(stop_at),
            ),
            id,
        )

    async def move_sliders(
        self,
        a: float,
        b: float,
        c: float,
        *,
        speed: float = 1.0,
        valid_for: float | None = None,
        marks: Sequence[MarkLike] = (),
        stop_at: StopAtLike | None = None,
        id: str | None = None,  # noqa: A002 - the field's name on the wire
    ) -> AsyncGoalHandle:
        """Move the sliders A, B, C to positions lambda_10 [m]; return once the service accepts the goal.

        The motion is a straight line in slider space if the start allows this. The motion can also begin at a pose from
        which the service refuses move_to. The other arguments are those of move_to.
        """
        return await self.send(
            lambda name: SlidersGoal(
                (a, b, c),
                speed=speed,
                valid_for=valid_for,
                id=name,
                marks=marks_of(marks),
                stop_at=stop_at_of(stop_at),
            ),
            id,
        )

    async def follow(
        self,
        points: Points,
        *,
        stretch: bool = False,
        settle: bool = True,
        go_there: bool = False,
        marks: Sequence[MarkLike] = (),
        stop_at: StopAtLike | None = None,
        id: str | None = None,  # noqa: A002 - the field's name on the wire
    ) -> AsyncGoalHandle:
        """Send a timed trajectory that begins at the robot's pose; see trirail.client.client.Robot.follow."""
        with called():
            trajectory = points_of(points)
            if go_there:
                way = await self.send(first_pose(trajectory))
                try:
                    check_arrived(await way.wait())
                except asyncio.CancelledError:
                    self._stop_unanswered(way.id)
                    raise
            return await self.send(
                lambda name: TrajectoryGoal(
                    trajectory,
                    stretch=stretch,
                    settle=settle,
                    id=name,
                    marks=marks_of(marks),
                    stop_at=stop_at_of(stop_at),
                ),
                id,
            )

    def jog(
        self, x: float = 0.0, y: float = 0.0, phi: float = 0.0, *, timeout: float = 0.2, tool: Tool | None = None
    ) -> AsyncJog:
        """Move the platform at a velocity [m/s, rad/s] until the context ends.

        The client renews the jog before each `timeout` [s] passes. The velocity is that of the `tool`, and the platform
        turns about the tool. If no tool is given, the platform's centre replaces the tool.

        with robot.jog(x=0.01):  # of AsyncRobot: async with
            wait_for_the_key_to_be_released()

        """
        return AsyncJog(self.send, (x, y, phi), timeout, tool)

    def track(self, *, timeout: float = 0.25, id: str | None = None) -> AsyncTrack:  # noqa: A002 - the field's name on the wire
        """Follow a moving target until the context ends; the program updates the target 10 to 200 times a second.

        with robot.track() as track:  # of AsyncRobot: async with, and await
            for pose, velocity, time in camera:
                track.update(pose, velocity, time)

        Between two updates, the robot assumes that the target moves at the velocity of the latest update. The robot
        respects every limit. It brakes on its path when the context ends, or if no update arrives for `timeout` seconds
        of real time. `id` is that of move_to.
        """

        goal_id = id or uuid.uuid4().hex[:12]

        def post(goal: Goal, deliver: Taker) -> None:
            self._connection.post(("goal", self.user), GoalReply, goal_message(lambda _: goal, goal_id), deliver)

        return AsyncTrack(self.send, post, goal_id, timeout)

    async def send(self, make: Goal | Callable[[str], Goal], id: str | None = None) -> AsyncGoalHandle:  # noqa: A002
        """Send a trirail.wire.goals.Goal; return once the service accepts the goal.

        `make` is the goal, or a function that returns the goal for an id.
        """
        began = called_at()
        goal_id = id or id_of(make)
        *before, last = goal_messages(make, goal_id)
        is_present = functools.partial(self._is_present, goal_id)
        goal = self._goals.open(AsyncGoalHandle(goal_id, self.command, self.role, is_present))
        try:
            reply = await self._connection.fetch(("goal", self.user), GoalReply, last, before=before, began=began)
        except BaseException as error:
            # If a jog's renewal is cancelled, the jog itself continues until its time-out.
            if self._goals.refuse(goal_id) and isinstance(error, asyncio.CancelledError | ServiceError):
                self._stop_unanswered(goal_id)
            raise
        self._goals.accept(goal, reply)
        return goal

    async def _is_present(self, goal_id: str) -> bool:
        """Return whether a goal is the present goal in the next state."""
        goal = (await self.state()).goal
        return goal is not None and goal.id == goal_id

    def _stop_unanswered(self, goal_id: str | None = None) -> None:
        """Stop a goal or homing whose sender was cancelled or received no reply, without waiting for a reply."""
        with contextlib.suppress(ServiceError):  # the connection is closed
            self._connection.stop_unanswered(self.user, Command.STOP, msgspec.json.encode(Stop(goal_id)))

    async def check(self, goal: Goal) -> GoalReply:
        """Plan a trirail.wire.goals.Goal without moving; return the reply that the service would give to the goal now.

        The service checks the whole path against every limit. The path begins at rest, at the end of the accepted goals
        or, if these have no fixed end or there are none, at the commanded pose. The check works in every mode, and for
        users without the lease. Jogs and tracks have no path and cannot be checked. A trajectory can be checked if it
        fits into one message. Raises RefusedError for the same reasons as the goal itself, apart from mode and lease.
        """
        return await self._connection.fetch(("check", self.user), GoalReply, check_message(goal))

    async def calibrate_camera(
        self,
        look: Look,
        moves: Sequence[Triple] | None = None,
        *,
        views: Mapping[str, str] | None = None,
        lens: Lens = "affine",
        centre: tuple[float, float] | None = None,
        looks: int = 1,
        approach: Triple | None = None,
        speed: float = 1.0,
        wait: float = 0.0,
    ) -> CameraCalibration:
        """Calibrate cameras from the marks of a part on the table; the stage makes test moves and returns to its start.

        `look` is a function that takes one picture with each camera and returns the marks that it finds, {mark: (u, v)}
        [pixel]. `moves` are x, y [m] and phi [rad] relative to the robot's pose, by default ±1 mm and ±1°; the marks
        must stay in the picture during each move. `views` maps each mark to the view that shows it. By default, each
        mark has a separate view, as with two cameras or with one camera that is moved from mark to mark. A perspective
        or radial `lens` needs more moves, and a radial lens also the `centre` of its picture [pixel].

        At each pose, the client waits until the robot is at rest and then for `wait` seconds more, and takes `looks`
        pictures. With an `approach` of x, y [m] and phi [rad], the robot first overshoots by this amount and then
        returns, so that the backlash is always on the same side. Ctrl-C stops the robot. Raises AlignmentError if the
        looks are not sufficient, and RefusedError if a move is refused.
        """
        from trirail.alignment.procedure import DEFAULT_MOVES, calibrate_by_moves

        requests = calibrate_by_moves(DEFAULT_MOVES if moves is None else moves, views, lens, centre, looks, approach)
        return await self._converse(look, requests, speed, wait)

    async def align(
        self,
        look: Look,
        targets: Mapping[str, tuple[float, float]],
        calibration: CameraCalibration | None = None,
        *,
        tolerance: float = 1e-6,
        angle: float = 2.4e-5,
        corrections: int = 3,
        distance: float = 1e-3,
        looks: int = 1,
        approach: Triple | None = None,
        speed: float = 1.0,
        wait: float = 0.0,
    ) -> Alignment:
        """Move a part until its marks are at their `targets`, {mark: (u, v)} in pixels; return the alignment's result.

        The procedure measures the marks, corrects the pose about the marks' centroid from the measured pose, and
        measures again. It ends when the best rigid motion places every mark within `tolerance` [m] and the part within
        `angle` [rad], after `corrections` corrections, or when the error grows. If the calibration is unconfirmed, the
        first correction is limited to twice the moves of the calibration. If no `calibration` is given, the procedure
        first calibrates the cameras with moves of ±1 mm and ±1°. If the distance between marks is wrong by more than
        the fraction `distance`, the procedure refuses the marks and nothing moves. The other arguments are those of
        calibrate_camera.
        """
        from trirail.alignment.procedure import AlignmentTask, align, calibrate_and_align

        def task(known: CameraCalibration) -> AlignmentTask:
            return AlignmentTask(known, targets, tolerance, angle, corrections, distance, looks, approach)

        requests = align(task(calibration)) if calibration is not None else calibrate_and_align(task, looks, approach)
        return await self._converse(look, requests, speed, wait)

    async def calibrate_geometry(
        self,
        look: Look,
        field: tuple[float, float],
        *,
        views: Mapping[str, str] | None = None,
        lens: Lens = "radial",
        poses: int = 30,
        looks: int = 4,
        approach: Triple | None = None,
        speed: float = 1.0,
        wait: float = 0.0,
    ) -> GeometryCalibration:
        """Identify the stage's geometry, encoder scales and cameras from the marks of a part; return the corrections.

        `field` is the size of the pictures, (columns, rows) in pixels. The procedure takes looks at the present pose,
        after moves of 1 mm and 1°, and then at poses all over the travel at which the marks stay in the pictures. There
        are `poses` looks in total, at least 12; the information matrix determines the poses. The stage then returns to
        its start.

        In the result, `.parameters` are corrections to the configuration by name [m, rad, or a fraction], and
        `.deviations` are the standard deviations of these corrections. `.undetermined` names the parameters that the
        looks do not determine. `.residual` is the prediction error, before and after the fit, for looks that the fit
        did not use. This call writes no file, and the service continues to use its geometry. `trirail align geometry`
        instead writes a configuration for the next start of the service. The other arguments are those of
        calibrate_camera. Needs trirail[analysis].
        """
        from trirail.client.alignment import completed
        from trirail.client.stage_geometry import geometry_task

        info: Info = await completed(self.info())
        task = geometry_task(info, field, views, lens, poses, looks, approach)
        from trirail.alignment.geometry_calibration import calibrate_geometry

        return await self._converse(look, calibrate_geometry(task), speed, wait)

    async def _converse(
        self, look: Look, requests: Generator[AlignmentRequest, Observation, T], speed: float, wait: float
    ) -> T:
        """Carry out the requests of a procedure of trirail.alignment.procedure; return the procedure's result."""
        from trirail.client.alignment import drive_async

        return await drive_async(self, look, requests, speed, wait)

    async def _begin_call(self, began: float) -> None:
        """Announce a call of the time `began` [s] that sends goals later: after a stop, they are refused."""
        await self._connection.fetch(("role", self.user), RoleReply, began=began)

    async def _report_look(self, look: bytes) -> None:
        """Report a look of an alignment to the service; `look` is the JSON of a trirail.wire.looks.AlignmentLook."""
        await self._connection.fetch(("alignment", self.user), AlignmentLook, look, REPORT_WITHIN)

    async def enable(self) -> None:
        """Enable the drives; return when they hold the robot's position, immediately if they already do.

        If the call is cancelled, or no reply arrives, the service may still enable the drives: call `disable` if they
        must not have power. The client does not, because another user may have enabled them.
        """
        await self.command(Command.ENABLE)

    async def disable(self) -> None:
        """Stop the robot, then disable the drives; return when no drive has power."""
        await self.command(Command.DISABLE)

    async def stop(self) -> None:
        """Stop on the path within the jerk limits; return when the robot is at rest. Goals are refused until then."""
        await self.command(Command.STOP)

    async def quick_stop(self) -> None:
        """Stop each drive with its own quick-stop ramp, as fast as the drive can stop.

        The drives then have no power, and the robot is in fault until `reset`.
        """
        await self.command(Command.QUICK_STOP)

    async def reset(self) -> None:
        """Clear a fault; the robot stays disabled. Raises RefusedError if the cause of the fault persists."""
        await self.command(Command.RESET)

    async def home(self) -> None:
        """Home the drives that have no absolute position; return when all are homed and hold the robot's position.

        If the call is cancelled, homing stops.
        """
        await self.command(Command.HOME)

    async def pause(self) -> None:
        """Stop on the path; return when the robot is at rest. `resume` continues the goal unless the goal is a jog."""
        await self.command(Command.PAUSE)

    async def resume(self) -> None:
        """Continue a paused goal. If the call is cancelled, or no reply arrives, the robot stops."""
        await self.command(Command.RESUME)

    async def override(self, percent: float) -> None:
        """Set the speed override of current and later motions: 0, or 1 to 200 [%]. All limits still apply."""
        content = made_content(Command.OVERRIDE, lambda: Override(number(percent, "override")))
        await self.command(Command.OVERRIDE, content)

    async def set_output(self, name: str, value: bool) -> None:
        """Set a digital output of the configuration; the new value is sent together with the next setpoints.

        Raises RefusedError `unknown_output` for an unknown name. Raises RefusedError `not_enabled` or `fault` if the
        robot is disabled or in fault, unless the configuration has `always = true` for the output.
        """
        content = made_content(Command.SET_OUTPUT, lambda: SetOutput(name, value))
        await self.command(Command.SET_OUTPUT, content)

    def lease(self, *, force: bool = False, timeout: float = 1.0) -> AsyncLease:
        """Hold the lease until the context ends; meanwhile only this user's goals and commands move the robot.

        A background task renews the lease independently of the rest of the program. If no renewal arrives for `timeout`
        [s], or if the context ends, the robot stops within its limits and the lease is released. With `force`, the
        client takes the lease over from another user, if this user's role allows a takeover. Entering the context
        raises RefusedError `leased` if another user holds the lease. All users can still send stop, quick_stop and
        disable.

        with robot.lease():  # of AsyncRobot: async with, and await
            robot.move_to(x=0.02, y=0.0, phi=0.0).wait()

        """
        return AsyncLease(self.command, force=force, timeout=timeout)

    async def acquire(self, lease: AcquireLease | None = None) -> CommandReply:
        """Acquire the lease, or renew it once. The context manager `lease` instead renews the lease automatically."""
        return await self.command(Command.ACQUIRE, lease)

    async def release(self) -> None:
        """Release this user's lease, even if another client of this user holds it; return when the robot is at rest."""
        await self.command(Command.RELEASE)

    async def command(self, name: str, content: CommandContent | bytes | None = None) -> CommandReply:
        """Send a command by its name on the wire; return once the service has carried the command out.

        `content` is an object of the content type that trirail.wire.vocabulary.Command specifies for the command, or
        such an object encoded as JSON. The client also sends the commands that stop the robot to the service's stop
        port, which other connections cannot block.
        """
        began = called_at()
        payload = content_message(name, content)
        command = Command(name)
        if command.stops:
            return await self._stop(command, payload)
        within = {Command.HOME: HOME_WITHIN, Command.ENABLE: ENABLE_WITHIN}.get(command, REPLY_WITHIN)
        before = began if command.starts else math.inf
        try:
            reply = await self._connection.fetch(("cmd", self.user, name), CommandReply, payload, within, began=before)
        except (asyncio.CancelledError, ServiceError):
            if command in (Command.HOME, Command.RESUME):  # else the robot would move although no task waits for it
                self._stop_unanswered()
            raise
        if command is Command.RESUME:
            self._connection.forget_pause(began)
        return reply

    async def _stop(self, command: Command, payload: bytes | None) -> CommandReply:
        """Send a command that stops the robot. Requests that were called for earlier are not sent afterwards."""
        called_for = called_at()
        if stops_everything(command, payload):
            self._connection.note_stop(command, called_for)
        if command is Command.PAUSE:
            try:
                return await self._connection.fetch(("cmd", self.user, command), CommandReply, payload)
            except RefusedError:
                self._connection.forget_pause(called_for)
                raise
        return await self._connection.stop(self.user, command, payload, REPLY_WITHIN)

    async def info(self) -> Info:
        """Return the robot's geometry, limits, rates and versions."""
        return await self._connection.fetch(("info",), Info)

    async def role(self) -> Role | None:
        """Return this user's role; None if the user has no role.

        If the service requires no certificates, every user is a maintainer.
        """
        role = (await self._connection.fetch(("role", self.user), RoleReply)).role
        return None if role is None else Role(role)

    async def users(self) -> list[str]:
        """Return the names of the users who are connected to the robot, including this user.

        Raises RefusedError `not_allowed` if this user has no role.
        """
        return await self._connection.users(self.user)

    async def poses(self) -> dict[str, NamedPose]:
        """Return the poses of the configuration and the taught poses, by name."""
        return {pose.name: pose for pose in (await self._connection.fetch(("poses",), NamedPoses)).poses}

    async def teach(self, name: str) -> NamedPose:
        """Save the robot's measured pose under a name; return the pose. The drives may be enabled or disabled.

        When the call returns, the service has written the pose to its disk. The pose replaces a taught pose of the same
        name. Raises RefusedError if the robot moves, is in fault or has not been homed, or if the name is in [poses].
        """
        return await self._connection.fetch(("teach", self.user, check_new_pose(name)), NamedPose)

    async def forget(self, name: str) -> NamedPose:
        """Remove a taught pose and return it. Raises RefusedError if no pose with this name was taught."""
        return await self._connection.fetch(("forget", self.user, check_name(name, "pose")), NamedPose)

    # ------------------------------------------------------------------ states, events and records

    async def state(self, timeout: float = 2.0) -> State:
        """Return the next published state that is not older than the latest reply or event that this client received.

        In the state, `pose` is computed from the measured slider positions, and `commanded` is the setpoint of the
        drives, in SI units and radians. Raises ServiceError if no state arrives within `timeout` seconds.
        """
        async with aclosing(self.states(timeout)) as states:
            async for state in states:
                if not self._connection.overtaken(state):
                    return state
        raise await self._connection.nobody("state")

    def states(self, timeout: float | None = None) -> AsyncGenerator[State]:
        """Yield states as they arrive; skip all but the newest if the caller is slow.

        End after `timeout` seconds without a state.
        """
        return self._connection.states(seconds(timeout))

    def events(self, history: bool = False, timeout: float | None = None) -> AsyncGenerator[Event]:
        """Yield each event once, in order; with `history`, begin with the past events.

        End after `timeout` seconds without an event. On a busy machine, Zenoh may leave out the oldest past events.
        Without `history`, the events that occur while the gateway restarts are missing.
        """
        return self._connection.events(history, seconds(timeout))

    def records(self, deliver: Callable[[bytes], None]) -> AbstractContextManager[Any]:
        """Return a context manager: within its context, `deliver` is called with every batch of records.

        trirail.wire.records.unpack decodes a batch. The event loop calls `deliver`, which must return quickly.
        """
        return self._connection.records(deliver)

    @property
    def _connection(self) -> AsyncConnection:
        if self._open is None:
            raise ServiceError("not connected: use the robot within `async with AsyncRobot(…) as robot`")
        return self._open

    def _on_event(self, event: Event) -> None:
        if event.run and event.run not in self._newest:
            self._goals.lose_others(event.run)
        newest = self._newest.get(event.run, event.seq)
        if event.seq > newest + 1:  # Zenoh delivers events in order, after it has asked for lost events again
            self._goals.miss(newest + 1, event.seq - 1)
        self._newest[event.run] = max(event.seq, newest)
        self._goals.note_switches(event.marks)
        if (result := result_of(event)) is not None:
            self._goals.end(result)
