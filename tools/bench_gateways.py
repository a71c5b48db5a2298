"""Robots that stand for whole ones behind a router: python tools/bench_gateways.py LOCATOR KEYS ROBOT…

A hundred whole services are too many for one machine. Of each robot named this has what the router sees: a session of
its own as the gateway's guard opens it, with the robot's certificate from the folder KEYS; all that the gateway listens
to (nobody answers); and all that it publishes, as often: state, records and summary, of a loop that is canned. What is
left out is the loop, and what the gateway makes of its records. It says "ready" on standard output, and goes on until
SIGTERM.
"""

from __future__ import annotations

import signal
import sys
import time
from pathlib import Path

import msgspec
import numpy as np
import zenoh
from trirail.config import SIM, Config, Tls, Zenoh, load
from trirail.processes.gateway import SUMMARY_EVERY
from trirail.processes.guard import Guard
from trirail.processes.inbox import Inbox
from trirail.processes.publications import Publications
from trirail.processes.reports import BATCHES_PER_SECOND
from trirail.processes.state import StateMaker
from trirail.telemetry.sinks import free_port
from trirail.wire.records import DTYPE
from trirail.wire.state import summary_of

ROUTER, USER = "hub", "ann"
"""Names in the certificates of the router, and of who measures."""


def behind(robot: str, locator: str, keys: Path) -> Zenoh:
    """Return [zenoh] of a robot that dials the router, and listens to USER beside it."""
    return Zenoh(
        listen=(f"tls/127.0.0.1:{free_port()}",),
        connect=(locator,),
        router=ROUTER,
        tls=Tls(str(keys / "users" / robot)),
    )


class StandIn:
    """One robot: everything that a gateway publishes, of the same records again and again."""

    def __init__(self, config: Config) -> None:
        batch = np.zeros(config.loop.rate_hz // BATCHES_PER_SECOND, dtype=DTYPE)
        batch["cycle"] = np.arange(1, len(batch) + 1)
        states = StateMaker(config)
        states.records(batch)
        self._batch, self._state = batch.tobytes(), states.newest()
        self._summary = summary_of(self._state, 0.0, "canned")
        self._session = Guard(config).open()
        self._publications = Publications(self._session, config.robot.name)
        self._inbox = Inbox(self._session, config.robot.name, lambda _: None)
        self._inbox.declare()

    def publish(self, summary: bool) -> None:
        """Publish what one batch of the loop leads to."""
        self._publications.records(self._batch)
        self._publications.state(self._state)
        if summary:
            self._publications.summary(self._summary)
        for _ in self._inbox.take(64):  # else it would fill
            pass


def main(locator: str, keys: Path, names: list[str]) -> None:
    """Stand for these robots."""
    zenoh.init_log_from_env_or("off")
    config = load(SIM)
    made = []
    for name in names:
        own = msgspec.structs.replace(config.robot, name=name)
        made.append(StandIn(msgspec.structs.replace(config, robot=own, zenoh=behind(name, locator, keys))))
    print("ready", flush=True)
    ending: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, _: ending.append(number))
    batches_per_summary = round(SUMMARY_EVERY * BATCHES_PER_SECOND)
    due, turn = time.monotonic(), 0
    while not ending:
        for number, each in enumerate(made):  # each in its own turn, as robots that know nothing of each other
            each.publish(summary=(turn + number) % batches_per_summary == 0)
        turn += 1
        due = max(due + 1.0 / BATCHES_PER_SECOND, time.monotonic() - 1.0)
        time.sleep(max(0.0, due - time.monotonic()))


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), sys.argv[3:])
