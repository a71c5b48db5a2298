"""A picture of a recording, as the Rerun viewer shows it: python tools/screenshot.py FILE.rrd OUT.png.

Needs no display, only a Vulkan driver; on Debian, mesa-vulkan-drivers.
"""

from __future__ import annotations

import argparse
import io
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

from PIL import Image
from rerun.experimental import ViewerClient

TIMEOUT = 60.0
SETTLE = 2.0
"""For the views to take in what has been loaded [s]."""
TITLE_BAR = 36
"""Height of the strip that the viewer keeps for the window's buttons [pixels]; there is nothing in it."""


def main() -> int:
    """Take the picture; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path, metavar="FILE.rrd")
    parser.add_argument("picture", type=Path, metavar="OUT.png")
    parser.add_argument("--size", default="1600x900", help="width x height in pixels (default: %(default)s)")
    parser.add_argument("--at", type=float, metavar="SECONDS", help="nominal time to show (default: the end)")
    arguments = parser.parse_args()
    if not arguments.recording.is_file():
        parser.error(f"{arguments.recording} is not a file")
    width, height = (int(number) for number in arguments.size.split("x"))
    port = _free_port()
    command = [sys.executable, "-m", "rerun", "--headless", "--hide-welcome-screen", "--bind", "127.0.0.1"]
    command += ["--window-size", f"{width}x{height + TITLE_BAR}", "--port", str(port), str(arguments.recording)]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True
    ) as viewer:
        try:
            client = _connect(viewer, f"rerun+http://127.0.0.1:{port}/proxy")
            client.run_command("ui.toggle_top_panel")
            if arguments.at is not None:
                client.set_time("t", duration=arguments.at, play_state="paused")
            time.sleep(SETTLE)
            picture = Image.open(io.BytesIO(client.take_screenshot()))
            picture.crop((0, TITLE_BAR, width, TITLE_BAR + height)).save(arguments.picture)
        finally:
            os.killpg(viewer.pid, signal.SIGTERM)  # `python -m rerun` does not pass the signal on to the viewer
    return 0


def _connect(viewer: subprocess.Popen[str], url: str) -> ViewerClient:
    """Return a client of the viewer, once it has loaded the recording."""
    deadline = time.monotonic() + TIMEOUT
    while time.monotonic() < deadline:
        if viewer.poll() is not None:
            raise SystemExit(f"the viewer ended: {viewer.communicate()[0]}")
        try:
            client = ViewerClient.connect(url)
            state = client.get_state()
        except (ConnectionError, RuntimeError, ValueError):
            time.sleep(0.2)
            continue
        if state.active_recording and state.views and not state.loading:
            return client
        time.sleep(0.2)
    raise SystemExit(f"the viewer has not loaded the recording within {TIMEOUT:g} s")


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


if __name__ == "__main__":
    sys.exit(main())
