"""The operator's page in a browser, used as an operator does, beside a robot that is none."""

from __future__ import annotations

import itertools
import json
import math
import random
import signal
import time
from typing import Any

import msgspec
import pytest
from chromium import Page, needs_chromium
from panel.conftest import SHOWN
from panel.fake_robot import FakeRobot
from trirail.client.held_jog import TIMEOUT
from trirail.errors import RefusalCode, RefusedError
from trirail.panel.description import MICROMETRES, MILLIMETRES
from trirail.panel.server import Panel
from trirail.wire.state import Info
from waiting import wait_until

pytestmark = [pytest.mark.viewer, needs_chromium]

SIZES = {"desk": (1280, 800, False), "phone": (390, 844, True), "small phone": (375, 667, True)}


def moves(robot: FakeRobot) -> None:
    wait_until(lambda: robot.velocity[0] > 0.0, "the robot moves")


def stands(robot: FakeRobot) -> None:
    wait_until(lambda: not any(robot.velocity) and robot.goal is None, "the robot stands")


# ---------------------------------------------------------------------- the dead man


@pytest.mark.alone  # a hand's signs of life have to be in time, through a browser
def test_the_robot_moves_while_a_button_is_held(enabled: Page, robot: FakeRobot) -> None:
    before = robot.pose[0]
    enabled.press("[data-axis=x][data-sign='1']")
    moves(robot)
    wait_until(lambda: robot.pose[0] > before + 0.025 * 3 * TIMEOUT, "it goes on for longer than one time-out")
    enabled.let_go()
    stands(robot)
    assert len({goal.id for goal in robot.sent}) == 1
    assert max(goal.timeout for goal in robot.sent) == TIMEOUT
    assert robot.sent[-1].timeout < TIMEOUT
    assert robot.pose[1:] == (0.005, 0.1)


@pytest.mark.parametrize(
    ("key", "axis", "sign"),
    [("ArrowRight", 0, 1), ("ArrowLeft", 0, -1), ("ArrowUp", 1, 1), ("ArrowDown", 1, -1), ("a", 2, 1), ("d", 2, -1)],
)
def test_keys_jog_while_they_are_down(enabled: Page, robot: FakeRobot, key: str, axis: int, sign: int) -> None:
    enabled.key_down(key)
    wait_until(lambda: bool(robot.sent), "it moves")
    moved = (robot.sent[0].x, robot.sent[0].y, robot.sent[0].phi)
    assert [math.copysign(1.0, value) if value else 0.0 for value in moved] == [sign * (k == axis) for k in range(3)]
    enabled.key_up(key)
    stands(robot)


@pytest.mark.usefixtures("slow_hand")
def test_two_buttons_at_once_are_one_jog_and_each_ends_by_itself(enabled: Page, robot: FakeRobot) -> None:
    enabled.key_down("ArrowRight")
    moves(robot)
    enabled.press("[data-axis=phi][data-sign='-1']")
    wait_until(lambda: robot.velocity[2] < 0.0 < robot.velocity[0], "both")
    enabled.key_up("ArrowRight")
    wait_until(lambda: robot.velocity[0] == 0.0 and robot.velocity[2] < 0.0, "the button alone")
    enabled.let_go()
    stands(robot)
    assert len({goal.id for goal in robot.sent}) == 1


def test_a_finger_holds_and_what_takes_the_touch_away_lets_go(enabled: Page, robot: FakeRobot) -> None:
    for end in ("touchEnd", "touchCancel"):
        enabled.resize(375, 667, phone=True)
        enabled.touch("[data-axis=x][data-sign='1']")
        moves(robot)
        enabled.end_touch(end)
        stands(robot)


@pytest.mark.usefixtures("slow_hand")
@pytest.mark.parametrize(
    "gone",
    [
        "dispatchEvent(new Event('blur'))",
        "dispatchEvent(new Event('pagehide'))",
        "Object.defineProperty(document, 'hidden', {value: true, configurable: true}),"
        " document.dispatchEvent(new Event('visibilitychange'))",
        "document.querySelector('.held').dispatchEvent(new PointerEvent('lostpointercapture', {pointerId: 1}))",
    ],
)
def test_what_takes_the_page_from_the_operator_lets_go(enabled: Page, robot: FakeRobot, gone: str) -> None:
    enabled.press("[data-axis=x][data-sign='1']")
    moves(robot)
    enabled.evaluate(gone)
    stands(robot)
    asked = len(robot.sent)
    enabled.evaluate("new Promise((done) => setTimeout(done, 300))")  # the button is still down
    assert len(robot.sent) == asked
    enabled.let_go()


@pytest.mark.usefixtures("slow_hand")
@pytest.mark.parametrize("by", ["#language", "#along", "key in a list", "contextmenu", "dragstart"])
def test_what_takes_the_keys_from_the_page_lets_go(enabled: Page, robot: FakeRobot, by: str) -> None:
    """A page hears no key while a list or menu is open, or while something is dragged."""
    enabled.key_down("ArrowRight")
    moves(robot)
    if by.startswith("#"):
        enabled.click(by)
    elif by == "key in a list":
        enabled.evaluate("document.querySelector('#along').focus()")
        enabled.key_down("F4")
    else:
        enabled.evaluate(f"document.body.dispatchEvent(new Event('{by}', {{bubbles: true, cancelable: true}}))")
    stands(robot)
    enabled.key_up("ArrowRight")


def test_a_page_that_hangs_moves_nothing_and_begins_nothing_when_it_goes_on(enabled: Page, robot: FakeRobot) -> None:
    enabled.press("[data-axis=x][data-sign='1']")
    moves(robot)
    enabled.evaluate("(() => { const over = performance.now() + 1500; while (performance.now() < over); })()")
    stands(robot)
    assert len({goal.id for goal in robot.sent}) == 1
    enabled.let_go()


def test_a_frozen_tab_moves_nothing(enabled: Page, robot: FakeRobot) -> None:
    enabled.press("[data-axis=x][data-sign='1']")
    moves(robot)
    enabled.signal_renderers(signal.SIGSTOP)
    try:
        stands(robot)
    finally:
        enabled.signal_renderers(signal.SIGCONT)
    enabled.let_go()
    assert len({goal.id for goal in robot.sent}) == 1


def test_a_tab_that_the_browser_freezes_moves_nothing(enabled: Page, robot: FakeRobot) -> None:
    """As it does on phones, where another program is looked at."""
    enabled.resize(390, 844, phone=True)
    enabled.touch("[data-axis=x][data-sign='1']")
    moves(robot)
    enabled.freeze()
    stands(robot)
    asked = len(robot.sent)
    enabled.freeze(over=True)
    enabled.evaluate("new Promise((done) => setTimeout(done, 300))")  # the finger is still down
    assert len(robot.sent) == asked


def test_a_tab_that_is_closed_lets_go(browser: Page, enabled: Page, panel: Panel, robot: FakeRobot) -> None:
    other = browser.another()
    other.open(panel.url)
    other.until(f"{SHOWN} && !document.querySelector('.hold').disabled")
    other.press("[data-axis=x][data-sign='1']")
    moves(robot)
    other.close()
    stands(robot)


@pytest.mark.usefixtures("slow_hand")
def test_a_jog_that_the_robot_has_ended_begins_again_only_by_a_new_press(enabled: Page, robot: FakeRobot) -> None:
    enabled.press("[data-axis=x][data-sign='1']")
    moves(robot)
    robot.refusal = RefusedError(RefusalCode.AT_LIMIT, "jog 'x' has ended at the limit of platform x")
    enabled.until("document.querySelector('#answer').textContent.includes('platform x')")
    robot.refusal = None
    asked = len(robot.sent)
    stands(robot)
    enabled.evaluate("new Promise((done) => setTimeout(done, 300))")
    assert len(robot.sent) == asked
    enabled.let_go()
    enabled.press("[data-axis=x][data-sign='1']")
    moves(robot)
    enabled.let_go()


@pytest.mark.usefixtures("slow_hand")
def test_the_speed_is_chosen_by_slider_and_keys(enabled: Page, robot: FakeRobot) -> None:
    found = []
    for key in ("", "-", "+", "+"):
        if key:
            enabled.type_key(key)
        said = enabled.text("#speed-says")
        enabled.key_down("ArrowRight")
        moves(robot)
        found.append(round(robot.velocity[0] * 1e3, 6))
        assert said.startswith(f"{found[-1]:g} mm/s")
        enabled.key_up("ArrowRight")
        stands(robot)
    assert found == [25.0, 12.5, 25.0, 50.0]


# ---------------------------------------------------------------------- STOP and the other commands


@pytest.mark.parametrize("by", ["mouse", "Space", "Escape", "Space on a button", "touch"])
def test_stop_from_wherever_one_is(enabled: Page, robot: FakeRobot, by: str) -> None:
    enabled.key_down("ArrowRight")
    moves(robot)
    if by == "mouse":
        enabled.press("#stop")
    elif by == "touch":
        enabled.resize(375, 667, phone=True)
        enabled.touch("#stop")
    else:
        enabled.evaluate("document.querySelector('[data-command=disable]').focus()" if "button" in by else "0")
        enabled.type_key(by.split(maxsplit=1)[0])
    wait_until(lambda: "stop" in robot.commands, "a stop")
    stands(robot)
    enabled.evaluate("new Promise((done) => setTimeout(done, 300))")
    stands(robot)
    assert robot.commands == ["enable", "stop"]
    enabled.key_up("ArrowRight")
    enabled.let_go()


@pytest.mark.parametrize("by", ["mouse", "Space", "Escape"])
def test_stop_while_a_list_is_open(enabled: Page, robot: FakeRobot, by: str) -> None:
    robot.mode, robot._alive_until = "moving", float("inf")
    enabled.click("#language")
    enabled.until("document.querySelector('#language').matches(':open')")
    if by == "mouse":
        enabled.press("#stop")
        enabled.let_go()
    else:
        enabled.type_key(by)
    wait_until(lambda: robot.commands.count("stop") == 1, "a stop")


def test_stop_waits_for_no_command_under_way(enabled: Page, robot: FakeRobot) -> None:
    with robot.hanging("pause"):
        enabled.key_down("ArrowRight")
        enabled.until("!document.querySelector('[data-command=pause]').disabled")
        enabled.click("[data-command=pause]")
        wait_until(lambda: "pause" in robot.commands, "pause is under way")
        enabled.click("#stop")
        stands(robot)
        wait_until(lambda: "stop" in robot.commands, "a stop")
    enabled.key_up("ArrowRight")


def test_two_tabs_show_the_same_and_either_stops(browser: Page, enabled: Page, panel: Panel, robot: FakeRobot) -> None:
    other = browser.another()
    other.open(panel.url)
    other.until("document.querySelector('#mode-name').textContent === 'holding'")
    other.press("[data-axis=y][data-sign='1']")
    wait_until(lambda: robot.velocity[1] > 0.0, "the second tab moves it")
    enabled.until("document.querySelector('#mode-name').textContent === 'moving'")
    enabled.click("#stop")
    stands(robot)
    other.until("document.querySelector('#mode-name').textContent === 'holding'")
    asked = len(robot.sent)
    other.evaluate("new Promise((done) => setTimeout(done, 300))")
    assert len(robot.sent) == asked
    other.let_go()
    other.close()


def test_a_fault_is_told_with_its_reason_and_reset(enabled: Page, robot: FakeRobot) -> None:
    robot.fault("drive B: EMCY 8700: it missed the service's SYNC")
    enabled.until("document.querySelector('#mode-name').textContent === 'fault'")
    alarm = enabled.evaluate("(({innerText, role}) => [innerText, role])(document.querySelector('#alarm'))")
    assert "EMCY 8700" in alarm[0]
    assert alarm[1] == "alert"
    enabled.until("[...document.querySelectorAll('.hold')].every((button) => button.disabled)")
    enabled.click("[data-command=reset]")
    enabled.until("document.querySelector('#alarm').hidden")
    assert robot.mode == "disabled"


def test_a_refusal_is_told(page: Page, robot: FakeRobot) -> None:
    robot.refusal = RefusedError(RefusalCode.NOT_AT_REST, "slider A is moved from outside")
    page.click("[data-command=enable]")
    page.until("document.querySelector('#answer').textContent === 'Enable: slider A is moved from outside'")


def test_the_override_is_shown_and_set(enabled: Page, robot: FakeRobot) -> None:
    robot.share = 0.4
    enabled.until("document.querySelector('#override').value === '40'")
    enabled.evaluate("document.querySelector('#override').focus()")
    for _ in range(2):
        enabled.type_key("ArrowRight")  # moves the slider, not the robot
    wait_until(lambda: robot.share == 0.5, "both are sent")
    assert robot.sent == []
    robot.share = 0.8  # by somebody else
    enabled.until("document.querySelector('#override').value === '80'")


@pytest.mark.parametrize("right", [40.0, -40.0])
def test_an_override_is_sent_however_long_the_slider_is_held(enabled: Page, robot: FakeRobot, right: float) -> None:
    robot.share = 0.9
    enabled.until("document.querySelector('#override').value === '90'")
    values: list[str] = []

    def hold() -> None:
        values.append(enabled.evaluate("document.querySelector('#override').value"))
        robot.share = 0.2  # set by another operator
        enabled.evaluate("new Promise((later) => setTimeout(later, 1500))")
        values.append(enabled.evaluate("document.querySelector('#override').value"))

    enabled.drag("#override", right, 0.0, hold)
    assert values[0] == values[1] != "90"
    wait_until(lambda: robot.share == int(values[1]) / 100.0, "the value under the pointer is sent")


def test_a_slider_that_was_held_shows_the_override_again(enabled: Page, robot: FakeRobot) -> None:
    """Also if its value has not changed, and the mouse is released beside it."""
    enabled.press("#override")
    enabled.let_go("#mode-name")
    for share in (0.45, 0.65):
        robot.share = share
        enabled.until(f"document.querySelector('#override').value === '{round(share * 100)}'")


def test_named_poses_are_buttons_that_come_and_go_with_them(enabled: Page, robot: FakeRobot) -> None:
    names = "JSON.stringify([...document.querySelectorAll('#poses button')].map((button) => button.textContent))"
    enabled.until(f"{names} === '[\"park\"]'")
    robot.named["pick"] = (0.0, 0.0, 0.0)
    robot.say("pose pick taught by bob", kind="pose")
    enabled.until(f'{names} === \'["park","pick"]\'')
    enabled.click("[data-pose=pick]")
    enabled.until("document.querySelector('#answer').textContent === 'go to pick: arrived'")
    assert robot.gone_to == ["pick"]
    assert set(robot.named) == {"park", "pick"}
    robot.named.clear()  # and nobody is told
    enabled.click("[data-pose=park]")
    enabled.until("document.querySelector('#answer').textContent === \"go to park: no pose 'park'\"")
    robot.say("pose park removed by bob", kind="pose")
    enabled.until("!document.querySelector('#poses button')")
    robot.named["<b>"] = (0.0, 0.0, 0.0)  # whatever a service says, it is a name and no page
    robot.say("pose <b> taught by bob", kind="pose")
    enabled.until(f"{names} === '[\"<b>\"]'")
    robot.command("disable")
    enabled.until("document.querySelector('#poses button').disabled")


def test_the_last_alignment_is_shown_with_what_each_mark_had_to_go(page: Page, robot: FakeRobot, panel: Panel) -> None:
    def told(number: int, ways: dict[str, float], **more: Any) -> None:
        marks = [{"name": name, "pixel": (10.0, 20.0), "to_go": (way, 0.0)} for name, way in ways.items()]
        look = {"id": "align-1", "purpose": "alignment", "number": number, "marks": marks} | more
        robot.say("a look", kind="alignment", user="bob", alignment=look)

    shown = "document.querySelector('#alignment').innerText"
    button = "document.querySelector('[data-view=alignment]')"
    page.until(f"{button}.disabled")
    told(1, {"left": 4.123e-4, "<b>": 1e-4}, correction=(1e-4, 0.0, 0.0))
    page.until(f"!{button}.disabled")
    told(2, {"left": 3.1e-7, "<b>": 2e-7}, end="reached", seconds=0.25)
    page.click("[data-view=alignment]")
    for words in ("align-1 of bob", "reached in 0.25 s, corrections: 1", "look 2", "412.3 µm", "0.31 µm", "<b>"):
        page.until(f"{shown}.includes({json.dumps(words)})")
    robot.say("a look", kind="alignment", user="bob", alignment={"id": "align-2", "purpose": "check", "number": 1})
    for _ in range(300):
        robot.say("much else")
    later = page.another()
    later.open(panel.url)
    later.until("document.querySelector('#alignment').innerText !== ''")
    later.until("document.querySelector('#alignment').textContent.includes('Check')")
    later.close()


@pytest.mark.usefixtures("slow_hand")
def test_the_last_minutes_are_drawn_and_a_silent_time_is_a_gap(enabled: Page, robot: FakeRobot) -> None:
    enabled.click("[data-view=charts]")
    enabled.until("document.querySelector('#mechanism').hasAttribute('hidden')")
    enabled.until_equal("document.querySelectorAll('#charts canvas').length", 4)
    enabled.key_down("ArrowRight")
    moves(robot)
    rows = "(await import('./panel.js')).charts.rows"

    def drawn_so_far() -> list[Any]:
        found: list[Any] = enabled.evaluate(f"(async () => {rows})()")
        return found

    wait_until(
        lambda: len(drawn_so_far()) > 3 and drawn_so_far()[-1][0] > drawn_so_far()[0][0] + 2.0, "the way is drawn"
    )
    enabled.key_up("ArrowRight")
    drawn = drawn_so_far()
    assert drawn[-1][1:3] == pytest.approx([5.0, math.degrees(0.1)])
    robot.silent.set()
    enabled.until("document.querySelector('#mode-name').textContent === 'no contact'")
    assert drawn_so_far()[-1] == [None] * 7
    robot.silent.clear()


CHARTS = "(await import('./panel.js')).charts"


def test_curves_begin_anew_after_a_clock_that_was_set_back(page: Page) -> None:
    def times() -> list[float]:
        found: list[float] = page.evaluate(f"(async () => {CHARTS}.times)()")
        return found

    wait_until(lambda: len(times()) > 3, "curves")
    page.evaluate("(() => { const clock = Date.now; Date.now = () => clock() - 3_600_000; })()")
    before = times()[0]
    wait_until(lambda: times()[0] < before - 3000.0 and len(times()) > 3, "curves of now")
    found = times()
    assert found == sorted(found)


def test_the_time_in_which_the_page_was_hidden_is_a_gap(page: Page, robot: FakeRobot) -> None:
    def rows() -> list[list[float]]:
        found: list[list[float]] = page.evaluate(f"(async () => {CHARTS}.rows)()")
        return found

    wait_until(lambda: len(rows()) > 3, "curves")
    page.evaluate(
        "(() => { window.hidden = []; window.draw = requestAnimationFrame;"
        " window.requestAnimationFrame = (each) => hidden.push(each); })()"
    )
    page.until("hidden.length")
    before, robot.pose = len(rows()), (0.02, 0.005, 0.1)
    page.evaluate(
        "(() => { for (const clock of [Date, performance]) { const now = clock.now.bind(clock);"
        " clock.now = () => now() + 60_000; }"
        " window.requestAnimationFrame = draw; hidden.forEach((each) => draw(each)); })()"
    )
    wait_until(lambda: len(rows()) > before + 4, "curves again")
    drawn = rows()
    assert drawn[before] == [None] * 7
    later = [row[0] for row in drawn[before + 2 :]]  # the first may be of a state that was on its way
    assert later == pytest.approx([20.0] * len(later))


def test_curves_in_another_unit_are_cleared(page: Page, robot: FakeRobot) -> None:
    wait_until(lambda: page.evaluate(f"(async () => {CHARTS}.rows.length)()") > 3, "curves")
    restart(page, robot, small(robot.told))
    page.until(f"{SHOWN} && document.querySelector('#to-x').placeholder === 'µm'")
    wait_until(lambda: page.evaluate(f"(async () => {CHARTS}.rows.length)()") > 3, "curves")
    rows = page.evaluate(f"(async () => {CHARTS}.rows)()")
    assert [row[0] for row in rows] == pytest.approx([robot.pose[0] * 1e6] * len(rows))


def small(info: Info) -> Info:
    """The same robot with so little travel that it is shown in micrometres."""
    limits = msgspec.to_builtins(info.limits)
    limits["platform"]["x"] = [-0.01, 0.01]
    return msgspec.structs.replace(info, limits=limits)


def restart(page: Page, robot: FakeRobot, info: Info) -> None:
    """Start the service again with another configuration."""
    robot.silent.set()
    page.until("document.body.dataset.contact === 'none'")
    robot.told = info
    robot.silent.clear()


# ---------------------------------------------------------------------- poses that are typed, dragged and kept


def typed(page: Page, *words: str) -> None:
    for field, word in zip(("x", "y", "phi"), words, strict=True):
        page.write(f"#to-{field}", word)


@pytest.mark.parametrize(
    ("words", "pose"),
    [
        (("20", "-10", "10"), (0.02, -0.01, math.radians(10.0))),
        (("2,5", "500 um", "-30arcsec"), (0.0025, 0.0005, -math.radians(30.0 / 3600.0))),
        (("0.01 m", "1in", "5mrad"), (0.01, 0.0254, 0.005)),
        (("0,125", "-1,2500", "0"), (0.000125, -0.00125, 0.0)),
    ],
)
def test_a_pose_that_is_typed_is_checked_and_gone_to_when_told(
    words: tuple[str, str, str], pose: tuple[float, float, float], enabled: Page, robot: FakeRobot
) -> None:
    before = robot.pose
    typed(enabled, *words)
    enabled.until("document.querySelector('#going').dataset.may === 'yes'")
    assert enabled.text("#going-says") == "within limits"
    assert robot.pose == before
    enabled.click("#go")
    enabled.until("document.querySelector('#answer').textContent === 'go there: arrived'")
    assert robot.pose == pytest.approx(pose, abs=1e-12)


@pytest.mark.parametrize(
    ("language", "words"), [("en", "a comma before exactly three digits"), ("de", "ein Punkt vor genau drei Ziffern")]
)
@pytest.mark.parametrize("word", ["10,000", "1,250 mm", "-125,000"])
def test_a_mark_that_may_separate_thousands_is_no_number(language: str, words: str, word: str, enabled: Page) -> None:
    enabled.show_language(language)
    typed(enabled, "1", "2", "3")
    enabled.until("document.querySelector('#going').dataset.may === 'yes'")
    typed(enabled, word.replace(",", "." if language == "de" else ","), "2", "3")
    enabled.until("document.querySelector('#to-x').getAttribute('aria-invalid') === 'true'")
    assert words in enabled.text("#going-says")
    assert enabled.evaluate("document.querySelector('#going').dataset.may") == ""
    enabled.evaluate("localStorage.clear()")


@pytest.mark.parametrize("resolution", [MILLIMETRES, MICROMETRES], ids=["mm", "µm"])
@pytest.mark.generated(0, 1, 2)
def test_every_number_that_the_page_writes_is_read_as_the_same_value_in_every_language(
    page: Page, resolution: dict[str, Any], seed: int
) -> None:
    draw = random.Random(seed)
    values = [draw.uniform(-1.0, 1.0) * 10.0 ** draw.uniform(-6, 0) for _ in range(200)]
    values += [round(draw.uniform(-200.0, 200.0), draw.randint(0, 4)) / resolution["scale"] for _ in range(200)]
    found = {}
    for language in page.evaluate("[...document.querySelector('#language').options].map((each) => each.value)"):
        page.show_language(language)
        found[language] = page.evaluate(
            "(async () => { const { quantity, LENGTHS, ANGLES } = await import('./going.js');"
            " const { typedLength, typedAngle, useResolution } = await import('./units.js');"
            f" useResolution({json.dumps(resolution)});"
            " const read = (text, units) =>"
            "   [quantity(text, units),"
            "    ...Object.keys(units).map((unit) => quantity(text + unit, units) / units[unit])];"
            " const both = (value) => [read(typedLength(value), LENGTHS), read(typedAngle(value), ANGLES)];"
            f" return {json.dumps(values)}.map(both); }})()"
        )
    page.evaluate("localStorage.clear()")
    assert all(each == found["en"] for each in found.values())
    last = 0.51 * 10.0 ** -(resolution["decimals"] + 2), 0.51 * 10.0 ** -(resolution["angle_decimals"] + 1)
    for value, (length, angle) in zip(values, found["en"], strict=True):
        number = value * resolution["scale"]
        assert length == pytest.approx([value, *[number] * (len(length) - 1)], abs=last[0], rel=1e-12)
        assert length[0] == pytest.approx(value, abs=last[0] / resolution["scale"])
        assert angle[1:] == pytest.approx([math.degrees(value)] * (len(angle) - 1), abs=last[1], rel=1e-12)
        assert angle[0] == pytest.approx(value, abs=math.radians(last[1]))


def test_a_pose_keeps_its_place_when_the_language_changes(enabled: Page, robot: FakeRobot) -> None:
    robot.pose = (8.125e-3, -1.234e-3, math.radians(2.345))
    enabled.until("document.querySelector('#pose').innerText.includes('8.13 mm')")
    enabled.click("#here")
    for language, number in (("de", "8,125"), ("en", "8.125")):
        enabled.show_language(language)
        enabled.until_equal("document.querySelector('#to-x').value", number)
        enabled.until("document.querySelector('#going').dataset.may === 'yes'")
        enabled.write("#to-y", number)
        enabled.click("#go")
        wait_until(lambda: bool(robot.moved_to), "it goes")
        at, *_ = robot.moved_to.pop()
        assert at == pytest.approx((8.125e-3, 8.125e-3, math.radians(2.345)), abs=1e-9)
    enabled.evaluate("localStorage.clear()")


def test_what_is_in_the_way_is_said_before_anything_moves(enabled: Page) -> None:
    typed(enabled, "500", "0", "0")
    enabled.until("document.querySelector('#going').dataset.may === 'no'")
    assert "platform x: position 500 mm" in enabled.text("#going-says")
    enabled.until_equal("document.querySelector('.wanted').parentElement.getAttribute('class')", "barred")


@pytest.mark.parametrize("changed", ["unit", "frame", "its place", "tool"])
def test_numbers_that_would_mean_another_place_after_a_restart_are_cleared(
    changed: str, enabled: Page, robot: FakeRobot
) -> None:
    frames: dict[str, Any] = {"tool": {"tip": (0.02, 0.0)}, "work": {"table": (0.05, 0.02, 0.0)}}
    known = msgspec.structs.replace(robot.told, frames=frames)
    restart(enabled, robot, known)
    enabled.until(f"{SHOWN} && document.querySelector('#frame').options.length === 2")
    enabled.choose("#frame", "table")
    enabled.choose("#tool", "tip")
    typed(enabled, "20", "0", "0")
    restart(enabled, robot, known)
    enabled.until(f"{SHOWN} && document.querySelector('#going').dataset.may === 'yes'")
    other: dict[str, dict[str, Any]] = {
        "frame": frames | {"work": {}},
        "its place": frames | {"work": {"table": (0.06, 0.02, 0.0)}},
        "tool": frames | {"tool": {}},
    }
    info = small(known) if changed == "unit" else msgspec.structs.replace(known, frames=other[changed])
    restart(enabled, robot, info)
    enabled.until(f"{SHOWN} && document.querySelector('#to-x').value === ''")
    before = robot.pose
    enabled.click("#go")
    enabled.until_equal("document.activeElement.id", "to-x")
    assert robot.pose == before
    enabled.until_equal("document.querySelector('#to-x').placeholder", "µm" if changed == "unit" else "mm")


@pytest.mark.parametrize(
    "word", ["ten", "10 furlongs", "1.2.3", "1e3", "--5", "5 mm mm", "5 constructor", "5 __proto__", "9" * 400]
)
def test_what_is_no_number_is_said_and_goes_nowhere(word: str, enabled: Page, robot: FakeRobot) -> None:
    before = robot.pose
    typed(enabled, "1", word, "0")
    assert "expected a number" in enabled.text("#going-says")
    enabled.until_equal("document.querySelector('#to-y').getAttribute('aria-invalid')", "true")
    enabled.click("#go")
    enabled.until_equal("document.activeElement.id", "to-y")
    assert robot.pose == before


def test_a_pose_is_dragged_on_the_drawing_and_moves_nothing_before_it_is_told(enabled: Page, robot: FakeRobot) -> None:
    before = robot.pose
    scale = enabled.evaluate("document.querySelector('#mechanism').getScreenCTM().a")  # pixels a metre
    enabled.drag("#mechanism", right=0.02 * scale, up=0.01 * scale)
    enabled.until("document.querySelector('#going').dataset.may === 'yes'")
    assert robot.pose == before
    enabled.click("#go")
    wait_until(lambda: robot.pose != before, "it goes there")
    assert robot.pose == pytest.approx((before[0] + 0.02, before[1] + 0.01, before[2]), abs=1e-6)


def test_a_pose_is_turned_through_any_angle_without_a_jump(enabled: Page, robot: FakeRobot) -> None:
    """With Shift, around the platform: also past the direction at which the angle of the pointer changes its sign."""
    a, e, f = enabled.evaluate("(({a, e, f}) => [a, e, f])(document.querySelector('#mechanism').getScreenCTM())")
    x, y, phi = robot.pose
    shown = "document.querySelector('#to-phi').value"

    def move(kind: str, degrees: float) -> None:
        along = math.radians(degrees)
        at = {"x": a * (x + 0.1 * math.cos(along)) + e, "y": -a * (y + 0.1 * math.sin(along)) + f}
        enabled._mouse(kind, at | {"modifiers": 8})

    move("mousePressed", 178.0)
    for degrees in (*range(180, 400, 20), *range(400, 150, -20)):
        move("mouseMoved", degrees)
        enabled.until(f"Math.abs({shown} - {math.degrees(phi) + degrees - 178.0}) < 0.5")
    move("mouseReleased", 160.0)
    assert robot.pose == (x, y, phi)


@pytest.mark.usefixtures("slow_hand")
@pytest.mark.parametrize(
    ("button", "by"),
    [("[data-axis=x][data-sign='1']", (1e-4, 0, 0)), ("[data-axis=phi][data-sign='-1']", (0, 0, -math.radians(0.1)))],
)
def test_a_step_is_one_move_for_one_press(
    button: str, by: tuple[float, float, float], enabled: Page, robot: FakeRobot
) -> None:
    before = robot.pose
    enabled.click("[data-step='2']")
    enabled.press(button)
    wait_until(lambda: robot.pose != before, "it steps")
    time.sleep(2 * TIMEOUT)  # held for longer: no more steps, and no jog
    enabled.let_go(button)
    assert robot.pose == pytest.approx(tuple(a + b for a, b in zip(before, by, strict=True)), abs=1e-12)
    assert not robot.sent
    enabled.click("[data-step='0']")
    enabled.press(button)
    wait_until(lambda: bool(robot.sent), "it jogs")
    enabled.let_go(button)


def test_a_goal_whose_end_is_not_told_is_no_longer_shown_when_the_robot_has_none(
    enabled: Page, robot: FakeRobot
) -> None:
    """Such as to a tab that was frozen while more happened than the panel keeps."""
    robot.lasting = True
    enabled.click("[data-pose=park]")
    enabled.until("document.querySelector('#answer').textContent.startsWith('go to park')")
    wait_until(lambda: robot.goal is not None, "the goal")
    with robot._lock:
        robot.goal, robot.mode = None, "holding"
    enabled.until("document.querySelector('#answer').textContent === ''")


def test_a_place_is_kept_and_forgotten_by_its_name(enabled: Page, robot: FakeRobot) -> None:
    enabled.write("#pose-name", "pick")
    enabled.click("#teach")
    enabled.until("document.querySelector('#poses').innerText.includes('pick')")
    assert robot.named["pick"] == robot.pose
    enabled.until("!document.querySelector('#forget').disabled")
    enabled.click("#forget")
    enabled.until("document.querySelector('#forget').innerText === 'Sure?'")
    time.sleep(0.6)  # a double click is no answer
    enabled.click("#forget")
    enabled.until("!document.querySelector('#poses').innerText.includes('pick')")
    enabled.write("#pose-name", "park")  # of the configuration
    enabled.until("document.querySelector('#forget').disabled")


def test_only_a_robot_that_homes_has_the_button(page: Page, browser: Page) -> None:
    page.until("document.querySelector('[data-command=home]').hidden")
    homing = FakeRobot(homes=("A", "C"))
    with Panel(homing.robot()) as panel:
        other = browser.another()
        other.open(panel.url)
        other.until(SHOWN)
        other.click("[data-command=enable]")
        other.until("document.querySelector('#mode-name').textContent === 'holding'")
        other.click("[data-command=home]")
        wait_until(lambda: homing.commands == ["enable", "home"], "homing")
        other.close()


# ---------------------------------------------------------------------- what is shown


def test_the_numbers_and_the_drawing_are_the_state(page: Page, robot: FakeRobot) -> None:
    robot.pose = (0.0321, -0.0123, -0.2)
    page.until("document.querySelector('#pose').innerText.includes('32.10 mm')")
    shown = page.text("#pose")
    assert "−12.30 mm" in shown
    assert "−11.459°" in shown
    placed = page.evaluate("document.querySelector('.platform').parentElement.getAttribute('transform')")
    assert placed.startswith("translate(0.0321 0.0123) rotate(11.459")


def test_a_service_that_is_silent_is_told_and_comes_back(page: Page, robot: FakeRobot) -> None:
    robot.silent.set()
    page.until("document.querySelector('#mode-name').textContent === 'no contact'")
    assert "out of date" in page.text("#alarm")
    assert "mm" not in page.text("#pose")
    moving = (
        "['.platform', '.sleeve', '.carriage', '.pivot']"
        ".map((kind) => document.querySelector(kind).getBoundingClientRect().width > 0)"
    )
    assert not any(page.evaluate(moving))  # nobody knows where it is
    page.until("document.querySelector('.rail').getBoundingClientRect().width")
    robot.silent.clear()
    page.until(f"{SHOWN} && document.querySelector('#alarm').hidden")
    assert all(page.evaluate(moving))


def test_nothing_is_drawn_where_it_may_not_be_before_there_is_a_state(browser: Page) -> None:
    robot = FakeRobot()
    robot.silent.set()
    with Panel(robot.robot(), 0) as panel:
        page = browser.another()
        page.open(panel.url)
        page.until("document.querySelector('.rail')")
        assert not page.evaluate("document.querySelector('.platform').getBoundingClientRect().width")
        page.write("#to-x", "1")
        page.write("#to-y", "1")
        page.write("#to-phi", "1")
        page.until("document.querySelector('#going-says').textContent.includes('the position of the robot is unknown')")
        page.close()


def test_a_server_that_has_ended_is_told(browser: Page) -> None:
    page = browser.another()
    with Panel(FakeRobot().robot()) as panel:
        page.open(panel.url)
        page.until(SHOWN)
    page.until("document.querySelector('#alarm').innerText.includes('trirail panel')")
    page.close()


def test_events_come_with_their_time_the_past_too(page: Page, robot: FakeRobot) -> None:
    page.until("document.querySelector('#events').innerText.includes('the loop turns')")
    robot.say("recorder <b>lacks</b> 20 cycles", "warning")
    page.until("document.querySelector('#events li').innerText.includes('<b>lacks</b>')")
    newest = page.evaluate("document.querySelector('#events li').innerText")
    assert newest.split("recorder")[0].strip().count(":") == 2
    page.until_equal("document.querySelector('#events li').className", "warning")


def test_the_end_of_a_goal_stays_when_its_id_is_used_again(enabled: Page, robot: FakeRobot) -> None:
    ends = ("done", "stopped", "rejected", "done")
    for end in ends:
        robot._say_begun("again")
        robot.say(f"goal again {end}", kind="goal", id="again", outcome=end, user="ann")
    robot._say_begun("again")
    lines = "[...document.querySelectorAll('#events li[data-goal=again]')].map((each) => each.dataset.outcome ?? '')"
    enabled.until_equal(lines, ["", *reversed(ends)])


def test_events_are_shown_once_and_in_order_whatever_is_started_again(browser: Page, robot: FakeRobot) -> None:
    """So on a new connection of the tab, and after a service whose clock was set back."""
    shown = "[...document.querySelectorAll('#events li')].map((each) => each.event.message)"
    runs = [(run, seq) for run, most in (("a", 4), ("b", 2)) for seq in range(1, most + 1)]
    look = {"id": "align-1", "purpose": "alignment", "number": 1, "end": "missing"}
    with Panel(robot.robot(), 0) as panel:
        script = panel._files["panel.js"]
        panel._files["panel.js"] = script.replace(
            b"socket = new WebSocket", b"globalThis.opened = socket = new WebSocket"
        )
        page = browser.another()
        page.open(panel.url)
        page.until(SHOWN)
        for run, seq in runs:
            more: dict[str, Any] = (
                {"alignment": look, "kind": "alignment", "user": "bob"} if (run, seq) == ("a", 4) else {}
            )
            robot.say(f"{run} {seq}", run=run, seq=seq, time={"a": 1.7e9, "b": 1.6e9}[run] + seq, **more)
        wanted = ["b 2", "b 1", "a 4", "a 3", "a 2", "a 1", "the loop turns at 1000 Hz"]
        page.until_equal(shown, wanted)
        page.evaluate("(() => { globalThis.before = opened; opened.close(); })()")
        page.until("opened !== before && document.body.dataset.contact === 'yes'")
        robot.say("b 3", run="b", seq=3)
        page.until(f"{shown}[0] === 'b 3'")
        page.until_equal(shown, ["b 3", *wanted])
        page.close()


def test_nothing_is_loaded_from_elsewhere_and_nothing_fails(page: Page, panel: Panel) -> None:
    loaded = page.evaluate("performance.getEntriesByType('resource').map((each) => [each.name, each.responseStatus])")
    assert {name.removeprefix(panel.url) for name, _ in loaded} >= {"panel.js", "hold.js", "drawing.js", "panel.css"}
    assert all(name.startswith(panel.url) and status == 200 for name, status in loaded), loaded


# ---------------------------------------------------------------------- for every eye and hand


@pytest.mark.parametrize("faulty", [False, True])
def test_text_has_the_contrast_of_wcag_aa(enabled: Page, robot: FakeRobot, faulty: bool) -> None:
    enabled.write("#to-x", "900")
    enabled.write("#to-y", "0")
    enabled.write("#to-phi", "0")
    enabled.until("document.querySelector('#going').dataset.may === 'no'")
    robot.say("a warning", "warning")
    robot.say("an error", "error")
    enabled.until("document.querySelector('#events li').innerText.includes('an error')")
    if faulty:
        robot.fault("drive B")
        enabled.until("document.querySelector('#mode-name').textContent === 'fault'")
    for scheme, size in itertools.product(("light", "dark"), SIZES):
        width, height, phone = SIZES[size]
        enabled.resize(width, height, phone=phone)
        enabled.colours(scheme)
        if not faulty:
            enabled.press("[data-axis=x][data-sign='1']")
            enabled.until("document.querySelector('.held')")
        found = enabled.evaluate(COLOURS)
        enabled.let_go()
        assert len(found) > 30
        low = {
            (words, round(contrast(ink, ground), 2))
            for words, ink, ground, large in found
            if contrast(ink, ground) < (3.0 if large else 4.5)
        }
        assert not low, (scheme, size)


COLOURS = """(() => {
  const number = (colour) => colour.match(/[\\d.]+/g).map(Number);
  const ground = (element) => {
    for (; element; element = element.parentElement) {
      const colour = number(getComputedStyle(element).backgroundColor);
      if (colour.length === 3 || colour[3] === 1) return colour.slice(0, 3);
    }
    throw new Error("no ground");
  };
  return [...document.querySelectorAll("body *")].flatMap((element) => {
    const own = [...element.childNodes].filter((node) => node.nodeType === 3 && node.data.trim());
    const style = getComputedStyle(element);
    if (!own.length || !element.getClientRects().length || style.visibility === "hidden") return [];
    const size = parseFloat(style.fontSize);
    const colour = element instanceof SVGElement ? style.fill : style.color;
    return [[own[0].data.trim(), number(colour).slice(0, 3), ground(element), size >= 24]];
  });
})()"""


def contrast(one: list[float], other: list[float]) -> float:
    """The contrast ratio of WCAG 2.2 for two colours of sRGB, 0 to 255."""
    light, dark = sorted((luminance(one), luminance(other)), reverse=True)
    return (light + 0.05) / (dark + 0.05)


def luminance(colour: list[float]) -> float:
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in (value / 255.0 for value in colour)]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def test_everything_fits_and_stop_is_always_in_reach(enabled: Page, robot: FakeRobot) -> None:
    robot.fault("drive B: " + "a long reason " * 20)
    enabled.until("document.querySelector('#mode-name').textContent === 'fault'")
    ends = ("0", "document.documentElement.scrollHeight")
    for (width, height, phone), place in itertools.product(SIZES.values(), ends):
        enabled.resize(width, height, phone=phone)
        enabled.until_equal("document.documentElement.scrollWidth", width)
        enabled.evaluate(f"scrollTo(0, {place})")
        x, y, w, h = enabled.evaluate(
            "(({x, y, width, height}) => [x, y, width, height])"
            "(document.querySelector('#stop').getBoundingClientRect())"
        )
        assert x >= 0.0
        assert y >= 0.0
        assert x + w <= width
        assert y + h <= height
        assert w >= 300.0
        assert h >= 140.0
        over = enabled.evaluate(f"document.elementFromPoint({x + w / 2}, {y + h / 2}).closest('button').id")
        assert over == "stop"


def test_every_control_is_reached_by_tab_named_and_seen_to_have_the_focus(enabled: Page) -> None:
    wanted = enabled.evaluate(
        "[...document.querySelectorAll('button, input, select')]"
        ".filter((each) => !each.disabled && each.checkVisibility()).length"
    )
    reached: dict[str, Any] = {}
    for _ in range(50):
        enabled.type_key("Tab")
        found = enabled.evaluate(
            "(({id, dataset, tagName, innerText, labels, ariaLabel}, style) => [id || JSON.stringify(dataset), tagName,"
            " innerText || labels?.[0]?.innerText || ariaLabel || '',"
            " style.outlineStyle, parseFloat(style.outlineWidth)])"
            "(document.activeElement, getComputedStyle(document.activeElement))"
        )
        if found[1] in ("BUTTON", "INPUT", "SELECT"):
            reached[found[0]] = found
    assert len(reached) == wanted, reached
    for name, _, words, style, outline in reached.values():
        assert words.strip(), name
        assert style == "solid", name
        assert outline >= 2.0, name


def test_mode_and_answers_are_told_to_those_who_hear_the_page(page: Page) -> None:
    roles = page.evaluate("['mode-name', 'alarm', 'answer'].map((id) => document.getElementById(id).role)")
    assert roles == ["status", "alert", "status"]
    for busy in ("#doing", "#pose", "#sliders", "#mechanism"):  # what changes all the time would be said all the time
        assert (
            page.evaluate(f"document.querySelector('{busy}').closest('[role=status], [role=alert], [aria-live]')")
            is None
        )
