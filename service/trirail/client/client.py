"""Blocking client of the service: goals, commands and states over Zenoh.

with Robot("demo") as robot:
    robot.enable()
    result = robot.move_to(x=0.02, y=-0.01, phi=0.1).wait(timeout=10)
"""

from __future__ import annotations

import functools
import inspect
import time
from collections.abc import AsyncGenerator, Callable, Coroutine, Generator, Iterator, Sequence
from html import escape
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Concatenate, ParamSpec, Self, TypeVar, cast

import zenoh

from trirail.client.async_client import AsyncRobot
from trirail.client.blocking import GoalHandle, Jog, Lease, LoopThread, Track, callback
from trirail.client.call_time import called, called_at
from trirail.client.goal import AsyncGoalHandle, Result
from trirail.client.trajectory import Points, points_of
from trirail.errors import TrirailError
from trirail.wire.marks import MarkLike, StopAtLike
from trirail.wire.messages import CommandReply
from trirail.wire.stop_protocol import STOPS
from trirail.wire.vocabulary import CommandContent

if TYPE_CHECKING:  # numpy, which most programs do not need
    from trirail.alignment.alignment_request import AlignmentRequest, Observation
    from trirail.client.alignment import Look

__all__ = ["GoalHandle", "Jog", "Lease", "Result", "Robot", "Track"]

SEEN_WITHIN = 1.0
"""Time-out for receiving the state that `repr(robot)` shows [s]."""

P = ParamSpec("P")
T = TypeVar("T")
Held = TypeVar("Held")


def _call(
    method: Callable[Concatenate[AsyncRobot, P], Coroutine[Any, Any, T]],
) -> Callable[Concatenate[Robot, P], T]:
    """Return the method of Robot that runs a method of AsyncRobot and waits for its result."""

    @functools.wraps(method)
    def call(robot: Robot, /, *args: P.args, **kwargs: P.kwargs) -> T:
        return robot._loop.call(method(robot._robot, *args, **kwargs))

    return call


def _stop(
    method: Callable[Concatenate[AsyncRobot, P], Coroutine[Any, Any, T]],
) -> Callable[Concatenate[Robot, P], T]:
    """Return the method of Robot that runs a stop method of AsyncRobot and waits for its result.

    Stops run in a separate event loop, so calls that wait for a congested link do not delay a stop.
    """

    @functools.wraps(method)
    def call(robot: Robot, /, *args: P.args, **kwargs: P.kwargs) -> T:
        return robot._stop_loop.call(method(robot._stopping, *args, **kwargs), at=time.monotonic())

    return call


def _command(
    method: Callable[[AsyncRobot, str, CommandContent | bytes | None], Coroutine[Any, Any, CommandReply]],
) -> Callable[..., CommandReply]:
    """Return the method of Robot that sends a command by name, in the separate event loop if it stops the robot."""
    send, stop = _call(method), _stop(method)

    @functools.wraps(method)
    def command(robot: Robot, name: str, content: CommandContent | bytes | None = None) -> CommandReply:
        return (stop if name in STOPS else send)(robot, name, content)

    return command


def _goal(
    method: Callable[Concatenate[AsyncRobot, P], Coroutine[Any, Any, AsyncGoalHandle]],
) -> Callable[Concatenate[Robot, P], GoalHandle]:
    """Return the method of Robot that sends a goal through a method of AsyncRobot."""

    @functools.wraps(method)
    def send(robot: Robot, /, *args: P.args, **kwargs: P.kwargs) -> GoalHandle:
        return robot._send(lambda: method(robot._robot, *args, **kwargs))

    return _returning(send, GoalHandle)


def _context(
    method: Callable[Concatenate[AsyncRobot, P], Held], kind: Callable[[Held, LoopThread], T]
) -> Callable[Concatenate[Robot, P], T]:
    """Return the method of Robot that wraps a context manager of AsyncRobot in an object of class `kind`."""

    @functools.wraps(method)
    def hold(robot: Robot, /, *args: P.args, **kwargs: P.kwargs) -> T:
        return kind(method(robot._robot, *args, **kwargs), robot._loop)

    return _returning(hold, kind)


def _iterator(
    method: Callable[Concatenate[AsyncRobot, P], AsyncGenerator[T]],
) -> Callable[Concatenate[Robot, P], Iterator[T]]:
    """Return the method of Robot that yields the items of an asynchronous generator of AsyncRobot."""

    @functools.wraps(method)
    def iterate(robot: Robot, /, *args: P.args, **kwargs: P.kwargs) -> Iterator[T]:
        return robot._loop.iterate(method(robot._robot, *args, **kwargs))

    return _returning(iterate, Iterator)


def _conversation(
    method: Callable[Concatenate[AsyncRobot, P], Coroutine[Any, Any, T]],
) -> Callable[Concatenate[Robot, P], T]:
    """Return the method of Robot that runs an alignment procedure of AsyncRobot in the caller's thread."""

    @functools.wraps(method)
    def converse(robot: Robot, /, *args: P.args, **kwargs: P.kwargs) -> T:
        from trirail.client.alignment import finish  # numpy

        return finish(method(cast(AsyncRobot, robot), *args, **kwargs))

    return converse


def _returning(method: Callable[P, T], kind: object) -> Callable[P, T]:
    """Set the return type in a method's signature; return the method."""
    name = getattr(kind, "__name__", str(kind))
    vars(method)["__signature__"] = inspect.signature(method).replace(return_annotation=name)
    return method


class Robot:
    """Connection to one robot's service; several threads may share a connection.

    `name` is the name in the robot's configuration, and `connect` is the Zenoh locator of the service or of a router.
    The defaults are the environment variables TRIRAIL_ROBOT and TRIRAIL_CONNECT, or else the robot demo on this
    machine. `user` is the name of the user who sends the goals and commands, and defaults to the login name.

    For a locator tls/HOST:PORT, the folder `tls` must contain ca.pem, cert.pem and key.pem. The folder defaults to the
    environment variable TRIRAIL_TLS, or else to ~/.config/trirail/<name>. The user is then the name in the certificate,
    and a RefusedError `not_allowed` names the role that the call requires.

    A pose is x, y [m] of the platform's centre in the base frame and the platform's angle phi [rad], counterclockwise.
    Every call raises ServiceError if the service does not answer. If the service refuses the call, nothing moves, and
    the call raises RefusedError with a code, slider, value and limit.
    """

    def __init__(
        self,
        name: str | None = None,
        connect: str | None = None,
        user: str | None = None,
        tls: Path | str | None = None,
    ) -> None:
        self._robot = AsyncRobot(name, connect, user, tls)
        self.name, self.user = self._robot.name, self._robot.user
        self._connection = self._robot._connected()
        self._loop = LoopThread()
        self._loop.call(self._robot._use(self._connection))
        # A call that waits for a congested link blocks the thread of its event loop. Stops run in a second event loop,
        # so that a blocked call cannot delay a stop.
        self._stop_loop = LoopThread()
        self._stopping = self._stop_loop.call(self._robot._twin())

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def __repr__(self) -> str:
        """Return one line with the robot's mode and pose."""
        from trirail.client import picture

        try:
            return picture.line(self.name, self.state(SEEN_WITHIN))
        except (TrirailError, zenoh.ZError) as error:
            return f"<Robot {self.name}: {error}>"

    def _repr_html_(self) -> str:
        """Return the robot's mode and pose with a drawing, for notebooks."""
        from trirail.client import picture

        try:
            return picture.html(self.info(), self.state(SEEN_WITHIN))
        except (TrirailError, zenoh.ZError) as error:
            return escape(f"<Robot {self.name}: {error}>")

    def close(self) -> None:
        """Close the connection; accepted goals continue."""
        self._connection.close()
        self._loop.close()
        self._stop_loop.close()

    async def _for_running_loop(self) -> AsyncRobot:
        """Return a robot for the running event loop that shares this robot's connection.

        The returned robot works until either of the two robots is closed.
        """
        return await self._robot._shared(self._connection)

    @property
    def skipped(self) -> int:
        """Number of invalid messages received on this robot's keys."""
        return self._connection.skipped

    # ------------------------------------------------------------------ goals and commands

    move_to = _goal(AsyncRobot.move_to)
    move = _goal(AsyncRobot.move)
    move_to_named = _goal(AsyncRobot.move_to_named)
    move_sliders = _goal(AsyncRobot.move_sliders)
    send = _goal(AsyncRobot.send)
    check = _call(AsyncRobot.check)
    jog = _context(AsyncRobot.jog, Jog)
    track = _context(AsyncRobot.track, Track)
    calibrate_camera = _conversation(AsyncRobot.calibrate_camera)
    align = _conversation(AsyncRobot.align)
    calibrate_geometry = _conversation(AsyncRobot.calibrate_geometry)

    enable = _call(AsyncRobot.enable)
    disable = _stop(AsyncRobot.disable)
    stop = _stop(AsyncRobot.stop)
    quick_stop = _stop(AsyncRobot.quick_stop)
    reset = _call(AsyncRobot.reset)
    home = _call(AsyncRobot.home)
    pause = _call(AsyncRobot.pause)
    resume = _call(AsyncRobot.resume)
    override = _call(AsyncRobot.override)
    set_output = _call(AsyncRobot.set_output)
    lease = _context(AsyncRobot.lease, Lease)
    acquire = _call(AsyncRobot.acquire)
    release = _call(AsyncRobot.release)
    command = _command(AsyncRobot.command)

    info = _call(AsyncRobot.info)
    role = _call(AsyncRobot.role)
    users = _call(AsyncRobot.users)
    poses = _call(AsyncRobot.poses)
    teach = _call(AsyncRobot.teach)
    forget = _call(AsyncRobot.forget)

    def follow(
        self,
        points: Points,
        *,
        stretch: bool = False,
        settle: bool = True,
        go_there: bool = False,
        marks: Sequence[MarkLike] = (),
        stop_at: StopAtLike | None = None,
        id: str | None = None,  # noqa: A002 - the field's name on the wire
    ) -> GoalHandle:
        """Send a timed trajectory that begins at the robot's pose; return once the service accepts it.

        With `go_there`, the robot first moves to the first point, with a goal like that of move_to. The call waits for
        the end of this goal, and raises RefusedError `wrong_start` if the outcome of this goal is not done.

        A point consists of t [s], x, y [m] and phi [rad], and optionally of the velocity and acceleration of x, y and
        phi. `points` may be rows of t, x, y and phi, such as an array (N, 4), or the path of a CSV or JSON file.
        Quintic polynomials join the points. If a point has no velocity, the client uses the mean velocity between the
        neighbouring points, and zero at both ends. The service refuses a trajectory that is too fast for a slider; with
        `stretch`, the service instead slows the whole trajectory down. With `settle` False, the goal is done when its
        path ends, even if the measured position has not yet reached the target.
        """
        how: dict[str, Any] = {
            "stretch": stretch,
            "settle": settle,
            "go_there": go_there,
            "marks": marks,
            "stop_at": stop_at,
        }
        began = called_at()
        rows = points_of(points)  # in the caller's thread, since the caller's iterator may call this robot
        return self._send(lambda: self._robot.follow(rows, **how, id=id), began)

    # ------------------------------------------------------------------ what the service tells

    state = _call(AsyncRobot.state)
    states = _iterator(AsyncRobot.states)
    events = _iterator(AsyncRobot.events)

    def records(self, deliver: Callable[[bytes], None]) -> zenoh.Subscriber[None]:
        """Call `deliver` with every batch of records until the returned subscriber is closed.

        trirail.wire.records.unpack decodes a batch. A thread of the connection calls `deliver`, which must return
        quickly and must not call the robot.
        """
        return self._connection.records(callback(deliver))

    # ------------------------------------------------------------------ inside

    def _send(self, send: Callable[[], Coroutine[Any, Any, AsyncGoalHandle]], began: float | None = None) -> GoalHandle:
        """Send a goal and return its handle. If an exception such as Ctrl-C interrupts the call, stop the goal.

        `began` is the time at which the program called for the goal [s]; None for the present time.
        """
        sent: list[AsyncGoalHandle] = []

        async def handle() -> GoalHandle:
            with called(began):
                sent.append(await send())
            return GoalHandle(sent[0], self._loop, self.command)

        async def stop() -> None:
            for goal in sent:
                await goal.cancel()

        return self._loop.call(handle(), stop)

    async def _converse(
        self, look: Look, requests: Generator[AlignmentRequest, Observation, T], speed: float, wait: float
    ) -> T:
        """Carry out the requests of a trirail.alignment procedure in this thread; return the procedure's result."""
        from trirail.client.alignment import drive

        return drive(self, look, requests, speed, wait)

    _report_look = _call(AsyncRobot._report_look)
    _begin_call = _call(AsyncRobot._begin_call)
