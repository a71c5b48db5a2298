"""The recorder's process: takes what the loop sends and gives it to the recorder."""

from __future__ import annotations

import select
import signal
import time
from collections.abc import Callable
from pathlib import Path

from service.config import Config
from service.links import Closed, Link
from service.packets import Happened, Kind, Situation, Welcome, decode_answer
from service.recorder import Recorder

GATHER = 0.05
"""How long to let packets gather before they are taken: to wake for each costs more than what is in it [s]."""


def main(config: Config, record: str | None, link: Link, ready: Callable[[object], None]) -> int:
    """Record until the loop has gone or the process is told to end."""
    path = Path(record) if record else None
    recorder = Recorder(config, Path(config.telemetry.directory), path=path)
    ending = False

    def end(_signal: int, _frame: object) -> None:
        nonlocal ending
        ending = True

    signal.signal(signal.SIGTERM, end)
    poll = select.poll()
    poll.register(link.fileno(), select.POLLIN)
    try:
        while not ending:
            poll.poll(500)
            time.sleep(GATHER)
            while (packet := link.receive()) is not None:
                content = packet[1:]
                if packet[0] == Kind.RECORDS:
                    recorder.records(content)
                elif packet[0] == Kind.FRAMES:
                    recorder.frames(content)
                else:
                    said = decode_answer(content)
                    if isinstance(said, Happened):
                        recorder.event(said.event)
                    elif isinstance(said, Situation):
                        recorder.target(said.target)
                    elif isinstance(said, Welcome):
                        recorder.bus_load(said.bus_load)
                        ready({"recording": str(recorder.path), "live": recorder.live_url})
    except Closed:
        pass
    finally:
        recorder.close()
    return 0
