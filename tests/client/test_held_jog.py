"""A jog that is held: it moves while signs of the hand come, and nothing but a sign that is fresh moves it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import pytest
from panel.fake_robot import FakeRobot
from trirail.client import held_jog
from trirail.client.blocking import GoalHandle
from trirail.client.call_time import called_at
from trirail.client.held_jog import HeldJog
from trirail.errors import RefusalCode, RefusedError
from trirail.wire.goals import Goal
from waiting import WITHIN, wait_until

RIGHT = (0.01, 0.0, 0.0)
TIMEOUT = 1.0
"""Long enough for signs of life on a busy machine [s]."""


class Hand:
    """A jog of a robot that is none, and why it has ended."""

    def __init__(self) -> None:
        self.robot = FakeRobot()
        self.robot.command("enable")
        self.ends: list[str] = []
        self.jog = HeldJog(self.robot.send, self.ends.append)

    def velocities(self) -> list[float]:
        return [goal.x for goal in self.robot.sent]

    def press(self) -> None:
        """Give one sign, and wait until the jog has taken it."""
        self.jog.hold(RIGHT)
        wait_until(lambda: self.jog._sign is None)

    def let_go(self) -> None:
        """Let go, and wait until the jog knows that, after all earlier signs."""
        self.jog.release()
        wait_until(lambda: not self.jog._let_go)

    def hold(self, until: Callable[[], bool]) -> None:
        """Give signs, many in a time-out, until something holds."""
        deadline = time.monotonic() + WITHIN
        while not until():
            assert time.monotonic() < deadline
            self.jog.hold(RIGHT)
            time.sleep(TIMEOUT / 20)


@pytest.fixture
def hand(monkeypatch: pytest.MonkeyPatch) -> Iterator[Hand]:
    monkeypatch.setattr(held_jog, "TIMEOUT", TIMEOUT)
    hand = Hand()
    yield hand
    hand.jog.close()


def test_signs_are_one_jog_and_letting_go_ends_it_at_once(hand: Hand) -> None:
    hand.hold(lambda: len(hand.robot.sent) >= 8)
    hand.jog.release()
    wait_until(lambda: hand.velocities()[-1] == 0.0)
    assert len({goal.id for goal in hand.robot.sent}) == 1
    assert {goal.timeout for goal in hand.robot.sent[:-1]} == {TIMEOUT}
    assert hand.robot.sent[-1].timeout < TIMEOUT
    assert hand.ends == []


def test_a_new_press_is_a_new_jog(hand: Hand) -> None:
    for _ in range(3):
        hand.jog.hold(RIGHT)
        wait_until(lambda: hand.robot.sent[-1:] != [] and hand.velocities()[-1] > 0.0)
        hand.jog.release()
        wait_until(lambda: hand.velocities()[-1] == 0.0)
    assert len({goal.id for goal in hand.robot.sent}) == 3


def test_without_signs_nothing_is_renewed(hand: Hand) -> None:
    hand.jog.hold(RIGHT)
    wait_until(lambda: hand.robot.goal is not None)
    wait_until(lambda: hand.robot.state().goal is None)
    assert len(hand.robot.sent) == 1


@pytest.mark.long
def test_a_sign_that_has_waited_for_a_slow_service_is_thrown_away(hand: Hand) -> None:
    with hand.robot.hanging("goal"):
        hand.jog.hold(RIGHT)
        wait_until(lambda: len(hand.robot.sent) == 1)
        hand.jog.hold(RIGHT)
        time.sleep(1.5 * TIMEOUT)  # the second sign grows old: that is what is tried here
    wait_until(lambda: hand.robot.goal is not None)
    wait_until(lambda: hand.robot.state().goal is None)
    assert len(hand.robot.sent) == 1


def test_letting_go_while_the_service_is_slow_is_not_forgotten(hand: Hand) -> None:
    with hand.robot.hanging("goal"):
        hand.jog.hold(RIGHT)
        wait_until(lambda: len(hand.robot.sent) == 1)
        hand.jog.hold(RIGHT)
        hand.jog.release()
    wait_until(lambda: hand.velocities() == [RIGHT[0], 0.0])


def test_a_request_is_as_old_as_its_sign(hand: Hand, monkeypatch: pytest.MonkeyPatch) -> None:
    """A stop that is called between the sign and the request comes first."""
    monkeypatch.setattr(held_jog, "TIMEOUT", 5.0)  # no sign grows old on a busy machine
    times: list[float] = []

    def send(make: Callable[[str], Goal], goal_id: str) -> GoalHandle:
        times.append(called_at())
        return hand.robot.send(make, goal_id)

    monkeypatch.setattr(hand.jog, "_send_goal", send)
    with hand.robot.hanging("goal"):
        hand.jog.hold(RIGHT)
        wait_until(lambda: len(hand.robot.sent) == 1)
        before = time.monotonic()
        hand.jog.hold(RIGHT)
        after = time.monotonic()
    wait_until(lambda: len(times) == 2)
    assert before <= times[1] <= after


@pytest.mark.parametrize("code", [RefusalCode.NOT_ENABLED, RefusalCode.STOPPING, RefusalCode.AT_LIMIT])
def test_what_the_robot_has_refused_is_not_asked_again_before_the_hand_lets_go(hand: Hand, code: RefusalCode) -> None:
    hand.robot.refusal = RefusedError(code, "no")
    hand.hold(lambda: hand.ends == ["no"])
    hand.robot.refusal = None
    for _ in range(4):
        hand.press()
    hand.let_go()
    assert len(hand.robot.sent) == 1
    hand.hold(lambda: hand.robot.goal is not None)
    assert hand.robot.sent[0].id != hand.robot.sent[1].id
    assert hand.ends == ["no"]


def test_a_stop_of_somebody_else_ends_it_until_the_hand_lets_go(hand: Hand) -> None:
    hand.hold(lambda: hand.robot.goal is not None)
    hand.robot.command("stop")
    hand.hold(lambda: hand.ends != [])
    assert hand.ends == ["stop of ann"]
    asked = len(hand.robot.sent)
    for _ in range(4):
        hand.press()
    hand.jog.close()
    assert len(hand.robot.sent) == asked
