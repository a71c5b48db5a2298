"""Users take turns: whoever has much in the queue waits for himself, and all that waits has a limit."""

from __future__ import annotations

import time
from collections import Counter, defaultdict, deque

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from trirail.errors import RefusalCode, RefusedError
from trirail.processes.incoming import GOAL_PATIENCE, Backlog, FairQueue, Incoming
from trirail.wire.goals import PoseGoal
from trirail.wire.packets import GoalRequest
from trirail.wire.sizes import MAX_UNREAD, MAX_UNREAD_OF_ONE

USERS = "abcd"


@given(st.lists(st.sampled_from([*USERS, *USERS, "take", "take", "take"]), max_size=200))
def test_each_users_own_are_in_order_and_nobody_waits_for_more_than_one_of_each_other(acts: list[str]) -> None:
    queue: FairQueue[tuple[str, int]] = FairQueue()
    put: Counter[str] = Counter()
    taken: dict[str, list[int]] = defaultdict(list)
    waited: dict[str, Counter[str]] = {}
    """For each user who has something in it: whose were taken since his turn."""
    for act in acts:
        if act != "take":
            waited.setdefault(act, Counter())
            queue.put(act, (act, put[act]))
            put[act] += 1
        elif len(queue):
            user, number = queue.pop(next(iter(queue.users)))
            taken[user].append(number)
            for other, before in waited.items():
                before[user] += other != user
                assert before[user] <= 1
            waited.pop(user)
            if queue.count(user):
                waited[user] = Counter()
        assert set(queue.users) == {user for user in USERS if queue.count(user)}
    left = sorted(queue)
    for user in USERS:
        taken[user] += [number for name, number in left if name == user]
        assert taken[user] == list(range(put[user]))
    assert len(queue) == len(left)


def test_a_user_is_served_alone_and_everything_is_changed_in_its_place() -> None:
    queue: FairQueue[int] = FairQueue()
    for number in range(4):
        queue.put("ab"[number % 2], number)
    queue.change(lambda number: number + 10)
    assert queue.first("b") == 11
    assert queue.pop("b") == 11
    assert list(queue.users) == ["a", "b"]
    assert [queue.pop(user) for user in "aab"] == [10, 12, 13]
    for nothing in (queue.pop, queue.first):
        with pytest.raises(KeyError):
            nothing("a")


def put(backlog: Backlog, user: str, size: int = 100) -> None:
    now = time.monotonic_ns()
    incoming = Incoming("goal", f"trirail/demo/goal/{user}", size, b"", "", None, now)
    backlog.check_room(user, size)
    backlog.add(incoming, GoalRequest(1, user, "g", PoseGoal(0.0, 0.0, 0.0), now))


@given(st.lists(st.tuples(st.sampled_from(USERS), st.integers(0, MAX_UNREAD_OF_ONE)) | st.none(), max_size=60))
@example([("a", MAX_UNREAD_OF_ONE)] * (MAX_UNREAD // MAX_UNREAD_OF_ONE) + [("b", 1), None, ("b", 1)])
def test_goals_wait_up_to_a_number_of_bytes_and_each_that_leaves_makes_room(acts: list[tuple[str, int] | None]) -> None:
    backlog = Backlog()
    waiting: dict[str, deque[int]] = defaultdict(deque)
    for act in acts:
        held = sum(map(sum, waiting.values()))
        if act is None:
            for user in backlog.users[:1]:
                backlog.drop_first(user)
                waiting[user].popleft()
        elif held + act[1] <= MAX_UNREAD:
            put(backlog, *act)
            waiting[act[0]].append(act[1])
        else:
            with pytest.raises(RefusedError) as refused:
                put(backlog, *act)
            assert refused.value.code is RefusalCode.BUSY


@pytest.mark.parametrize("waits", [0.0, GOAL_PATIENCE + 1.0])
def test_a_goal_that_was_stopped_says_so_however_long_it_waited(monkeypatch: pytest.MonkeyPatch, waits: float) -> None:
    backlog = Backlog()
    put(backlog, "a")
    backlog.withdraw("g", "stop by b")
    now = time.monotonic_ns() + round(waits * 1e9)
    monkeypatch.setattr(time, "monotonic_ns", lambda: now)
    assert backlog.first("a").request.withdrawn == "stop by b"
