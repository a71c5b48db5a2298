"""The loop's process: it rehearses, connects the drives, takes its rights, and turns until it is told to end."""

from __future__ import annotations

import signal
from collections.abc import Callable
from types import FrameType

from trirail_drivers.bus.capture import Capture
from trirail_drivers.config import Can
from trirail_drivers.connection.opening import connect
from trirail_drivers.interface import DriveGroup

from trirail.config import Config
from trirail.kinematics.robot import warm_up
from trirail.processes import realtime
from trirail.processes.clock import Ticker
from trirail.processes.heartbeats import Heartbeats
from trirail.processes.loop import Loop
from trirail.processes.ports import Ports
from trirail.wire.packets import Farewell, message

PLANNER_WITHIN = 120.0
"""How long the planner may take to come up: the very first start compiles the kinematics [s]."""


def main(
    config: Config,
    bus: Callable[[], Can],
    ports: Ports,
    heartbeats: Heartbeats,
    ready: Callable[[object], None],
    rehearse: Callable[[Config], tuple[str, ...]],
) -> int:
    """Run the loop's process; `ready` is called with what the loop runs without once it turns.

    `bus` waits for the drives' bus and returns it. `rehearse` runs what must come without delay, before the drives are
    touched, and returns what kept it from that.
    """
    drives: DriveGroup | None = None
    ended_as_told = False
    try:
        warm_up()
        unrehearsed = rehearse(config)
        ports.planner.await_peer(PLANNER_WITHIN)
        capture = Capture() if config.telemetry.capture_can else None
        drives = connect(bus(), config.drives, capture=capture)
        drives.configure(config.period, config.limits.slider.fastest)
        lacking = (*realtime.acquire(config.loop), *unrehearsed)
        loop = Loop(config, drives, ports, heartbeats, capture=capture, lacking=lacking)

        def end(_signal: int, _frame: FrameType | None) -> None:
            loop.ending = True

        signal.signal(signal.SIGTERM, end)
        ready({"lacking": lacking, "bus_load": drives.bus_load})
        loop.run(Ticker(round(config.period * 1e9)))
        ended_as_told = True
    finally:
        heartbeats.of("loop").rest()  # the drives may take their time to stop
        if drives is not None:
            drives.close()
        for port in (ports.gateway, ports.recorder):
            if ended_as_told:
                port.send(message(Farewell()))
        for port in ports:
            port.close()
    return 0
