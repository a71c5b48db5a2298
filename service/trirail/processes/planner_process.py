"""The planner's process: thinks about one request at a time, beside the loop and never on its processor."""

from __future__ import annotations

import select
from collections.abc import Callable
from pathlib import Path

from trirail.config import Config
from trirail.motion.motion_planner import MotionPlanner
from trirail.processes import realtime
from trirail.processes.heartbeats import BEAT_EVERY, Heart
from trirail.wire import links
from trirail.wire.links import Closed
from trirail.wire.plan_packets import MAX_PLANNING, decode_plan_request, encode


def main(config: Config, path: Path, heart: Heart, ready: Callable[[object], None]) -> int:
    """Answer what the loop asks until the loop has gone. It keeps nothing, so it may be killed at any time."""

    def beat() -> None:
        if serving:  # the first start compiles in its warm-up
            heart.beat()

    serving = False
    planner = MotionPlanner(config, beat)
    planner.warm_up()
    lacking = realtime.stay_beside(config.loop, realtime.PLANNER_BELOW)
    link = links.connect(path, MAX_PLANNING)
    ready({"lacking": lacking})
    poll = select.poll()
    poll.register(link.fileno(), select.POLLIN)
    serving = True
    try:
        while True:
            heart.beat()
            poll.poll(BEAT_EVERY * 1e3)
            newest = None  # nobody waits any more for what was asked before
            while (packet := link.receive()) is not None:
                newest = packet
            if newest is not None:
                link.send(encode(planner.plan(decode_plan_request(newest))))
    except Closed:
        heart.rest()
    return 0
