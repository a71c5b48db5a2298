"""`trirail panel` with a robot that needs no service: python panel_process.py MOST_DESCRIPTORS."""

from __future__ import annotations

import resource
import sys
from pathlib import Path
from typing import Any
from unittest.mock import patch

sys.path.insert(0, str(Path(__file__).parents[1]))

from panel.fake_robot import AsyncFakeRobot, FakeRobot
from trirail.__main__ import main

HOURS = 3600.0


class Connected(AsyncFakeRobot):
    """In the place of AsyncRobot, which takes an address."""

    def __init__(self, *_: object, **_options: object) -> None:
        super().__init__(FakeRobot())


def run(most: int) -> Any:
    """Run it; who says nothing may do so for hours, and so nothing is mended by time alone."""
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
    sys.argv = ["trirail", "panel", "--port", "0", "--json"]
    with (
        patch("trirail.cli.panel_command.wait_for_robot"),
        patch("trirail.client.async_client.AsyncRobot", Connected),
        patch("trirail.panel.server.REQUEST_TIMEOUT_S", HOURS),
    ):
        return main()


if __name__ == "__main__":
    sys.exit(run(int(sys.argv[1])))
