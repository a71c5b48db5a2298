"""The recorder's process: takes what the loop sends and gives it to the recorder and to the black box."""

from __future__ import annotations

import contextlib
import select
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

from service.blackbox import BlackBox
from service.config import Config
from service.links import Closed, Link
from service.packets import Answer, Happened, Input, Kind, Remark, Situation, Welcome, decode_answer, message
from service.recorder import Recorder

GATHER = 0.05
"""How long to let packets gather before they are taken: to wake for each costs more than what is in it [s]."""


def main(config: Config, record: str | None, link: Link, ready: Callable[[object], None]) -> int:
    """Record until the loop has gone or the process is told to end."""

    def warn(words: str) -> None:
        print(f"trirail: recorder: {words}", file=sys.stderr, flush=True)  # noqa: T201 - the service's log
        with contextlib.suppress(Closed):  # then nobody is left to be told
            link.send(message(Remark("warning", words)))

    path = Path(record) if record else None
    recorder = Recorder(config, Path(config.telemetry.directory), path=path, warn=warn)
    folder = recorder.path.parent
    box = BlackBox(config.loop.rate_hz, lambda name: Recorder(config, folder, name=name, live=False), warn)
    ending = False

    def end(_signal: int, _frame: object) -> None:
        nonlocal ending
        ending = True

    def take(said: Answer) -> None:
        match said:
            case Happened(event):
                recorder.event(event)
                box.event(event)
            case Input():
                recorder.given(said)
                box.given(said)
            case Situation():
                recorder.target(said.target)
                box.stands("target", said.target)
            case Welcome():
                recorder.bus_load(said.bus_load)
                box.stands("bus_load", said.bus_load)
                ready({"recording": str(recorder.path), "live": recorder.live_url})

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
                    box.records(content)
                elif packet[0] == Kind.FRAMES:
                    recorder.frames(content)
                else:
                    take(decode_answer(content))
    except Closed:
        pass
    finally:
        recorder.close()
        box.close()
    return 0
