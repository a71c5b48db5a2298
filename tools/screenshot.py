"""Picture of a recording, as the Rerun viewer shows it: python tools/screenshot.py FILE.rrd OUT.png.

Needs no display, but a Vulkan driver; on Debian, install mesa-vulkan-drivers.
"""

from __future__ import annotations

import argparse
import io
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from interruption import interrupt_on_signals
from PIL import Image
from rerun.experimental import ViewerClient
from trirail.processes.operating_system import python
from trirail.telemetry.sinks import free_port

TIMEOUT = 60.0
SETTLE = 2.0
"""Time that the views need to show the loaded data [s]."""
NOTICED = 5.0
"""Time after which the notices of the viewer have disappeared [s]."""
TITLE_BAR = 36
"""Height of the strip that the viewer reserves for the buttons of a window [pixels]. The strip is empty here."""


def main() -> int:
    """Take the picture and write it to the file; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path, metavar="FILE.rrd")
    parser.add_argument("picture", type=Path, metavar="OUT.png")
    parser.add_argument("--size", default="1600x900", help="width x height in pixels (default: %(default)s)")
    parser.add_argument("--at", type=float, metavar="SECONDS", help="nominal time to show (default: the end)")
    arguments = parser.parse_args()
    if not arguments.recording.is_file():
        parser.error(f"{arguments.recording} is not a file")
    interrupt_on_signals()
    width, height = (int(number) for number in arguments.size.split("x"))
    with viewer(arguments.recording, width, height) as client:
        if arguments.at is not None:
            client.set_time("t", duration=arguments.at, play_state="paused")
        time.sleep(NOTICED)
        picture(client).save(arguments.picture)
    return 0


@contextmanager
def viewer(recording: Path, width: int, height: int) -> Iterator[ViewerClient]:
    """Run a viewer without a window; yield a client of the viewer once it has loaded a recording."""
    port = free_port()
    command = python("-m", "rerun_cli", "--headless", "--hide-welcome-screen", "--bind", "127.0.0.1")
    command += ["--window-size", f"{width}x{height + TITLE_BAR}", "--port", str(port), str(recording)]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True
    ) as process:
        try:
            client = _connect(process, f"rerun+http://127.0.0.1:{port}/proxy")
            client.run_command("ui.toggle_top_panel")
            yield client
        finally:
            os.killpg(process.pid, signal.SIGTERM)  # `python -m rerun_cli` does not pass the signal on to the viewer


def picture(client: ViewerClient) -> Image.Image:
    """Return a picture of a viewer, without the strip for the buttons of a window."""
    time.sleep(SETTLE)
    whole = Image.open(io.BytesIO(client.take_screenshot()))
    return whole.crop((0, TITLE_BAR, whole.width, whole.height))


def _connect(viewer: subprocess.Popen[str], url: str) -> ViewerClient:
    """Wait until the viewer has loaded the recording; return a client of the viewer."""
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


if __name__ == "__main__":
    sys.exit(main())
