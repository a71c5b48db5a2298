"""The process of the simulated drives: the loop has them on a bus between processes, as it has real ones on theirs."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

from msgspec import structs
from trirail_drivers.config import Can
from trirail_drivers.connection.serving import serve

from trirail.config import Config
from trirail.errors import ServiceError
from trirail.processes import realtime

NAME: Final = "drives"
"""The process, and its socket in the service's folder of sockets."""
WITHIN = 60.0
"""How long the drives may take to be there [s]."""
LOOK_EVERY = 0.005
"""How often it is seen whether they are [s]."""


def main(config: Config, runtime: Path, ready: Callable[[object], None]) -> int:
    """Serve the drives until the loop has gone. They keep nothing, so they may be killed when it has."""

    def begin() -> None:
        lacking = realtime.stay_beside(config.loop, realtime.DRIVES_BELOW)
        ready({"lacking": lacking})

    def connected() -> None:
        # The loop stops the robot first, whoever is told to end; its end is the end of this process.
        signal.signal(signal.SIGTERM, signal.SIG_IGN)

    serve(runtime / NAME, config.can, config.drives, begin, connected)
    return 0


def bus(config: Config, runtime: Path) -> Can:
    """Section [can] of the bus that the loop is on; where the drives are simulated, once their process serves them."""
    if config.can.interface != "simulated":
        return config.can
    path = runtime / NAME
    deadline = time.monotonic() + WITHIN
    while not path.exists():
        if time.monotonic() > deadline:
            raise ServiceError(f"the simulated drives are not there within {WITHIN:g} s")
        time.sleep(LOOK_EVERY)
    return structs.replace(config.can, interface="unix", channel=str(path))
