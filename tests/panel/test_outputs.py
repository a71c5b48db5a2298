"""Outputs and inputs on the page: switches and lamps, and ticks on the drawing where outputs switch on a path."""

from __future__ import annotations

import msgspec
import pytest
from chromium import Page, needs_chromium
from panel.fake_robot import FakeRobot
from trirail.panel.server import Panel
from trirail.wire.vocabulary import Role
from waiting import wait_until as wait

pytestmark = [pytest.mark.viewer, needs_chromium]

VALVE = "[data-output=valve]"
TICKS = "[...document.querySelectorAll('#mechanism .tick')].map((tick) => "


@pytest.fixture
def robot() -> FakeRobot:
    robot = FakeRobot()
    robot.mode = "holding"
    robot.told = msgspec.structs.replace(robot.told, outputs=("valve",), inputs=("part",))
    robot.outputs, robot.inputs = {"valve": False}, {"part": False}
    return robot


def test_a_switch_sets_its_output_and_shows_its_value(page: Page, robot: FakeRobot) -> None:
    page.until(f"document.querySelector('{VALVE}').ariaChecked === 'false'")
    page.click(VALVE)
    wait(lambda: robot.outputs["valve"], "the output is set")
    page.until(f"document.querySelector('{VALVE}').ariaChecked === 'true'")
    robot.outputs["valve"] = False  # by a mark, or another user
    page.until(f"document.querySelector('{VALVE}').ariaChecked === 'false'")


@pytest.mark.parametrize("by", ["mouse", "screen reader"])
def test_a_press_switches_to_the_other_value_than_the_one_that_was_seen(page: Page, robot: FakeRobot, by: str) -> None:
    """Also where another user has switched the output between press and release."""
    page.until(f"document.querySelector('{VALVE}').ariaChecked === 'false'")
    if by == "mouse":
        page.press(VALVE)
    robot.outputs["valve"] = True
    page.until(f"document.querySelector('{VALVE}').ariaChecked === 'true'")
    if by == "mouse":
        page.let_go(VALVE)
    else:
        page.evaluate(f"document.querySelector('{VALVE}').click()")
    wait(lambda: "set_output" in robot.commands, "the output is set")
    page.until("document.querySelector('#answer').textContent.includes('done')")
    assert robot.outputs["valve"] is (by == "mouse")


def test_no_value_is_shown_without_contact_whatever_the_name(browser: Page, robot: FakeRobot) -> None:
    """Names of what every object of the language has."""
    robot.told = msgspec.structs.replace(robot.told, outputs=("constructor",), inputs=("valueOf",))
    robot.outputs, robot.inputs = {"constructor": False}, {"valueOf": False}
    shown = "[...document.querySelectorAll('#outputs b, #inputs b')].map((each) => each.textContent).join()"
    page = browser.another()
    with Panel(robot.robot()) as panel:
        page.open(panel.url)
        page.until(f"{shown} === 'off,off'")
        robot.silent.set()
        page.until("document.body.dataset.contact === 'none'")
        assert page.evaluate(shown) == "–,–"
        page.close()


@pytest.mark.parametrize("element", ["#outputs button", "#inputs > *"])
@pytest.mark.parametrize(("language", "words"), [("en", ["off", "on"]), ("de", ["aus", "ein"])])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_a_value_is_seen_by_a_word_and_a_lamp_until_contact_is_lost(
    page: Page, robot: FakeRobot, element: str, language: str, words: list[str], scheme: str
) -> None:
    page.colours(scheme)
    page.show_language(language)
    name = "valve" if element.startswith("#outputs") else "part"
    shown = f"document.querySelector({element!r}).innerText.split(/\\s+/)"
    lamp = f"getComputedStyle(document.querySelector({element + ' .lamp'!r})).backgroundColor"
    lamps = []
    for value, word in enumerate(words):
        robot.outputs["valve"] = robot.inputs["part"] = bool(value)
        page.until(f"{shown}.join() === '{name},{word}'")
        lamps.append(page.evaluate(lamp))
    assert lamps[0] == "rgba(0, 0, 0, 0)" != lamps[1]
    robot.silent.set()
    page.until(f"{shown}.join() === '{name},–'")
    assert page.evaluate(lamp) == lamps[0]
    robot.silent.clear()
    page.until(f"{shown}.join() === '{name},{words[1]}'")
    page.evaluate("localStorage.clear()")


def test_a_viewer_cannot_switch(browser: Page, robot: FakeRobot) -> None:
    robot.granted = Role.VIEWER
    page = browser.another()
    with Panel(robot.robot()) as panel:
        page.open(panel.url)
        page.until("document.querySelector('#inputs .lamp')")
        page.until("document.body.dataset.contact === 'yes'")
        page.until(f"document.querySelector('{VALVE}').disabled")
        page.close()


def test_ticks_are_where_outputs_will_switch_and_where_they_have(page: Page, robot: FakeRobot) -> None:
    planned = [{"mark": 0, "output": "valve", "value": True, "pose": [0.02, 0.01, 0.0], "path": 0.01, "time": 0.5}]
    planned += [planned[0] | {"mark": 1, "pose": [0.03, 0.01, 0.0], "number": 3}]
    robot.say("two marks", kind="output", goal="g-1", planned=planned)
    page.until(f"{TICKS} tick.getAttribute('class')).join() === 'tick planned,tick planned'")
    page.until_equal(f"{TICKS} tick.textContent)", ["valve on", "3 × valve on"])
    assert page.evaluate(f"{TICKS} [tick.cx.baseVal.value, tick.cy.baseVal.value])") == [
        pytest.approx([0.02, -0.01]),
        pytest.approx([0.03, -0.01]),
    ]
    switch = {"goal": "g-1", "mark": 0, "output": "valve", "value": False, "cycle": 7, "t": 0.007, "time": 1.7e9}
    switch |= {"commanded": [0.025, 0.01, 0.0], "measured": [0.025, 0.01, 0.0]}
    robot.say("1 output switched", kind="output", goal="g-1", marks=[switch])
    page.until(f"{TICKS} tick.getAttribute('class')).at(-1) === 'tick off'")
    robot.say("one mark", kind="output", goal="g-2", planned=planned[:1])
    page.until(f"{TICKS} tick.textContent).join() === 'valve on'")
