"""A path's file goes to the server once, in small parts, so that a STOP waits for no more than one of them."""

from __future__ import annotations

import json
import time

import msgspec
import pytest
from chromium import Page, needs_chromium
from hypothesis import given
from hypothesis import strategies as st
from panel.conftest import SHOWN
from panel.fake_robot import FakeRobot
from panel.test_shift import choose, circle, may
from trirail.panel.messages import BeginUpload
from trirail.panel.server import MAX_MESSAGE, Panel
from trirail.panel.uploads import UploadedFile, Uploads
from trirail.wire.sizes import MAX_FILE
from waiting import WITHIN, wait_until
from websockets.sync.client import ClientConnection, connect

PART = 16_384
COUNTED = """
window.sizes = []; window.sent = 0; window.answered = 0; window.most = 0;
const send = WebSocket.prototype.send;
const counts = (take) => (event) => {
  if (event.data.startsWith('{"tell":"received"')) answered++;
  take(event);
};
WebSocket.prototype.send = function (content) {
  if (typeof content !== "string" || content.length > 4000) sizes.push(content.length);
  if (typeof content !== "string" || content.includes('"do":"upload"')) most = Math.max(most, ++sent - answered);
  if (!this.counted) this.counted = this.onmessage = counts(this.onmessage);
  send.call(this, content);
};
"""
"""Counts what is sent that could hold a STOP up, and how much of it is not answered."""


@given(st.lists(st.binary(max_size=20)), st.integers(0, 60))
def test_a_file_is_there_when_it_is_complete_and_never_longer_than_announced(parts: list[bytes], size: int) -> None:
    uploads, content = Uploads(), b""
    assert uploads.begin(BeginUpload(7, "path.csv", size)) == {"file": 7, "size": 0}
    for part in parts:
        if len(content + part) > size:
            with pytest.raises(ValueError, match="exceed the announced size"):
                uploads.append(part)
        else:
            content += part
            assert uploads.append(part) == {"file": 7, "size": len(content)}
        assert uploads.find(7) == (UploadedFile("path.csv", content) if len(content) == size else None)
        assert uploads.find(8) is None
    uploads.begin(BeginUpload(8, "other.csv", 0))
    assert uploads.find(7) is None


def answer(opened: ClientConnection, *tells: str) -> dict[str, object]:
    while True:
        said: dict[str, object] = msgspec.json.decode(opened.recv(WITHIN))
        if said["tell"] in tells:
            return said


def test_what_is_no_part_of_a_file_is_refused_and_the_tab_lives() -> None:
    robot = FakeRobot()
    robot.mode = "holding"
    with Panel(robot.robot(), 0) as panel, connect(f"{panel.url.replace('http', 'ws')}socket", legacy=True) as opened:
        ask = {"file": 1, "seen": 10**15}
        for wrong in (
            b"part",
            b"\xff",
            json.dumps({"do": "upload", "file": 1, "name": "a.csv", "size": MAX_FILE + 1}),
            json.dumps({"do": "check path", "file": 1, "number": 2}),
            json.dumps({"do": "follow"} | ask),
        ):
            opened.send(wrong)
            assert answer(opened, "refused", "accepted")["tell"] == "refused"
        text = circle(4.0).encode()
        opened.send(json.dumps({"do": "upload", "file": 1, "name": "a.csv", "size": len(text)}))
        opened.send(text[:100])
        opened.send(json.dumps({"do": "follow"} | ask))
        assert answer(opened, "refused", "accepted")["message"] == "the file has not been uploaded"
        assert not robot.followed
        opened.send(text[100:])
        opened.send(json.dumps({"do": "follow"} | ask))
        assert answer(opened, "refused", "accepted")["name"] == "a.csv"
        assert len(robot.followed[0]) == 21


# ---------------------------------------------------------------------- the page


@pytest.mark.viewer
@needs_chromium
@pytest.mark.parametrize("letter", ["\\0", "\u0416", "1", "\ufeff"])
def test_no_file_ends_the_connection_and_a_stop_passes_it(page: Page, robot: FakeRobot, letter: str) -> None:
    """Whatever is in it: JSON takes six letters for a control character."""
    page.evaluate(COUNTED)
    page.click("[data-view=following]")
    size = MAX_FILE // len(letter.replace("\\0", " ").encode())
    page.evaluate(
        f"(() => {{ const files = new DataTransfer(); files.items.add(new File(['{letter}'.repeat({size})], 'a.csv'));"
        " const field = document.querySelector('#file'); field.files = files.files;"
        " field.dispatchEvent(new Event('change', {bubbles: true})); })()"
    )
    may(page, "no")
    assert page.evaluate("Math.max(...sizes)") <= PART < MAX_MESSAGE
    assert page.evaluate("most") == 1
    page.click("#stop")
    wait_until(lambda: "stop" in robot.commands, "a stop")
    assert page.evaluate(SHOWN)


@pytest.mark.viewer
@needs_chromium
def test_a_file_is_sent_once_and_again_only_to_a_server_that_has_it_not(browser: Page, robot: FakeRobot) -> None:
    robot.mode = "holding"
    page = browser.another()
    text = circle(4.0) + "\n" * 30_000
    with Panel(robot.robot(), 0, "token") as panel:
        port = int(panel.url.split(":")[2].split("/")[0])
        page.open(panel.url)
        page.until(SHOWN)
        page.evaluate(COUNTED)
        choose(page, text)
        may(page, "yes")
        sent = page.evaluate("sizes.length")
        assert sent >= 2
        for language in ("de", "en"):
            page.show_language(language)
        page.click("#stretch")
        may(page, "yes")
        page.click("#follow")
        wait_until(lambda: bool(robot.followed), "it follows")
        assert page.evaluate("sizes.length") == sent
    page.until("document.body.dataset.contact === 'none'")
    deadline = time.monotonic() + WITHIN
    with Panel(robot.robot(), port, "token"):
        page.until(SHOWN)
        may(page, "yes")
        assert page.evaluate("sizes.length") == 2 * sent
        page.until("!document.querySelector('#follow').disabled")
        page.click("#follow")
        wait_until(lambda: len(robot.followed) == 2, "it follows")
    assert time.monotonic() < deadline
    page.evaluate("localStorage.clear()")
    page.close()


@pytest.mark.viewer
@needs_chromium
def test_a_file_that_cannot_be_read_any_more_is_told(enabled: Page) -> None:
    """As one that was deleted, or that another program has written to, since it was chosen."""
    enabled.evaluate(
        "void (Blob.prototype.arrayBuffer = async () => { throw new DOMException('', 'NotReadableError'); })"
    )
    choose(enabled, circle(0.01), "gone.csv")
    enabled.until("document.querySelector('#file-says').textContent === 'gone.csv cannot be read: choose it again'")
    assert enabled.evaluate("document.querySelector('#follow').disabled")
