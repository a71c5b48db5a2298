"""Fly scan, which consists of a path that the robot follows without a stop and the data collected on the path."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable, Coroutine, Mapping
from contextlib import aclosing
from typing import TYPE_CHECKING, Any, cast

from bluesky.protocols import EventCollectable, Flyable, Pausable, Reading
from event_model import DataKey, PartialEvent
from ophyd_async.core import AsyncStatus, Device

from trirail.bluesky.mover import Sending, cancel, check_done
from trirail.client.async_client import AsyncRobot
from trirail.client.call_time import called
from trirail.client.goal import AsyncGoalHandle
from trirail.errors import TrirailError
from trirail.wire.marks import Switch, switch_rows

if TYPE_CHECKING:
    from trirail.bluesky.stage import Stage

COLUMNS: dict[str, tuple[str, str]] = {
    "goal": ("string", ""),
    "mark": ("integer", ""),
    "output": ("string", ""),
    "value": ("boolean", ""),
    "cycle": ("integer", ""),
    "t": ("number", "s"),
    "time": ("number", "s"),
    "closed": ("boolean", ""),
    **{f"{kind}_{axis}": ("number", unit) for kind in ("commanded", "measured")
       for axis, unit in (("x", "m"), ("y", "m"), ("phi", "rad"))},
}  # fmt: skip
"""Type and unit of each column in the table of output switches."""


class Flight(Device, Flyable, EventCollectable, Pausable):
    """Fly scan of a stage: `kickoff` starts the path, `complete` waits for its end, and `collect` yields the data.

    `send` is a function that sends the goal of the path. `first` is the pose to which the robot moves before the path,
    as a mapping from the index of each coordinate to its value. When the plan that started the path ends, the device
    stops the path. The RunEngine would not do this, because it stops only devices that were set.
    """

    def __init__(
        self,
        stage: Stage,
        send: Callable[[AsyncRobot], Coroutine[Any, Any, AsyncGoalHandle]],
        has_marks: bool,
        name: str,
        first: Mapping[int, float] | None = None,
    ) -> None:
        self.parent = stage
        self._send = send
        self._has_marks = has_marks
        self._first = first
        self._goal: AsyncGoalHandle | None = None
        self._sampling: asyncio.Task[None] | None = None
        self._samples: list[tuple[str, dict[str, Reading[Any]]]] = []
        """Readings, each with the id of the goal in progress, since states can arrive before the path is accepted."""
        self._collected = 0
        """Number of rows that `collect` has yielded."""
        self._sending = Sending()
        self._interrupted: AsyncGoalHandle | None = None
        """Goal that was stopped on request, which is not a failure."""
        self._stopped: bool | None = None
        """Whether the start was stopped without being a failure; None if it was not stopped."""
        self._paused = False
        """Whether the plan has paused since the last `kickoff`."""
        self._begun: AsyncStatus[None] | None = None
        self._stopping: asyncio.Task[None] | None = None
        super().__init__(name or ("marked_flight" if has_marks else "flight"))

    @property
    def _stage(self) -> Stage:
        return cast("Stage", self.parent)

    @property
    def loop(self) -> asyncio.AbstractEventLoop:
        """Event loop in which the flight was started."""
        return self._loop

    @property
    def under_way(self) -> bool:
        """Whether the flight is starting, or its path is in progress."""
        begins = self._begun is not None and not self._begun.done
        return begins or (self._goal is not None and self._goal.result is None)

    async def connect(self, mock: object = False, *_: object, **__: object) -> None:
        """Connect the stage to the service. Raises TrirailError if a `mock` is requested."""
        refuse_mock(mock)
        await self._stage.link()

    def kickoff(self) -> AsyncStatus[None]:
        """Move to the first point, then start the path. The status is done when the service has accepted the path.

        The calling task runs the plan. If this task ends before the path does, the path is stopped.
        """
        self._end_sampling()  # that of a path for which the plan has not called `complete`
        self._goal, self._samples, self._collected, self._stopped, self._paused = None, [], 0, None, False
        self._interrupted = None
        self._loop, self._sending = asyncio.get_running_loop(), Sending()
        with called():  # a stop that is called later refuses the goals
            self._begun = status = AsyncStatus(self._kickoff())
        self._stage.note_flight(self)
        if (plan := asyncio.current_task()) is not None:
            plan.add_done_callback(lambda _: self._end_with_plan(status))
        return status

    async def _kickoff(self) -> None:
        link = await self._stage.link()
        if self._first is not None and self._stopped is None:
            await link.mover.start(self._first).end
        async with self._sending:
            if self._stopped:
                return
            if self._stopped is not None:
                raise TrirailError("the motion was stopped before its goal was sent")
            if not self._has_marks:
                self._sampling = asyncio.create_task(self._sample(link.robot))
                self._sampling.add_done_callback(lambda task: task.cancelled() or task.exception())
            try:
                self._goal = await self._sending.send(self._send(link.robot))
            except BaseException:
                self._end_sampling()
                raise

    @AsyncStatus.wrap
    async def complete(self) -> None:
        """Wait until the robot's measured position has settled at the end of the path.

        Raises UnfinishedError with the reason if the path ends with an outcome other than done, and TrirailError if a
        pause has stopped the path and the plan has not repeated it.
        """
        if self._paused:
            raise TrirailError(
                f"{self.name}: a pause has stopped the path, and the plan has resumed behind its kickoff; a checkpoint "
                "must not be between kickoff and complete"
            )
        goal = self._goal
        if goal is None and self._stopped:
            return
        if goal is None:
            raise TrirailError(f"{self.name}: complete was called before kickoff")
        link = await self._stage.link()
        try:
            result = await link.mover.settle(goal)
        finally:
            self._end_sampling()
        if goal is self._interrupted:
            return
        check_done(result)
        if not self._has_marks:  # the last states may arrive after the result
            end = goal.id, self._stage.readings(await link.robot.state())
            if end not in self._samples[-1:]:
                self._samples.append(end)

    async def stop(self, success: bool = True) -> None:
        """Stop the path; return when the robot is at rest.

        With `success`, `kickoff` and `complete` end without an error, also if the path has not begun.
        """
        self.note_stop(success)
        await self._stage.stop(success)
        self._end_sampling()

    def note_stop(self, success: bool) -> None:
        """Record that the flight is being stopped, so that its path is not sent any more."""
        self._stopped = success

    async def stop_path(self, success: bool) -> None:
        """Stop the path in the event loop in which it was started; return when the robot is at rest."""
        await self._sending.end()
        if (goal := self._interrupt(success)) is not None:
            await cancel(goal)

    def interrupt(self, success: bool) -> AsyncGoalHandle | None:
        """Stop the path from another thread, whose event loop then stops the goal that is returned, if there is one."""
        with contextlib.suppress(RuntimeError):  # the event loop is closed, so nothing is being sent
            self._loop.call_soon_threadsafe(self._sending.abandon)
        return self._interrupt(success)

    def _interrupt(self, success: bool) -> AsyncGoalHandle | None:
        goal = self._goal
        if goal is None or goal.result is not None:
            return None
        self._interrupted = goal if success else None
        return goal

    async def pause(self) -> None:
        """Stop the path. If the plan resumes from a checkpoint before `kickoff`, it repeats the path from its start.

        Otherwise `complete` raises an error, unless it is already in progress.
        """
        # The plan may already have stopped the path, together with the axes.
        stopped = self._stopped is not None and self._goal is self._interrupted
        self._paused = self._paused or self.under_way or stopped
        await self.stop()

    async def resume(self) -> None:
        """Do nothing, since the plan repeats `kickoff`."""

    async def describe_collect(self) -> dict[str, dict[str, DataKey]]:
        """Return the columns of the collected data. The name of the stream is the name of the flight."""
        if not self._has_marks:
            return {self.name: await self._stage.describe()}
        source = f"trirail://{(await self._stage.link()).shown.name}/event"
        return {self.name: {f"{self.name}-{name}": _key(source, *column) for name, column in COLUMNS.items()}}

    async def collect(self) -> AsyncIterator[PartialEvent]:
        """Yield a row for each switch of an output on the path; if there are no marks, yield a row for each state.

        A further call yields only the rows that have been added since then.
        """
        goal_id = self._goal.id if self._goal is not None else ""
        sampled = [readings for during, readings in self._samples if during == goal_id]
        rows = self._switches() if self._has_marks else sampled
        for row in rows[self._collected :]:
            self._collected += 1
            values = {name: reading["value"] for name, reading in row.items()}
            stamps = {name: reading["timestamp"] for name, reading in row.items()}
            yield {"time": next(iter(stamps.values())), "data": values, "timestamps": stamps}

    def _end_with_plan(self, begun: AsyncStatus[None]) -> None:
        """Stop the path if it is starting or in progress, and end its readings; called when the plan ends."""
        self._end_sampling()
        if self._begun is begun and self.under_way:
            self._stopping = asyncio.create_task(self._stop_late())

    async def _stop_late(self) -> None:
        try:
            await self.stop()
        except TrirailError:
            self.log.exception("%s is not stopped", self.name)

    def _switches(self) -> list[dict[str, Reading[Any]]]:
        result = self._goal.result if self._goal is not None else None
        switches: tuple[Switch, ...] = result.marks if result is not None else ()
        return [
            {f"{self.name}-{name}": {"value": value, "timestamp": row["time"]} for name, value in row.items()}
            for row in switch_rows(switches)
        ]

    async def _sample(self, robot: AsyncRobot) -> None:
        async with aclosing(robot._connection.states(None, every=True)) as states:
            async for state in states:
                if state.goal is not None:
                    self._samples.append((state.goal.id, self._stage.readings(state)))

    def _end_sampling(self) -> None:
        if self._sampling is not None:
            self._sampling.cancel()
            self._sampling = None


def refuse_mock(mock: object) -> None:
    """Raise TrirailError if a mock of a device is requested: the real robot would move."""
    if mock:
        raise TrirailError("a stage has no mock: connect it to a service with simulated drives, such as trirail demo")


def _key(source: str, dtype: Any, unit: str) -> DataKey:
    key: DataKey = {"source": source, "dtype": dtype, "shape": []}
    return {**key, "units": unit} if unit else key
