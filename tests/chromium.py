"""A headless Chromium that opens pages, uses them as a person does and takes pictures, by DevTools on a pipe."""

from __future__ import annotations

import base64
import io
import itertools
import json
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from PIL import Image
from waiting import WITHIN

FLAGS = ["--headless=new", "--no-sandbox", "--window-size=1280,800", "--remote-debugging-pipe"]
# The web viewer needs WebGL: Mesa's software renderer through ANGLE does without a graphics card.
WEBGL = ["--use-gl=angle", "--use-angle=gl-egl", "--ignore-gpu-blocklist"]
KEYS = {"Enter": "\r", "Space": " "}
needs_chromium = pytest.mark.skipif(
    shutil.which("chromium") is None, reason="no chromium: make ci-packages installs it on Debian"
)


class Pipe:
    """The browser's end of the protocol, which all its pages share."""

    def __init__(self, to_browser: io.RawIOBase, from_browser: io.BufferedReader) -> None:
        self._to, self._from = to_browser, from_browser
        self._numbers = itertools.count(1)

    def call(self, method: str, session: str = "", **parameters: Any) -> dict[str, Any]:
        number = next(self._numbers)
        request = {"id": number, "method": method, "params": parameters}
        if session:
            request["sessionId"] = session
        self._to.write(json.dumps(request).encode() + b"\0")
        while True:
            content = bytearray()
            while not content.endswith(b"\0"):
                byte = self._from.read(1)
                assert byte, "the browser has ended"
                content += byte
            answer = json.loads(content[:-1])
            if answer.get("id") == number:
                assert "error" not in answer, answer
                result: dict[str, Any] = answer["result"]
                return result


class Page:
    """One page, a tab of its own once something is opened in it."""

    def __init__(self, pipe: Pipe) -> None:
        self._pipe = pipe
        self._target = ""
        self._session = ""

    def another(self) -> Page:
        """One more page of the same browser."""
        return Page(self._pipe)

    def open(self, url: str, arrives_at: str = "") -> None:
        # In a window of its own: pages behind others draw nothing.
        self._target = self._pipe.call("Target.createTarget", url="about:blank", newWindow=True)["targetId"]
        self._session = self._pipe.call("Target.attachToTarget", targetId=self._target, flatten=True)["sessionId"]
        self.navigate(url, arrives_at)

    def navigate(self, url: str, arrives_at: str = "") -> None:
        """Show another address in the same tab, which may lead to a further one."""
        self._call("Page.navigate", url=url)
        self.until(f"location.href.startsWith({arrives_at or url!r}) && document.readyState === 'complete'")

    def picture(self) -> Image.Image:
        shot = self._call("Page.captureScreenshot", format="png")["data"]
        return Image.open(io.BytesIO(base64.b64decode(shot))).convert("RGB")

    # ------------------------------------------------------------------ looking

    def evaluate(self, expression: str) -> Any:
        """What an expression of JavaScript comes to in the page; a promise is waited for."""
        found = self._call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    def until(self, expression: str) -> None:
        """Wait until an expression of JavaScript holds in the page."""
        deadline = time.monotonic() + WITHIN
        while not self.evaluate(f"Boolean({expression})"):
            assert time.monotonic() < deadline, f"not {expression}: {self.text('body')}"
            time.sleep(0.02)

    def until_equal(self, expression: str, value: object) -> None:
        """Wait until an expression of JavaScript has a value: the page follows the robot, a moment later."""
        deadline = time.monotonic() + WITHIN
        while (found := self.evaluate(expression)) != value:
            if time.monotonic() > deadline:
                assert found == value, expression
            time.sleep(0.02)

    def text(self, selector: str) -> str:
        found: str = self.evaluate(f"document.querySelector({selector!r}).innerText")
        return found

    def resize(self, width: int, height: int, *, phone: bool = False) -> None:
        self._call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=phone)
        self._call("Emulation.setTouchEmulationEnabled", enabled=phone)

    def colours(self, scheme: str) -> None:
        """Show the page as to somebody who likes it light, or dark; return when it is drawn so."""
        self._call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])
        self.evaluate("new Promise((drawn) => requestAnimationFrame(() => requestAnimationFrame(drawn)))")

    def languages(self, wished: str) -> None:
        """Be the browser of somebody who wishes pages in this language."""
        agent = self.evaluate("navigator.userAgent")
        self._call("Emulation.setUserAgentOverride", userAgent=agent, acceptLanguage=wished)

    # ------------------------------------------------------------------ using

    def middle(self, selector: str) -> dict[str, float]:
        """Where an element is, scrolled into view."""
        found: dict[str, float] = self.evaluate(
            f"(() => {{ const it = document.querySelector({selector!r}); it.scrollIntoView({{block: 'nearest'}});"
            " const at = it.getBoundingClientRect(); return {x: at.x + at.width / 2, y: at.y + at.height / 2}; })()"
        )
        return found

    def press(self, selector: str) -> None:
        self._mouse("mousePressed", self.middle(selector))

    def let_go(self, selector: str = "body") -> None:
        self._mouse("mouseReleased", self.middle(selector))

    def click(self, selector: str) -> None:
        self.press(selector)
        self.let_go(selector)

    def drag(self, selector: str, right: float, up: float, while_held: Callable[[], object] = lambda: None) -> None:
        """Drag from the middle of an element by a number of pixels; call `while_held` before the button is released."""
        at = self.middle(selector)
        self._mouse("mousePressed", at)
        for part in (0.5, 1.0):
            self._mouse("mouseMoved", {"x": at["x"] + part * right, "y": at["y"] - part * up})
        while_held()
        self._mouse("mouseReleased", {"x": at["x"] + right, "y": at["y"] - up})

    def write(self, selector: str, words: str) -> None:
        """Write into a field, in place of what stands there."""
        self.evaluate(
            f"(() => {{ const field = document.querySelector({selector!r}); field.focus(); field.value = {words!r};"
            " field.dispatchEvent(new Event('input', {bubbles: true})); })()"
        )

    def show_language(self, code: str) -> None:
        """Choose the language of the page, and wait until its words have arrived."""
        self.choose("#language", code)
        self.until(f"document.documentElement.lang === {code!r}")

    def choose(self, selector: str, value: str) -> None:
        """Choose one of a list, as by its keys."""
        self.evaluate(
            f"(() => {{ const list = document.querySelector({selector!r}); list.value = {value!r};"
            " list.dispatchEvent(new Event('change', {bubbles: true})); })()"
        )

    def choose_file(self, selector: str, name: str, text: str) -> None:
        """Choose a file of this name and content."""
        self.evaluate(
            f"(() => {{ const files = new DataTransfer(); files.items.add(new File([{json.dumps(text)}], {name!r}));"
            f" const field = document.querySelector({selector!r}); field.files = files.files;"
            " field.dispatchEvent(new Event('change', {bubbles: true})); })()"
        )

    def touch(self, selector: str) -> None:
        self._call("Input.dispatchTouchEvent", type="touchStart", touchPoints=[self.middle(selector)])

    def end_touch(self, kind: str = "touchEnd") -> None:
        self._call("Input.dispatchTouchEvent", type=kind, touchPoints=[])

    def key_down(self, key: str) -> None:
        text = KEYS.get(key, key if len(key) == 1 else "")
        name = " " if key == "Space" else key
        code = f"Key{key.upper()}" if len(key) == 1 else key
        self._call("Input.dispatchKeyEvent", type="keyDown", key=name, code=code, text=text)

    def key_up(self, key: str) -> None:
        code = f"Key{key.upper()}" if len(key) == 1 else key
        self._call("Input.dispatchKeyEvent", type="keyUp", key=" " if key == "Space" else key, code=code)

    def type_key(self, key: str) -> None:
        self.key_down(key)
        self.key_up(key)

    def close(self) -> None:
        self._pipe.call("Target.closeTarget", targetId=self._target)

    def freeze(self, *, over: bool = False) -> None:
        """Freeze the tab as the browser does with those that are not looked at, or let it go on."""
        self._call("Page.setWebLifecycleState", state="active" if over else "frozen")

    def signal_renderers(self, number: signal.Signals) -> None:
        """Send a signal to the processes in which this browser's pages run: SIGSTOP freezes them."""
        for process in self._pipe.call("SystemInfo.getProcessInfo")["processInfo"]:
            if process["type"] == "renderer":
                os.kill(process["id"], number)

    def _mouse(self, kind: str, at: dict[str, float]) -> None:
        self._call("Input.dispatchMouseEvent", type=kind, button="left", clickCount=1, **at)

    def _call(self, method: str, **parameters: Any) -> dict[str, Any]:
        return self._pipe.call(method, self._session, **parameters)


@contextmanager
def chromium(program: str, profile: Path, flags: Sequence[str] = WEBGL) -> Iterator[Page]:
    """Run a browser with a profile of its own; it reads requests from descriptor 3 and answers on 4."""
    (ours_in, theirs_out), (theirs_in, ours_out) = os.pipe(), os.pipe()
    command = [program, *FLAGS, *flags, f"--user-data-dir={profile}"]
    browser = subprocess.Popen(
        ["bash", "-c", f'exec "$@" 3<&{theirs_in} 4>&{theirs_out}', "bash", *command],
        pass_fds=[theirs_in, theirs_out],
        stderr=subprocess.DEVNULL,
    )
    os.close(theirs_in)
    os.close(theirs_out)
    try:
        with os.fdopen(ours_out, "wb", buffering=0) as to_browser, os.fdopen(ours_in, "rb") as from_browser:
            yield Page(Pipe(to_browser, from_browser))
    finally:
        browser.terminate()
        browser.wait(WITHIN)
