"""Sets that meet a stop, a cancellation, a refusal or the loss of the service half-way, with a robot that is told what
to do: nothing moves behind a stop, every set ends, and no error or task is left."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncGenerator, Awaitable, Callable
from typing import Any, cast

import pytest
from trirail.bluesky import UnfinishedError
from trirail.bluesky import mover as mover_module
from trirail.bluesky.flight import Flight
from trirail.bluesky.mover import AxisMove, Mover, cancel, setpoint_of
from trirail.client import goal as goal_module
from trirail.client.async_client import AsyncRobot
from trirail.client.call_time import called_at
from trirail.client.goal import AsyncGoalHandle, Result
from trirail.errors import RefusalCode, RefusedError, ServiceError, TrirailError
from trirail.wire.state import Pose
from waiting import WITHIN


class State:
    """What a mover reads of a state."""

    def __init__(self, pose: Pose, seq: int = 1) -> None:
        self.pose, self.seq = pose, seq
        self.goal: Going | None = None
        self.commanded = self


class Going:
    """A goal in progress, of another client."""

    def __init__(self, target: Pose | None) -> None:
        self.target = target


class Robot:
    """A robot that accepts a goal when told to, and ends it by a stop or when told to."""

    def __init__(self) -> None:
        self.pose = Pose(0.0, 0.0, 0.0)
        self.going: Going | None = None
        self.goals: list[AsyncGoalHandle] = []
        self.targets: list[tuple[float, float, float]] = []
        self.accepts = asyncio.Event()
        self.accepts.set()
        self.refuses: Exception | None = None
        self.cancelled = 0
        self.called: list[float] = []
        """When the program called for each goal."""
        self.told: asyncio.Queue[State | Exception] = asyncio.Queue()

    async def state(self) -> State:
        state = State(self.pose)
        state.goal = self.going
        return state

    async def states(self, timeout: float | None = None) -> AsyncGenerator[State]:
        while True:
            state = await self.told.get()
            if isinstance(state, Exception):
                raise state
            yield state

    async def move_to(self, x: float, y: float, phi: float, **_: Any) -> AsyncGoalHandle:
        self.targets.append((x, y, phi))
        self.called.append(called_at())
        try:
            await self.accepts.wait()
        except asyncio.CancelledError:
            self.cancelled += 1
            raise
        if self.refuses is not None:
            raise self.refuses
        goal = AsyncGoalHandle(f"g{len(self.goals) + 1}", self._stop, self._answer, self._answer)
        if self.goals and self.goals[-1].result is None:
            self.end("preempted", -1)
        self.goals.append(goal)
        return goal

    async def _answer(self) -> bool:
        return True

    async def _stop(self, *_: object) -> None:
        if self.goals[-1].result is not None:
            raise RefusedError(RefusalCode.NO_GOAL, "it has ended")
        self.end("stopped")

    def end(self, outcome: str, number: int = -1) -> None:
        goal = self.goals[number]
        goal.end(Result(goal.id, outcome, f"goal {goal.id} {outcome}"))

    @property
    def under_way(self) -> list[str]:
        return [goal.id for goal in self.goals if goal.result is None]


def run(work: Callable[[Robot, Mover], Awaitable[None]]) -> None:
    """Run a test in an event loop; nothing must be left in it, and no error unread."""
    errors: list[dict[str, Any]] = []

    async def main() -> None:
        asyncio.get_running_loop().set_exception_handler(lambda _, context: errors.append(context))
        async with asyncio.timeout(WITHIN):
            robot = Robot()
            await work(robot, Mover(cast(AsyncRobot, robot)))
            assert robot.under_way == []
            while asyncio.all_tasks() != {asyncio.current_task()}:
                await asyncio.sleep(0)

    asyncio.run(main(), debug=True)
    assert errors == []


async def until(condition: Callable[[], bool]) -> None:
    while not condition():
        await asyncio.sleep(0)


async def outcome(move: AxisMove) -> str:
    """Return how a set ends: "" for done, else the outcome of its goal or its error's class."""
    await asyncio.wait({move.end})
    error = move.end.exception()
    return "" if error is None else error.result.outcome if isinstance(error, UnfinishedError) else type(error).__name__


async def follow(mover: Mover, move: AxisMove) -> None:
    async for _ in mover.progress(move):
        pass


@pytest.mark.parametrize(("success", "ends"), [(True, ["", ""]), (False, ["TrirailError"] * 2)])
def test_sets_that_wait_are_stopped_before_their_goal_is_sent(success: bool, ends: list[str]) -> None:
    async def work(robot: Robot, mover: Mover) -> None:
        moves = [mover.start({0: 0.01}), mover.start({0: 0.02})]  # of one axis: two goals
        await mover.stop(success)
        assert [await outcome(move) for move in moves] == ends
        await until(lambda: not mover._tasks)
        assert robot.targets == []

    run(work)


def test_a_goal_is_called_for_when_its_first_set_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """So that a stop which the program calls between the set and the sending of its goal refuses the goal."""
    monkeypatch.setattr(mover_module, "GATHERING_S", 0.05)

    async def work(robot: Robot, mover: Mover) -> None:
        before = time.monotonic()
        first = mover.start({0: 0.01})
        between = time.monotonic()
        await asyncio.sleep(0.001)
        second, third = mover.start({1: 0.01}), mover.start({1: 0.02})
        after = time.monotonic()
        await until(lambda: len(robot.goals) == 2)
        robot.end("done")
        assert [await outcome(move) for move in (first, second, third)] == ["", "preempted", ""]
        assert before <= robot.called[0] <= between < robot.called[1] <= after

    run(work)


def test_a_second_set_of_an_axis_begins_a_goal_of_its_own() -> None:
    async def work(robot: Robot, mover: Mover) -> None:
        first, second, third = mover.start({0: 0.01}), mover.start({0: 0.02}), mover.start({1: 0.03})
        await until(lambda: len(robot.goals) == 2)
        robot.end("done")
        assert [await outcome(move) for move in (first, second, third)] == ["preempted", "", ""]
        assert robot.targets == [(0.01, 0.0, 0.0), (0.02, 0.03, 0.0)]

    run(work)


def test_a_stop_while_a_goal_is_being_sent_stops_that_and_all_behind_it() -> None:
    async def work(robot: Robot, mover: Mover) -> None:
        robot.accepts.clear()
        first = mover.start({0: 0.01})
        await until(lambda: len(robot.targets) == 1)
        second, third = mover.start({0: 0.02}), mover.start({0: 0.03})
        stopping = asyncio.create_task(mover.stop(False))
        await until(second.end.done)
        assert not stopping.done()
        robot.accepts.set()
        await stopping
        assert [await outcome(move) for move in (first, second, third)] == ["stopped", *["TrirailError"] * 2]
        assert robot.targets == [(0.01, 0.0, 0.0)]

    run(work)


def test_a_stop_of_a_goal_whose_end_was_missed_succeeds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(goal_module, "CHECK_PERIOD_S", 0.01)

    async def is_present() -> bool:
        return False

    async def confirm(*_: object) -> None: ...

    async def work(robot: Robot, mover: Mover) -> None:
        move = mover.start({0: 0.01})
        await until(lambda: len(robot.goals) == 1)
        vars(robot.goals[0]).update(_missed="events 2 to 1003", _is_present=is_present, _command=confirm)
        await cancel(robot.goals[0])
        assert await outcome(move) == "ServiceError"
        robot.end("stopped")

    run(work)


def test_a_set_behind_a_stop_moves() -> None:
    async def work(robot: Robot, mover: Mover) -> None:
        first = mover.start({0: 0.01})
        stopping = asyncio.create_task(mover.stop(True))
        await asyncio.sleep(0)
        second = mover.start({1: 0.02})
        await stopping
        assert await outcome(first) == ""
        await until(lambda: len(robot.goals) == 1)
        robot.end("done")
        assert await outcome(second) == ""
        assert robot.targets == [(0.0, 0.02, 0.0)]

    run(work)


def test_a_cancelled_set_is_not_sent_and_the_others_are() -> None:
    async def work(robot: Robot, mover: Mover) -> None:
        moves = [mover.start({0: 0.01}), mover.start({1: 0.02})]
        waiting = asyncio.create_task(follow(mover, moves[0]))
        await asyncio.sleep(0)
        waiting.cancel()
        await until(lambda: len(robot.goals) == 1)
        assert robot.targets == [(0.0, 0.02, 0.0)]
        robot.end("done")
        assert (moves[0].end.cancelled(), await outcome(moves[1])) == (True, "")

    run(work)


def test_a_set_that_is_cancelled_under_way_keeps_its_target() -> None:
    async def work(robot: Robot, mover: Mover) -> None:
        waiting = asyncio.create_task(follow(mover, mover.start({0: 0.01})))
        await until(lambda: len(robot.goals) == 1)
        waiting.cancel()
        second = mover.start({1: 0.02})
        await until(lambda: len(robot.goals) == 2)
        assert robot.targets[-1] == (0.01, 0.02, 0.0)
        robot.end("done")
        assert await outcome(second) == ""

    run(work)


def test_a_refused_goal_leaves_the_sets_under_way_theirs() -> None:
    async def work(robot: Robot, mover: Mover) -> None:
        first = mover.start({0: 0.01})
        await until(lambda: len(robot.goals) == 1)
        robot.refuses = RefusedError(RefusalCode.OUT_OF_WORKSPACE, "too far")
        second = mover.start({1: 9.0})
        assert await outcome(second) == "RefusedError"
        robot.end("done")
        assert await outcome(first) == ""

    run(work)


def test_a_goal_that_ends_while_the_next_is_refused_ends_all_of_its_sets() -> None:
    async def work(robot: Robot, mover: Mover) -> None:
        first = mover.start({0: 0.01})
        await until(lambda: len(robot.goals) == 1)
        robot.accepts.clear()
        robot.refuses = RefusedError(RefusalCode.FAULT, "the robot is in fault")
        second = mover.start({1: 0.02})
        await until(lambda: len(robot.targets) == 2)
        robot.end("faulted")
        robot.accepts.set()
        assert [await outcome(move) for move in (first, second)] == ["faulted", "RefusedError"]

    run(work)


@pytest.mark.parametrize(
    "told", [[State(Pose(0.0, 0.0, 0.0), 5), State(Pose(0.0, 0.0, 0.0), 1)], [ServiceError("closed")]]
)
def test_a_lost_service_ends_the_sets_and_the_next_goal_is_sent(told: list[State | Exception]) -> None:
    async def work(robot: Robot, mover: Mover) -> None:
        first = mover.start({0: 0.01})
        await until(lambda: len(robot.goals) == 1)
        for state in told:
            robot.told.put_nowait(state)
        assert await outcome(first) == "ServiceError"
        robot.end("faulted")
        second = mover.start({1: 0.02})
        await until(lambda: len(robot.goals) == 2)
        robot.end("done")
        assert await outcome(second) == ""
        assert robot.targets[-1] == (0.0, 0.02, 0.0)

    run(work)


@pytest.mark.parametrize("known", [True, False])
def test_a_stop_after_the_service_was_lost_stops_the_goal_of_then(known: bool) -> None:
    """The robot may still be moving, although the set has ended with an error."""

    async def work(robot: Robot, mover: Mover) -> None:
        first = mover.start({0: 0.01})
        await until(lambda: len(robot.goals) == 1)
        robot.told.put_nowait(ServiceError("no state"))
        assert await outcome(first) == "ServiceError"
        if not known:  # the service has restarted, or the goal's end was missed
            robot.goals[0].end(Result("g1", "done", ""))
        await mover.stop(success=True)
        assert robot.under_way == []
        await mover.stop(success=True)

    run(work)


def test_a_stop_does_not_wait_for_an_answer_that_does_not_come(monkeypatch: pytest.MonkeyPatch) -> None:
    """The client stops a goal whose sending is cancelled, in case the service has received it."""
    monkeypatch.setattr(mover_module, "ANSWERED_S", 0.02)

    async def work(robot: Robot, mover: Mover) -> None:
        robot.accepts.clear()
        move = mover.start({0: 0.01})
        await until(lambda: len(robot.targets) == 1)
        flight = Stage(robot, mover).flight()
        begun = flight.kickoff()
        await until(lambda: len(robot.targets) == 2)
        with pytest.raises(ServiceError, match="not answered"):
            await mover.stop(success=True)
        with pytest.raises(ServiceError, match="not answered"):
            await flight.stop()
        assert await outcome(move) == "ServiceError"
        with pytest.raises(ServiceError, match="before the service had answered"):
            await begun
        assert robot.cancelled == 2
        robot.accepts.set()
        behind = mover.start({0: 0.02})
        await until(lambda: len(robot.goals) == 1)
        robot.end("done")
        assert await outcome(behind) == ""

    run(work)


def test_the_first_progress_of_a_set_is_of_its_own_goal() -> None:
    async def work(robot: Robot, mover: Mover) -> None:
        for x in (0.01, 0.02):
            move = mover.start({0: x})
            await until(lambda: robot.targets[-1:] == [(x, 0.0, 0.0)] and mover.pose is None)  # noqa: B023
            robot.told.put_nowait(State(Pose(x / 2.0, 0.0, 0.0)))
            await until(lambda: mover.pose is not None)
            assert [pose.x async for pose in _one(mover, move)] == [x / 2.0]
            robot.end("done")
            await asyncio.wait({move.end})

    async def _one(mover: Mover, move: AxisMove) -> AsyncGenerator[Pose]:
        async for pose in mover.progress(move):
            yield pose
            return

    run(work)


class Stage:
    """What a flight uses of a stage."""

    def __init__(self, robot: Robot, mover: Mover) -> None:
        self.robot, self.mover = robot, mover

    async def link(self) -> Stage:
        return self

    def note_flight(self, flight: Flight) -> None:
        self.flights = [flight]

    async def stop(self, success: bool) -> None:
        await self.mover.stop(success)
        for flight in self.flights:
            await flight.stop_path(success)

    def flight(self) -> Flight:
        flight = Flight(cast(Any, None), lambda _: self.robot.move_to(0.1, 0.0, 0.0), False, "flight")
        flight.parent = cast(Any, self)
        return flight


@pytest.mark.parametrize("times", [1, 3])
def test_readings_end_with_a_plan_that_does_not_complete_its_flights(times: int) -> None:
    async def work(robot: Robot, mover: Mover) -> None:
        flight = Stage(robot, mover).flight()

        async def plan() -> None:
            for _ in range(times):
                await flight.kickoff()
                robot.end("done")

        await asyncio.create_task(plan())
        await until(lambda: flight._sampling is None)

    run(work)


def test_a_flight_that_is_stopped_while_its_path_is_sent_does_not_fly() -> None:
    async def work(robot: Robot, mover: Mover) -> None:
        flight = Stage(robot, mover).flight()
        robot.accepts.clear()
        begun = flight.kickoff()
        after = time.monotonic()
        await until(lambda: len(robot.targets) == 1)
        assert robot.called[0] <= after
        stopping = asyncio.create_task(flight.stop(success=False))
        await until(lambda: flight._stopped is not None)
        robot.accepts.set()
        await stopping
        assert robot.under_way == []
        await begun
        with pytest.raises(TrirailError, match="stopped"):
            await flight.complete()

    run(work)


@pytest.mark.parametrize("target", [None, Pose(0.1, 0.2, 0.3)])
def test_a_set_of_one_axis_leaves_the_others_at_the_setpoints_that_locate_tells(target: Pose | None) -> None:
    async def work(robot: Robot, mover: Mover) -> None:
        robot.pose, robot.going = Pose(1.0, 2.0, 3.0), Going(target)
        move = mover.start({0: 0.5})
        await until(lambda: bool(robot.goals))
        setpoint = setpoint_of(cast(Any, await robot.state()))
        assert robot.targets == [(0.5, setpoint.y, setpoint.phi)]
        assert setpoint == (target or robot.pose)
        robot.end("done")
        assert await outcome(move) == ""

    run(work)
