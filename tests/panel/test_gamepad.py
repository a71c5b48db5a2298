"""A gamepad at the page: it moves the robot only while a shoulder button is held, and ends safely when it goes."""

from __future__ import annotations

import json
import signal
from collections.abc import Callable

import pytest
from chromium import Page, needs_chromium
from panel.fake_robot import FakeRobot
from panel.test_page import moves, stands
from waiting import wait_until

pytestmark = [pytest.mark.viewer, needs_chromium]

PLUG = """
window.pads ??= [null];
navigator.getGamepads = () => window.pads;
(() => {
  const pad = {connected: true, mapping: MAPPING, index: pads.length, axes: [0, 0, 0, 0], quiet: null,
    buttons: Array.from({length: 17}, () => ({pressed: false})),
    get timestamp() { return this.quiet ?? performance.now(); }};
  pads.push(window.pad = pad);
  dispatchEvent(Object.assign(new Event("gamepadconnected"), {gamepad: pad}));
})();
"""
EAST, LEFT, RIGHT, UP, DOWN = 1, 4, 5, 12, 13
Do = Callable[[Page], None]


@pytest.fixture
def held(enabled: Page) -> Page:
    """A page with a gamepad whose shoulder buttons and sticks are let go."""
    enabled._call("Emulation.setFocusEmulationEnabled", enabled=True)
    plug(enabled)
    enabled.until("document.querySelector('#answer').textContent.includes('shoulder')")
    settle(enabled)
    return enabled


def plug(page: Page, mapping: str = "standard") -> None:
    """Connect one more gamepad, which is `pad` in the page from then on."""
    page.evaluate(PLUG.replace("MAPPING", json.dumps(mapping)))


def settle(page: Page) -> None:
    """Wait for two looks at the gamepad, which is looked at every 50 ms."""
    page.evaluate("new Promise((done) => setTimeout(done, 150))")


def press(page: Page, button: int, down: bool = True) -> None:
    page.evaluate(f"pad.buttons[{button}].pressed = {json.dumps(down)}")


def push(page: Page, *axes: float) -> None:
    page.evaluate(f"pad.axes = {json.dumps(axes)}")


def jog(page: Page, robot: FakeRobot) -> None:
    press(page, RIGHT)
    push(page, 1.0, 0.0, 0.0)
    moves(robot)


@pytest.mark.parametrize("shoulder", [LEFT, RIGHT])
@pytest.mark.parametrize(
    ("axes", "signs"),
    [((1.0, 0.0, 0.0), (1, 0, 0)), ((0.0, -1.0, 0.0), (0, 1, 0)), ((0.0, 0.05, -0.6), (0, 0, 1))],
)
@pytest.mark.usefixtures("slow_hand")
def test_a_stick_moves_the_robot_while_a_shoulder_button_is_held(
    held: Page, robot: FakeRobot, shoulder: int, axes: tuple[float, ...], signs: tuple[int, ...]
) -> None:
    push(held, *axes)
    settle(held)
    assert not robot.sent
    press(held, shoulder)
    wait_until(lambda: any(robot.velocity), "it moves")
    assert [(value > 0) - (value < 0) for value in robot.velocity] == list(signs)
    press(held, shoulder, False)
    stands(robot)


@pytest.mark.usefixtures("slow_hand")
@pytest.mark.parametrize(
    "ends",
    [
        "dispatchEvent(new Event('blur'))",
        "dispatchEvent(new Event('pagehide'))",
        "document.hasFocus = () => false",
        "Object.defineProperty(document, 'hidden', {value: true, configurable: true}),"
        " document.dispatchEvent(new Event('visibilitychange'))",
        "pad.connected = false",
        "navigator.getGamepads = () => []",
        "pad.quiet = performance.now() - 3000",
        "pad.axes = [0.1, 0, 0]",
    ],
)
def test_what_takes_page_or_pad_from_the_hand_ends_the_jog(held: Page, robot: FakeRobot, ends: str) -> None:
    jog(held, robot)
    held.evaluate(ends)
    stands(robot)
    asked = len(robot.sent)
    settle(held)  # the shoulder button is still down
    assert len(robot.sent) == asked


@pytest.mark.usefixtures("slow_hand")
def test_after_lost_focus_the_shoulder_button_must_be_pressed_again(held: Page, robot: FakeRobot) -> None:
    jog(held, robot)
    held.evaluate("dispatchEvent(new Event('blur'))")
    stands(robot)
    asked = len(robot.sent)
    settle(held)
    assert len(robot.sent) == asked
    press(held, RIGHT, False)
    settle(held)
    press(held, RIGHT)
    moves(robot)
    press(held, RIGHT, False)
    stands(robot)


def test_a_page_that_hangs_ends_the_jog(held: Page, robot: FakeRobot) -> None:
    jog(held, robot)
    held.evaluate("(() => { const over = performance.now() + 1500; while (performance.now() < over); })()")
    stands(robot)
    settle(held)
    assert len({goal.id for goal in robot.sent}) == 1


def test_a_frozen_tab_ends_the_jog_by_its_time_out(held: Page, robot: FakeRobot) -> None:
    jog(held, robot)
    held.signal_renderers(signal.SIGSTOP)
    try:
        stands(robot)
    finally:
        held.signal_renderers(signal.SIGCONT)
    settle(held)
    assert len({goal.id for goal in robot.sent}) == 1


@pytest.mark.usefixtures("slow_hand")
def test_a_jog_that_the_robot_has_ended_begins_again_only_by_a_new_press(held: Page, robot: FakeRobot) -> None:
    jog(held, robot)
    held.evaluate("document.querySelector('#stop').dispatchEvent(new PointerEvent('pointerdown'))")
    wait_until(lambda: "stop" in robot.commands, "it stops")
    stands(robot)
    settle(held)
    asked = [goal for goal in robot.sent if goal.x or goal.y or goal.phi]  # the jog's end may arrive after the stop
    settle(held)
    assert [goal for goal in robot.sent if goal.x or goal.y or goal.phi] == asked


def test_the_other_buttons_stop_and_set_the_speed(held: Page, robot: FakeRobot) -> None:
    before = int(held.evaluate("document.querySelector('#speed').value"))
    for button, after in ((UP, before + 1), (DOWN, before)):
        press(held, button)
        held.until(f"document.querySelector('#speed').value === '{after}'")
        settle(held)
        press(held, button, False)
        settle(held)
    press(held, EAST)
    wait_until(lambda: "stop" in robot.commands, "it stops")
    settle(held)
    assert robot.commands.count("stop") == 1
    assert not robot.sent


def test_a_pad_where_nothing_may_move_says_why(held: Page, robot: FakeRobot) -> None:
    held.click("[data-command=disable]")
    held.until("document.querySelector('.hold').disabled")
    push(held, 1.0, 0.0, 0.0)
    press(held, LEFT)
    held.until("document.querySelector('#answer').textContent.includes(document.querySelector('.hold').title)")
    held.until("document.querySelector('.hold').title")
    assert not robot.sent


@pytest.mark.parametrize("pads", [("standard",), ("standard", "standard"), ("", "standard"), ("standard", "", "")])
def test_the_stop_button_of_every_pad_that_is_announced_stops(
    enabled: Page, robot: FakeRobot, pads: tuple[str, ...]
) -> None:
    enabled._call("Emulation.setFocusEmulationEnabled", enabled=True)
    stops = 0
    for number, mapping in enumerate(pads, start=1):
        plug(enabled, mapping)
        words = "east button stops" if mapping else "not supported"
        enabled.until(f"document.querySelector('#answer').textContent.includes('{words}')")
        settle(enabled)
        for button in (EAST, LEFT, UP):
            for down in (True, False):
                enabled.evaluate(f"pads[{number}].buttons[{button}].pressed = {json.dumps(down)}")
                settle(enabled)
        stops += mapping == "standard"
        wait_until(lambda: robot.commands.count("stop") == stops, "it stops")  # noqa: B023
    assert robot.commands.count("stop") == stops


@pytest.mark.usefixtures("slow_hand")
def test_one_of_two_pads_moves_the_robot_until_its_own_shoulder_button_is_released(
    held: Page, robot: FakeRobot
) -> None:
    plug(held)
    settle(held)
    jog(held, robot)
    held.evaluate(f"pads[1].buttons[{LEFT}].pressed = true; pads[1].axes = [-1, 0, 0, 0]")
    settle(held)
    moves(robot)
    press(held, RIGHT, False)
    stands(robot)
    asked = len(robot.sent)
    settle(held)  # the other shoulder button was pressed while it could not move the robot
    assert len(robot.sent) == asked
    held.evaluate(f"pads[1].buttons[{LEFT}].pressed = false")
    settle(held)
    held.evaluate(f"pads[1].buttons[{LEFT}].pressed = true")
    wait_until(lambda: robot.velocity[0] < 0.0, "it moves back")
    held.evaluate(f"pads[1].buttons[{LEFT}].pressed = false")
    stands(robot)


@pytest.mark.usefixtures("slow_hand")
def test_a_pad_that_moves_the_robot_ends_where_that_is_not_permitted_any_more(held: Page, robot: FakeRobot) -> None:
    jog(held, robot)
    robot.holder = "bob"
    stands(robot)
    asked = len(robot.sent)
    robot.holder = None
    held.until("!document.querySelector('.hold').disabled")
    settle(held)
    assert len(robot.sent) == asked
