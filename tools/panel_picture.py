"""A picture of the operator's page beside a running robot: python tools/panel_picture.py [OUT.png].

A service on simulated drives of its own, enabled and moving, its page in Chromium, which has to be installed.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

from trirail.client import own_service
from trirail.client.client import Robot
from trirail.panel.server import Panel

OUT = Path(__file__).parent / "pictures" / "panel.png"
SIZE = (1280, 800)
SETTLES = 4000
"""The page is drawn so long after it was opened [ms]."""
TOUR = ((0.03, 0.02, 0.2), (-0.03, 0.02, -0.2), (0.02, -0.03, 0.1), (0.0, 0.0, 0.0))


def main() -> None:
    """Draw it."""
    out = Path(sys.argv[1]) if len(sys.argv) > 1 else OUT
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        raise SystemExit("no Chromium here: install it (Debian: apt-get install chromium)")
    with tempfile.TemporaryDirectory(prefix="trirail-") as folder:
        config, locator = own_service.private(Path(folder))
        with own_service.service(config, Path(folder, "shown.rrd")), Robot("demo", locator, user="ann") as robot:
            robot.enable()
            threading.Thread(target=_tour, args=[robot], daemon=True).start()
            with Panel(robot, 0) as panel:
                width, height = SIZE
                subprocess.run(
                    [
                        *(browser, "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"),
                        *(f"--user-data-dir={folder}/profile", f"--window-size={width},{height}"),
                        *(f"--timeout={SETTLES}", f"--screenshot={out}", panel.url),
                    ],
                    check=True,
                    capture_output=True,
                )
    print(f"drawn to {out}")


def _tour(robot: Robot) -> None:
    for pose in TOUR * 4:
        robot.move_to(*pose, speed=0.3).wait(timeout=30.0)


if __name__ == "__main__":
    main()
