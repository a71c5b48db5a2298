"""A client of the service: goals, commands and states over Zenoh.

with Robot("demo") as robot:
    robot.enable()
    result = robot.move_to(x=0.02, y=-0.01, phi=0.1).wait(timeout=10)
"""

from __future__ import annotations

import getpass
import os
import re
import threading
import uuid
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from html import escape
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Literal, Self

import zenoh
from trirail_drivers.interface import Triple

from trirail.client.connection import REPLY_WITHIN, Connection
from trirail.client.goal import GoalHandle, Jog, Result
from trirail.client.lease import Lease
from trirail.client.outgoing import content_message, goal_message, id_of, made_content, number, seconds
from trirail.client.track import Taker, Track
from trirail.client.trajectory import Points, check_arrived, first_pose, points_of
from trirail.errors import RefusalCode, RefusedError, ServiceError, TrirailError
from trirail.wire.credentials import Credentials, credentials_for
from trirail.wire.endpoints import DEFAULT_LOCATOR, ReachableBy, reach
from trirail.wire.goals import (
    Goal,
    MoveGoal,
    NamedGoal,
    OwnLimits,
    PoseGoal,
    SlidersGoal,
    Tool,
    TrajectoryGoal,
)
from trirail.wire.looks import AlignmentLook
from trirail.wire.messages import CommandReply, Event, GoalReply, RoleReply
from trirail.wire.sizes import MAX_NAME
from trirail.wire.state import Info, NamedPose, NamedPoses, State
from trirail.wire.stop_protocol import STOPS
from trirail.wire.text import check_name, check_new_pose, quoted
from trirail.wire.vocabulary import AcquireLease, Command, CommandContent, Override, Role

if TYPE_CHECKING:  # numpy, which most programs do without
    from trirail.alignment.camera_calibration import CameraCalibration
    from trirail.alignment.images import Lens
    from trirail.alignment.procedure import Alignment
    from trirail.client.alignment import Look

__all__ = ["GoalHandle", "Jog", "Lease", "Result", "Robot", "Track"]

SEEN_WITHIN = 1.0
"""How long a state is waited for by who looks where the robot is [s]."""
REPORT_WITHIN = 2.0
"""How long the answer may take to what is told of an alignment [s]."""
HOME_WITHIN = 600.0
"""How long homing may take [s]: three drives of the greatest time-out there is."""


class Robot:
    """A connection to one robot's service; several threads may share it.

    `name` is that of the robot's configuration, `connect` the Zenoh locator of its service or of a router, both from
    TRIRAIL_ROBOT and TRIRAIL_CONNECT if absent, or demo on this machine; `user` is who is told to have sent goals and
    commands (the login name if absent). At a locator tls/HOST:PORT the folder `tls`, TRIRAIL_TLS or
    ~/.config/trirail/<name> if absent, has ca.pem, cert.pem and key.pem, and the user is whom the certificate names;
    RefusedError not_allowed says which role would be needed. Poses are x, y [m] of the platform's centre in
    the base frame and its angle phi [rad], counterclockwise. Any call raises ServiceError where nobody answers and
    RefusedError, with code, slider, value and limit, where the service says no; nothing moves because of that call.
    """

    def __init__(
        self,
        name: str | None = None,
        connect: str | None = None,
        user: str | None = None,
        tls: Path | str | None = None,
    ) -> None:
        self.name, connect, self.user, credentials = identity(name, connect, user, tls)
        self._connection = Connection(self.name, connect, credentials, self.user)
        self._goals: dict[str, GoalHandle] = {}
        self._goals_lock = threading.Lock()
        self._results = self._connection.subscribe_to_events(self._on_event, history=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def __repr__(self) -> str:
        """Say where the robot is, and what it does."""
        from trirail.client import picture

        try:
            return picture.line(self.name, self.state(SEEN_WITHIN))
        except (TrirailError, zenoh.ZError) as error:
            return f"<Robot {self.name}: {error}>"

    def _repr_html_(self) -> str:
        """The same with a drawing, for notebooks."""
        from trirail.client import picture

        try:
            return picture.html(self.info(), self.state(SEEN_WITHIN))
        except (TrirailError, zenoh.ZError) as error:
            return escape(f"<Robot {self.name}: {error}>")

    def close(self) -> None:
        """End the connection; goals under way go on."""
        self._connection.close()

    @property
    def skipped(self) -> int:
        """How often something was published on this robot's keys that was none of its messages."""
        return self._connection.skipped

    # ------------------------------------------------------------------ goals and commands

    def move_to(
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
        id: str | None = None,  # noqa: A002 - the field's name on the wire
    ) -> GoalHandle:
        """Send a pose goal, x, y [m] and phi [rad] in the base frame; return once it is accepted.

        The platform goes straight in pose space where its start allows. `speed` is a fraction of full speed, (0, 1]:
        0.5 takes twice as long over the same path. With `blend` [m] the next pose goal waits for this one, and begins
        when no point of the platform is farther than that from where it is to be; without it, the next goal preempts
        this one. `limits` are lower ones than the platform's. A goal that has not begun within `valid_for` [s] expires.
        With a `tool`, a point of the platform in its own frame, (u, v) [m], or a name of [frames.tool], it is this
        point that goes to x, y, straight and within the platform's limits, while the platform turns. `frame` is one of
        [frames.work] in which x, y and phi are given.
        Its `id` must be new; one is made if absent. Raises RefusedError: out of reach, not enabled, stopping, ….
        """
        return self.send(
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
            ),
            id,
        )

    def move(
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
        id: str | None = None,  # noqa: A002 - the field's name on the wire
    ) -> GoalHandle:
        """Move the platform by x, y [m] and turn it by phi [rad] about its `tool`, or its centre; return when accepted.

        x and y are along the axes of `frame`: base, platform (as it is then), or one of [frames.work]. `origin` says
        from where: "commanded" is where the goals before it lead, so that moves add up whenever they are sent;
        "measured" is where the robot is measured to be. All else as of move_to.
        """
        return self.send(
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
            ),
            id,
        )

    def move_to_named(
        self,
        name: str,
        *,
        speed: float = 1.0,
        limits: OwnLimits | None = None,
        blend: float | None = None,
        valid_for: float | None = None,
        id: str | None = None,  # noqa: A002 - the field's name on the wire
    ) -> GoalHandle:
        """Send the platform to the pose of a name, one of `poses`; all else as of move_to.

        It is the pose that has the name when the service takes the goal. RefusedError `unknown_pose` where none has.
        """
        return self.send(
            lambda goal_id: NamedGoal(
                name=check_name(name, "pose"),
                id=goal_id,
                speed=speed,
                valid_for=valid_for,
                limits=limits,
                blend=blend,
            ),
            id,
        )

    def move_sliders(
        self,
        a: float,
        b: float,
        c: float,
        *,
        speed: float = 1.0,
        valid_for: float | None = None,
        id: str | None = None,  # noqa: A002 - the field's name on the wire
    ) -> GoalHandle:
        """Send a goal for the sliders A, B, C, their lambda_10 [m]; return once it is accepted.

        Straight in slider space where the start allows; also the way out of a pose that move_to refuses. `speed`,
        `valid_for` and `id` as of move_to.
        """
        return self.send(lambda name: SlidersGoal((a, b, c), speed=speed, valid_for=valid_for, id=name), id)

    def follow(
        self,
        points: Points,
        *,
        stretch: bool = False,
        settle: bool = True,
        go_there: bool = False,
        id: str | None = None,  # noqa: A002 - the field's name on the wire
    ) -> GoalHandle:
        """Send a timed trajectory that begins where the robot stands; return once it is accepted.

        With `go_there` the robot goes to its first point before, by a goal as of move_to: this waits for its end, and
        raises RefusedError `wrong_start` where that is not done.

        A point is t [s], x, y [m] and phi [rad], and where it is known, velocity and acceleration of the three.
        `points` may be rows of these four, as an array (N, 4), or the path of a CSV or JSON file.
        Quintic between the points; where they have no velocity it is that between their neighbours, zero at the ends.
        One that is too fast for a slider is refused, or slowed as a whole with `stretch`. With `settle` False it is
        done when its path has ended, whether or not the robot is measured to be there.
        """
        meant = points_of(points)
        if go_there:
            self._arrive(first_pose(meant))
        return self.send(lambda name: TrajectoryGoal(meant, stretch=stretch, settle=settle, id=name), id)

    def jog(
        self, x: float = 0.0, y: float = 0.0, phi: float = 0.0, *, timeout: float = 0.2, tool: Tool | None = None
    ) -> Jog:
        """Move the platform at a velocity [m/s, rad/s] while the context lasts, renewed before each `timeout` [s].

        It is that of a `tool`, about which the platform turns; of the centre where there is none.

        with robot.jog(x=0.01):
            wait_for_the_key_to_be_released()
        """
        return Jog(self.send, (x, y, phi), timeout, tool)

    def track(self, *, timeout: float = 0.25, id: str | None = None) -> Track:  # noqa: A002 - the field's name on the wire
        """Follow a moving target while the context lasts, told of 10 to 200 times a second; brake when it ends.

        with robot.track() as track:
            for pose, velocity, time in camera:
                track.update(pose, velocity, time)

        The robot goes on with the target's velocity between two updates, within every limit, and brakes on its path
        when none has come for `timeout` seconds of real time. `id` as of move_to.
        """

        goal_id = id or uuid.uuid4().hex[:12]

        def post(goal: Goal, deliver: Taker) -> None:
            self._connection.post(("goal", self.user), GoalReply, goal_message(lambda _: goal, goal_id), deliver)

        return Track(self.send, post, goal_id, timeout)

    def send(self, make: Goal | Callable[[str], Goal], id: str | None = None) -> GoalHandle:  # noqa: A002
        """Send a trirail.wire.goals.Goal, or the one that `make` makes for an id; return once it is accepted."""
        goal_id = id or id_of(make)
        content = goal_message(make, goal_id)
        goal = GoalHandle(goal_id, self.command)
        with self._goals_lock:
            goal = self._goals.setdefault(goal_id, goal)
        try:
            reply = self._connection.fetch(("goal", self.user), GoalReply, content)
        except (RefusedError, ServiceError):
            with self._goals_lock:
                self._goals.pop(goal_id, None)
            raise
        goal.reply = reply
        return goal

    def calibrate_camera(
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
        """Find how cameras show the marks of a part on the table, by moves of the stage; return there afterwards.

        `look` takes a picture, or one of each camera, and returns {mark: (u, v)} in pixels; a mark that it does not
        find is missing. `moves` are x, y [m] and phi [rad] from where the robot stands, ±1 mm and ±1° if absent; each
        must leave the marks in the picture. `views` names for each mark the view that shows it: without it each has
        one of its own, as with two cameras, or one that is moved to each mark. A `lens` perspective wants more moves,
        radial too and the `centre` of its picture [pixel]. `looks` pictures are taken at each place, `wait` seconds
        after the robot stands; with an `approach`, x, y [m] and phi [rad], it goes so far beyond first and back, so
        that backlash is on the same side each time. Ctrl-C stops the robot. Raises AlignmentError where looks do not
        tell it, RefusedError where a move is refused.
        """
        from trirail.alignment.procedure import MOVES, calibration_by_moves

        meant = MOVES if moves is None else moves
        return self._converse(look, calibration_by_moves(meant, views, lens, centre, looks, approach), speed, wait)  # type: ignore[no-any-return]

    def align(
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
        """Move a part until its marks are at their `targets`, {mark: (u, v)} in pixels; return how that went.

        Measure, correct about the marks' middle from where the robot is measured to be, measure again, until every
        mark is within `tolerance` [m] of where the best rigid motion has it and the part within `angle` [rad], or
        `corrections` have been made, or the error grows. The first correction with a calibration that is not confirmed
        goes no farther than twice its moves. Without a `calibration` one is made first, by moves of ±1 mm and ±1°.
        Marks whose distance is wrong by more than `distance`, a share, are refused, nothing moves. All else as of
        calibrate_camera.
        """
        from trirail.alignment.procedure import Task, align, calibrated_first

        def task(known: CameraCalibration) -> Task:
            return Task(known, targets, tolerance, angle, corrections, distance, looks, approach)

        wishes = align(task(calibration)) if calibration is not None else calibrated_first(task, looks, approach)
        return self._converse(look, wishes, speed, wait)  # type: ignore[no-any-return]

    def _converse(self, look: Look, wishes: Generator[Any, Any, Any], speed: float, wait: float) -> Any:
        """Do what a conversation of trirail.alignment.procedure wishes; return what it ends with."""
        from trirail.client.alignment import drive

        return drive(self, look, wishes, speed, wait)

    def _report_look(self, look: bytes) -> None:
        """Tell the service of a look of an alignment: a trirail.wire.looks.AlignmentLook as JSON."""
        self._connection.fetch(("alignment", self.user), AlignmentLook, look, REPORT_WITHIN)

    def _arrive(self, make: Callable[[str], Goal]) -> None:
        """Send a goal and wait until it is done. Raises RefusedError where it ends otherwise."""
        check_arrived(self.send(make).wait())

    def enable(self) -> None:
        """Power the drives up; return when the robot holds where it stands. Confirmed at once if it does already."""
        self.command(Command.ENABLE)

    def disable(self) -> None:
        """Stop, then take power off; return when the drives have none."""
        self.command(Command.DISABLE)

    def stop(self) -> None:
        """Stop on the path within the limits' jerk; return when the robot stands. No goal is taken until then."""
        self.command(Command.STOP)

    def quick_stop(self) -> None:
        """Stop every drive by its own ramp, as fast as it can; the robot is in fault until reset, without power."""
        self.command(Command.QUICK_STOP)

    def reset(self) -> None:
        """Clear a fault whose cause is gone; the robot is disabled afterwards. RefusedError while the cause lasts."""
        self.command(Command.RESET)

    def home(self) -> None:
        """Home the drives whose positions are not absolute; return when all are and the robot holds."""
        self.command(Command.HOME)

    def pause(self) -> None:
        """Stop on the path; return when the robot stands. The goal is kept for resume, a jog is not."""
        self.command(Command.PAUSE)

    def resume(self) -> None:
        """Go on with a paused goal."""
        self.command(Command.RESUME)

    def override(self, percent: float) -> None:
        """Let this motion and those to come run at a share of full speed, 0 or 1 to 200 %, within the limits."""
        self.command(Command.OVERRIDE, made_content(Command.OVERRIDE, lambda: Override(number(percent, "override"))))

    def lease(self, *, force: bool = False, timeout: float = 1.0) -> Lease:
        """Have the robot for oneself while the context lasts: only this user's goals and commands move it.

        It is kept by signs of life, from a thread of its own. Where these cease for `timeout` [s], and where the
        context ends, the robot stops within its limits and the lease is free. `force` takes it over from who holds it,
        by a role that may. Entering raises RefusedError `leased` where somebody else holds it. Stop, quick_stop and
        disable are everybody's all the same.

        with robot.lease():
            robot.move_to(x=0.02, y=0.0, phi=0.0).wait()
        """
        return Lease(self.command, force=force, timeout=timeout)

    def acquire(self, lease: AcquireLease | None = None) -> CommandReply:
        """Take the lease, or keep it by one sign of life; `lease` keeps it for as long as signs come."""
        return self.command(Command.ACQUIRE, lease)

    def release(self) -> None:
        """Give the lease back that this user holds, whichever of his clients keeps it; return when the robot stands."""
        self.command(Command.RELEASE)

    def command(self, name: str, content: CommandContent | bytes | None = None) -> CommandReply:
        """Send a command by its name on the wire; return once the service confirms that it has been carried out.

        `content` is of the type that trirail.wire.vocabulary.Command has for it, or that as JSON. What stops the robot
        is asked for at the service's door for stops as well, which others' connections keep nobody out of.
        """
        payload = content_message(name, content)
        if name in STOPS:
            return self._connection.stop(self.user, name, payload, REPLY_WITHIN)
        within = HOME_WITHIN if name == Command.HOME else REPLY_WITHIN
        return self._connection.fetch(("cmd", self.user, name), CommandReply, payload, within)

    def info(self) -> Info:
        """Ask for geometry, limits, rates and versions."""
        return self._connection.fetch(("info",), Info)

    def role(self) -> Role | None:
        """Ask what this user may; None where he may nothing. Where nobody is asked for a certificate: all."""
        role = self._connection.fetch(("role", self.user), RoleReply).role
        return None if role is None else Role(role)

    def users(self) -> list[str]:
        """Return who is connected to the robot now, by name, this user too."""
        return self._connection.users()

    def poses(self) -> dict[str, NamedPose]:
        """Ask for the named poses: those of the configuration, and those that were taught."""
        return {pose.name: pose for pose in self._connection.fetch(("poses",), NamedPoses).poses}

    def teach(self, name: str) -> NamedPose:
        """Keep where the robot is measured to stand, with power or without, as the pose of a name; return that pose.

        The service keeps it for good: when this returns it is on its disk. A taught pose of that name is replaced.
        Raises RefusedError where the robot moves, is in fault or has not been homed, and for names of [poses].
        """
        return self._connection.fetch(("teach", self.user, check_new_pose(name)), NamedPose)

    def forget(self, name: str) -> NamedPose:
        """Remove a taught pose; return what it was. Raises RefusedError where none of that name was taught."""
        return self._connection.fetch(("forget", self.user, check_name(name, "pose")), NamedPose)

    # ------------------------------------------------------------------ what the service tells

    def state(self, timeout: float = 2.0) -> State:
        """Return the next state that is published; after an answer or an event, none of before that.

        Raises ServiceError if none comes within `timeout` seconds.
        `pose` is measured, from the measured sliders; `commanded` is what the drives were told. SI units and radians.
        """
        for state in self.states(timeout):
            if not self._connection.overtaken(state):
                return state
        raise self._connection.nobody("state")

    def states(self, timeout: float | None = None) -> Iterator[State]:
        """Yield states as they come, the newest where this is too slow; end after `timeout` seconds without one."""
        return self._connection.states(seconds(timeout))

    def events(self, history: bool = False, timeout: float | None = None) -> Iterator[Event]:
        """Yield events in order, each once, with `history` the past first; end after `timeout` seconds without one."""
        return self._connection.events(history, seconds(timeout))

    def records(self, deliver: Callable[[bytes], None]) -> zenoh.Subscriber[None]:
        """Have every batch of records taken as it comes, until the context ends; wire.records.unpack reads them.

        `deliver` is called by the connection's own thread: it must be quick.
        """
        return self._connection.records(deliver)

    # ------------------------------------------------------------------ inside

    def _on_event(self, event: Event) -> None:
        if (result := result_of(event)) is None:
            return
        with self._goals_lock:
            goal = self._goals.pop(result.id, None)
        if goal is not None:
            goal.end(result)


def identity(
    robot: str | None, connect: str | None, user: str | None, tls: Path | str | None
) -> tuple[str, str, str, Credentials | None]:
    """Return with which robot a client speaks, where, as whom, and with which credentials.

    What is not given is as the environment has it, as in a shell. Raises RefusedError, ServiceError.
    """
    robot = check_name(robot or os.environ.get("TRIRAIL_ROBOT") or "demo", "robot")
    connect = connect or os.environ.get("TRIRAIL_CONNECT") or DEFAULT_LOCATOR
    if tls is None and reach(connect) is ReachableBy.CERTIFICATE:
        tls = os.environ.get("TRIRAIL_TLS") or None
    credentials = credentials_for(robot, connect, tls)
    known_as = credentials.name if credentials is not None else ""
    name = check_name(user or known_as or _user(), "user")
    if credentials is not None and known_as != name:
        whose = f"in the name of {quoted(known_as)}" if known_as else "without a common name"
        problem = f"the certificate in {credentials.folder} is {whose}: {name} cannot send with it"
        raise RefusedError(RefusalCode.NOT_ALLOWED, problem)
    return robot, connect, name, credentials


def result_of(event: Event) -> Result | None:
    """Return how the goal ended whose end an event tells; None for one that tells of something else."""
    if event.id is None or event.outcome is None:
        return None
    return Result(event.id, event.outcome, event.message, event.settle, event.residual, event.overshoot)


def _user() -> str:
    try:
        name = getpass.getuser()
    except (KeyError, OSError):
        return "anonymous"
    return re.sub(r"[^A-Za-z0-9_-]", "-", name)[:MAX_NAME] or "anonymous"
