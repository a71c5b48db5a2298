"""A track's updates are posted, and what comes of them is heard whenever it comes, in whatever order."""

from __future__ import annotations

import asyncio
from typing import Any
from unittest.mock import Mock

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from trirail.client.alignment import finish
from trirail.client.goal import AsyncGoalHandle, Result
from trirail.client.track import AsyncTrack, Taker
from trirail.errors import RefusalCode, RefusedError, ServiceError, TrirailError
from trirail.wire.goals import Goal, TrackGoal
from trirail.wire.messages import GoalReply
from trirail.wire.vocabulary import Command, Stop

POSE = 0.0, 0.0, 0.0
UPDATES = 12


async def no_command(*_: object) -> Any:
    raise AssertionError("nothing was to be commanded")


class Sent:
    """A track of which all updates have been sent, and what takes the answer to each after the first."""

    def __init__(self) -> None:
        self.goals: list[Goal] = []
        self.takers: list[Taker] = []
        self.track = AsyncTrack(self._begin, self._post, "target", 0.25)
        for _ in range(UPDATES + 1):
            finish(self.track.update(POSE))

    async def _begin(self, _: object, goal_id: str) -> AsyncGoalHandle:
        handle = AsyncGoalHandle(goal_id, no_command, no_command, no_command)
        handle.reply = GoalReply(goal_id, None, lag=0.0)
        return handle

    def _post(self, goal: Goal, take: Taker) -> None:
        self.goals.append(goal)
        self.takers.append(take)

    def told(self) -> TrirailError | None:
        """What the next update raises."""
        try:
            finish(self.track.update(POSE))
        except TrirailError as error:
            return error
        return None


@given(st.permutations(range(UPDATES)), st.sets(st.integers(0, UPDATES - 1)))
def test_an_update_that_was_lost_is_told_only_where_no_later_one_was_answered(order: list[int], lost: set[int]) -> None:
    sent, newest = Sent(), -1
    for number in order:
        sent.takers[number](ServiceError("silent") if number in lost else GoalReply("target", None, lag=number * 1e-3))
        told = sent.told()
        assert (told is not None) == (number in lost and number > newest)
        newest = max(newest, number)


@given(st.permutations(range(UPDATES)))
def test_a_refusal_is_told_whenever_it_comes(order: list[int]) -> None:
    sent = Sent()
    for number in order:
        sent.takers[number](RefusedError(RefusalCode.JOG_OVER, "it has ended"))
        assert isinstance(sent.told(), RefusedError)


def test_the_lag_is_what_the_service_last_said() -> None:
    sent = Sent()
    assert sent.track.lag == pytest.approx(0.0)
    sent.takers[3](GoalReply("target", None, lag=2e-3))
    sent.takers[4](GoalReply("target", None))
    assert sent.track.lag == pytest.approx(2e-3)


def test_an_update_is_sent_as_it_is_said() -> None:
    sent = Sent()
    finish(sent.track.update((0.1, 0.2, 0.3), (1.0, 2.0, 3.0), time=5.0))
    said = TrackGoal(0.1, 0.2, 0.3, velocity=(1.0, 2.0, 3.0), time=5.0, id="target", timeout=0.25)
    assert sent.goals[-1] == said


@pytest.mark.parametrize("ended", [False, True])
def test_leaving_a_track_stops_it_and_waits_for_its_end(ended: bool) -> None:
    """Also if it has just ended, and the client does not know that yet."""
    asked: list[tuple[Command, bytes]] = []

    async def command(name: Command, content: bytes) -> None:
        asked.append((name, content))
        asyncio.get_running_loop().call_soon(handle.end, Result("target", "stopped", "stop by ann"))
        if ended:
            raise RefusedError(RefusalCode.NO_GOAL, "it has ended")

    handle = AsyncGoalHandle("target", command, no_command, no_command)

    async def begin(_: object, goal_id: str) -> AsyncGoalHandle:
        assert goal_id == handle.id
        return handle

    async def follow() -> None:
        async with AsyncTrack(begin, Mock(), "target", 0.25) as track:
            await track.update(POSE)
        assert track.result is not None
        await track.close()

    asyncio.run(follow())
    assert asked == [(Command.STOP, msgspec.json.encode(Stop("target")))]
