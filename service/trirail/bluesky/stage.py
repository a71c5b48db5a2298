"""Stage as a Bluesky device, with x, y, phi and the pose as movable axes and the values of a state as readings."""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import AsyncGenerator, AsyncIterator, Sequence
from contextlib import aclosing
from typing import Any, Generic, NamedTuple, TypeVar, cast

import numpy as np
from bluesky.protocols import HasHints, Hints, Location
from event_model import DataKey
from numpy.typing import NDArray
from ophyd_async.core import AsyncLocatable, AsyncReadable, WatchableAsyncStatus, WatcherUpdate

from trirail.bluesky.flight import Flight, refuse_mock
from trirail.bluesky.monitor import Monitored, Readings
from trirail.bluesky.mover import Mover, setpoint_of, stop_elsewhere
from trirail.client.async_client import AsyncRobot
from trirail.client.client import Robot
from trirail.client.trajectory import Points, first_pose, points_of
from trirail.telemetry.drawn_robot import DrawnRobot
from trirail.wire.goals import PoseGoal
from trirail.wire.marks import MarkLike, marks_of
from trirail.wire.state import Pose, State

COORDINATES = ("x", "y", "phi")
UNITS = ("m", "m", "rad")
UNNAMED = "stage"
"""Default name of a stage."""
NAN_POSE = Pose(math.nan, math.nan, math.nan)
"""Measured pose in a reading while a slider is not homed."""
T = TypeVar("T", float, NDArray[np.float64])
Keys = dict[str, DataKey]


class StageLink(NamedTuple):
    """Connection of a stage to its service for one event loop."""

    loop: asyncio.AbstractEventLoop
    robot: AsyncRobot
    shown: DrawnRobot
    mover: Mover


class Stage(Monitored, AsyncReadable, HasHints):
    """Robot as a Bluesky device, with the movable axes `x`, `y` and `phi`, and `pose` for all three together.

    Lengths are in metres, angles in radians. All values of a reading are from the same state, which is newer than every
    event that this client has received. A reading after a move therefore shows the end of the move. The stage neither
    enables nor homes the robot.
    """

    def __init__(self, robot: Robot, name: str = "") -> None:
        self._robot = robot
        self._links: dict[asyncio.AbstractEventLoop, asyncio.Task[StageLink]] = {}
        self._flights: set[Flight] = set()
        """Flights that have been started and have not ended."""
        self.x = MovableAxis(0)
        self.y = MovableAxis(1)
        self.phi = MovableAxis(2)
        self.pose = MovablePose()
        super().__init__(name)

    @property
    def hints(self) -> Hints:
        """Keys of the readings that a table or a plot shows by default."""
        return {"fields": [self.x.name, self.y.name, self.phi.name]}

    async def connect(self, mock: object = False, *_: object, **__: object) -> None:
        """Connect to the service in the running event loop, and query the robot's geometry and limits.

        Raises ServiceError if the service does not answer, and TrirailError if a `mock` is requested.
        """
        refuse_mock(mock)
        await self.link()

    async def link(self) -> StageLink:
        """Return the connection for the running event loop; the first call creates it."""
        if not self.name:
            self.set_name(UNNAMED)  # Bluesky's documents need a name; init_devices would have used the variable's name
        loop = asyncio.get_running_loop()
        task = self._links.get(loop)
        if task is None or (task.done() and _made(task) is None):
            task = self._links[loop] = asyncio.create_task(self._connect(loop))
        return await asyncio.shield(task)

    async def describe(self) -> Keys:
        """Return the units, limits and precision of every reading, from a query of the service."""
        return self._keys(DrawnRobot.from_info(await (await self.link()).robot.info()))

    def _keys(self, shown: DrawnRobot) -> Keys:
        """Return the units, limits and precision of every reading of a robot."""
        keys = [self._key(shown, axis) for axis in range(3)]
        source = keys[0]["source"]
        vector = DataKey(source=source, dtype="array", dtype_numpy="<f8", shape=[3], units="m")
        return {
            **{axis.name: key for axis, key in zip((self.x, self.y, self.phi), keys, strict=True)},
            self.pose.name: DataKey({**vector, "units": "m, m, rad"}),
            self.key("sliders"): vector,
            self.key("following_error"): vector,
            self.key("t"): DataKey(source=source, dtype="number", dtype_numpy="<f8", shape=[], units="s"),
        }

    async def read(self) -> Readings:
        """Return the readings of the next state.

        The readings are the measured pose [m, m, rad], the slider positions and following errors [m], and the nominal
        time [s]. The pose, and the position of a slider that is not homed, are NaN.
        """
        return self.readings(await (await self.link()).robot.state())

    async def stop(self, success: bool = True) -> None:
        """Stop the goal of this stage's axes, and its flights, whichever event loop has sent them.

        Return when the robot is at rest. Goals of other clients continue.
        """
        here, robot = asyncio.get_running_loop(), (await self.link()).robot
        flights = [flight for flight in self._flights if flight.under_way]
        for flight in flights:
            flight.note_stop(success)
        movers = [(loop, link.mover) for loop, task in tuple(self._links.items()) if (link := _made(task))]
        # Another event loop may be blocked or closed. Its goals are stopped in this one.
        elsewhere = [mover.interrupt(success) for loop, mover in movers if loop is not here]
        elsewhere += [flight.interrupt(success) for flight in flights if flight.loop is not here]
        stops = await asyncio.gather(
            *(stop_elsewhere(robot, goal) for goal in elsewhere if goal is not None),
            *(mover.stop(success) for loop, mover in movers if loop is here),
            *(flight.stop_path(success) for flight in flights if flight.loop is here),
            return_exceptions=True,  # each is tried
        )
        if errors := [each for each in stops if each is not None]:
            raise errors[0]
        for _, mover in movers:
            mover.forget()

    def note_flight(self, flight: Flight) -> None:
        """Record that a flight has been started, so that `stop` stops it; forget those that have ended."""
        self._flights = {other for other in self._flights if other.under_way} | {flight}

    async def check(self, pose: Sequence[float]) -> None:
        """Let the service check the whole path to a pose against every limit, without moving.

        Raises RefusedError with the limit and the value if the service would refuse the pose.
        """
        x, y, phi = (float(value) for value in pose)
        await (await self.link()).robot.check(PoseGoal(x=x, y=y, phi=phi))

    def follow(
        self, points: Points, *, marks: Sequence[MarkLike] = (), stretch: bool = False, name: str = ""
    ) -> Flight:
        """Return a fly scan along timed points, as in Robot.follow. The robot first moves to the first point.

        The scan collects the switches of outputs at its marks. If there are no marks, it collects the readings of every
        state during the path. By default, the scan is named "flight", or "marked_flight" if it has marks, since one
        stream cannot contain both.
        """
        rows, places = points_of(points), marks_of(marks)
        start = first_pose(rows)("start")
        first = dict(enumerate((start.x, start.y, start.phi)))
        return Flight(self, lambda robot: robot.follow(rows, stretch=stretch, marks=places), bool(places), name, first)

    def fly_to(
        self, x: float, y: float, phi: float, *, marks: Sequence[MarkLike] = (), speed: float = 1, name: str = ""
    ) -> Flight:
        """Return a fly scan to a pose on a straight path, as in Robot.move_to; the data are those of `follow`."""
        places = marks_of(marks)
        return Flight(self, lambda robot: robot.move_to(x, y, phi, speed=speed, marks=places), bool(places), name)

    def key(self, name: str) -> str:
        """Return the key of the reading with this name."""
        return f"{self.name or UNNAMED}-{name}"

    def readings(self, state: State) -> Readings:
        """Return all readings of a state."""
        pose = state.measured_pose or NAN_POSE
        values: dict[str, Any] = {
            **dict(zip((self.x.name, self.y.name, self.phi.name), pose, strict=True)),
            self.pose.name: np.array(pose),
            self.key("sliders"): np.where(state.sliders.homed, state.sliders.position, math.nan),
            self.key("following_error"): np.array(state.sliders.following_error),
            self.key("t"): state.t,
        }
        return {name: {"value": value, "timestamp": state.time} for name, value in values.items()}

    async def _states(self) -> AsyncGenerator[State]:
        async with aclosing((await self.link()).robot.states()) as states:
            async for state in states:
                yield state

    def _readings(self, state: State) -> Readings:
        return self.readings(state)

    def _key(self, shown: DrawnRobot, axis: int) -> DataKey:
        limits, name = shown.limits, COORDINATES[axis]
        low, high = getattr(limits.platform, name)
        return {
            "source": f"trirail://{shown.name}/state",
            "dtype": "number",
            "dtype_numpy": "<f8",
            "shape": [],
            "units": UNITS[axis],
            # The precision is one digit finer than the in-position window.
            "precision": math.ceil(-math.log10(limits.in_position.pose[axis])) + 1,
            "limits": {"control": {"low": low, "high": high}},
        }

    async def _connect(self, loop: asyncio.AbstractEventLoop) -> StageLink:
        """Return a connection for the running event loop.

        Connections of closed event loops are closed first, but for those with goals that `stop` must stop.
        """
        for closed in [each for each in tuple(self._links) if each.is_closed()]:
            before = _made(self._links[closed])
            if before is not None and before.mover.moves:
                continue
            del self._links[closed]
            if before is not None:
                with contextlib.suppress(RuntimeError):  # tasks that the closed event loop has left behind
                    await before.robot.close()
        robot = await self._robot._for_running_loop()
        shown = DrawnRobot.from_info(await robot.info())
        return StageLink(loop, robot, shown, Mover(robot))


def _made(task: asyncio.Task[StageLink]) -> StageLink | None:
    """Return the connection that a task has made; None if there is none."""
    return task.result() if task.done() and not task.cancelled() and task.exception() is None else None


class _Movable(Monitored, AsyncLocatable[T], AsyncReadable, HasHints, Generic[T]):
    """Base class of the movable axes of a stage; one value of type T sets one axis or all axes."""

    def __init__(self, coordinate: str) -> None:
        self._coordinate = coordinate
        super().__init__()

    @property
    def _stage(self) -> Stage:
        return cast(Stage, self.parent)  # Device sets the parent when a stage gets its axes

    @property
    def name(self) -> str:
        """Name of the axis, which is also the key of its reading."""
        if self._name or self.parent is None:
            return self._name
        return self._stage.key(self._coordinate)

    @property
    def hints(self) -> Hints:
        """Key of the reading that a table or a plot shows by default."""
        return {"fields": [self.name]}

    async def connect(self, mock: object = False, *_: object, **__: object) -> None:
        """Connect the stage to the service. Raises TrirailError if a `mock` is requested."""
        refuse_mock(mock)
        await self._stage.link()

    async def describe(self) -> Keys:
        """Return the units, limits and precision of the reading."""
        return {self.name: (await self._stage.describe())[self.name]}

    async def read(self) -> Readings:
        """Wait for the next state message and return the measured value in the message."""
        return self._own(await self._stage.read())

    async def locate(self) -> Location[T]:
        """Return the setpoint and the measured value; NaN while a slider is not homed.

        The setpoint is the target of the goal in progress; if there is no goal, it is the commanded value.
        """
        state = await (await self._stage.link()).robot.state()
        setpoint, measured = (setpoint_of(state), state.measured_pose) if state.measured_pose else (NAN_POSE, NAN_POSE)
        return Location(setpoint=self._value(setpoint), readback=self._value(measured))

    @WatchableAsyncStatus.wrap
    async def set(self, value: T) -> AsyncIterator[WatcherUpdate[T]]:
        """Move to a value. The status is done when the measured position has settled at the value.

        The status fails with the reason if the goal is refused, or ends with an outcome other than done. Sets of
        several axes within some milliseconds become one straight move.
        """
        targets = self._targets(value)
        link = await self._stage.link()
        move = link.mover.start(targets)
        initial: T | None = None
        key = self._stage._keys(link.shown)[self.name]
        async for pose in link.mover.progress(move):
            current = self._value(pose)
            initial = current if initial is None else initial
            yield WatcherUpdate(
                current=current, initial=initial, target=value, name=self.name, unit=key.get("units"),
                precision=key.get("precision"),
            )  # fmt: skip

    async def stop(self, success: bool = True) -> None:
        """Stop the goal of the stage's axes; return when the robot is at rest."""
        await self._stage.stop(success)

    def _states(self) -> AsyncGenerator[State]:
        return self._stage._states()

    def _readings(self, state: State) -> Readings:
        return self._own(self._stage.readings(state))

    def _own(self, readings: Readings) -> Readings:
        return {self.name: readings[self.name]}

    def _targets(self, value: T) -> dict[int, float]:
        raise NotImplementedError

    def _value(self, pose: Pose) -> T:
        raise NotImplementedError


class MovableAxis(_Movable[float]):
    """Movable axis for one coordinate of the platform's centre: x, y [m] or phi [rad]."""

    def __init__(self, index: int) -> None:
        self._index = index
        super().__init__(COORDINATES[index])

    async def check_value(self, value: float) -> None:
        """Check the path to a value; see Stage.check. The other coordinates are at their setpoints, as in `locate`."""
        pose = list(setpoint_of(await (await self._stage.link()).robot.state()))
        pose[self._index] = float(value)
        await self._stage.check(pose)

    def _targets(self, value: float) -> dict[int, float]:
        return {self._index: float(value)}

    def _value(self, pose: Pose) -> float:
        return pose[self._index]


class MovablePose(_Movable[NDArray[np.float64]]):
    """Movable axis for the whole pose of the platform's centre: x, y [m] and phi [rad]."""

    def __init__(self) -> None:
        super().__init__("pose")

    async def check_value(self, value: Sequence[float] | NDArray[np.float64]) -> None:
        """Check the path to a pose; see Stage.check."""
        await self._stage.check([float(number) for number in value])

    def _targets(self, value: NDArray[np.float64]) -> dict[int, float]:
        x, y, phi = (float(number) for number in value)
        return {0: x, 1: y, 2: phi}

    def _value(self, pose: Pose) -> NDArray[np.float64]:
        return np.array(pose)
