"""What an operator does at the page all day beside jogging: tools and frames, files, the lease, recordings."""

from __future__ import annotations

import errno
import math
import os
import subprocess
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
from chromium import Page, needs_chromium
from hypothesis import given
from hypothesis import strategies as st
from panel.fake_robot import FakeRobot
from panel.test_page import restart, typed
from telemetry.test_sessions import record
from trirail.errors import RefusalCode, RefusedError
from trirail.motion.runs import centre_motion, rest, tool_motion
from trirail.panel.recordings import Recordings
from trirail.panel.server import Panel
from trirail.telemetry import contents
from trirail.wire.sizes import MAX_FILE
from trirail.wire.state import CorrectionInfo
from waiting import wait_until as wait

pytestmark = [pytest.mark.viewer, needs_chromium]

TIP, TABLE = (0.02, 0.03), (0.05, 0.02, 0.3)
FRAMES = {"tool": {"tip": TIP}, "work": {"table": TABLE}}
SHOWN = "document.body.dataset.contact === 'yes'"


@pytest.fixture
def robot(tmp_path: Path) -> FakeRobot:
    robot = FakeRobot()
    robot.mode = "holding"
    robot.told = msgspec.structs.replace(robot.told, frames=FRAMES, recordings=str(tmp_path))
    return robot


@pytest.fixture
def panel(robot: FakeRobot) -> Iterator[Panel]:
    with Panel(robot.robot(), 0) as panel:
        yield panel


@pytest.fixture
def page(browser: Page, panel: Panel) -> Iterator[Page]:
    page = browser.another()
    page.open(panel.url)
    page.until(f"{SHOWN} && !document.querySelector('.hold').disabled")
    yield page
    page.close()


# ---------------------------------------------------------------------- tools and frames


def test_the_page_s_frames_are_the_service_s(page: Page) -> None:
    """Whatever pose, tool and frame, and back again."""
    coordinate = st.floats(-1.0, 1.0)

    @given(st.tuples(*[coordinate] * 3), st.tuples(*[coordinate] * 2), st.tuples(*[coordinate] * 3))
    def same(pose: tuple[float, ...], tool: tuple[float, ...], frame: tuple[float, ...]) -> None:
        found = page.evaluate(
            "(async () => { const {ofTool, ofCentre, inFrame, inBase} = await import('./frames.js');"
            f" const [pose, tool, frame] = {msgspec.json.encode([pose, tool, frame]).decode()};"
            " return [ofTool(pose, tool), ofCentre(pose, tool), inBase(inFrame(pose, frame), frame)]; })()"
        )
        wanted = [tool_motion(rest(pose), tool).pose, centre_motion(rest(pose), tool).pose, pose]
        for one, other in zip(found, wanted, strict=True):
            assert one == pytest.approx(other, abs=1e-12)

    same()


def test_a_pose_is_gone_to_with_the_tool_and_frame_that_are_chosen(page: Page, robot: FakeRobot) -> None:
    page.click("#here")
    before = [page.evaluate(f"document.querySelector('#to-{axis}').value") for axis in ("x", "y", "phi")]
    page.choose("#tool", "tip")
    page.choose("#frame", "table")
    x, y, phi = tool_motion(rest(robot.pose), TIP).pose  # the same place, in other numbers
    c, s = math.cos(-TABLE[2]), math.sin(-TABLE[2])
    wanted = [c * (x - TABLE[0]) - s * (y - TABLE[1]), s * (x - TABLE[0]) + c * (y - TABLE[1]), phi - TABLE[2]]
    shown = [float(page.evaluate(f"document.querySelector('#to-{axis}').value")) for axis in ("x", "y", "phi")]
    assert shown == pytest.approx([wanted[0] * 1e3, wanted[1] * 1e3, math.degrees(wanted[2])], abs=1e-3)
    assert shown != pytest.approx([float(value) for value in before], abs=1e-3)
    page.until("document.querySelector('#going').dataset.may === 'yes'")
    typed(page, "1", "2", "3")
    page.click("#go")
    wait(lambda: bool(robot.moved_to), "it goes")
    pose, tool, frame = robot.moved_to[0]
    assert pose == pytest.approx((1e-3, 2e-3, math.radians(3.0)))
    assert (tool, frame) == ("tip", "table")


def test_what_is_in_the_way_is_that_of_the_tool_s_own_path(page: Page) -> None:
    typed(page, "140", "0", "0")
    page.until("document.querySelector('#going').dataset.may === 'yes'")
    page.choose("#frame", "table")
    typed(page, "140", "0", "0")  # 190 mm from the base's origin
    page.until("document.querySelector('#going').dataset.may === 'no'")


@pytest.mark.usefixtures("slow_hand")
@pytest.mark.parametrize(("along", "angle"), [("base", 0.0), ("platform", 0.1), ("table", TABLE[2])])
def test_a_jog_is_along_the_axes_that_are_chosen(page: Page, robot: FakeRobot, along: str, angle: float) -> None:
    page.choose("#along", along)
    page.press("[data-axis=x][data-sign='1']")
    wait(lambda: any(robot.velocity), "it moves")
    page.let_go()
    x, y, phi = robot.sent[0].x, robot.sent[0].y, robot.sent[0].phi
    assert math.atan2(y, x) == pytest.approx(angle, abs=1e-6)
    assert math.hypot(x, y) == pytest.approx(0.025)
    assert phi == 0.0


@pytest.mark.usefixtures("slow_hand")
def test_no_jog_is_faster_than_the_platform_may_whatever_its_axes(page: Page, robot: FakeRobot) -> None:
    most = msgspec.to_builtins(robot.told.limits)["platform"]["velocity"]
    page.choose("#along", "table")
    page.evaluate("document.querySelector('#speed').value = 6")
    for key in ("ArrowRight", "ArrowUp"):
        page.key_down(key)
    wait(lambda: robot.velocity[1] > robot.velocity[0] != 0.0, "both")
    for key in ("ArrowRight", "ArrowUp"):
        page.key_up(key)
    assert all(abs(goal.x) <= most[0] and abs(goal.y) <= most[1] for goal in robot.sent)
    assert max(abs(goal.y) for goal in robot.sent) == pytest.approx(most[1])


@pytest.mark.usefixtures("slow_hand")
def test_a_held_jog_is_about_the_tool_that_is_chosen_until_it_has_braked(page: Page, robot: FakeRobot) -> None:
    page.choose("#tool", "tip")
    page.press("[data-axis=phi][data-sign='1']")
    wait(lambda: any(robot.velocity), "it moves")
    page.let_go()
    wait(lambda: robot.sent[-1].phi == 0.0, "it is let go")
    assert {goal.tool for goal in robot.sent} == {"tip"}


@pytest.mark.usefixtures("slow_hand")
def test_a_step_is_of_the_tool_along_the_axes_that_are_chosen(page: Page, robot: FakeRobot) -> None:
    page.choose("#along", "platform")
    page.choose("#tool", "tip")
    page.click("[data-step='3']")
    page.click("[data-axis=x][data-sign='1']")
    wait(lambda: bool(robot.moved_to), "it steps")
    assert robot.moved_to[0][1:] == ("tip", "platform")


# ---------------------------------------------------------------------- files


def circle(seconds: float, radius: float = 0.01) -> str:
    rows = [f"{k / 20 * seconds},{radius * math.cos(math.tau * k / 20)},{radius * math.sin(math.tau * k / 20)},0"
            for k in range(21)]  # fmt: skip
    return "t,x,y,phi\n" + "\n".join(rows)


def choose(page: Page, text: str, name: str = "path.csv") -> None:
    page.click("[data-view=following]")
    page.choose_file("#file", name, text)


def may(page: Page, answer: str) -> None:
    page.until(f"document.querySelector('#following').dataset.may === {answer!r}")


def drawn(page: Page) -> tuple[str, int]:
    route = "(({className, points}) => [className.baseVal, points.length])(document.querySelector('.route'))"
    kind, length = page.evaluate(route)
    return kind, length


def test_a_file_is_checked_and_drawn_before_it_is_followed(page: Page, robot: FakeRobot) -> None:
    choose(page, circle(4.0))
    may(page, "yes")
    assert page.text("#file-says") == "path.csv: 4 s, within limits"
    assert drawn(page) == ("route free", 200)
    assert not robot.followed
    assert not robot.moved_to
    page.click("#file-start")
    wait(lambda: bool(robot.moved_to), "it goes to the start")
    assert robot.moved_to[0][0] == pytest.approx((0.01, 0.0, 0.0))
    page.click("#follow")
    wait(lambda: bool(robot.followed), "it follows")
    assert len(robot.followed[0]) == 21
    page.until("document.querySelector('#file-progress').style.visibility === ''")
    page.until_equal("document.querySelector('#file-progress').value", 0.25)
    assert page.text("#file-says") == "path.csv: 25 %, 3.0 s left"
    page.click("#stop")
    page.until("document.querySelector('#file-progress').style.visibility === 'hidden'")
    assert page.text("#file-says") == "path.csv: 4 s, within limits"


def test_checks_without_the_map_of_as_built_errors_are_said_to_be_approximate(page: Page, robot: FakeRobot) -> None:
    """The page's server has no map. Backlash alone it knows exactly."""
    note = " (approximate: checked without the map of as-built errors)"
    for greatest, words in ((0.0, ""), (1e-3, note)):
        correction = CorrectionInfo("as_built.toml", "2026-03-01", (greatest, 0.0, 0.0), (1e-4, 1e-4, 1e-4))
        restart(page, robot, msgspec.structs.replace(robot.told, correction=correction))
        page.until(SHOWN)
        typed(page, "20", "0", "0")
        page.until_equal("document.querySelector('#going-says').textContent", f"within limits{words}")
        choose(page, circle(4.0))
        page.until_equal("document.querySelector('#file-says').textContent", f"path.csv: 4 s, within limits{words}")


def test_neither_progress_nor_check_of_a_file_is_shown_without_contact(page: Page, robot: FakeRobot) -> None:
    said = "document.querySelector('#file-says').innerText"
    bar = "document.querySelector('#file-progress').style.visibility"
    choose(page, circle(4.0))
    may(page, "yes")
    for under_way in (False, True):
        if under_way:
            page.click("#follow")
            page.until_equal(said, "path.csv: 25 %, 3.0 s left")
        robot.silent.set()
        page.until("document.body.dataset.contact === 'none'")
        assert page.evaluate(said) == "path.csv: No contact with the robot."
        assert page.evaluate(bar) == "hidden"
        assert page.evaluate("document.querySelector('#following').dataset.may") == ""
        assert drawn(page) == ("route", 200)
        robot.silent.clear()
        page.until_equal(said, "path.csv: 25 %, 3.0 s left" if under_way else "path.csv: 4 s, within limits")
        page.until_equal(bar, "" if under_way else "hidden")
        page.until("document.querySelector('.route').getAttribute('class') === 'route free'")


def test_a_file_that_is_chosen_while_another_is_followed_has_its_own_words(page: Page, robot: FakeRobot) -> None:
    said = "document.querySelector('#file-says').innerText"
    under_way = "path.csv: 25 %, 3.0 s left"
    choose(page, circle(4.0))
    may(page, "yes")
    page.click("#follow")
    page.until_equal(said, under_way)
    choose(page, circle(5.0), "other.csv")
    page.until_equal(said, f"{under_way}\nother.csv: 5 s, within limits")
    page.choose_file("#file", "large.csv", "0" * (MAX_FILE + 1))
    page.until(f"{said} === '{under_way}\\nlarge.csv is too large: a path has 5000 points at most'")
    choose(page, circle(5.0), "other.csv")
    page.until_equal(said, f"{under_way}\nother.csv: 5 s, within limits")
    page.click("#stop")
    page.until_equal(said, "other.csv: 5 s, within limits")


def test_one_that_is_too_fast_is_refused_or_slowed_where_that_is_wanted(page: Page) -> None:
    choose(page, circle(0.05))
    may(page, "no")
    assert "times too fast" in page.text("#file-says")
    assert drawn(page) == ("route barred", 21)
    page.until("document.querySelector('#follow').disabled")
    page.click("#stretch")
    may(page, "yes")
    assert "times slower than requested" in page.text("#file-says")


def test_a_file_is_slowed_and_followed_by_keys_alone(page: Page, robot: FakeRobot) -> None:
    choose(page, circle(0.05))
    may(page, "no")
    page.evaluate("document.querySelector('#stretch').focus()")
    page.type_key("Enter")
    may(page, "yes")
    page.until("document.querySelector('#stretch').checked")
    assert not robot.followed
    page.type_key("Tab")
    page.type_key("Tab")
    page.until_equal("document.activeElement.id", "follow")
    page.type_key("Enter")
    wait(lambda: bool(robot.followed), "it follows")


@pytest.mark.parametrize("list_", ["language", "along", "tool", "frame"])
def test_keys_in_a_list_choose_and_move_nothing_but_stop_is_stop(page: Page, robot: FakeRobot, list_: str) -> None:
    page.evaluate(f"document.querySelector('#{list_}').focus()")
    before = page.evaluate(f"document.querySelector('#{list_}').selectedIndex")
    page.type_key("Enter")
    page.until(f"document.querySelector('#{list_}').matches(':open')")
    for key in ("a", "d", "ArrowLeft", "ArrowRight", "ArrowDown" if before == 0 else "ArrowUp"):
        page.type_key(key)
    page.type_key("Enter")
    page.until(f"document.querySelector('#{list_}').selectedIndex !== {before}")
    assert not robot.sent
    page.type_key("Space")
    wait(lambda: "stop" in robot.commands, "a stop")
    page.evaluate("localStorage.clear()")


def test_keys_move_nothing_where_an_open_list_is_filled_again(page: Page, robot: FakeRobot) -> None:
    page.evaluate("document.querySelector('#tool').focus()")
    page.type_key("Enter")
    page.until("document.querySelector('#tool').matches(':open')")
    page.type_key("ArrowDown")
    page.evaluate("document.querySelector('#tool option').dataset.before = 'yes'")
    for colours in ("dark", "light"):
        page.colours(colours)
    page.until("!document.querySelector('#tool option').dataset.before")
    page.type_key("ArrowDown")
    page.type_key("ArrowUp")
    assert not robot.sent


@pytest.mark.parametrize(
    ("name", "text", "why"),
    [
        ("a.csv", "", "line 1: columns none"),
        ("a.csv", "t,x,y,phi\n0,0,0,0\n1,zero,0,0\n", "line 3, column x"),
        ("a.json", "[{}]", "missing required field"),
        ("a.json", "[" * 5000, "Expected object, got array"),
        ("a.csv", "t,x,y,phi\n0,0,0,0\n9,0.5,0,0\n", "leaves the workspace"),
        ("a.csv", "t,x,y,phi\n0,0,0,0\n0,0.01,0,0\n", "times must rise"),
        ("a.csv", "t,x,y,phi\n" + "".join(f"{k},0,0,0\n" for k in range(5001)), "maximum of 5000"),
        ("a.csv", "x" * 1_600_000, "too large"),
    ],
)
def test_a_file_that_cannot_be_followed_says_why(page: Page, name: str, text: str, why: str) -> None:
    choose(page, text, name)
    page.until(f"document.querySelector('#file-says').textContent.includes({why!r})")
    page.until("document.querySelector('#follow').disabled")


def test_json_is_followed_too_and_a_refusal_is_told(page: Page, robot: FakeRobot) -> None:
    points = [{"t": float(k), "x": 0.01 * k, "y": 0.0, "phi": 0.0} for k in range(4)]
    choose(page, msgspec.json.encode(points).decode(), "path.json")
    may(page, "yes")
    robot.refusal = RefusedError(RefusalCode.WRONG_START, "the trajectory begins elsewhere")
    page.click("#follow")
    page.until("document.querySelector('#answer').textContent.includes('begins elsewhere')")
    page.until_equal("document.querySelector('#file-progress').style.visibility", "hidden")


# ---------------------------------------------------------------------- the lease, and who is there


def test_the_lease_is_taken_over_and_given_back_and_says_since_when(page: Page, robot: FakeRobot) -> None:
    assert page.text("#lease") == "Nobody holds the lease."
    robot.holder = "bob"
    robot.say("lease acquired by bob", kind="lease", user="bob")
    page.until("document.querySelector('#lease').textContent.startsWith('bob holds the lease since ')")
    enabled = "[...document.querySelectorAll('[data-command]:enabled')].map((each) => each.dataset.command).join()"
    page.until(f"{enabled}.includes('takeover')")
    assert not {"acquire", "release"} & set(page.evaluate(enabled).split(","))
    page.click("[data-command=takeover]")
    page.until("document.querySelector('#lease').textContent.startsWith('You hold the lease')")
    assert robot.forced == [True]
    page.click("[data-command=release]")
    page.until("document.querySelector('#lease').textContent === 'Nobody holds the lease.'")


def test_who_is_connected_is_shown_while_it_is_known(page: Page, robot: FakeRobot) -> None:
    page.until("document.querySelector('#people').textContent === 'Connected: ann, bob'")
    robot.connected = ["ann"]
    page.until("document.querySelector('#people').textContent === 'Connected: ann'")
    robot.silent.set()
    page.until("document.querySelector('#people').textContent === ''")


# ---------------------------------------------------------------------- recordings


def sessions(page: Page) -> str:
    page.click("[data-view=sessions]")
    page.until("document.querySelector('#sessions').textContent")
    return page.text("#sessions")


def test_sessions_are_listed_reported_and_downloaded(page: Page, panel: Panel, tmp_path: Path) -> None:
    recorded = record(tmp_path)
    shown = sessions(page)
    assert recorded.name in shown
    assert "1 done, 1 faulted" in shown
    assert "drive B: EMCY 8700" in shown
    links = page.evaluate(
        f"[...[...document.querySelectorAll('#sessions tr')].find((row) => row.innerText.includes({recorded.name!r}))"
        ".querySelectorAll('a')].map((each) => each.href)"
    )
    with urllib.request.urlopen(links[1], timeout=60.0) as answer:
        assert answer.read() == recorded.read_bytes()
        assert recorded.name in answer.headers["Content-Disposition"]
        assert answer.headers["X-Content-Type-Options"] == "nosniff"
    with urllib.request.urlopen(links[0], timeout=60.0) as answer:
        assert "EMCY 8700" in answer.read().decode()


def test_where_there_is_nothing_here_that_is_said(page: Page, robot: FakeRobot, tmp_path: Path) -> None:
    assert str(tmp_path) in sessions(page)
    assert "not on the panel's" in sessions(page)


@pytest.mark.parametrize("language", ["en", "de"])
@pytest.mark.parametrize("failure", ["error", "timeout", "no permission", "no answer"])
def test_a_list_that_cannot_be_made_is_never_called_empty(
    page: Page, robot: FakeRobot, tmp_path: Path, language: str, failure: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    record(tmp_path)
    page.show_language(language)

    def fail(*_: object, **__: object) -> Any:
        if failure == "timeout":
            raise subprocess.TimeoutExpired("trirail", 300.0)
        if failure == "error":
            return subprocess.CompletedProcess([], 2, b"", b"trirail: no memory")
        raise PermissionError(errno.EACCES, "Permission denied")

    if failure == "no answer":
        page.evaluate("window.fetch = () => Promise.reject(new Error('broken'))")
    else:
        monkeypatch.setattr(*((os, "listdir") if failure == "no permission" else (subprocess, "run")), fail)
    shown = sessions(page)
    why = {"error": "no memory", "timeout": "longer than 300 s", "no permission": "Permission", "no answer": "broken"}
    assert {"en": "cannot be listed", "de": "nicht auflisten"}[language] in shown
    assert why[failure] in shown
    page.evaluate("localStorage.clear()")


def test_a_session_in_which_the_clock_was_set_back_lasts_as_long_as_it_was_recorded(page: Page, tmp_path: Path) -> None:
    recorded = record(tmp_path)
    kept = contents.load(recorded)
    assert kept is not None
    assert kept.began is not None
    contents.save(recorded, msgspec.structs.replace(kept, ended=kept.began - 9.0, cycles=3_641_000, lost_cycles=17))
    assert recorded.name in sessions(page)
    row = f"[...document.querySelectorAll('#sessions tr')].find((row) => row.innerText.includes({recorded.name!r}))"
    assert page.evaluate(f"{row}.cells[1].innerText") == "1:00:41"
    assert "Not recorded: 17 cycles." in page.evaluate(f"{row}.innerText")


@given(st.text())
def test_no_other_file_is_sent(name: str) -> None:
    folder = Path(__file__).parent
    assert Recordings("demo", lambda: str(folder)).send_file(None, name, {}) is None  # type: ignore[arg-type]
    assert Recordings("demo", lambda: str(folder)).report(name) is None


def test_a_page_without_contact_goes_nowhere(page: Page, robot: FakeRobot) -> None:
    choose(page, circle(4.0))
    may(page, "yes")
    robot.silent.set()
    page.until("document.body.dataset.contact === 'none'")
    for selector in ("#go", "#follow", "#file-start", "[data-command=acquire]", ".hold"):
        page.until(f"document.querySelector({selector!r}).disabled")
    robot.silent.clear()
