"""A gamepad as a pendant: it moves the robot only while a shoulder button is held, and ends safely when it goes."""

from __future__ import annotations

import errno
import os
import pty
import select
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any, NamedTuple

import pytest
from cli.test_pendant import Operator
from hypothesis import given
from hypothesis import strategies as st
from trirail.cli import pendant
from trirail.cli.gamepad import QUIET, Button, Code, EventType, Gamepad, Pad, StickRange, is_gamepad
from trirail.client import held_jog
from trirail.errors import ServiceError
from waiting import wait_until

SIDE = StickRange(-32768, 32767)
RANGES: dict[int, StickRange] = {Code.X: SIDE, Code.Y: SIDE, Code.RX: SIDE, Code.HAT_Y: StickRange(-1, 1)}
FULL = 32767


class Event(NamedTuple):
    """As evdev's InputEvent."""

    type: int
    code: int
    value: int


def key(button: Button, value: int = 1) -> Event:
    return Event(EventType.KEY, button, value)


def stick(code: Code, value: int) -> Event:
    return Event(EventType.ABS, code, value)


class Hand:
    """An operator with a gamepad instead of keys."""

    def __init__(self, operator: Operator) -> None:
        self.operator = operator
        self.pad = Gamepad(RANGES)

    def feel(self, *events: Event) -> None:
        for event in events:
            self.pad.apply(event, self.operator.now)
        pendant.follow(self.operator.pendant, self.pad, self.operator.now)
        self.operator.pendant.tick(self.operator.now)


@pytest.fixture(autouse=True)
def slow(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(held_jog, "TIMEOUT", 2.0)  # the pendant's clock is the operator's, the robot's is not


@pytest.fixture
def hand() -> Iterator[Hand]:
    made = Hand(Operator())
    yield made
    made.operator.pendant.close()


# ---------------------------------------------------------------------- the dead man


@pytest.mark.parametrize("shoulder", [Button.TL, Button.TR])
@pytest.mark.parametrize(
    ("moved", "velocity"),
    [
        (stick(Code.X, FULL), (0.025, 0.0, 0.0)),
        (stick(Code.X, -32768), (-0.025, 0.0, 0.0)),
        (stick(Code.Y, -32768), (0.0, 0.025, 0.0)),  # away from the hand
        (stick(Code.RX, -32768), (0.0, 0.0, 0.15)),  # to the left: counterclockwise
    ],
)
def test_a_stick_moves_the_robot_while_a_shoulder_button_is_held(
    hand: Hand, shoulder: Button, moved: Event, velocity: tuple[float, float, float]
) -> None:
    hand.feel(moved)
    assert hand.operator.robot.sent == []
    hand.feel(key(shoulder))
    assert hand.operator.sent(1) == [pytest.approx(velocity, abs=1e-5)]
    hand.feel()
    hand.operator.sent(2)
    hand.feel(key(shoulder, 0))
    assert hand.operator.sent(3)[2] == (0.0, 0.0, 0.0)
    hand.feel(moved)
    assert len(hand.operator.robot.sent) == 3


def test_a_stick_that_comes_back_to_its_middle_ends_the_jog(hand: Hand) -> None:
    hand.feel(key(Button.TL), stick(Code.X, FULL))
    hand.operator.sent(1)
    hand.feel(stick(Code.X, 2000))
    assert hand.operator.sent(2)[1] == (0.0, 0.0, 0.0)


def test_one_shoulder_of_two_is_enough(hand: Hand) -> None:
    hand.feel(key(Button.TL), key(Button.TR), stick(Code.X, FULL))
    hand.operator.sent(1)
    hand.feel(key(Button.TL, 0))
    assert hand.operator.sent(2)[1][0] > 0.0
    hand.feel(key(Button.TR, 0))
    assert hand.operator.sent(3)[2] == (0.0, 0.0, 0.0)


def test_what_the_kernel_has_lost_lets_go(hand: Hand) -> None:
    hand.feel(key(Button.TL), stick(Code.X, FULL))
    hand.operator.sent(1)
    hand.feel(Event(EventType.SYN, Code.SYN_DROPPED, 0))
    assert hand.operator.sent(2)[1] == (0.0, 0.0, 0.0)
    hand.feel(stick(Code.X, FULL))
    assert len(hand.operator.robot.sent) == 2


def test_a_pad_that_says_nothing_any_more_lets_go_until_it_does(hand: Hand) -> None:
    """As a wireless one that is out of reach: the kernel keeps its last state."""
    hand.feel(key(Button.TL), stick(Code.X, FULL))
    hand.operator.sent(1)
    hand.operator.now += 1.01 * QUIET
    hand.feel()
    assert hand.operator.sent(2)[1] == (0.0, 0.0, 0.0)
    hand.feel(stick(Code.X, FULL - 1))
    assert hand.operator.sent(3)[2][0] > 0.0


def test_a_key_of_the_terminal_works_beside_a_pad_that_is_not_held(hand: Hand) -> None:
    hand.operator.press("right")
    hand.operator.sent(1)
    hand.feel(stick(Code.X, -FULL))
    assert hand.operator.sent(1) == [pytest.approx((0.025, 0.0, 0.0))]


def test_the_other_buttons_stop_and_set_the_speed(hand: Hand) -> None:
    usual = hand.operator.pendant.speed
    hand.feel(stick(Code.HAT_Y, -1), stick(Code.HAT_Y, 0))
    assert hand.operator.pendant.speed == pytest.approx([2.0 * value for value in usual])
    hand.feel(stick(Code.HAT_Y, 1), stick(Code.HAT_Y, 0))
    assert hand.operator.pendant.speed == usual
    hand.feel(key(Button.EAST))
    wait_until(lambda: "stop" in hand.operator.robot.commands)


events = st.builds(Event, st.just(EventType.KEY), st.sampled_from(Button), st.integers(0, 2)) | st.builds(
    Event, st.just(EventType.ABS), st.sampled_from([Code.X, Code.Y, Code.RX, Code.HAT_Y]), st.integers(-40000, 40000)
) | st.builds(Event, st.integers(0, 30), st.integers(0, 800), st.integers())  # fmt: skip


@given(st.lists(events, max_size=30))
def test_whatever_comes_nothing_moves_without_a_shoulder_button_and_nothing_faster_than_it_may(
    said: list[Event],
) -> None:
    pad = Gamepad(RANGES)
    held: set[int] = set()
    for event in said:
        pad.apply(event, 1.0)
        if event.type == EventType.KEY and event.code in (Button.TL, Button.TR):
            (held.add if event.value else held.discard)(event.code)
        if (event.type, event.code) == (EventType.SYN, Code.SYN_DROPPED):
            held.clear()
        direction = pad.direction(1.0)
        assert direction is None or held
        assert direction is None or max(map(abs, direction)) <= 1.0
    assert set(pad.keys) <= {" ", "+", "-"}


# ---------------------------------------------------------------------- the device


class Device:
    """A gamepad that is plugged in until it is not; stands in for evdev.InputDevice."""

    name = "Some Pad"

    def __init__(self) -> None:
        self._reader, self._writer = os.pipe()
        self._said: list[Event] = []
        self.closed = False

    def capabilities(self) -> dict[int, list[tuple[int, Any]]]:
        return {EventType.ABS: [(code, SimpleNamespace(min=low, max=high)) for code, (low, high) in RANGES.items()]}

    def fileno(self) -> int:
        return self._reader

    def say(self, *said: Event) -> None:
        self._said += said
        os.write(self._writer, bytes(len(said)))

    def unplug(self) -> None:
        os.close(self._writer)

    def read(self) -> Iterator[Event]:
        if not select.select([self._reader], [], [], 0)[0]:
            raise BlockingIOError
        if not os.read(self._reader, 1024):
            raise OSError(errno.ENODEV, "No such device")
        said, self._said = self._said, []
        yield from said

    def close(self) -> None:
        self.closed = True


@contextmanager
def at_terminal() -> Iterator[int]:
    """Be at a terminal; yields where its keys are typed. Within the test: pytest has its own standard input before."""
    ours, theirs = pty.openpty()
    with os.fdopen(theirs, "r+b", buffering=0) as file, pytest.MonkeyPatch.context() as patched:
        terminal = SimpleNamespace(fileno=file.fileno, isatty=lambda: True, write=lambda _: 0, flush=lambda: None)
        patched.setattr(sys, "stdin", terminal)
        patched.setattr(sys, "stdout", terminal)
        yield ours
    os.close(ours)


def test_a_pad_that_is_unplugged_while_it_moves_the_robot_ends_it_and_says_so() -> None:
    operator, device = Operator(), Device()

    def pull() -> None:
        device.say(key(Button.TR), stick(Code.X, FULL))
        operator.sent(3)
        device.unplug()

    pulling = threading.Thread(target=pull)
    gone = pytest.raises(ServiceError, match="the gamepad Some Pad is gone: the robot brakes")
    with at_terminal(), Pad(device) as pad, gone:
        pulling.start()
        pendant.run(operator.robot.robot(), pad)
    pulling.join()
    assert device.closed
    assert operator.sent(4)[-1] == (0.0, 0.0, 0.0)
    wait_until(lambda: operator.robot.state().mode == "holding")
    operator.pendant.close()


def test_the_pad_stops_the_robot_and_the_operator_leaves_by_the_terminal() -> None:
    operator, device = Operator(), Device()
    device.say(key(Button.EAST))
    with at_terminal() as keyboard, Pad(device) as pad:

        def leave() -> None:
            wait_until(lambda: "stop" in operator.robot.commands)
            os.write(keyboard, b"q")

        leaving = threading.Thread(target=leave)
        leaving.start()
        assert pendant.run(operator.robot.robot(), pad) == 0
        leaving.join()
    assert not [thread for thread in threading.enumerate() if thread.name == "states"]
    operator.pendant.close()


def test_only_what_has_a_shoulder_button_and_sticks_is_a_gamepad() -> None:
    whole: dict[int, list[int]] = {EventType.KEY: [304, 310, 311], EventType.ABS: [0, 1, 3, 17]}
    assert is_gamepad(whole)
    assert not is_gamepad(whole | {EventType.KEY: [304]})
    assert not is_gamepad(whole | {EventType.ABS: [0, 1]})
    keyboard: dict[int, list[int]] = {EventType.KEY: list(range(1, 120))}
    assert not is_gamepad(keyboard)


def test_without_evdev_it_is_said_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "evdev", None)
    with pytest.raises(ServiceError, match=r"pip install 'trirail\[gamepad\]'"):
        Pad.first()


def test_the_codes_are_the_kernel_s() -> None:
    ecodes = pytest.importorskip("evdev").ecodes
    for code in EventType:
        assert getattr(ecodes, f"EV_{code.name}") == code
    names = {Code.SYN_DROPPED: "SYN_DROPPED", Code.HAT_Y: "ABS_HAT0Y"}
    for each in Code:
        assert getattr(ecodes, names.get(each, f"ABS_{each.name}")) == each
    for button in Button:
        assert getattr(ecodes, f"BTN_{button.name}") == button


def test_events_of_evdev_are_taken() -> None:
    event = pytest.importorskip("evdev").InputEvent
    pad = Gamepad(RANGES)
    pad.apply(event(0, 0, EventType.KEY, Button.TL, 1), 1.0)
    pad.apply(event(0, 0, EventType.ABS, Code.X, FULL), 1.0)
    assert pad.direction(1.0) == pytest.approx((1.0, 0.0, 0.0), abs=1e-4)


@pytest.mark.skipif(not os.access("/dev/uinput", os.W_OK), reason="needs /dev/uinput: modprobe uinput, as root")
def test_a_gamepad_of_the_kernel_s_is_found_read_and_missed() -> None:
    evdev = pytest.importorskip("evdev")
    sticks = [(code, evdev.AbsInfo(0, low, high, 0, 0, 0)) for code, (low, high) in RANGES.items()]
    made = evdev.UInput({EventType.KEY: list(Button), EventType.ABS: sticks}, name="trirail's test")
    with Pad.first() as pad:
        assert pad.name == "trirail's test"
        for said in (key(Button.TL), stick(Code.X, FULL)):
            made.write(*said)
        made.syn()
        assert select.select([pad], [], [], 10.0)[0]
        pad.poll(1.0)
        assert pad.gamepad.direction(1.0) == pytest.approx((1.0, 0.0, 0.0), abs=1e-4)
        made.close()
        with pytest.raises(ServiceError, match="is gone"):
            read_on(pad)


def read_on(pad: Pad) -> None:
    while select.select([pad], [], [], 10.0)[0]:
        pad.poll(2.0)
