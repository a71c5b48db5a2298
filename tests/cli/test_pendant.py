"""The pendant: what a terminal sends is taken for keys, and a key moves the robot only while it comes again."""

from __future__ import annotations

import os
import pty
import select
import signal
import termios
import threading
import tty
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from panel.fake_robot import FakeRobot
from rich.console import Console
from trirail.cli import pendant, terminal
from trirail.cli.pendant import KEY_TIMEOUT_S, Pendant, keys
from trirail.client import held_jog, picture
from trirail.errors import ServiceError
from waiting import wait_until

TOP = (0.25, 0.25, 1.5)


@pytest.mark.parametrize(
    ("typed", "found"),
    [
        (b"\x1b[A\x1b[B\x1b[C\x1b[D", ["up", "down", "right", "left"]),
        (b"\x1bOA\x1bOC", ["up", "right"]),
        (b"\x1b[1;2C", ["right"]),
        (b"aDq +-=", ["a", "d", "q", " ", "+", "-", "+"]),
        (b"\x1b", ["escape"]),
        (b"\x1b[3~\x1b[15~\x1b[200~", []),
        ("φ\xff".encode("latin-1", "ignore"), []),
    ],
)
def test_keys(typed: bytes, found: list[str]) -> None:
    assert list(keys(typed)) == found


@given(st.binary())
def test_whatever_is_typed_is_keys(typed: bytes) -> None:
    assert all(keys(typed))


@pytest.fixture
def tty_pair(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[int, int]]:
    """A keyboard, and the terminal of the pendant."""
    keyboard, terminal = pty.openpty()
    tty.setcbreak(terminal)
    stream = SimpleNamespace(fileno=lambda: terminal)
    monkeypatch.setattr(pendant, "sys", SimpleNamespace(stdin=stream, stdout=stream))
    yield keyboard, terminal
    os.close(keyboard)
    os.close(terminal)


class Hand:
    """Stands in for the pendant: it notes the keys, and q ends it."""

    def __init__(self) -> None:
        self.pressed: list[str] = []
        self.over = self.released = False
        self.speed, self.said = TOP, ""

    def press(self, key: str, _now: float) -> None:
        self.pressed.append(key)
        self.over = self.over or key == "q"

    def release_key(self) -> None:
        self.released = True

    def tick(self, _now: float) -> None:
        """Do nothing: no key is held."""


@pytest.mark.parametrize(
    ("typed", "found"),
    [
        (b"\x1b[D\x1b[A", ["left", "up"]),
        (b"\x1bOC", ["right"]),
        (b"\x1b[1;2B\x1b[3~a", ["down", "a"]),
        (b"\x1bd\x1b", ["escape", "d", "escape"]),
    ],
)
def test_a_key_that_a_serial_line_sends_byte_by_byte_is_the_same_key(
    typed: bytes, found: list[str], tty_pair: tuple[int, int]
) -> None:
    keyboard, terminal = tty_pair
    hand = Hand()
    shown = SimpleNamespace(update=lambda *_, **__: None)
    serving = threading.Thread(target=pendant._serve, args=(hand, SimpleNamespace(state=None), shown))
    serving.start()
    try:
        for byte in typed:
            os.write(keyboard, bytes([byte]))
            wait_until(lambda: not select.select([terminal], [], [], 0.0)[0])
        wait_until(lambda: len(hand.pressed) >= len(found))
    finally:
        hand.over = True
        serving.join()
    assert hand.pressed == found


def test_keys_typed_during_a_stall_are_stale_but_a_stop_is_not(
    tty_pair: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    os.write(tty_pair[0], b"a+\x1b[C \x1b[Aq")
    passes = iter((0.0, 2.0 * pendant.STALL_S))
    monkeypatch.setattr(pendant, "time", SimpleNamespace(monotonic=lambda: next(passes)))
    hand = Hand()
    pendant._serve(hand, SimpleNamespace(state=None), SimpleNamespace(update=lambda *_, **__: None))  # type: ignore[arg-type]
    assert hand.pressed == [" ", "q"]
    assert hand.released


def test_keys_beyond_what_one_read_returns_are_as_stale(
    tty_pair: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    os.write(tty_pair[0], b"a")  # stays there, so that there is something to read
    reads = iter((b"a" * pendant.MAX_BUFFERED, b"aa q"))
    passes = iter((0.0, 2.0 * pendant.STALL_S, 2.0 * pendant.STALL_S + 0.01))
    monkeypatch.setattr(pendant, "time", SimpleNamespace(monotonic=lambda: next(passes)))
    monkeypatch.setattr(pendant, "os", SimpleNamespace(read=lambda *_: next(reads)))
    hand = Hand()
    pendant._serve(hand, SimpleNamespace(state=None), SimpleNamespace(update=lambda *_, **__: None))  # type: ignore[arg-type]
    assert hand.pressed == [" ", "q"]


def test_keys_work_while_the_output_is_suspended(tty_pair: tuple[int, int]) -> None:
    """By Scroll Lock of a console: what is written then waits."""
    keyboard, terminal = tty_pair
    termios.tcflow(terminal, termios.TCOOFF)
    drawings: list[object] = []
    hand, shown = Hand(), SimpleNamespace(update=lambda text, **_: drawings.append(text))
    os.write(keyboard, b" q")
    pendant._serve(hand, SimpleNamespace(state=None), shown)  # type: ignore[arg-type]
    assert (hand.pressed, drawings) == ([" ", "q"], [])
    termios.tcflow(terminal, termios.TCOON)
    hand.over = False
    os.write(keyboard, b"q")
    pendant._serve(hand, SimpleNamespace(state=None), shown)  # type: ignore[arg-type]
    assert drawings


def test_ctrl_s_does_not_suspend_the_output(tty_pair: tuple[int, int], operator: Operator) -> None:
    before = termios.tcgetattr(tty_pair[1])
    assert before[0] & termios.IXON
    with pendant._raw(operator.pendant):
        assert not termios.tcgetattr(tty_pair[1])[0] & termios.IXON
    assert termios.tcgetattr(tty_pair[1]) == before


@pytest.mark.parametrize("number", [signal.SIGHUP, signal.SIGTERM, signal.SIGQUIT], ids=lambda number: number.name)
def test_a_signal_that_ends_the_pendant_restores_the_terminal(
    number: signal.Signals, tty_pair: tuple[int, int], operator: Operator
) -> None:
    before = termios.tcgetattr(tty_pair[1])
    earlier = signal.signal(number, signal.SIG_IGN)  # its default would end this process
    try:
        with pytest.raises(pendant._TerminalClosed), pendant._raw(operator.pendant):
            signal.raise_signal(number)
    finally:
        signal.signal(number, earlier)
    assert termios.tcgetattr(tty_pair[1]) == before


def test_the_message_of_a_stop_goes_when_the_robot_moves_again(tty_pair: tuple[int, int]) -> None:
    robot = FakeRobot()
    modes, drawn = iter(("moving", "holding", "moving", "moving")), list[str]()
    hand, newest = Hand(), SimpleNamespace(state=None)

    def draw(*_: object, **__: object) -> None:
        drawn.append(hand.said)
        if (mode := next(modes, None)) is None:
            hand.over = True
            return
        if newest.state is not None and newest.state.mode == "moving" != mode:
            hand.said = pendant.STOPPED  # before the state of the stopped robot has arrived
        newest.state = msgspec.structs.replace(robot.state(), mode=mode)

    pendant._serve(hand, newest, SimpleNamespace(update=draw))  # type: ignore[arg-type]
    assert drawn == ["", "", pendant.STOPPED, pendant.HELP, pendant.HELP]


@pytest.mark.parametrize("show", [pendant.run, lambda robot: picture.html(robot.told, robot.state())])
def test_a_service_of_another_version_is_told_in_one_line(
    show: Callable[[Any], object], monkeypatch: pytest.MonkeyPatch
) -> None:
    stream = SimpleNamespace(isatty=lambda: True)
    monkeypatch.setattr(pendant, "sys", SimpleNamespace(stdin=stream, stdout=stream))
    monkeypatch.setattr(terminal, "can_redraw", lambda: True)
    robot = FakeRobot()
    robot.told = msgspec.structs.replace(robot.told, limits={"platform": {}})
    with pytest.raises(ServiceError, match="the service has another version"):
        show(robot)


@pytest.mark.parametrize("kind", ["dumb", "unknown"])
def test_a_terminal_that_cannot_show_the_pose_takes_no_keys(
    kind: str, tty_pair: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    stream = SimpleNamespace(isatty=lambda: True, fileno=lambda: tty_pair[1])
    monkeypatch.setattr(pendant, "sys", SimpleNamespace(stdin=stream, stdout=stream))
    monkeypatch.setattr(terminal, "out", Console(force_terminal=True, _environ={"TERM": kind}))
    os.write(tty_pair[0], b"q")
    with pytest.raises(ServiceError, match="needs a terminal that shows the pose"):
        pendant.run(FakeRobot())  # type: ignore[arg-type]


class Operator:
    """A pendant, and a clock of its own for the repetition of keys."""

    def __init__(self) -> None:
        self.robot = FakeRobot()
        self.robot.command("enable")
        self.pendant = Pendant(self.robot.at_pendant(), TOP)
        self.now = 0.0

    def press(self, key: str) -> None:
        self.pendant.press(key, self.now)
        self.pendant.tick(self.now)

    def wait(self, seconds: float) -> None:
        """Let the pendant's clock go on."""
        self.now += seconds
        self.pendant.tick(self.now)

    def sent(self, number: int) -> list[tuple[float, float, float]]:
        """What has been sent, as soon as it is so many."""
        wait_until(lambda: len(self.robot.sent) >= number)
        return [(goal.x, goal.y, goal.phi) for goal in self.robot.sent]


@pytest.fixture
def operator(monkeypatch: pytest.MonkeyPatch) -> Iterator[Operator]:
    monkeypatch.setattr(held_jog, "TIMEOUT", 2.0)  # the pendant's clock is the operator's, the robot's is not
    made = Operator()
    yield made
    made.pendant.close()


@pytest.mark.parametrize(
    ("key", "velocity"),
    [
        ("right", (0.025, 0.0, 0.0)),
        ("left", (-0.025, 0.0, 0.0)),
        ("up", (0.0, 0.025, 0.0)),
        ("down", (0.0, -0.025, 0.0)),
        ("a", (0.0, 0.0, 0.15)),
        ("d", (0.0, 0.0, -0.15)),
    ],
)
def test_a_key_that_comes_again_is_one_jog_until_it_does_not(
    operator: Operator, key: str, velocity: tuple[float, float, float]
) -> None:
    for number in range(1, 6):
        operator.press(key)
        sent = operator.sent(number)
        operator.wait(0.9 * KEY_TIMEOUT_S)
    assert all(each == pytest.approx(velocity) for each in sent)
    operator.wait(0.2 * KEY_TIMEOUT_S)
    assert operator.sent(6)[5] == (0.0, 0.0, 0.0)
    assert len({goal.id for goal in operator.robot.sent}) == 1
    operator.wait(10.0 * KEY_TIMEOUT_S)
    assert len(operator.robot.sent) == 6


def test_another_key_ends_what_is_held(operator: Operator) -> None:
    for other in ("+", "q"):
        operator.robot.sent.clear()
        operator.press("right")
        operator.sent(1)
        operator.press(other)
        assert operator.sent(2)[1] == (0.0, 0.0, 0.0)
        wait_until(lambda: operator.robot.state().goal is None)
    assert operator.pendant.over


@pytest.mark.parametrize("key", [" ", "escape"])
def test_space_and_escape_stop_also_what_others_have_begun(operator: Operator, key: str) -> None:
    operator.press(key)
    wait_until(lambda: "stop" in operator.robot.commands)
    wait_until(lambda: operator.pendant.said == pendant.STOPPED)


def test_the_speed_goes_up_and_down_within_its_bounds(operator: Operator) -> None:
    usual = operator.pendant.speed
    operator.press("+")
    assert operator.pendant.speed == pytest.approx([2.0 * value for value in usual])
    for _ in range(20):
        operator.press("+")
    assert operator.pendant.speed == TOP
    for _ in range(20):
        operator.press("-")
    assert operator.pendant.speed == pytest.approx([0.01 * value for value in TOP])


def test_a_refusal_is_shown(operator: Operator) -> None:
    operator.robot.command("disable")
    operator.press("up")
    wait_until(lambda: "send enable first" in operator.pendant.said)
