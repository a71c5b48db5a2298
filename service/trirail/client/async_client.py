"""A client of the service for asyncio: goals, commands and states over Zenoh.

async with AsyncRobot("demo") as robot:
    await robot.enable()
    goal = await robot.move_to(x=0.02, y=-0.01, phi=0.1)
    result = await goal.wait(timeout=10)
"""

from __future__ import annotations

import asyncio
import contextlib
import copy
import uuid
from collections.abc import AsyncGenerator, Callable, Generator, Mapping, Sequence
from contextlib import AbstractContextManager, AsyncExitStack, aclosing
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Self, TypeVar

import msgspec
from trirail_drivers.interface import Triple

from trirail.client.async_connection import AsyncConnection
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
)
from trirail.client.track import AsyncTrack, Taker
from trirail.client.trajectory import Points, check_arrived, first_pose, points_of
from trirail.errors import ServiceError
from trirail.wire.goals import Goal, MoveGoal, NamedGoal, OwnLimits, PoseGoal, SlidersGoal, Tool, TrajectoryGoal
from trirail.wire.looks import AlignmentLook
from trirail.wire.marks import MarkLike, StopAtLike, marks_of, stop_at_of
from trirail.wire.messages import CommandReply, Event, GoalReply, RoleReply
from trirail.wire.state import Info, NamedPose, NamedPoses, State
from trirail.wire.stop_protocol import STOPS
from trirail.wire.text import check_name, check_new_pose
from trirail.wire.vocabulary import AcquireLease, Command, CommandContent, Override, Role, SetOutput, Stop

if TYPE_CHECKING:  # numpy, which most programs do without
    from trirail.alignment.alignment_request import AlignmentRequest, Observation
    from trirail.alignment.camera_calibration import CameraCalibration
    from trirail.alignment.geometry_calibration import GeometryCalibration
    from trirail.alignment.images import Lens
    from trirail.alignment.procedure import Alignment
    from trirail.client.alignment import Look

REPORT_WITHIN = 2.0
"""Time-out of the answer to the report of a look [s]."""
HOME_WITHIN = 600.0
"""Longest time of homing [s]: three drives with the greatest time-out."""
T = TypeVar("T")


class AsyncRobot:
    """Connection to one robot's service inside its context, for the tasks of one event loop.

    Arguments, names and errors are those of trirail.client.client.Robot, which wraps these calls for threads.
    Cancelling a call that sends a goal stops that goal if the service has received it. An accepted goal continues, even
    if no task waits for it.
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

    async def __aenter__(self) -> Self:
        loop = asyncio.get_running_loop()
        opening = loop.run_in_executor(None, self._connected)
        try:
            connection = await asyncio.shield(opening)
        except asyncio.CancelledError:  # a connection that opens later is closed again
            opening.add_done_callback(lambda done: None if done.exception() else done.result().close())
            raise
        self._opened.push_async_callback(lambda: loop.run_in_executor(None, connection.close))
        await self._use(connection)
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def close(self) -> None:
        """End the connection; goals under way continue."""
        self._open = None
        await self._opened.aclose()

    def _connected(self) -> Connection:
        """Open a connection, which may take a while. Raises ServiceError where the service cannot be reached."""
        return Connection(self.name, self._connect, self._credentials, self.user)

    async def _use(self, connection: Connection) -> None:
        """Send and receive by a connection, in the running event loop."""
        self._open = AsyncConnection(connection)
        self._opened.enter_context(self._open.subscribe_to_events(self._on_event, history=True))

    async def _shared(self, connection: Connection) -> AsyncRobot:
        """Return a robot with goals of its own by the same connection, in the running event loop."""
        shared = copy.copy(self)
        shared._opened, shared._goals = AsyncExitStack(), OpenGoals()
        await shared._use(connection)
        return shared

    async def _twin(self, connection: Connection) -> AsyncRobot:
        """Return a robot that sends commands by the same connection, in the running event loop."""
        twin = copy.copy(self)
        twin._open = AsyncConnection(connection)
        return twin

    @property
    def skipped(self) -> int:
        """Number of publications on this robot's keys that were not valid messages."""
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
        """Send a pose goal, x, y [m] and phi [rad] in the base frame; return once it is accepted.

        The platform moves straight in pose space where its start allows. `speed` is a fraction of full speed, (0, 1]:
        0.5 takes twice as long over the same path. With `blend` [m] the next pose goal waits for this one, and begins
        when no point of the platform is farther than that from its target; without it, the next goal preempts this
        one. `limits` are lower than the platform's. A goal that has not begun within `valid_for` [s] expires.
        With a `tool`, a point of the platform in its own frame, (u, v) [m], or a name of [frames.tool], this point
        moves to x, y, straight and within the platform's limits, while the platform turns. `frame` is one of
        [frames.work] in which x, y and phi are given.
        Outputs switch at `marks` on the path: trirail.Mark, or dicts of its fields; the result has a row per switch.
        At the edge `stop_at` of an input the goal ends, by a controlled stop: trirail.StopAt, or a dict.
        The `id` must be new; one is made if absent. Raises RefusedError: out of reach, not enabled, stopping, ….
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
        """Move the platform by x, y [m] and turn it by phi [rad] about its `tool`, or its centre; return when accepted.

        x and y are along the axes of `frame`: base, platform (at that time), or one of [frames.work]. `origin` is the
        start of the move: "commanded" is the end of the goals before it, so that moves add up whenever they are sent;
        "measured" is the robot's measured pose. The rest is as for move_to.
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
        """Move the platform to a named pose, one of `poses`; the rest is as for move_to.

        The name is resolved when the service takes the goal. Raises RefusedError `unknown_pose` for an unknown name.
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
        """Send a goal for the sliders A, B, C, their lambda_10 [m]; return once it is accepted.

        The motion is straight in slider space where the start allows; it also leads out of a pose that move_to refuses.
        `speed`, `valid_for` and `id` are as for move_to.
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
        trajectory = points_of(points)
        if go_there:
            check_arrived(await (await self.send(first_pose(trajectory))).wait())
        return await self.send(
            lambda name: TrajectoryGoal(
                trajectory, stretch=stretch, settle=settle, id=name, marks=marks_of(marks), stop_at=stop_at_of(stop_at)
            ),
            id,
        )

    def jog(
        self, x: float = 0.0, y: float = 0.0, phi: float = 0.0, *, timeout: float = 0.2, tool: Tool | None = None
    ) -> AsyncJog:
        """Move the platform at a velocity [m/s, rad/s] while the context lasts, renewed before each `timeout` [s].

        The velocity is that of the `tool`, about which the platform turns; without one, that of its centre.

        with robot.jog(x=0.01):  # of AsyncRobot: async with
            wait_for_the_key_to_be_released()
        """
        return AsyncJog(self.send, (x, y, phi), timeout, tool)

    def track(self, *, timeout: float = 0.25, id: str | None = None) -> AsyncTrack:  # noqa: A002 - the field's name on the wire
        """Follow a moving target while the context lasts, updated 10 to 200 times a second; brake when it ends.

        with robot.track() as track:  # of AsyncRobot: async with, and await
            for pose, velocity, time in camera:
                track.update(pose, velocity, time)

        The robot keeps the target's velocity between two updates, within every limit, and brakes on its path
        when none has come for `timeout` seconds of real time. `id` is as for move_to.
        """

        goal_id = id or uuid.uuid4().hex[:12]

        def post(goal: Goal, deliver: Taker) -> None:
            self._connection.post(("goal", self.user), GoalReply, goal_message(lambda _: goal, goal_id), deliver)

        return AsyncTrack(self.send, post, goal_id, timeout)

    async def send(self, make: Goal | Callable[[str], Goal], id: str | None = None) -> AsyncGoalHandle:  # noqa: A002
        """Send a trirail.wire.goals.Goal, or the one that `make` makes for an id; return once it is accepted."""
        goal_id = id or id_of(make)
        *before, last = goal_messages(make, goal_id)
        goal = self._goals.open(AsyncGoalHandle(goal_id, self.command))
        try:
            reply = await self._connection.fetch(("goal", self.user), GoalReply, last, before=before)
        except BaseException as error:
            # A cancelled renewal of a jog does not stop the jog.
            if self._goals.refuse(goal_id) and isinstance(error, asyncio.CancelledError):
                with contextlib.suppress(ServiceError):  # the connection is closed
                    stop = msgspec.json.encode(Stop(goal_id))
                    self._connection.query_unanswered(("cmd", self.user, Command.STOP), stop)
            raise
        self._goals.accept(goal, reply)
        return goal

    async def check(self, goal: Goal) -> GoalReply:
        """Plan a trirail.wire.goals.Goal without moving; return the reply of the service if it could be accepted now.

        The whole path is checked against every limit. It begins at rest, at the end of the goals under way or at the
        commanded pose. Neither mode nor lease matters. A jog or a track has no path to check; a trajectory is checked
        up to the points of one message. Raises RefusedError as for the goal itself.
        """
        return await self._connection.fetch(("check", self.user), GoalReply, check_message(goal))

    async def calibrate_camera(
        self,
        look: Look,
        moves: Sequence[Triple] | None = None,
        *,
        views: Mapping[str, str] | None = None,
        lens: Lens = "affine",
        centre: tuple[float, float] = (0.0, 0.0),
        looks: int = 1,
        approach: Triple | None = None,
        speed: float = 1.0,
        wait: float = 0.0,
    ) -> CameraCalibration:
        """Calibrate cameras by the marks of a part on the table and moves of the stage, which returns afterwards.

        `look` takes a picture, or one of each camera, and returns {mark: (u, v)} in pixels; marks that it does not
        find are missing. `moves` are x, y [m] and phi [rad] from the robot's pose, ±1 mm and ±1° if absent; each must
        leave the marks in the picture. `views` names for each mark the view that shows it: without it each has one of
        its own, as with two cameras, or one that is moved to each mark. A `lens` perspective or radial needs more
        moves, radial also the `centre` of its picture [pixel]. `looks` pictures are taken at each place, `wait` seconds
        after the robot is at rest; with an `approach`, x, y [m] and phi [rad], it overshoots by that first and returns,
        so that backlash is on the same side each time. Ctrl-C stops the robot. Raises AlignmentError where the looks do
        not suffice, RefusedError where a move is refused.
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

        Measure, correct about the marks' middle from the robot's measured pose, measure again, until every mark is
        within `tolerance` [m] of its place by the best rigid motion and the part within `angle` [rad], or
        `corrections` have been made, or the error grows. The first correction with an unconfirmed calibration is
        limited to twice its moves. Without a `calibration` one is made first, by moves of ±1 mm and ±1°. Marks whose
        distance is wrong by more than `distance`, a share, are refused, and nothing moves. The rest is as for
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
        """Find the stage's own geometry, encoder scales and cameras by the marks of a part; return what to change.

        `field` is the size of the pictures, (columns, rows) in pixels. The stage looks at its pose and after moves of
        1 mm and 1°, then at poses all over its travel at which marks stay in the pictures: `poses` looks in all, 12 at
        least; then it returns. They are chosen by the information matrix. `.parameters` are corrections to the
        configuration by name [m, rad, share], `.deviations` their standard deviations, `.undetermined` the names of
        those that the looks do not tell, `.residual` how well looks that were held out are predicted, before and
        after. Nothing is written, and the service keeps its geometry: `trirail align geometry` writes a configuration
        for its next start. The rest is as for calibrate_camera; needs trirail[analysis].
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
        """Carry out the requests of a conversation of trirail.alignment.procedure; return its result."""
        from trirail.client.alignment import drive_async

        return await drive_async(self, look, requests, speed, wait)

    async def _report_look(self, look: bytes) -> None:
        """Report a look of an alignment to the service: a trirail.wire.looks.AlignmentLook as JSON."""
        await self._connection.fetch(("alignment", self.user), AlignmentLook, look, REPORT_WITHIN)

    async def enable(self) -> None:
        """Power the drives up; return when the robot holds, immediately if it does already."""
        await self.command(Command.ENABLE)

    async def disable(self) -> None:
        """Stop, then power the drives down; return when none has power."""
        await self.command(Command.DISABLE)

    async def stop(self) -> None:
        """Stop on the path within the limits' jerk; return when the robot is at rest. Until then goals are refused."""
        await self.command(Command.STOP)

    async def quick_stop(self) -> None:
        """Stop every drive by its own ramp, as fast as it can; the robot is in fault until reset, without power."""
        await self.command(Command.QUICK_STOP)

    async def reset(self) -> None:
        """Clear a fault whose cause is gone; leave the robot disabled. Raises RefusedError while the cause lasts."""
        await self.command(Command.RESET)

    async def home(self) -> None:
        """Home the drives whose positions are not absolute; return when all are and the robot holds."""
        await self.command(Command.HOME)

    async def pause(self) -> None:
        """Stop on the path; return when the robot is at rest. The goal is kept for resume, a jog is not."""
        await self.command(Command.PAUSE)

    async def resume(self) -> None:
        """Continue a paused goal."""
        await self.command(Command.RESUME)

    async def override(self, percent: float) -> None:
        """Set the speed override of this and later motions, 0 or 1 to 200 % of full speed, within the limits."""
        content = made_content(Command.OVERRIDE, lambda: Override(number(percent, "override")))
        await self.command(Command.OVERRIDE, content)

    async def set_output(self, name: str, value: bool) -> None:
        """Set a digital output of the configuration, from the next setpoints on.

        Raises RefusedError: `unknown_output`; `not_enabled` or `fault` while the robot is disabled or in fault, unless
        the output is configured as `always = true`.
        """
        content = made_content(Command.SET_OUTPUT, lambda: SetOutput(name, value))
        await self.command(Command.SET_OUTPUT, content)

    def lease(self, *, force: bool = False, timeout: float = 1.0) -> AsyncLease:
        """Hold the lease while the context lasts: only this user's goals and commands move the robot.

        Signs of life keep it, regardless of the rest of the program. When these cease for `timeout` [s], and when the
        context ends, the robot stops within its limits and the lease is free. `force` takes it over from its holder,
        if the user's role allows. Entering raises RefusedError `leased` where somebody else holds it. Everybody can
        still send stop, quick_stop and disable.

        with robot.lease():  # of AsyncRobot: async with, and await
            robot.move_to(x=0.02, y=0.0, phi=0.0).wait()
        """
        return AsyncLease(self.command, force=force, timeout=timeout)

    async def acquire(self, lease: AcquireLease | None = None) -> CommandReply:
        """Take the lease, or keep it by one sign of life; the context of `lease` sends such signs itself."""
        return await self.command(Command.ACQUIRE, lease)

    async def release(self) -> None:
        """Release the lease of this user, whichever client keeps it; return when the robot is at rest."""
        await self.command(Command.RELEASE)

    async def command(self, name: str, content: CommandContent | bytes | None = None) -> CommandReply:
        """Send a command by its name on the wire; return once the service confirms that it has been carried out.

        `content` is of the type that trirail.wire.vocabulary.Command has for it, or that as JSON. Commands that stop
        the robot are also sent to the service's door for stops, which other connections cannot block.
        """
        payload = content_message(name, content)
        if name in STOPS:
            return await self._connection.stop(self.user, name, payload, REPLY_WITHIN)
        within = HOME_WITHIN if name == Command.HOME else REPLY_WITHIN
        return await self._connection.fetch(("cmd", self.user, name), CommandReply, payload, within)

    async def info(self) -> Info:
        """Return geometry, limits, rates and versions."""
        return await self._connection.fetch(("info",), Info)

    async def role(self) -> Role | None:
        """Return this user's role; None where they have none. Without certificates every user is a maintainer."""
        role = (await self._connection.fetch(("role", self.user), RoleReply)).role
        return None if role is None else Role(role)

    async def users(self) -> list[str]:
        """Return the names of the users connected to the robot now, this one included."""
        return await self._connection.users()

    async def poses(self) -> dict[str, NamedPose]:
        """Return the named poses: those of the configuration, and those that were taught."""
        return {pose.name: pose for pose in (await self._connection.fetch(("poses",), NamedPoses)).poses}

    async def teach(self, name: str) -> NamedPose:
        """Save the robot's measured pose, with power or without, under a name; return that pose.

        It is on the service's disk when this returns. A taught pose of that name is replaced.
        Raises RefusedError where the robot moves, is in fault or has not been homed, and for names of [poses].
        """
        return await self._connection.fetch(("teach", self.user, check_new_pose(name)), NamedPose)

    async def forget(self, name: str) -> NamedPose:
        """Remove a taught pose, and return it. Raises RefusedError where none of that name was taught."""
        return await self._connection.fetch(("forget", self.user, check_name(name, "pose")), NamedPose)

    # ------------------------------------------------------------------ what the service tells

    async def state(self, timeout: float = 2.0) -> State:
        """Return the next published state; after an answer or an event, none that is older than that.

        Raises ServiceError if none comes within `timeout` seconds.
        `pose` is computed from the measured sliders; `commanded` is the setpoint of the drives. SI units and radians.
        """
        async with aclosing(self.states(timeout)) as states:
            async for state in states:
                if not self._connection.overtaken(state):
                    return state
        raise await self._connection.nobody("state")

    def states(self, timeout: float | None = None) -> AsyncGenerator[State]:
        """Yield states as they arrive, only the newest for a slow caller; end after `timeout` seconds without one."""
        return self._connection.states(seconds(timeout))

    def events(self, history: bool = False, timeout: float | None = None) -> AsyncGenerator[Event]:
        """Yield events in order, each once, with `history` past ones first; end after `timeout` seconds without one."""
        return self._connection.events(history, seconds(timeout))

    def records(self, deliver: Callable[[bytes], None]) -> AbstractContextManager[Any]:
        """Deliver every batch of records as it arrives, until the context ends; wire.records.unpack reads them.

        `deliver` is called in the event loop: it must be quick.
        """
        return self._connection.records(deliver)

    @property
    def _connection(self) -> AsyncConnection:
        if self._open is None:
            raise ServiceError("not connected: use it within `async with AsyncRobot(…) as robot`")
        return self._open

    def _on_event(self, event: Event) -> None:
        self._goals.note_switches(event.marks)
        if (result := result_of(event)) is not None:
            self._goals.end(result)
