"""`trirail panel` with a robot that needs no service: python panel_process.py MOST_DESCRIPTORS."""

from __future__ import annotations

import resource
import sys
from pathlib import Path
from typing import Any
from unittest.mock import patch

sys.path.insert(0, str(Path(__file__).parents[1]))

from panel.fake_robot import FakeRobot
from trirail.__main__ import main

HOURS = 3600.0


class Connected(FakeRobot):
    """In the place of Robot, which takes an address and is a context."""

    def __init__(self, *_: object, **_options: object) -> None:
        super().__init__()

    def __enter__(self) -> Connected:
        return self

    def __exit__(self, *_: object) -> None:
        self.silent.set()


def run(most: int) -> Any:
    """Run it; who says nothing may do so for hours, and so nothing is mended by time alone."""
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
    sys.argv = ["trirail", "panel", "--port", "0", "--json"]
    with patch("trirail.client.client.Robot", Connected), patch("trirail.panel.server.OPENING", HOURS):
        return main()


if __name__ == "__main__":
    sys.exit(run(int(sys.argv[1])))
