"""A headless Chromium that opens a page and takes pictures of it, by the DevTools protocol on a pipe."""

from __future__ import annotations

import base64
import io
import itertools
import json
import os
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from PIL import Image

# The web viewer needs WebGL: Mesa's software renderer through ANGLE does without a graphics card.
FLAGS = ["--headless=new", "--no-sandbox", "--use-gl=angle", "--use-angle=gl-egl", "--ignore-gpu-blocklist"]


class Page:
    """One page."""

    def __init__(self, to_browser: io.RawIOBase, from_browser: io.BufferedReader) -> None:
        self._to, self._from = to_browser, from_browser
        self._numbers = itertools.count(1)
        self._session = ""

    def open(self, url: str) -> None:
        target = self._call("Target.createTarget", url=url)["targetId"]
        self._session = self._call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]

    def picture(self) -> Image.Image:
        shot = self._call("Page.captureScreenshot", format="png")["data"]
        return Image.open(io.BytesIO(base64.b64decode(shot))).convert("RGB")

    def _call(self, method: str, **parameters: Any) -> dict[str, Any]:
        number = next(self._numbers)
        request = {"id": number, "method": method, "params": parameters}
        if self._session:
            request["sessionId"] = self._session
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


@contextmanager
def chromium(program: str, profile: Path) -> Iterator[Page]:
    """Run a browser with a profile of its own; it reads requests from descriptor 3 and answers on 4."""
    (ours_in, theirs_out), (theirs_in, ours_out) = os.pipe(), os.pipe()
    command = [program, *FLAGS, "--window-size=1280,800", "--remote-debugging-pipe", f"--user-data-dir={profile}"]
    browser = subprocess.Popen(
        ["bash", "-c", f'exec "$@" 3<&{theirs_in} 4>&{theirs_out}', "bash", *command],
        pass_fds=[theirs_in, theirs_out],
        stderr=subprocess.DEVNULL,
    )
    os.close(theirs_in)
    os.close(theirs_out)
    try:
        with os.fdopen(ours_out, "wb", buffering=0) as to_browser, os.fdopen(ours_in, "rb") as from_browser:
            yield Page(to_browser, from_browser)
    finally:
        browser.terminate()
        browser.wait(20)
