"""The page that `trirail panel --open` opens in a browser, without showing the address to other users."""

from __future__ import annotations

import signal
import stat
import webbrowser
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest
from chromium import Page, needs_chromium
from panel.conftest import SHOWN
from panel.fake_robot import FakeRobot
from trirail.cli import panel_command
from trirail.client import async_client
from trirail.panel.server import Panel
from trirail.processes import operating_system


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch, robot: FakeRobot) -> Iterator[list[str]]:
    """Let the command serve a robot that needs no service; return what it opens in the browser."""
    opened: list[str] = []
    monkeypatch.setattr(async_client, "AsyncRobot", lambda *_, **__: robot.robot())
    monkeypatch.setattr(panel_command, "wait_for_robot", lambda _: None)
    monkeypatch.setattr(webbrowser, "open", opened.append)
    before = signal.getsignal(signal.SIGTERM)
    yield opened
    signal.signal(signal.SIGTERM, before)


def test_a_browser_gets_no_argument_with_the_token(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, opened: list[str]
) -> None:
    """Every user of the machine can see the arguments of processes."""
    token = panel_command.read_token(tmp_path / "token")
    seen: list[tuple[int, int, bool]] = []

    class Ends:
        """Signals that end the command at once, after a look at the file."""

        def __enter__(self) -> Ends:
            return self

        def __exit__(self, *_: object) -> None:
            pass

        def first(self) -> None:
            modes = [stat.S_IMODE(path.stat().st_mode) for path in (file_of(opened), file_of(opened).parent)]
            seen.append((modes[0], modes[1], token in file_of(opened).read_text()))

    monkeypatch.setattr(operating_system, "Signals", Ends)
    assert panel_command.panel(port=0, token=tmp_path / "token", open_=True) == 0
    assert len(opened) == 1
    assert token not in opened[0]
    assert seen == [(0o600, 0o700, True)]
    assert not file_of(opened).parent.exists()


def test_without_a_place_for_the_file_the_page_is_served_all_the_same(
    monkeypatch: pytest.MonkeyPatch, opened: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device", "/tmp/x")

    ended: list[bool] = []
    monkeypatch.setattr("trirail_drivers.files.tempfile.mkdtemp", refuse)
    monkeypatch.setattr(operating_system.Signals, "first", lambda _: ended.append(True))
    assert panel_command.panel(port=0, open_=True) == 0
    assert (opened, ended) == ([], [True])
    assert "open the printed address" in " ".join(capsys.readouterr().err.split())


def file_of(opened: list[str]) -> Path:
    return Path(unquote(urlsplit(opened[0]).path))


@pytest.mark.viewer
@needs_chromium
def test_the_file_leads_a_browser_to_the_page(browser: Page, panel: Panel) -> None:
    page = browser.another()
    with panel_command.redirect_to(panel.url) as address:
        page.open(address, panel.url)
        page.until(SHOWN)
    page.close()
