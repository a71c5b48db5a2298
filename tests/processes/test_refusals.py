"""What is refused: the asker is answered always, everyone is told, so many times a second and user."""

from __future__ import annotations

import random
import time
from types import SimpleNamespace
from typing import Any

import pytest
from trirail.errors import RefusalCode, RefusedError
from trirail.processes import replies as refusals
from trirail.processes.incoming import Incoming
from trirail.processes.publications import EVENTS_KEPT
from trirail.processes.replies import REFUSALS_OF_ALL, REFUSALS_OF_USER, REFUSALS_OF_USER_PER_SECOND, Refusals
from trirail.wire import packets
from trirail.wire.messages import ErrorReply


class Listener:
    """Stands for the loop and for the askers, and for the clock."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 100.0
        self.told: list[Any] = []
        self.answers: list[Any] = []
        link: Any = SimpleNamespace(send=lambda packet: self.told.append(packets.decode_request(packet[1:]).notice))
        replies: Any = SimpleNamespace(answer=lambda _, content: self.answers.append(content))
        monkeypatch.setattr(refusals, "time", SimpleNamespace(monotonic=lambda: self.now))
        self.refusals = Refusals(link, replies)

    def refuse(self, user: str) -> None:
        message = Incoming("goal", f"trirail/demo/goal/{user}", 0, b"", "", None, time.monotonic_ns())
        self.refusals.refuse(message, RefusedError(RefusalCode.BUSY, "send fewer"))


@pytest.fixture
def listener(monkeypatch: pytest.MonkeyPatch) -> Listener:
    return Listener(monkeypatch)


def test_each_refusal_is_answered_and_so_many_of_a_user_are_announced(listener: Listener) -> None:
    for _ in range(3 * REFUSALS_OF_USER):
        listener.refuse("ann")
    listener.refuse("bob")
    assert listener.answers == [ErrorReply(RefusalCode.BUSY, "send fewer")] * (3 * REFUSALS_OF_USER + 1)
    assert [said.user for said in listener.told] == ["ann"] * REFUSALS_OF_USER + ["bob"]
    assert {said.message for said in listener.told} == {"send fewer"}
    for number in (1, 2, 3):
        listener.now += 1.0 / REFUSALS_OF_USER_PER_SECOND
        for _ in range(5):
            listener.refuse("ann")
        assert len(listener.told) == REFUSALS_OF_USER + 1 + number


@pytest.mark.generated(0, 1, 2)
def test_a_day_of_refusals_leaves_other_events_in_the_history(listener: Listener, seed: int) -> None:
    """A client that sends invalid goals day and night displaces half of the history in a quarter of an hour at most."""
    chance = random.Random(seed)
    end = listener.now + 900.0
    while listener.now < end:
        listener.now += chance.expovariate(5.0)
        listener.refuse(f"user{chance.randrange(1 + seed)}")
    assert len(listener.told) < EVENTS_KEPT / 2


def test_of_all_users_together_so_many_are_announced(listener: Listener) -> None:
    for number in range(2 * REFUSALS_OF_ALL):
        listener.refuse(f"user{number}")
    assert len(listener.told) == REFUSALS_OF_ALL
    assert len(listener.answers) == 2 * REFUSALS_OF_ALL
