"""The page's languages: each has every word, and no word of the page is outside of them."""

from __future__ import annotations

import itertools
import re
from pathlib import Path
from typing import Any, get_args

import msgspec
import pytest
import trirail
from chromium import Page, needs_chromium
from panel.conftest import SHOWN
from panel.fake_robot import FakeRobot
from panel.test_page import SIZES
from trirail.errors import RefusalCode
from trirail.panel.server import LANGUAGES, Panel
from trirail.wire.messages import Outcome
from trirail.wire.vocabulary import Command, FaultCause, Mode, Role
from waiting import wait_until

PAGE = Path(str(trirail.__file__)).parent / "panel/page"
FILES = {file.stem: msgspec.json.decode(file.read_bytes(), type=dict[str, str]) for file in PAGE.glob("*.json")}
SERVICE = ("refusal.", "obstacle.", "cause.", "bound.", "event.", "said.", "word.")
"""What the service says: in English it has words of its own."""
WORDS = re.compile(r"[^\W\d_]{3,}")
"""Three letters or more: what is shorter is a coordinate or a unit."""


def places(text: str) -> list[str]:
    return sorted(re.findall(r"\{(\w+)\}", text))


def test_german_and_english_are_there() -> None:
    assert {"en", "de"} <= set(FILES)


@pytest.mark.parametrize("code", FILES)
def test_every_language_has_every_word_with_the_same_values_in_it(code: str) -> None:
    assert {key for key in FILES[code] if not key.startswith(SERVICE)} == set(FILES["en"])
    for key, text in FILES[code].items():
        assert text.strip(), key
        assert key.startswith(SERVICE) or places(text) == places(FILES["en"][key]), key


@pytest.mark.parametrize("code", set(FILES) - {"en"})
def test_every_other_language_words_what_the_service_says(code: str) -> None:
    causes = {
        *FaultCause,
        "emcy",
        "fault",
        "silent",
        "heartbeat",
        "state",
        "timeout",
        "homing",
        "frame",
        "setpoint",
        "bus",
    }
    wanted = {f"refusal.{each}" for each in RefusalCode} | {f"cause.{each}" for each in causes}
    assert wanted <= set(FILES[code])
    assert {key for key in FILES[code] if key.startswith(("refusal.", "cause."))} - wanted == {
        "refusal.service",
        "refusal.outdated",
        "refusal.unreadable",
        "cause.drive",
    }


def test_every_word_is_used_and_every_one_used_is_there() -> None:
    """Where a key has a part that is not known before, all that are possible are there."""
    source = "\n".join(file.read_text() for file in (*PAGE.glob("*.js"), PAGE / "index.html") if file.stem != "uplot")
    used = set(re.findall(r"""data-say(?:-\w+)?="([\w.]+)\"""", source)) | set(re.findall(r'say\("([\w.]+)"', source))
    assert used <= set(FILES["en"]) | {key for key in FILES["de"] if key.startswith(SERVICE)}
    made = {f"mode.{mode}" for mode in Mode} | {f"do.{name}" for name in Command} | {f"role.{role}" for role in Role}
    assert made | {f"outcome.{each}" for each in get_args(Outcome)} <= set(FILES["en"])
    literals = set(re.findall(r"""["'`]([\w.]+)["'`]""", source)) | {"language"}
    stems = tuple(set(re.findall(r"`([a-z_]+\.)\$\{", source)))
    unused = {key for key in FILES["en"] if key not in used | literals and not key.startswith(stems)}
    assert not unused


# ---------------------------------------------------------------------- in a browser


@pytest.fixture
def robot(tmp_path: Path) -> FakeRobot:
    robot = FakeRobot(homes=("A",))
    frames = {"tool": {"tip": (0.02, 0.0)}, "work": {"table": (0.01, 0.0, 0.2)}}
    robot.told = msgspec.structs.replace(robot.told, frames=frames, recordings=str(tmp_path))
    return robot


MARKED = {key: f"⟦{text}⟧" for key, text in FILES["en"].items()}
FOUND = """(() => {
  const found = [];
  const own = (element) => element.closest('[translate=no]') === null;
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  for (let node = walker.nextNode(); node; node = walker.nextNode())
    if (own(node.parentElement) && !node.parentElement.closest('script, style')) found.push(node.data);
  for (const element of document.querySelectorAll('*'))
    for (const name of ['aria-label', 'title', 'placeholder', 'alt'])
      if (element.hasAttribute(name)) found.push(element.getAttribute(name));
  return found;
})()"""


def outside(page: Page) -> list[str]:
    """The page's words that come from no language file; of the robot is what is not to be translated."""
    return [text for text in page.evaluate(FOUND) if WORDS.search(unmarked(text))]


def unmarked(text: str) -> str:
    """What is in no marks; words may be values in others."""
    while (rest := re.sub(r"⟦[^⟦⟧]*⟧", "", text)) != text:
        text = rest
    return text


@pytest.mark.viewer
@needs_chromium
def test_no_word_of_the_page_is_outside_of_the_languages(browser: Page, robot: FakeRobot) -> None:
    with Panel(robot.robot(), 0) as panel:
        panel._files["xx.json"] = msgspec.json.encode(MARKED)
        panel._files[LANGUAGES] = msgspec.json.encode({"xx": "marked"})
        page = browser.another()
        page.open("about:blank")
        page.languages("xx")
        page.navigate(panel.url)
        page.until(f"{SHOWN} && document.querySelector('#people').textContent")
        page.until_equal("document.querySelector('#mode-name').textContent", "⟦disabled⟧")
        assert outside(page) == []
        page.click("[data-command=enable]")
        page.until("document.querySelector('#mode-name').textContent === '⟦holding⟧'")
        for view in ("charts", "sessions", "mechanism", "following", "to-pose"):
            page.click(f"[data-view={view}]")
            assert outside(page) == [], view
        for step in range(5):
            page.click(f"[data-step='{step}']")
        for words in ("900", "ten", "1"):
            for field in ("x", "y", "phi"):
                page.write(f"#to-{field}", words)
            page.evaluate("new Promise((done) => setTimeout(done, 150))")
            assert outside(page) == [], words
        robot.fault("drive B: EMCY 8700")
        page.until("!document.querySelector('#alarm').hidden")
        assert outside(page) == []
        robot.silent.set()
        page.until("document.body.dataset.contact === 'none'")
        assert outside(page) == []
        page.close()


BROKEN = """[...document.querySelectorAll('button, th, h1, h2, label > span, #mode-name')].flatMap((element) => {
  const walker = document.createTreeWalker(element, NodeFilter.SHOW_TEXT);
  const broken = [];
  for (let node = walker.nextNode(); node; node = walker.nextNode())
    for (const word of node.data.matchAll(/[^\\s-]+/g)) {
      const range = document.createRange();
      range.setStart(node, word.index);
      range.setEnd(node, word.index + word[0].length);
      const lines = new Set([...range.getClientRects()].map((each) => Math.round(each.top)));
      if (lines.size > word[0].split('\\u00ad').length) broken.push(word[0]);
    }
  return broken;
})"""


@pytest.mark.viewer
@needs_chromium
def test_no_word_is_broken_and_none_sticks_out(browser: Page, robot: FakeRobot) -> None:
    with Panel(robot.robot(), 0) as panel:
        page = browser.another()
        page.open(panel.url)
        page.until(SHOWN)
        for (width, height, phone), code in itertools.product(SIZES.values(), FILES):
            page.resize(width, height, phone=phone)
            page.show_language(code)
            for view in ("following", "to-pose"):
                page.click(f"[data-view={view}]")
                assert page.evaluate(BROKEN) == [], (code, width, view)
                wide = "[...document.querySelectorAll('button')].filter((each) => each.scrollWidth > each.clientWidth)"
                assert page.evaluate(f"{wide}.map((each) => each.innerText)") == [], (code, width, view)
        page.close()


@pytest.mark.viewer
@needs_chromium
def test_the_language_is_the_browser_s_or_that_of_the_switch_and_keeps_the_lease(
    browser: Page, robot: FakeRobot
) -> None:
    with Panel(robot.robot(), 0) as panel:

        def opened() -> Page:
            page = browser.another()
            page.open("about:blank")
            page.languages("de-CH")
            page.navigate(panel.url)
            page.until(SHOWN)
            return page

        page = opened()
        shown: dict[str, Any] = {"en": "Enable", "de": "Ein"}
        assert page.text("[data-command=enable]") == shown["de"]
        page.click("[data-command=enable]")
        page.click("[data-command=acquire]")
        page.until("document.querySelector('#lease').textContent.startsWith('Sie')")
        page.choose("#language", "en")
        page.until(f"document.querySelector('[data-command=enable]').innerText === {shown['en']!r}")
        page.until_equal("document.documentElement.lang", "en")
        page.until("document.querySelector('#lease').textContent.startsWith('You')")
        assert "release" not in robot.commands
        page.close()
        again = opened()  # what was chosen is kept
        assert again.text("[data-command=enable]") == shown["en"]
        again.evaluate("localStorage.clear()")
        again.close()


@pytest.mark.viewer
@needs_chromium
def test_the_language_that_was_chosen_last_stays_whichever_arrives_last(page: Page) -> None:
    page.evaluate(
        "(() => { const real = fetch; window.arrived = [];"
        " self.fetch = async (name) => {"
        "   await new Promise((later) => setTimeout(later, { 'de.json': 300, 'en.json': 50 }[name] ?? 0));"
        "   const answer = await real(name); setTimeout(() => arrived.push(name), 50); return answer; }; })()"
    )
    page.choose("#language", "de")
    page.choose("#language", "en")
    page.evaluate("document.querySelector('#answer').textContent = 'what was said'")
    page.until("arrived.length === 2")
    assert page.evaluate("arrived") == ["en.json", "de.json"]
    assert page.evaluate("document.documentElement.lang") == "en"
    assert page.text("#answer") == "what was said", "the language has not changed, so nothing is shown anew"
    page.evaluate("localStorage.clear()")


@pytest.mark.viewer
@needs_chromium
def test_a_browser_that_keeps_nothing_shows_the_page_and_stops(browser: Page, robot: FakeRobot) -> None:
    """It may be set to refuse cookies and all else of pages; what asks for that then fails."""
    with Panel(robot.robot(), 0) as panel:
        refusal = b"{get() { throw new DOMException('refused', 'SecurityError'); }}"
        refused = b"Object.defineProperty(self, 'localStorage', %s);" % refusal
        panel._files["words.js"] = refused + panel._files["words.js"]
        page = browser.another()
        page.open(panel.url)
        page.until(SHOWN)
        page.choose("#language", "de")
        page.until("document.querySelector('[data-command=enable]').innerText === 'Ein'")
        page.click("#stop")
        wait_until(lambda: robot.commands == ["stop"])
        page.close()
