"""The client for asyncio with a whole service: every call of it, several at once, and what a cancelled task leaves."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from contextlib import aclosing, suppress

import pytest
from refusals import refused_as
from trirail.client.async_client import AsyncRobot
from trirail.client.client import Robot
from trirail.errors import RefusalCode, RefusedError
from trirail.wire.goals import MoveGoal, PoseGoal, TrajectoryGoal, TrajectoryPoint, VelocityGoal
from trirail.wire.records import unpack
from trirail.wire.state import State
from trirail.wire.vocabulary import Role
from waiting import WITHIN

pytestmark = pytest.mark.slow

Work = Callable[[AsyncRobot], Awaitable[None]]


def run(locator: str, work: Work) -> None:
    async def main() -> None:
        async with asyncio.timeout(5 * WITHIN), AsyncRobot("demo", locator, user="ann") as robot:
            await robot.enable()
            assert (await (await robot.move_to(x=0.0, y=0.0, phi=0.0)).wait()).outcome == "done"
            await work(robot)
            assert asyncio.all_tasks() == {asyncio.current_task()}

    asyncio.run(main())


async def until(robot: AsyncRobot, condition: Callable[[State], bool]) -> State:
    async with aclosing(robot.states(WITHIN)) as states:
        async for state in states:
            if condition(state):
                return state
    raise AssertionError("the service no longer sends its state")


def test_a_session(locator: str) -> None:
    async def work(robot: AsyncRobot) -> None:
        assert (await robot.info()).robot == "demo"
        assert await robot.role() is Role.MAINTAINER
        assert robot.user in await robot.users()
        first, second = await asyncio.gather(
            robot.move(x=0.01, blend=0.005, id="first"), robot.move(y=0.01, speed=0.5, id="second")
        )
        assert {(await goal.wait()).outcome for goal in (first, second)} == {"done"}
        assert (await robot.state()).pose == pytest.approx((0.01, 0.01, 0.0), abs=1e-5)
        assert (await robot.teach("corner")).taught
        assert (await (await robot.move_sliders(0.0, 0.0, 0.0)).wait()).outcome == "done"
        points = [TrajectoryPoint(0.0, 0.0, 0.0, 0.0), TrajectoryPoint(1.0, 0.01, 0.0, 0.0)]
        assert (await (await robot.follow(points)).wait()).outcome == "done"
        with refused_as(RefusalCode.WRONG_START):
            await robot.follow(points)
        assert (await (await robot.follow(points, go_there=True)).wait()).outcome == "done"
        assert (await (await robot.move_to_named("corner")).wait()).outcome == "done"
        await robot.forget("corner")
        assert "corner" not in await robot.poses()
        with refused_as(RefusalCode.OUT_OF_WORKSPACE):
            await robot.move_to(x=0.5, y=0.0, phi=0.0)
        goal = await robot.move_to(x=0.1, y=0.0, phi=0.0, speed=0.01)
        await robot.pause()
        await robot.resume()
        await robot.override(50)
        await goal.cancel()
        assert (await goal.wait()).outcome == "stopped"
        await robot.override(100)
        await robot.stop()
        batches: list[int] = []
        with robot.records(lambda batch: batches.append(len(unpack(batch)))):
            await until(robot, lambda _: sum(batches) > 100)
        missing: set[str | None] = {"first", "second"}
        async for event in robot.events(history=True, timeout=WITHIN):
            missing -= {event.id} if event.outcome == "done" else set()
            if not missing:
                break
        await robot.quick_stop()
        await robot.reset()
        await robot.disable()

    run(locator, work)


def test_a_check_is_answered_as_the_goal_and_moves_nothing(locator: str) -> None:
    async def work(robot: AsyncRobot) -> None:
        goal = PoseGoal(0.02, 0.01, 0.1, id="checked")
        replies = await asyncio.gather(*(robot.check(goal) for _ in range(5)))
        state = await robot.state()
        assert (state.mode, state.goal) == ("holding", None)
        assert {(reply.id, reply.accepted) for reply in replies} == {("checked", True)}
        with refused_as(RefusalCode.OUT_OF_WORKSPACE):
            await robot.check(PoseGoal(0.3, 0.0, 0.0))
        with refused_as(RefusalCode.MALFORMED):
            await robot.check(VelocityGoal(0.01, 0.0, 0.0))
        points = tuple(TrajectoryPoint(t, 0.01 * t, 0.0, 0.0) for t in (0.0, 1.0))
        assert (await robot.check(TrajectoryGoal(points))).duration == pytest.approx(1.0, abs=0.01)
        await robot.override(10.0)
        checks = [asyncio.create_task(robot.check(goal)) for _ in range(5)]
        moving = await robot.send(goal)
        assert {(await check).accepted for check in checks} == {True}
        assert replies[0].duration is not None
        assert moving.duration == pytest.approx(10.0 * replies[0].duration, rel=0.01)
        assert (await robot.check(MoveGoal(0.001, 0.0, 0.0))).duration is not None
        assert (await robot.state()).mode == "moving"
        await robot.override(100.0)
        assert (await moving.wait(WITHIN)).outcome == "done"

    run(locator, work)


def test_a_goal_that_is_refused_for_its_id_leaves_the_handle_of_the_first(locator: str) -> None:
    async def work(robot: AsyncRobot) -> None:
        first = await robot.move_to(x=0.03, y=0.0, phi=0.0, id="same")
        with refused_as(RefusalCode.DUPLICATE_ID):
            await robot.move_to(x=0.0, y=0.0, phi=0.0, id="same")
        assert (await first.wait(WITHIN)).outcome == "done"
        with Robot("demo", locator, user="ann") as blocking:
            second = blocking.move_to(x=0.0, y=0.0, phi=0.0, id="other")
            with refused_as(RefusalCode.DUPLICATE_ID):
                blocking.move_to(x=0.0, y=0.0, phi=0.0, id="other")
            assert second.wait(WITHIN).outcome == "done"
            assert repr(second) == "<GoalHandle other done>"
        state = await robot.state()
        assert (state.pose.x, state.pose.y, state.pose.phi) == state.pose

    run(locator, work)


def test_a_jog_lasts_while_its_context_does(locator: str) -> None:
    async def work(robot: AsyncRobot) -> None:
        async with robot.jog(x=0.002, timeout=10.0) as jog:
            await until(robot, lambda state: state.pose[0] > 0.001)
        assert (await robot.state()).pose[0] < 0.012  # it brakes where the context is left, not a time-out later
        assert jog.result is not None
        assert jog.result.outcome == "done"
        await until(robot, lambda state: not any(state.commanded.pose_velocity))
        await robot.disable()
        with refused_as(RefusalCode.NOT_ENABLED):
            async with robot.jog(x=0.02):
                raise AssertionError("it has begun")

    run(locator, work)


def test_a_lease_is_kept_by_a_task_and_given_back(locator: str) -> None:
    async def work(robot: AsyncRobot) -> None:
        async with AsyncRobot("demo", locator, user="bob") as bob:
            async with robot.lease(timeout=2.0) as lease:
                assert not await lease.wait(3.0)  # longer than a time-out: it is kept
                with refused_as(RefusalCode.LEASED):
                    await bob.move_to(x=0.01, y=0.0, phi=0.0)
                assert (await (await robot.move_to(x=0.01, y=0.0, phi=0.0)).wait()).outcome == "done"
            assert (await (await bob.move_to(x=0.0, y=0.0, phi=0.0)).wait()).outcome == "done"

    run(locator, work)


def test_a_task_that_is_cancelled_while_it_jogs_moves_nothing_any_more(locator: str) -> None:
    async def work(robot: AsyncRobot) -> None:
        async def jog() -> None:
            async with robot.jog(x=0.02, timeout=5.0):
                await asyncio.Event().wait()

        jogging = asyncio.create_task(jog())
        await until(robot, lambda state: state.mode == "moving")
        jogging.cancel()
        with pytest.raises(asyncio.CancelledError):
            await jogging
        assert (await until(robot, lambda state: state.mode == "holding")).goal is None

    run(locator, work)


def test_a_goal_whose_sender_is_cancelled_does_not_go_on(locator: str) -> None:
    async def work(robot: AsyncRobot) -> None:
        for number in range(20):  # cancelled as early, or as late, as it comes
            sending = asyncio.create_task(robot.move_to(x=0.1, y=0.0, phi=0.0, speed=0.001, id=f"g{number}"))
            for _ in range(number):
                await asyncio.sleep(0)
            if sending.cancel():
                with pytest.raises(asyncio.CancelledError):
                    await sending
            else:  # answered before, while the one before it was still being stopped
                with suppress(RefusedError):
                    await (await sending).cancel()
        moved = (await robot.state()).seq
        async with aclosing(robot.states(WITHIN)) as states:  # a goal that went on would take more than a minute
            async for state in states:
                if state.mode != "holding" or state.goal is not None:
                    moved = state.seq
                elif state.seq > moved + 500:
                    break

    run(locator, work)
