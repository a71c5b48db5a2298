"""A browser for the tests of the panel's page."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from chromium import Page, chromium
from trirail.client import held_jog
from trirail.panel import orders, tab
from trirail.panel.server import Panel


@pytest.fixture(scope="session")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with chromium("chromium", tmp_path_factory.mktemp("profile"), ["--disable-gpu"]) as page:
        yield page


@pytest.fixture
def slow_hand(panel: Panel, monkeypatch: pytest.MonkeyPatch) -> None:
    """Take a hand's signs that come late: on a busy machine a browser says no more than it is given the time for."""
    monkeypatch.setattr(held_jog, "TIMEOUT", 2.0)
    for module in (tab, orders):
        monkeypatch.setattr(module, "FRESH", 5000)
    panel._files["hold.js"] = panel._files["hold.js"].replace(b"HUNG = 180;", b"HUNG = 1800;")
