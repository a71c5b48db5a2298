"""Picture of the operator's page while a robot moves: python tools/panel_picture.py [OUT.png].

The tool starts a service on simulated drives, moves the robot, and opens the page in Chromium, which must be installed.
"""

from __future__ import annotations

import base64
import json
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from interruption import interrupt_on_signals
from trirail.client import own_service
from trirail.client.async_client import AsyncRobot
from trirail.client.client import Robot
from trirail.panel.server import Panel
from websockets.sync.client import connect

OUT = Path(__file__).parent / "pictures" / "panel.png"
SIZE = (1280, 800)
TIMEOUT = 60.0
"""Time limit until the browser answers and until the page shows the robot [s]."""
READY = (
    "document.querySelector('.goal')?.getBoundingClientRect().width && document.querySelector('#people').textContent"
)
"""JavaScript condition for taking the picture: the page has loaded and shows the goal of the robot."""
TOUR = ((0.03, 0.02, 0.2), (-0.03, 0.02, -0.2), (0.02, -0.03, 0.1), (0.0, 0.0, 0.0))


def main() -> None:
    """Take the picture and write it to the file."""
    out = Path(sys.argv[1]) if len(sys.argv) > 1 else OUT
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        raise SystemExit("no Chromium here: install it (Debian: apt-get install chromium)")
    interrupt_on_signals()
    with tempfile.TemporaryDirectory(prefix="trirail-", ignore_cleanup_errors=True) as folder:
        config, locator = own_service.private(Path(folder))
        os.environ["STATE_DIRECTORY"] = folder  # separates the taught poses from the user's poses
        with own_service.service(config, Path(folder, "shown.rrd")), Robot("demo", locator, user="ann") as robot:
            robot.enable()
            for name in ("pick", "place"):
                robot.teach(name)
            over = threading.Event()
            tour = threading.Thread(target=_tour, args=[robot, over])
            tour.start()
            try:
                shown = Panel(AsyncRobot("demo", locator, user="ann"), 0)
                with shown as panel, _page(browser, Path(folder, "profile"), panel.url) as call:
                    deadline = time.monotonic() + TIMEOUT
                    while not call("Runtime.evaluate", expression=f"Boolean({READY})")["result"]["value"]:
                        if time.monotonic() > deadline:
                            raise SystemExit("the page does not show the robot in time")
                        time.sleep(0.02)
                    out.write_bytes(base64.b64decode(call("Page.captureScreenshot", format="png")["data"]))
            finally:
                over.set()
                tour.join()
    print(f"drawn to {out}")


@contextmanager
def _page(browser: str, profile: Path, url: str) -> Iterator[Callable[..., dict[str, Any]]]:
    """Open a page in a browser; yield a function that calls a method of the DevTools protocol on the page."""
    width, height = SIZE
    flags = ("--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--remote-debugging-port=0")
    command = [browser, *flags, f"--user-data-dir={profile}", f"--window-size={width},{height}", url]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as process:
        try:
            port_file, deadline = profile / "DevToolsActivePort", time.monotonic() + TIMEOUT
            while not (port_file.is_file() and len(lines := port_file.read_text().splitlines()) == 2):
                if process.poll() is not None or time.monotonic() > deadline:
                    raise SystemExit(f"{browser} does not start")
                time.sleep(0.05)
            with urllib.request.urlopen(f"http://127.0.0.1:{lines[0]}/json") as answer:
                address = next(each["webSocketDebuggerUrl"] for each in json.load(answer) if each["type"] == "page")
            with connect(address, max_size=None) as opened:

                def call(method: str, **parameters: Any) -> dict[str, Any]:
                    opened.send(json.dumps({"id": 1, "method": method, "params": parameters}))
                    while "result" not in (message := json.loads(opened.recv(TIMEOUT))):
                        if "error" in message:
                            raise SystemExit(message["error"]["message"])
                    result: dict[str, Any] = message["result"]
                    return result

                call(
                    "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False
                )
                yield call
        finally:
            process.terminate()


def _tour(robot: Robot, over: threading.Event) -> None:
    while not over.is_set():
        for pose in TOUR:
            robot.move_to(*pose, speed=0.3).wait(timeout=30.0)


if __name__ == "__main__":
    main()
