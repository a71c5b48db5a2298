"""Users take turns: whoever has much in the queue waits for himself."""

from __future__ import annotations

from collections import Counter, defaultdict

import pytest
from hypothesis import given
from hypothesis import strategies as st
from trirail.processes.incoming import FairQueue

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
