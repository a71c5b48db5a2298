"""What counts as a press on the page: a hand acts on the control that it means, and on no other, and STOP stops."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import msgspec
import pytest
from chromium import Page, needs_chromium
from panel.conftest import SHOWN
from panel.fake_robot import FakeRobot
from trirail.panel.server import Panel
from waiting import wait_until

pytestmark = [pytest.mark.viewer, needs_chromium]

TOOLS: dict[str, Any] = {"alpha": (0.01, 0.0), "drill": (0.02, 0.0), **{f"tool{k}": (0.0, 1e-3 * k) for k in range(11)}}
WORK: dict[str, Any] = {"anvil": (0.0, 0.01, 0.5), "desk": (0.0, 0.0, 1.0)}
WORK |= {f"frame{k}": (0.0, 1e-3 * k, 0.0) for k in range(11)}
SIZES = {
    "desk": (1280, 800, False),
    "low desk": (1100, 500, False),
    "magnified desk": (640, 400, False),
    "tablet": (820, 1180, True),
    "phone": (390, 844, True),
    "phone on its side": (844, 390, True),
}
BOX = (
    "(({left, top, width, height}) => [left, top, width, height])(document.querySelector('%s').getBoundingClientRect())"
)


@pytest.fixture
def robot() -> FakeRobot:
    robot = FakeRobot()
    robot.mode = "holding"
    robot.told = msgspec.structs.replace(robot.told, frames={"tool": TOOLS, "work": WORK})
    return robot


@pytest.fixture
def page(browser: Page, panel: Panel) -> Iterator[Page]:
    page = browser.another()
    page.open(panel.url)
    page.until(f"{SHOWN} && !document.querySelector('.hold').disabled")
    yield page
    page.evaluate("localStorage.clear()")
    page.close()


def value(page: Page, control: str) -> str:
    found: str = page.evaluate(f"document.querySelector('#{control}').value")
    return found


def settle(page: Page) -> None:
    """Wait until what was pressed would have been sent, and the next states are drawn."""
    page.evaluate("new Promise((later) => setTimeout(later, 400))")


def key(page: Page, kind: str, name: str, code: str, **more: Any) -> None:
    page._call("Input.dispatchKeyEvent", type=kind, key=name, code=code, **more)


def press_at(page: Page, control: str, share: float) -> None:
    """Click a slider at a share of its width."""
    page.middle(f"#{control}")  # scrolled into view
    left, top, width, height = page.evaluate(BOX % f"#{control}")
    for kind in ("mousePressed", "mouseReleased"):
        page._mouse(kind, {"x": left + share * width, "y": top + height / 2})


# ---------------------------------------------------------------------- keys


CODES = {"ArrowRight": 39, "ArrowUp": 38, "PageUp": 33, "End": 35, "d": 68, "x": 88, "+": 187}


@pytest.mark.usefixtures("slow_hand")
@pytest.mark.parametrize(
    ("control", "name"),
    [
        *((slider, name) for slider in ("speed", "override") for name in ("ArrowRight", "ArrowUp", "PageUp", "End")),
        ("pose-name", "d"),
        ("tool", "x"),
    ],
)
def test_a_key_that_was_pressed_elsewhere_does_nothing_to_what_gets_the_focus(
    page: Page, robot: FakeRobot, control: str, name: str
) -> None:
    text = name if len(name) == 1 else ""
    code = f"Key{name.upper()}" if text else name
    press = {"windowsVirtualKeyCode": CODES[name], "text": text}
    key(page, "keyDown", name, code, **press)
    if control in ("speed", "override"):
        press_at(page, control, 0.1)
    else:
        page.evaluate(f"document.querySelector('#{control}').focus()")
    page.until_equal("document.activeElement.id", control)
    settle(page)
    before, share, asked = value(page, control), robot.share, len(robot.commands)
    for _ in range(5):
        key(page, "keyDown", name, code, autoRepeat=True, **press)
    settle(page)
    assert (value(page, control), robot.share, len(robot.commands)) == (before, share, asked)
    key(page, "keyUp", name, code)
    if control in ("speed", "override") and name != "End":  # a key that is pressed there works there, and is repeated
        for repeat in (False, True):
            key(page, "keyDown", name, code, autoRepeat=repeat, **press)
        page.until(f"document.querySelector('#{control}').value > {before}")
        key(page, "keyUp", name, code)


def test_a_key_that_is_held_in_a_field_changes_no_speed_later(page: Page) -> None:
    before = value(page, "speed")
    page.evaluate("document.querySelector('#pose-name').focus()")
    key(page, "keyDown", "+", "BracketRight", text="+")
    page.click("h1")
    page.until("document.activeElement === document.body")
    key(page, "keyDown", "+", "BracketRight", text="+", autoRepeat=True)
    key(page, "keyUp", "+", "BracketRight")
    assert value(page, "speed") == before


@pytest.mark.parametrize("list_", ["tool", "along", "frame", "language"])
def test_a_key_that_jogs_chooses_nothing_in_a_list_that_is_closed(page: Page, robot: FakeRobot, list_: str) -> None:
    page.evaluate(f"document.querySelector('#{list_}').focus()")
    before = value(page, list_)
    for name in ("d", "a", "D", "A", "ArrowLeft", "ArrowRight"):
        page.type_key(name)
        page.evaluate("new Promise((later) => setTimeout(later, 1100))")  # the next letter is one of its own
        assert value(page, list_) == before, name
    assert not robot.sent


SCROLLERS = ["warnings", "answer", "going-says", "file-says", "alignment", "events", "sessions"]


@pytest.mark.parametrize("scroller", SCROLLERS)
def test_keys_that_scroll_what_has_the_focus_do_not_jog(page: Page, robot: FakeRobot, scroller: str) -> None:
    views = {"file-says": "following", "alignment": "alignment", "sessions": "sessions"}
    if scroller in views:
        page.evaluate(f"document.querySelector('[data-view={views[scroller]}]').disabled = false")
        page.click(f"[data-view={views[scroller]}]")
    page.evaluate(
        f"(() => {{ const it = document.querySelector('#{scroller}'); it.style.height = it.style.maxHeight = '40px';"
        " it.style.overflow = 'auto'; const long = document.createElement('p'); long.style.height = '400px';"
        " it.append(long); it.focus(); })()"
    )
    page.until_equal("document.activeElement.id", scroller)
    for name in ("ArrowDown", "ArrowRight", "a"):
        page.key_down(name)
        settle(page)
        page.key_up(name)
    assert not robot.sent


# ---------------------------------------------------------------------- sliders


def swipe(page: Page, control: str, share: float, right: float, up: float) -> None:
    """Move a finger that begins on a slider."""
    page.evaluate(f"document.querySelector('#{control}').scrollIntoView({{block: 'center'}})")
    settle(page)
    left, top, width, height = page.evaluate(BOX % f"#{control}")
    at = {"x": left + share * width, "y": top + height / 2}
    page._call("Input.dispatchTouchEvent", type="touchStart", touchPoints=[at])
    for part in range(1, 11):
        to = {"x": at["x"] + part / 10 * right, "y": at["y"] - part / 10 * up}
        page._call("Input.dispatchTouchEvent", type="touchMove", touchPoints=[to])
        page.evaluate("new Promise(requestAnimationFrame)")
    page.end_touch()


@pytest.mark.parametrize("control", ["speed", "override"])
@pytest.mark.parametrize("share", [0.1, 0.9])
def test_a_finger_that_scrolls_the_page_sets_no_slider(
    page: Page, robot: FakeRobot, control: str, share: float
) -> None:
    page.resize(390, 844, phone=True)
    before = value(page, control)
    page.evaluate(
        f"(() => {{ const it = document.querySelector('#{control}'); window.values = new Set();"
        " for (const kind of ['input', 'change']) it.addEventListener(kind, () => values.add(it.value)); })()"
    )
    swipe(page, control, share, 0.0, 150.0)
    settle(page)
    assert set(page.evaluate("[...values]")) <= {before}
    assert value(page, control) == before
    assert robot.share == 1.0
    assert "override" not in robot.commands


@pytest.mark.parametrize("control", ["speed", "override"])
@pytest.mark.parametrize("how", ["along", "tap"])
def test_a_finger_that_moves_along_a_slider_or_taps_it_sets_it(
    page: Page, robot: FakeRobot, control: str, how: str
) -> None:
    page.resize(390, 844, phone=True)
    before = value(page, control)
    if how == "along":
        swipe(page, control, 0.5, -100.0, 0.0)
    else:
        page.evaluate(f"document.querySelector('#{control}').scrollIntoView({{block: 'center'}})")
        settle(page)
        left, top, width, height = page.evaluate(BOX % f"#{control}")
        at = {"x": left + 0.2 * width, "y": top + height / 2}
        page._call("Input.dispatchTouchEvent", type="touchStart", touchPoints=[at])
        page.end_touch()
    page.until(f"document.querySelector('#{control}').value !== '{before}'")
    assert float(value(page, control)) < float(before)
    if control == "override":
        wait_until(lambda: robot.share == float(value(page, "override")) / 100.0, "it is sent")


# ---------------------------------------------------------------------- STOP


def open_list(page: Page, list_: str) -> None:
    page.click(f"#{list_}")
    page.until(f"document.querySelector('#{list_}').matches(':open')")


@pytest.mark.parametrize("size", SIZES)
def test_no_open_list_covers_stop(page: Page, size: str) -> None:
    width, height, phone = SIZES[size]
    page.resize(width, height, phone=phone)
    for list_ in ("tool", "along", "frame", "language"):
        # Where the whole page does not fit, a list that is scrolled to the start is behind header and STOP.
        for block in ("center", "end") if size == "low desk" else ("start", "center", "end"):
            page.evaluate(f"document.querySelector('#{list_}').scrollIntoView({{block: '{block}'}})")
            page.evaluate(f"document.querySelector('#{list_}').focus({{preventScroll: true}})")
            page.type_key("Enter")
            page.until(f"document.querySelector('#{list_}').matches(':open')")
            covered = page.evaluate(
                "(() => { const {left, right, top, bottom} = document.querySelector('#stop').getBoundingClientRect();"
                " const over = [];"
                " for (let x = left + 5; x < right; x += 10)"
                "   for (let y = top + 5; y < Math.min(bottom, innerHeight); y += 10) {"
                "     const it = document.elementFromPoint(x, y); if (it?.closest('select')) over.push([x, y]); }"
                " return over.length; })()"
            )
            assert covered == 0, (list_, block)
            _, top, _, tall = page.evaluate(BOX % f"#{list_} option")
            assert 0.0 <= top < top + tall <= height, "its entries are seen"
            page.key_down("Tab")
            page.key_up("Tab")
            page.until(f"!document.querySelector('#{list_}').matches(':open')")


@pytest.mark.parametrize("by", ["mouse", "touch"])
def test_a_press_on_stop_stops_whatever_lies_above_it_and_chooses_nothing(
    page: Page, robot: FakeRobot, by: str
) -> None:
    left, top, width, height = page.evaluate(BOX % "#stop")
    page.evaluate(  # no rule of the page's own may be relied upon for this
        "document.adoptedStyleSheets = [(() => { const rules = new CSSStyleSheet(); rules.replaceSync("
        f"'::picker(select) {{ position-area: none; inset: {top}px auto auto {left}px; width: {width}px;"
        f" height: {height}px; max-height: none; margin: 0; }}'); return rules; }})()]"
    )
    if by == "touch":
        page._call("Emulation.setTouchEmulationEnabled", enabled=True)
    before = value(page, "frame")
    robot.mode, robot._alive_until = "moving", float("inf")
    open_list(page, "frame")
    at = {"x": left + width / 2, "y": top + height / 2}
    page.until(f"document.elementFromPoint({at['x']}, {at['y']}).closest('select')")
    if by == "mouse":
        page._mouse("mousePressed", at)
        page._mouse("mouseReleased", at)
    else:
        page._call("Input.dispatchTouchEvent", type="touchStart", touchPoints=[at])
        page.end_touch()
    wait_until(lambda: "stop" in robot.commands, "a stop")
    settle(page)
    assert robot.commands == ["stop"]
    assert value(page, "frame") == before


@pytest.mark.parametrize("first", ["middle", "right"])
@pytest.mark.parametrize("where", ["h1", "#mechanism"])
def test_stop_is_pressed_by_a_mouse_of_which_another_button_is_held(
    page: Page, robot: FakeRobot, first: str, where: str
) -> None:
    buttons = {"middle": 4, "right": 2}[first]
    begin, stop = page.middle(where), page.middle("#stop")

    def mouse(kind: str, at: dict[str, float], button: str, held: int) -> None:
        page._call("Input.dispatchMouseEvent", type=kind, button=button, buttons=held, clickCount=1, **at)

    mouse("mousePressed", begin, first, buttons)
    mouse("mouseMoved", stop, first, buttons)
    assert "stop" not in robot.commands
    mouse("mousePressed", stop, "left", buttons | 1)
    wait_until(lambda: "stop" in robot.commands, "a stop")
    mouse("mouseReleased", stop, "left", buttons)
    mouse("mouseReleased", stop, first, 0)
    settle(page)
    assert robot.commands == ["stop"]


@pytest.mark.parametrize(
    ("name", "code", "text"),
    [
        ("Process", "Space", ""),
        ("\u00a0", "Space", "\u00a0"),
        ("\u3000", "Space", "\u3000"),
        ("Process", "Escape", ""),
        (" ", "", " "),
    ],
)
@pytest.mark.parametrize("focus", ["", "pose-name"])
def test_space_and_escape_stop_whatever_layout_or_input_method_names_them(
    page: Page, robot: FakeRobot, name: str, code: str, text: str, focus: str
) -> None:
    if focus:
        page.evaluate(f"document.querySelector('#{focus}').focus()")
    key(page, "keyDown", name, code, text=text)
    key(page, "keyUp", name, code)
    wait_until(lambda: "stop" in robot.commands, "a stop")
    settle(page)
    assert robot.commands == ["stop"]
    assert value(page, "pose-name") == ""


def test_space_of_a_keyboard_on_the_screen_stops(page: Page, robot: FakeRobot) -> None:
    """It tells no key, but only the text."""
    page.evaluate("document.querySelector('#pose-name').focus()")
    page._call("Input.insertText", text="a")
    page._call("Input.insertText", text=" ")
    wait_until(lambda: "stop" in robot.commands, "a stop")
    page._call("Input.insertText", text="b c")
    settle(page)
    assert (value(page, "pose-name"), robot.commands) == ("ab c", ["stop"])


@pytest.mark.parametrize("where", [60, 300, 560, 650])
@pytest.mark.parametrize("size", ["phone", "desk"])
def test_stop_stays_in_sight_and_stops_where_the_page_is_magnified(
    page: Page, robot: FakeRobot, where: int, size: str
) -> None:
    width, height, _ = SIZES[size]
    page.resize(width, height, phone=True)
    for spread in (*range(20, 120, 8), 120):
        points = [{"x": 195 - spread, "y": where, "id": 0}, {"x": 195 + spread, "y": where, "id": 1}]
        page._call("Input.dispatchTouchEvent", type="touchStart" if spread == 20 else "touchMove", touchPoints=points)
        page.evaluate("new Promise(requestAnimationFrame)")
    page.end_touch()
    settle(page)
    page._call("Emulation.setPageScaleFactor", pageScaleFactor=3)
    page.until("visualViewport.scale > 2.9")
    settle(page)
    left, top, w, h = page.evaluate(BOX % "#stop")
    scale, x, y, seen_w, seen_h = page.evaluate(
        "(({scale, offsetLeft: x, offsetTop: y, width, height}) => [scale, x, y, width, height])(visualViewport)"
    )
    assert x - 0.5 <= left < left + w <= x + seen_w + 0.5
    assert y - 0.5 <= top < top + h <= y + seen_h + 0.5
    assert h * scale == pytest.approx(148.0 if size == "phone" else 172.0, abs=1.0)
    page.evaluate("scrollTo(0, 200)")
    page._call("Emulation.setPageScaleFactor", pageScaleFactor=1)
    page.until("visualViewport.scale === 1")
    settle(page)
    page.touch("#stop")
    wait_until(lambda: "stop" in robot.commands, "a stop")
    page.end_touch()


@pytest.mark.parametrize("size", SIZES)
def test_stop_stays_in_sight_wherever_the_page_is_scrolled(page: Page, robot: FakeRobot, size: str) -> None:
    width, height, phone = SIZES[size]
    page.resize(width, height, phone=phone)
    for place in ("0", "document.documentElement.scrollHeight / 2", "document.documentElement.scrollHeight"):
        page.evaluate(f"scrollTo(0, {place})")
        settle(page)
        left, top, w, h = page.evaluate(BOX % "#stop")
        assert 0.0 <= left < left + w <= width
        assert 0.0 <= top < top + h <= height
        page.evaluate("document.querySelector('#stop').scrollIntoView = () => null")  # it is in view
        page.click("#stop")
        wait_until(lambda: robot.commands == ["stop"], "a stop")
        robot.commands.clear()


# ---------------------------------------------------------------------- a screen reader


def test_a_press_without_a_pointer_makes_a_step_and_holds_nothing(page: Page, robot: FakeRobot) -> None:
    button = "[data-axis=x][data-sign='1']"
    page.evaluate(f'document.querySelector("{button}").click()')
    settle(page)
    assert not robot.sent
    page.click("[data-step='2']")
    before = robot.pose
    page.evaluate(f'document.querySelector("{button}").click()')
    wait_until(lambda: robot.pose != before, "it steps")
    settle(page)
    assert robot.pose == pytest.approx((before[0] + 1e-4, *before[1:]), abs=1e-12)
    page.evaluate(f'document.querySelector("{button}").focus()')
    page.type_key("Enter")
    wait_until(lambda: len(robot.moved_to) == 2, "it steps by a key")
    settle(page)
    assert len(robot.moved_to) == 2
    assert not robot.sent
