"""Flood every port of a service with junk for a number of seconds, and check that the service keeps working.

There are two hundred client sessions: most send invalid messages, and twenty subscribe and never read. Many TCP
connections to the ports of Zenoh, of Rerun and of the operator's page stay half open. At the same time, a user moves
the robot and stops it. Afterwards the same processes must be alive, the robot must move to a goal, the page must be
served, and the growth of the log must be limited. Then users of every role flood a service one after the other, and the
memory of the service must stay limited.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import json
import logging
import math
import multiprocessing
import os
import random
import socket
import subprocess
import sys
import tempfile
import threading
import time
import urllib.parse
import urllib.request
from collections import Counter
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from typing import NamedTuple

import flood_memory
import zenoh
from flood_memory import memory
from interruption import interrupt_on_signals
from trirail.client import own_service
from trirail.client.client import Robot
from trirail.errors import RefusedError, ServiceError, TrirailError
from trirail.processes.operating_system import processes, python
from trirail.telemetry.sinks import free_port
from trirail.wire import boundary, zenoh_session
from trirail.wire.sizes import MAX_MESSAGE

SESSIONS = 200
DEAF = 20
"""Number of sessions that subscribe to everything and never read."""
HALF_OPEN = 150
"""Number of TCP connections to each port that send nothing or junk."""
SENDERS = 4
PENDING = 200
"""Maximum number of unanswered queries of one sender."""
GROWS_BY_MB = 128.0
"""Maximum growth of a process's memory because of all sessions and, in the recorder, a minute of cycles [1e6 bytes]."""
SAMPLES = 10
"""Number of memory samples during the flood."""
LOG_BYTES, LOG_BYTES_A_SECOND = 100_000, 300
"""Maximum growth of the log [bytes, bytes/s]: a burst of lines, and then one or two lines per second."""
STOP_WITHIN = 5.0
"""Time limit for the answer to a stop, on a machine that is busy with the flood [s]."""

ODD = ("\x1b[2J", "\u202e", "\0", "\n", "[/]", "\ue000", "😀", "'", "`", "%s", "{}")
NUMBERS = (0.0, -0.0, 1e-310, 1e-17, 0.5, 1.0, 1e17, 1e300, -1e300)


class Message(NamedTuple):
    """Message that is sent by a Zenoh query or put."""

    key: str
    payload: bytes
    encoding: str | None = None


def _goal(rnd: random.Random, **fields: object) -> bytes:
    goal = {"kind": "pose", "x": rnd.choice((9.0, 1e300)), "y": rnd.choice(NUMBERS), "phi": 0.0} | fields
    return json.dumps(goal).encode()


def _trajectory(points: int) -> bytes:
    listed = [{"t": n, "x": 9.0, "y": 0.0, "phi": 0.0} for n in range(points)]
    return json.dumps({"kind": "trajectory", "points": listed}).encode()


def _key(*parts: str) -> str:
    return zenoh_session.key("demo", *parts)


JUNK: dict[str, Callable[[random.Random], Message]] = {
    "bytes": lambda rnd: Message(_key("goal", "eve"), rnd.randbytes(rnd.randrange(200))),
    "packed bytes": lambda rnd: Message(_key("goal", "eve"), rnd.randbytes(50), boundary.MSGPACK),
    "nested": lambda rnd: Message(_key("goal", "eve"), rnd.choice((b'{"a":', b"[", b'{"kind":')) * rnd.randrange(9000)),
    "nested, packed": lambda rnd: Message(_key("goal", "eve"), b"\x91" * rnd.randrange(9000), boundary.MSGPACK),
    "numbers": lambda rnd: Message(_key("goal", "eve"), _goal(rnd, speed=rnd.choice(NUMBERS), blend=1e-320)),
    "fields": lambda rnd: Message(_key("goal", "eve"), _goal(rnd, **{rnd.choice(ODD) * 9: rnd.choice(ODD)})),
    "ids": lambda rnd: Message(_key("goal", "eve"), _goal(rnd, id=rnd.choice(ODD) * rnd.randrange(90))),
    "users": lambda rnd: Message(_key("goal", rnd.choice("ü x%") * rnd.choice((1, 65, 3000))), _goal(rnd)),
    "too large": lambda rnd: Message(_key("goal", "eve"), bytes(rnd.randrange(MAX_MESSAGE, 2 * MAX_MESSAGE))),
    "encodings": lambda rnd: Message(_key("goal", "eve"), _goal(rnd), rnd.choice(("image/png", "a/b;c", "zenoh/x"))),
    "wildcards": lambda rnd: Message(rnd.choice(("**", "trirail/**", _key("**"), _key("goal", "*"))), _goal(rnd)),
    "commands": lambda rnd: Message(_key("cmd", "eve", rnd.choice(("dance", "override", "pause"))), rnd.randbytes(9)),
    "states": lambda rnd: Message(_key(rnd.choice(("state", "event", "records"))), rnd.randbytes(rnd.randrange(3000))),
    "info": lambda rnd: Message(_key("info"), rnd.randbytes(rnd.randrange(3000))),
    "trajectories": lambda rnd: Message(_key("goal", "eve"), _trajectory(rnd.randrange(500))),
    "duplicates": lambda rnd: Message(_key("goal", "eve"), _goal(rnd, x=9.0, id="same")),
}


class Flood:
    """Context in which threads send junk to a service."""

    def __init__(self, locator: str, ports: tuple[int, ...], rate: float) -> None:
        self.sent: Counter[str] = Counter()
        self.answered = 0
        self._locator = locator
        self._ports = ports
        self._pause = SENDERS / rate
        self._over = threading.Event()
        self._threads: list[threading.Thread] = []

    def __enter__(self) -> Flood:
        sessions = [zenoh_session.open_client(self._locator) for _ in range(SESSIONS - DEAF)]
        share = len(sessions) // SENDERS
        for number in range(SENDERS):
            own = sessions[number * share :][:share]
            self._begin(lambda own=own, number=number: self._send(own, random.Random(number)))  # type: ignore[misc]
        for port in self._ports:
            self._begin(lambda port=port: self._half_open(port, random.Random(port)))  # type: ignore[misc]
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        for thread in self._threads:
            thread.join()

    def _begin(self, what: Callable[[], None]) -> None:
        thread = threading.Thread(target=what, daemon=True)
        thread.start()
        self._threads.append(thread)

    def _send(self, sessions: list[zenoh.Session], rnd: random.Random) -> None:
        pending = threading.Semaphore(PENDING)

        def over(_: zenoh.Reply) -> None:
            self.answered += 1

        for one in itertools.cycle(sessions):
            kind, make = rnd.choice(list(JUNK.items()))
            key, payload, encoding = make(rnd)
            with contextlib.suppress(zenoh.ZError):  # the service may have closed the connection
                if kind == "states" or rnd.random() < 0.3:
                    one.put(key, payload, encoding=encoding)
                    self.sent[kind] += 1
                elif pending.acquire(timeout=5.0):
                    handler = zenoh.handlers.Callback(over, drop=pending.release, indirect=False)
                    one.get(key, handler, payload=payload, encoding=encoding, timeout=5.0)
                    self.sent[kind] += 1
            if self._over.wait(self._pause):
                return

    def _half_open(self, port: int, rnd: random.Random) -> None:
        kept: list[socket.socket] = []
        while not self._over.wait(0.02):
            with contextlib.suppress(OSError):
                connection = socket.create_connection(("127.0.0.1", port), timeout=1.0)
                kept.append(connection)
                connection.setblocking(False)
                connection.send(
                    rnd.choice((b"", b"\0", rnd.randbytes(900), b"GET / HTTP/1.1\r\n", b"PRI * HTTP/2.0\r\n"))
                )
                self.sent["connections"] += 1
            while len(kept) > HALF_OPEN:
                kept.pop(rnd.randrange(len(kept))).close()
        for connection in kept:
            connection.close()


def _flood(locator: str, ports: tuple[int, ...], rate: float, seconds: float, deaf: bool, results: Connection) -> None:
    """Flood a service from a separate process: sessions that never read block Zenoh's threads in the whole process."""
    if deaf:
        kept = [zenoh_session.open_client(locator) for _ in range(DEAF)]
        subscribed = [one.declare_subscriber("trirail/**", zenoh.handlers.FifoChannel(1)) for one in kept]
        time.sleep(seconds)
        results.send((Counter({"deaf": len(subscribed)}), 0))
        os._exit(0)  # to close a blocked session would also block
    flood = Flood(locator, ports, rate)
    with flood:
        time.sleep(seconds)
    results.send((flood.sent, flood.answered))
    os._exit(0)


def _received(results: Connection) -> Iterator[tuple[Counter[str], int]]:
    """Yield the counts of messages and answers that processes send, until all these processes have ended."""
    with contextlib.suppress(EOFError):
        while True:
            yield results.recv()


@contextlib.contextmanager
def sampled(pids: dict[str, int], every: float) -> Iterator[list[dict[str, float]]]:
    """Sample the memory of processes at the interval `every` [s]; yield the list of samples."""
    samples: list[dict[str, float]] = []
    over = threading.Event()

    def sample() -> None:
        while not over.wait(every):
            with contextlib.suppress(OSError):  # a process that has ended is reported elsewhere
                samples.append(memory(pids))

    thread = threading.Thread(target=sample, daemon=True)
    thread.start()
    try:
        yield samples
    finally:
        over.set()
        thread.join()


@contextlib.contextmanager
def private_service(folder: Path) -> Iterator[tuple[own_service.Process, str, tuple[int, ...]]]:
    """Run a service on unused TCP ports; yield its process, its locator and the ports."""
    zenoh_port, live_port = free_port(), free_port()
    config, private = own_service.private(folder, live_port)
    locator = f"tcp/127.0.0.1:{zenoh_port}"
    config.write_text(config.read_text().replace(private, locator))
    with own_service.service(config, folder / "flood.rrd") as process:
        yield process, locator, (zenoh_port, live_port)


@contextlib.contextmanager
def operators_page(locator: str) -> Iterator[str]:
    """Serve the operator's page from a separate process; yield its address."""
    command = python("-m", "trirail", "panel", "--port", "0", "--robot", "demo", "--connect", locator, "--json")
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            line = process.stdout.readline() if process.stdout else ""
            yield json.loads(line)["url"]
        finally:
            process.terminate()


def use(locator: str, seconds: float) -> tuple[int, list[float]]:
    """Connect, move the robot and stop it repeatedly, like a user.

    Return the number of accepted goals and the time until each stop was answered [s].
    """
    ends, accepted = time.monotonic() + seconds, 0
    stops: list[float] = []
    for number in itertools.count():
        if time.monotonic() >= ends:
            break
        asked = math.inf
        with contextlib.suppress(ServiceError), Robot("demo", locator, user="ann") as robot:
            with contextlib.suppress(RefusedError):
                robot.move_to(x=0.02 * (number % 2), y=0.0, phi=0.0)
                accepted += 1
            asked = time.monotonic()
            with contextlib.suppress(RefusedError):
                robot.stop()
            asked -= time.monotonic()
        stops.append(abs(asked))
        time.sleep(0.1)
    return accepted, stops


def run(seconds: float, rate: float) -> list[str]:
    """Flood a service for `seconds`; print the results and return the failures."""
    with (
        tempfile.TemporaryDirectory() as name,
        private_service(Path(name)) as (service, locator, ports),
        operators_page(locator) as page,
    ):
        pids = processes(service.pid)
        flooded = (*ports, urllib.parse.urlsplit(page).port or 0)
        with Robot("demo", locator, user="ann") as robot:
            robot.enable()
            before = memory(pids)
            context = multiprocessing.get_context("spawn")
            heard, sender = context.Pipe(duplex=False)
            floods = [
                context.Process(target=_flood, args=(locator, flooded, rate, seconds, deaf, sender), daemon=True)
                for deaf in (False, True)
            ]
            for one in floods:
                one.start()
            sender.close()  # the floods have the only other copies: `heard` ends with them
            with sampled(pids, seconds / SAMPLES) as samples:
                accepted, stops = use(locator, seconds)
            counts = list(_received(heard))
            for one in floods:
                one.join()
            if len(counts) < len(floods):
                return ["a process of the flood has failed, see above"]
            sent, answered = max(counts, key=lambda counted: sum(counted[0].values()))
            after = memory(pids)
            print(f"{sum(sent.values())} messages of {len(sent)} kinds in {seconds:g} s, {answered} answers")
            print(f"{accepted} goals taken, {len(stops)} stops, the slowest answered in {max(stops):.2f} s")
            for process in pids:
                meanwhile = " ".join(f"{sample[process]:.0f}" for sample in samples)
                print(f"{process:12}{before[process]:5.0f} MB before, {meanwhile}, {after[process]:.0f} after")
            unheard = [] if answered else ["the service has answered no message of the flood"]
            failures = _failures(robot, service.pid, pids, before, after, stops, seconds)
            return [*unheard, *failures, *_page_failures(page)]


def _failures(
    robot: Robot,
    service: int,
    pids: dict[str, int],
    before: dict[str, float],
    after: dict[str, float],
    stops: list[float],
    seconds: float,
) -> Iterator[str]:
    if processes(service) != pids:
        yield f"processes have ended: {pids} before, {processes(service)} after"
    if max(stops) > STOP_WITHIN:
        yield f"a stop was answered after {max(stops):.1f} s"
    for name, held in after.items():
        if held > before[name] + GROWS_BY_MB:
            yield f"the {name} took {held - before[name]:.0f} MB more"
    size = os.stat(f"/proc/{service}/fd/1").st_size
    print(f"{size} bytes of log")
    if size > LOG_BYTES + seconds * LOG_BYTES_A_SECOND:
        yield f"the log has {size} bytes"
    try:
        result = robot.move_to(x=0.03, y=0.01, phi=0.1).wait(20.0)
        if result.outcome != "done":
            yield f"the robot did not move: {result.message}"
    except (TrirailError, TimeoutError) as error:
        yield f"the robot does not move: {error}"


def _page_failures(page: str) -> Iterator[str]:
    try:
        with urllib.request.urlopen(page, timeout=20.0) as answer:
            if b"STOP" not in answer.read():
                yield "the operator's page is another one"
    except OSError as error:
        yield f"the operator's page is not served: {error}"


def main() -> int:
    """Run as the command line specifies; return the exit code, which is 1 after a failure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("seconds", type=float)
    parser.add_argument("--rate", type=float, default=3000.0, help="messages a second at most, of all sessions")
    arguments = parser.parse_args()
    interrupt_on_signals()
    logging.getLogger("trirail").disabled = True  # every client would log skipped messages
    try:
        failures = run(arguments.seconds / 2, arguments.rate)
        failures += flood_memory.run(arguments.seconds / 4)  # recovery takes as long again
    except KeyboardInterrupt:
        print("interrupted")
        return 130
    for failure in failures:
        print(f"does not hold: {failure}")
    print("held" if not failures else "did not hold")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
