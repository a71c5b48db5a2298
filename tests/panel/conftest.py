"""A browser for the tests of the panel's page."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from chromium import Page, chromium
from panel.fake_robot import FakeRobot
from trirail.client import held_jog
from trirail.panel import feed
from trirail.panel.server import Panel

SHOWN = "document.body.dataset.contact === 'yes'"


@pytest.fixture(scope="session")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with chromium("chromium", tmp_path_factory.mktemp("profile"), ["--disable-gpu"]) as page:
        yield page


@pytest.fixture
def robot() -> FakeRobot:
    return FakeRobot()


@pytest.fixture(autouse=True)
def _slow_browser(monkeypatch: pytest.MonkeyPatch) -> None:
    """Accept what is pressed late: on a busy machine a browser draws a state when it is given the time for it."""
    monkeypatch.setattr(feed, "MAX_STATE_AGE_S", 5.0)


@pytest.fixture
def panel(robot: FakeRobot) -> Iterator[Panel]:
    with Panel(robot.robot()) as panel:
        yield panel


@pytest.fixture
def page(browser: Page, panel: Panel) -> Iterator[Page]:
    page = browser.another()
    page.open(panel.url)
    page.until(SHOWN)
    yield page
    page.close()


@pytest.fixture
def enabled(page: Page, robot: FakeRobot) -> Page:
    page.click("[data-command=enable]")
    page.until("document.querySelector('#mode-name').textContent === 'holding'")
    return page


@pytest.fixture
def slow_hand(panel: Panel, monkeypatch: pytest.MonkeyPatch) -> None:
    """Take a hand's signs that come late: on a busy machine a browser says no more than it is given the time for."""
    monkeypatch.setattr(held_jog, "TIMEOUT", 2.0)
    panel._files["hold.js"] = panel._files["hold.js"].replace(b"HUNG = 180;", b"HUNG = 1800;")
