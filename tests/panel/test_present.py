"""What the page says is so now, what cannot work is disabled and says why, and nothing is lost without a question."""

from __future__ import annotations

import itertools
import time

import msgspec
import pytest
from chromium import Page, needs_chromium
from generated import thinned
from panel.conftest import SHOWN
from panel.fake_robot import FakeRobot
from panel.test_gamepad import settle
from panel.test_page import moves, small, stands, typed
from trirail.errors import RefusalCode, RefusedError
from trirail.panel import feed
from trirail.panel.server import Panel
from trirail.wire.state import DigitalLine, GoalState, Pose
from trirail.wire.vocabulary import Command, Mode, Role
from waiting import wait_until

pytestmark = [pytest.mark.viewer, needs_chromium]

ANSWER = "document.querySelector('#answer').textContent"
RIGHT = "[data-axis=x][data-sign='1']"
EVERYBODYS = {each for each in Command if each.ignores_lease}


def bars(page: Page) -> dict[str, str]:
    """Return the reason of each control that is disabled."""
    found: dict[str, str] = page.evaluate(
        "Object.fromEntries([...document.querySelectorAll('button:disabled, input:disabled')]"
        ".map((each) => [each.id || each.dataset.command || Object.values(each.dataset).join(' '), each.title]))"
    )
    return found


# ---------------------------------------------------------------------- every line states the present


@pytest.mark.parametrize(
    ("outcome", "words"), [("done", "arrived"), ("stopped", "stopped"), ("preempted", "replaced by another goal")]
)
def test_a_goal_is_on_its_way_while_it_is_and_then_has_ended(
    enabled: Page, robot: FakeRobot, outcome: str, words: str
) -> None:
    robot.lasting = True
    typed(enabled, "1", "2", "3")
    enabled.click("#go")
    enabled.until(f"{ANSWER} === 'go there: on its way'")
    robot.share = 0.0
    enabled.until(f"{ANSWER} === 'go there: waits'")
    robot.share = 1.0
    enabled.until(f"{ANSWER} === 'go there: on its way'")
    robot.arrive(outcome)
    enabled.until(f"{ANSWER} === 'go there: {words}'")
    robot.fault("drive B")
    enabled.until(f"{ANSWER} === ''")


def test_what_is_done_is_said_until_it_is_so_no_longer(enabled: Page, robot: FakeRobot) -> None:
    enabled.click("[data-command=acquire]")
    enabled.until(f"{ANSWER} === 'Take lease: done'")
    robot.refusal = RefusedError(RefusalCode.LEASE_OVER, "taken over by bob")
    robot.holder = "bob"
    enabled.until(f"{ANSWER} === '' && document.querySelector('#lease').textContent.startsWith('bob')")
    enabled.until("document.querySelector('header').contains(document.querySelector('#lease'))")


def test_a_line_goes_by_itself_after_a_while(enabled: Page, robot: FakeRobot) -> None:
    robot.refusal = RefusedError(RefusalCode.MOVING, "no")
    enabled.click("[data-command=disable]")
    enabled.until(f"{ANSWER} === 'Disable: no'")
    enabled.evaluate("(() => { const now = performance.now(); performance.now = () => now + 60_000; })()")
    enabled.until(f"{ANSWER} === ''")


def test_no_line_outlives_the_contact(enabled: Page, robot: FakeRobot) -> None:
    with robot.hanging("pause"):
        robot.mode, robot._alive_until = "moving", float("inf")
        enabled.until("!document.querySelector('[data-command=pause]').disabled")
        enabled.click("[data-command=pause]")
        enabled.until(f"{ANSWER} === 'Pause …'")
        robot.silent.set()
        enabled.until(f"document.body.dataset.contact === 'none' && {ANSWER} === ''")
    robot.silent.clear()


@pytest.mark.parametrize(("language", "words"), [("en", "STOP may have no effect"), ("de", "STOP wirkt vielleicht")])
def test_without_the_service_s_states_a_stop_is_sent_and_the_page_does_not_deny_it(
    enabled: Page, robot: FakeRobot, language: str, words: str
) -> None:
    enabled.show_language(language)
    robot.silent.set()
    enabled.until(f"document.querySelector('header').textContent.includes({words!r})")
    enabled.click("#stop")
    wait_until(lambda: "stop" in robot.commands, "a stop")
    enabled.evaluate("localStorage.clear()")


def test_a_way_is_checked_again_when_the_robot_stands_elsewhere(enabled: Page, robot: FakeRobot) -> None:
    typed(enabled, "100", "0", "0")
    enabled.until("document.querySelector('#going').dataset.may === 'yes'")
    robot.pose = (0.151, 0.212, -0.654)
    enabled.until("document.querySelector('#going').dataset.may === 'no'")
    assert "on the way" in enabled.text("#going-says")


def test_no_override_is_shown_without_contact(enabled: Page, robot: FakeRobot) -> None:
    shown = "document.querySelector('#override-says').textContent"
    robot.share = 0.4
    enabled.until_equal(shown, "40 %")
    robot.silent.set()
    enabled.until("document.body.dataset.contact === 'none'")
    assert enabled.evaluate(shown) == "– %"
    robot.silent.clear()
    enabled.until_equal(shown, "40 %")


def test_nothing_is_said_to_be_within_limits_without_contact(enabled: Page, robot: FakeRobot) -> None:
    said = "[document.querySelector('#going').dataset.may, document.querySelector('#going-says').innerText]"
    wanted = "document.querySelector('.wanted').parentElement.getAttribute('class')"
    typed(enabled, "10", "0", "0")
    enabled.until_equal(said, ["yes", "within limits"])
    enabled.until_equal(wanted, "free")
    robot.silent.set()
    enabled.until("document.body.dataset.contact === 'none'")
    assert enabled.evaluate(said) == ["", "No contact with the robot."]
    assert enabled.evaluate(wanted) == ""
    robot.silent.clear()
    enabled.until_equal(said, ["yes", "within limits"])
    enabled.until_equal(wanted, "free")


@pytest.mark.parametrize("view", ["mechanism", "charts", "sessions"])
def test_warnings_are_seen_in_every_view_while_they_are_in_force(page: Page, robot: FakeRobot, view: str) -> None:
    full, certificate = "nothing is recorded: the disk is full", "the certificate of ann expires in 3 days"
    page.click(f"[data-view={view}]")
    robot.warnings = (full, certificate)
    page.until(f"document.body.innerText.includes({full!r}) && document.body.innerText.includes({certificate!r})")
    page.until(f"document.querySelector('header').innerText.includes({full!r})")
    robot.warnings = (certificate,)
    page.until(f"!document.body.innerText.includes({full!r})")
    assert certificate in page.text("header")
    robot.silent.set()
    page.until(f"!document.body.innerText.includes({certificate!r})")


@pytest.mark.parametrize("language", ["en", "de"])
@pytest.mark.parametrize(
    "later", [{"limits": {"reach": 1.0}}, {"takeover": "owner"}, {"output_lines": {"valve": DigitalLine("D", 0)}}]
)
def test_nothing_moves_and_the_cure_is_told_while_a_later_service_is_not_understood(
    enabled: Page, robot: FakeRobot, language: str, later: dict[str, object], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(feed, "USERS_PERIOD_S", 0.05)
    enabled.show_language(language)
    robot.silent.set()
    enabled.until("document.body.dataset.contact === 'none'")
    before, robot.told = robot.told, msgspec.structs.replace(robot.told, **later)
    robot.silent.clear()
    enabled.until("document.querySelector('#alarm').innerText.includes('trirail panel')")
    enabled.until("document.querySelector('.hold').disabled")
    assert {"en": "restart trirail panel", "de": "trirail panel neu starten"}[language] in enabled.text("#alarm")
    assert (enabled.evaluate("document.body.dataset.contact"), "mm" in enabled.text("#pose")) == ("none", False)
    enabled.click("#stop")
    wait_until(lambda: robot.commands[-1] == "stop", "a stop")
    robot.told = before  # by an older service, or only a late answer
    enabled.until(SHOWN)
    enabled.evaluate("localStorage.clear()")


@pytest.mark.parametrize("language", ["en", "de"])
def test_a_pose_of_another_geometry_is_marked_and_asks_first(enabled: Page, robot: FakeRobot, language: str) -> None:
    enabled.show_language(language)
    robot.foreign, old = {"old", "older"}, "[data-pose=old]"
    for name in ("new", "old", "older"):
        robot.teach(name)
    enabled.until_equal(
        "[...document.querySelectorAll('#poses button')].map((each) => each.innerText)",
        ["park", "new", "⚠ old", "⚠ older"],
    )
    words = {"en": "another geometry", "de": "anderen Geometrie"}[language]
    enabled.until(f"document.querySelector('{old}').title.includes({words!r})")
    for other in ("[data-pose=older]", "[data-pose=new]"):  # the answer is the second press on the same pose
        enabled.click(old)
        enabled.until(f"{ANSWER}.includes('old') && document.querySelector('{old}').classList.contains('asked')")
        enabled.click(other)
        enabled.until(f"!document.querySelector('{old}').classList.contains('asked')")
    wait_until(lambda: robot.gone_to == ["new"], "the pose that asks nothing")
    enabled.click(old)
    enabled.evaluate("(() => { const now = performance.now(); performance.now = () => now + 1000; })()")
    enabled.click(old)
    wait_until(lambda: robot.gone_to == ["new", "old"], "the pose that asks")
    enabled.evaluate("localStorage.clear()")


@pytest.mark.parametrize("state_hz", [1, 2])
def test_contact_stays_and_the_robot_goes_where_states_are_rare(
    browser: Page, robot: FakeRobot, state_hz: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(feed, "MAX_STATE_AGE_S", 0.5)
    robot.mode, robot.told = "holding", msgspec.structs.replace(robot.told, state_hz=state_hz)
    page = browser.another()
    with Panel(robot.robot()) as panel:
        page.open(panel.url)
        page.until(SHOWN)
        page.evaluate("window.lost = 0")
        observed = "window.lost += document.body.dataset.contact === 'none'"
        page.evaluate(f"new MutationObserver(() => {{ {observed}; }}).observe(document.body, {{ attributes: true }})")
        pressed: list[str] = []
        for _ in range(3):
            time.sleep(0.8)
            page.click("[data-pose=park]")
            pressed.append("park")
            wait_until(lambda: robot.gone_to == pressed, "it goes")
        assert page.evaluate("window.lost") == 0
        page.close()


def test_a_key_that_is_held_presses_once(page: Page) -> None:
    """Otherwise Enter would also answer the question whether a pose is to be replaced or forgotten."""
    press = "new KeyboardEvent('keydown', {{key: 'Enter', repeat: {}, bubbles: true, cancelable: true}})"
    send = f"((event) => (document.querySelector('#forget').dispatchEvent(event), event))({press})"
    for repeat in ("false", "true"):
        assert page.evaluate(f"{send.format(repeat)}.defaultPrevented") == (repeat == "true")


@pytest.mark.parametrize("language", ["en", "de"])
@pytest.mark.parametrize("homed", [(True, True, False), (False, True, True), (False, False, False)])
def test_a_position_that_is_not_homed_is_not_shown_as_measured(
    page: Page, robot: FakeRobot, homed: tuple[bool, bool, bool], language: str
) -> None:
    page.show_language(language)
    drawn = "document.querySelector('.platform').getBoundingClientRect().width > 0"
    cells = "[...document.querySelectorAll('#{} tr')].map((row) => row.cells[1].innerText)"
    page.until(f"{drawn} && {cells.format('sliders')}[0].includes('mm')")
    robot.homed, words = homed, {"en": "not homed", "de": "nicht referenziert"}[language]
    page.until(f"!({drawn})")
    assert page.evaluate(cells.format("pose")) == [words] * 3
    for known, cell in zip(homed, page.evaluate(cells.format("sliders")), strict=True):
        assert (cell == words, "mm" in cell) == (not known, known)
    assert page.evaluate("document.querySelector('#here').disabled")
    robot.homed = (True, True, True)
    page.until(f"{drawn} && !document.querySelector('#numbers').innerText.includes({words!r})")
    page.evaluate("localStorage.clear()")


@pytest.mark.parametrize("language", ["en", "de"])
def test_what_is_pressed_on_a_page_that_is_late_is_refused_in_words(
    enabled: Page, robot: FakeRobot, language: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot.lasting = True
    typed(enabled, "1", "2", "3")
    enabled.click("#go")
    wait_until(lambda: robot.mode == "moving", "it goes")
    robot.mode = "holding"  # paused
    enabled.until("!document.querySelector('[data-command=resume]').disabled")
    enabled.show_language(language)
    monkeypatch.setattr(feed.Feed, "is_fresh", lambda *_: False)
    before, why = robot.pose, {"en": "the page showed no state", "de": "die Anzeige war nicht aktuell"}[language]
    enabled.click("[data-step='1']")
    enabled.write("#pose-name", "here")
    enabled.until("!document.querySelector('#teach').disabled")
    for selector in (RIGHT, "#go", "[data-pose=park]", "[data-command=resume]", "[data-command=acquire]", "#teach"):
        enabled.evaluate("document.querySelector('#answer').textContent = ''")
        enabled.click(selector)
        enabled.until(f"{ANSWER}.includes({why!r})")
    enabled.click("#stop")
    wait_until(lambda: "stop" in robot.commands, "a stop")
    assert (robot.pose, robot.gone_to, robot.commands) == (before, [], ["enable", "stop"])
    assert "here" not in robot.named
    enabled.evaluate("localStorage.clear()")


# ---------------------------------------------------------------------- what cannot work


def test_under_a_lease_of_another_what_is_not_everybodys_is_disabled(enabled: Page, robot: FakeRobot) -> None:
    robot.holder = "bob"
    enabled.until("document.querySelector('.hold').disabled")
    found = bars(enabled)
    for name in ("go", "override", "park", "follow", "x 1", "phi -1"):
        assert "bob holds the lease" in found[name], name
    for command in enabled.evaluate("[...document.querySelectorAll('[data-command]')].map((e) => e.dataset.command)"):
        if command in set(Command) - EVERYBODYS:
            assert "bob" in found[command], command
    assert {"disable", "quick_stop", "takeover"}.isdisjoint(found)
    robot.holder = None
    enabled.until("!document.querySelector('.hold').disabled")


@pytest.mark.parametrize("by", thinned(["mouse", "finger", "key"], every=3))
def test_a_disabled_control_says_why_where_it_is_pressed(enabled: Page, robot: FakeRobot, by: str) -> None:
    robot.holder = "bob"
    enabled.until("document.querySelector('.hold').disabled")
    if by == "key":
        enabled.type_key("ArrowRight")
    elif by == "mouse":
        enabled.click(RIGHT)
    else:
        enabled.resize(390, 844, phone=True)
        enabled.touch(RIGHT)
        enabled.end_touch()
    enabled.until(f"{ANSWER} === 'bob holds the lease: wait, or take it over.'")
    assert not robot.sent
    box = enabled.evaluate(
        "(({top, bottom}) => [top, bottom])(document.querySelector('#answer').getBoundingClientRect())"
    )
    stop = enabled.evaluate("document.querySelector('#stop').getBoundingClientRect().top")
    assert 0.0 <= box[0] < box[1] <= stop
    robot.holder = None
    enabled.until(f"{ANSWER} === ''")


@pytest.mark.parametrize("policy", ["optional", "required"])
def test_every_disabled_control_has_its_reason_in_every_state(enabled: Page, robot: FakeRobot, policy: str) -> None:
    robot.told = msgspec.structs.replace(robot.told, lease=policy)
    robot.silent.set()
    enabled.until("document.body.dataset.contact === 'none'")
    robot.silent.clear()
    enabled.until(SHOWN)
    goals = (None, GoalState("g", 0.5, 1.0, target=Pose(0.0, 0.0, 0.0)))
    marker = itertools.count(10)
    for mode, holder, goal in itertools.product(Mode, (None, "ann", "bob"), goals):
        with robot._lock:
            robot.mode, robot.holder, robot.goal, robot._alive_until = mode, holder, goal, float("inf")
            robot.share = (number := next(marker)) / 100.0
        enabled.until(f"document.querySelector('#override-says').textContent === '{number} %'")
        for name, why in bars(enabled).items():
            assert len(why) > 10, (name, mode, holder)
        may = mode in (Mode.HOLDING, Mode.MOVING) or (mode is Mode.STOPPING and goal is not None)
        may = may and (holder == "ann" or (holder is None and policy == "optional"))
        assert enabled.evaluate("!document.querySelector('.hold').disabled") == may, (mode, holder, goal)


def change(page: Page, robot: FakeRobot, what: str, there: bool) -> None:
    """Take from the page what a control needs, or give it back."""
    if what == "lease":
        robot.holder = None if there else "bob"
        return
    robot.silent.set()
    page.until("document.body.dataset.contact === 'none'")
    if what == "contact" and not there:
        return
    if what == "tools":
        tools = {"tip": (0.02, 0.03)} if there else {}
        robot.told = msgspec.structs.replace(robot.told, frames={"tool": tools, "work": {}})
    elif what != "contact":
        robot.granted = Role.MAINTAINER if there else Role(what)
    robot.silent.clear()
    page.until(SHOWN)


@pytest.mark.parametrize(
    ("control", "what"),
    [
        *(("override", what) for what in ("lease", "contact", "viewer")),
        *(("pose-name", what) for what in ("operator", "viewer")),
        ("tool", "tools"),
    ],
)
def test_keys_of_a_control_that_cannot_work_move_nothing_until_it_has_them_again(
    enabled: Page, robot: FakeRobot, control: str, what: str
) -> None:
    change(enabled, robot, what, True)
    enabled.until("!document.querySelector('.hold').disabled")
    enabled.evaluate(f"document.querySelector('#{control}').focus()")
    enabled.until_equal("document.activeElement.id", control)
    for there in (False, True):
        change(enabled, robot, what, there)
        enabled.until_equal("document.activeElement.id", control if there else "")
        for key in ("ArrowRight", "a"):
            enabled.key_down(key)
            settle(enabled)
            enabled.key_up(key)
        assert not robot.sent


@pytest.mark.parametrize("by", ["pointer", "focus"])
def test_keys_jog_again_when_the_operator_has_chosen_something_else(enabled: Page, robot: FakeRobot, by: str) -> None:
    enabled.evaluate("document.querySelector('#pose-name').focus()")
    change(enabled, robot, "operator", False)
    enabled.until("document.activeElement === document.body && !document.querySelector('.hold').disabled")
    if by == "pointer":
        enabled.click("h1")
    else:
        enabled.evaluate("document.querySelector('[data-view=charts]').focus()")
    enabled.key_down("ArrowRight")
    wait_until(lambda: bool(robot.sent), "it jogs")
    enabled.key_up("ArrowRight")
    stands(robot)
    change(enabled, robot, "operator", True)
    enabled.until("document.querySelector('#pose-name').checkVisibility()")
    assert enabled.evaluate("document.activeElement.id") == ""


# ---------------------------------------------------------------------- a hand that leaves


@pytest.mark.usefixtures("slow_hand")
def test_a_mouse_that_is_dragged_off_a_held_button_stops(enabled: Page, robot: FakeRobot) -> None:
    enabled.press(RIGHT)
    moves(robot)
    at = enabled.middle(RIGHT)
    enabled._mouse("mouseMoved", at | {"x": at["x"] + 5.0})
    assert robot.goal is not None
    enabled._mouse("mouseMoved", at | {"y": at["y"] + 100.0})
    stands(robot)
    asked = len(robot.sent)
    enabled._mouse("mouseMoved", at)  # back again: it has been let go
    enabled.evaluate("new Promise((done) => setTimeout(done, 300))")
    assert len(robot.sent) == asked
    enabled.let_go()


@pytest.mark.usefixtures("slow_hand")
def test_a_finger_that_leaves_a_held_button_stops(enabled: Page, robot: FakeRobot) -> None:
    enabled.resize(390, 844, phone=True)
    enabled.touch(RIGHT)
    moves(robot)
    at = enabled.middle(RIGHT)
    enabled._call("Input.dispatchTouchEvent", type="touchMove", touchPoints=[at | {"x": at["x"] - 150.0}])
    stands(robot)
    enabled.end_touch()


# ---------------------------------------------------------------------- speed, events


@pytest.mark.parametrize("speed", [0, 3, 6])
def test_the_speed_governs_goals_as_it_does_jogs(enabled: Page, robot: FakeRobot, speed: int) -> None:
    enabled.evaluate(f"document.querySelector('#speed').value = {speed}")
    typed(enabled, "1", "2", "3")
    enabled.click("#go")
    wait_until(lambda: len(robot.speeds) == 1, "it goes")
    enabled.click("[data-pose=park]")
    wait_until(lambda: len(robot.speeds) == 2, "to a pose")
    enabled.click("[data-step='1']")
    enabled.until("!document.querySelector('.hold').disabled")
    enabled.click(RIGHT)
    wait_until(lambda: len(robot.speeds) == 3, "by a step")
    assert robot.speeds == [(0.01, 0.1, 1.0)[speed // 3]] * 3


@pytest.mark.usefixtures("slow_hand")
def test_a_jog_is_one_line_of_events(enabled: Page, robot: FakeRobot) -> None:
    lines = "document.querySelector('#events').childElementCount"
    for jogs in (1, 2):
        before = enabled.evaluate(lines)
        enabled.press(RIGHT)
        moves(robot)
        enabled.until(f"{lines} === {before} + 1")
        enabled.let_go(RIGHT)
        stands(robot)
        enabled.until("document.querySelector('#events li').textContent.includes('done')")
        robot.say(f"after jog {jogs}")
        enabled.until(f"document.querySelector('#events li').textContent.includes('after jog {jogs}')")
        enabled.until_equal(lines, before + 2)


# ---------------------------------------------------------------------- what would be lost


@pytest.mark.parametrize("what", ["teach", "forget"])
def test_what_would_lose_a_pose_asks_first(enabled: Page, robot: FakeRobot, what: str) -> None:
    robot.named["pick"] = old = (0.0, 0.0, 0.0)
    robot.say("pose pick taught by bob", kind="pose")
    enabled.until("document.querySelector('[data-pose=pick]')")
    enabled.write("#pose-name", "pick")
    button = f"document.querySelector('#{what}')"
    enabled.until(f"!{button}.disabled")
    usual = enabled.text(f"#{what}")
    for _ in range(2):  # a double click is one press
        enabled.click(f"#{what}")
    enabled.until(f"{button}.innerText === 'Sure?' && {ANSWER}.includes('pick')")
    enabled.write("#pose-name", "pic")  # another name is another question
    enabled.until(f"{button}.innerText === {usual!r} && {ANSWER} === ''")
    enabled.write("#pose-name", "pick")
    enabled.click(f"#{what}")
    enabled.until(f"{button}.innerText === 'Sure?'")
    assert robot.named["pick"] == old
    time.sleep(0.6)
    enabled.click(f"#{what}")
    wait_until(lambda: robot.named.get("pick") != old, "it is answered")
    assert robot.named.get("pick") == (robot.pose if what == "teach" else None)


def test_a_question_lasts_ten_seconds(browser: Page, robot: FakeRobot) -> None:
    robot.named["pick"] = (0.0, 0.0, 0.0)
    with Panel(robot.robot(), 0) as panel:
        panel._files["naming.js"] = panel._files["naming.js"].replace(b"ASKED = 10_000;", b"ASKED = 100;")
        page = browser.another()
        page.open(panel.url)
        page.until(SHOWN)
        page.write("#pose-name", "pick")
        page.click("#forget")
        page.until("document.querySelector('#forget').innerText === 'Forget'")
        assert "pick" in robot.named
        page.close()


def test_a_pose_keeps_its_place_while_others_come_and_go(page: Page, robot: FakeRobot) -> None:
    def place(name: str) -> list[float]:
        box: list[float] = page.evaluate(
            f"(({{x, y}}) => [x, y])(document.querySelector('[data-pose={name}]').getBoundingClientRect())"
        )
        return box

    for name in ("b", "d"):
        robot.named[name] = (0.0, 0.0, 0.0)
    robot.say("poses", kind="pose")
    page.until("document.querySelector('[data-pose=d]')")
    before = place("d")
    del robot.named["park"]
    robot.say("pose", kind="pose")
    page.until("!document.querySelector('[data-pose=park]')")
    assert place("d") == before
    robot.named = {"a": (0.0, 0.0, 0.0)} | robot.named
    robot.say("pose", kind="pose")
    page.until("document.querySelector('[data-pose=a]')")
    assert place("d") == before


# ---------------------------------------------------------------------- a stage, and German


def test_a_stage_is_shown_in_micrometres_and_gone_to_in_them(browser: Page, robot: FakeRobot) -> None:
    robot.told = small(robot.told)
    robot.mode, robot.pose = "holding", (1.2345e-3, 0.0, 0.0)
    with Panel(robot.robot(), 0) as panel:
        page = browser.another()
        page.open(panel.url)
        page.until(f"{SHOWN} && document.querySelector('#pose').textContent.includes('1234.5 µm')")
        page.until_equal("document.querySelector('#to-x').placeholder", "µm")
        assert "µm/s" in page.text("#sliders")
        assert "µm/s" in page.text("#speed-says")
        page.click("#here")
        page.until_equal("document.querySelector('#to-x').value", "1234.5")
        typed(page, "250", "0.5 mm", "0")
        page.click("#go")
        wait_until(lambda: bool(robot.moved_to), "it goes")
        assert robot.moved_to[0][0] == pytest.approx((250e-6, 0.5e-3, 0.0))
        assert page.text("[data-step='1']").split() == ["1", "µm", "0.0001°"]
        page.close()


def test_step_buttons_show_their_units(page: Page) -> None:
    shown = [page.text(f"[data-step='{step}']").split("\n") for step in range(1, 5)]
    assert [[part.replace("\u00a0", " ") for part in parts] for parts in shown] == [
        ["10 µm", "0.01°"],
        ["0.1 mm", "0.1°"],
        ["1 mm", "1°"],
        ["10 mm", "1°"],
    ]


def test_german_has_decimal_commas_and_words_for_what_the_service_says(page: Page, robot: FakeRobot) -> None:
    page.show_language("de")
    page.until("document.documentElement.lang === 'de'")
    robot.pose = (0.0321, -0.0123, -0.2)
    page.until("document.querySelector('#pose').innerText.includes('32,10 mm')")
    assert "−12,30 mm" in page.text("#pose")
    assert "." not in page.text("#numbers") + page.text("#speed-says") + page.text("#steps")
    page.click("#here")
    page.until_equal("document.querySelector('#to-y').value", "-12,3")
    typed(page, "-12,3", "0", "0")
    page.until("document.querySelector('#going').dataset.may === 'yes'")
    typed(page, "500", "0", "0")
    page.until("document.querySelector('#going').dataset.may === 'no'")
    assert page.text("#going-says").startswith("Plattform x: ")
    robot.refusal = RefusedError(RefusalCode.NOT_AT_REST, "slider A is moved from outside", slider="A")
    page.click("[data-command=enable]")
    page.until(f"{ANSWER}.startsWith('Ein: ein Schlitten wird von außen bewegt')")
    page.until_equal("document.querySelector('#answer span').title", "slider A is moved from outside")
    robot.refusal = RefusedError(RefusalCode.OUT_OF_WORKSPACE, "no", slider="B", value=0.1525, limit=0.15)
    page.click("[data-command=enable]")
    page.until(f"{ANSWER}.endsWith('außerhalb der Grenzen: Schlitten B 152,50 mm, Grenze 150,00 mm')")
    robot.say("drive B: EMCY 8700", "error", kind="fault", fault={"cause": "emcy", "drive": "B", "code": 0x8700})
    page.until("document.querySelector('#events li').textContent.endsWith('Antrieb B: EMCY 8700h')")
    robot.fault("drive B: EMCY 8700")
    page.until("document.querySelector('#alarm').innerText.includes('Antrieb B: EMCY 8700h')")
    page.evaluate("localStorage.clear()")
