"""Memory of a service under floods of messages by users of every role: the growth must be limited and temporary.

The service listens with TLS. A separate process with a valid certificate sends each flood: valid goals that are
refused, junk, messages and attachments of 4 MiB, many ids, many names, silent subscribers, tokens and queriers.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import multiprocessing
import os
import re
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, Final, NamedTuple

import zenoh
from trirail.cli.key_folder import KeyFolder
from trirail.client import own_service
from trirail.client.client import Robot
from trirail.processes.operating_system import processes
from trirail.telemetry.sinks import free_port
from trirail.wire import zenoh_session
from trirail.wire.credentials import Credentials
from trirail.wire.sizes import MAX_MESSAGE, MAX_TRANSPORT

GROWS_BY: Final = 64.0
"""Maximum growth of a process's resident memory during a flood [1e6 bytes]."""
KEEPS: Final = 20.0
"""Maximum growth that remains after the flood [1e6 bytes]."""
RETURNS_WITHIN: Final = 20.0
"""Time limit for the memory to recover after the floods of a user [s]; accepted queries are answered at a limited rate.
"""
SAMPLE_EVERY: Final = 0.05
"""Interval of memory samples [s]."""
RATE_HZ: Final = 100
"""Rate of the service's cycles [Hz]."""
FIRST: Final = 2500
"""Number of small messages before the large messages. It is larger than the service's queue for one user."""
PENDING: Final = 4000
"""Maximum number of unanswered queries of one flood."""
USERS: Final = {"eva": "viewer", "ann": "operator", "max": "maintainer"}
REVOKED: Final = "gone"

LARGE: Final = bytes(MAX_TRANSPORT - 4096)
"""Payload that is nearly as large as the largest message that the transport reassembles."""
REFUSED: Final = json.dumps({"kind": "pose", "x": 9.0, "y": 0.0, "phi": 0.0}).encode()


class Query(NamedTuple):
    """Query that a flood sends."""

    key: str
    payload: bytes | None = None
    attachment: bytes | None = None


def _key(*parts: str) -> str:
    return zenoh_session.key("demo", *parts)


def _behind(small: Query, *large: Query) -> Iterator[Query]:
    """Yield enough small messages to fill the service's queue for one user, and then large messages."""
    yield from itertools.repeat(small, FIRST)
    yield from itertools.cycle(large)


def _named(*parts: str) -> Iterator[str]:
    return (_key(*parts, f"u{number}") for number in itertools.count())


def _goals_of_many_ids() -> Iterator[Query]:
    for number in itertools.count():
        yield Query(_key("goal", "ann"), REFUSED[:-1] + f', "id": "{number:060}"}}'.encode())


def _stops_of_many_ids() -> Iterator[Query]:
    for number in itertools.count():
        yield Query(_key("cmd", "eva", "stop"), b'{"goal": "g"}', f"{number:060}".encode())


QUERIES: Final[dict[str, tuple[str, Callable[[], Iterator[Query]]]]] = {
    "4 MiB to a role": (REVOKED, lambda: _behind(Query(_key("role", "u0")), Query(_key("role", "u0"), LARGE))),
    "4 MiB to many roles": (REVOKED, lambda: (Query(key, LARGE) for key in _named("role"))),
    "roles of many names": (REVOKED, lambda: map(Query, _named("role"))),
    "4 MiB in stops": (
        "eva",
        lambda: _behind(Query(_key("cmd", "eva", "stop")), Query(_key("cmd", "eva", "stop"), LARGE)),
    ),
    "4 MiB attached": (
        "eva",
        lambda: _behind(
            Query(_key("info")), Query(_key("info"), None, LARGE), Query(_key("cmd", "eva", "stop"), None, LARGE)
        ),
    ),
    "stops of many ids": ("eva", _stops_of_many_ids),
    "long selectors": (
        "eva",
        lambda: (Query(f"{_key('info')}?{number}={'a' * 60_000}") for number in itertools.count()),
    ),
    "goals refused": ("ann", lambda: itertools.repeat(Query(_key("goal", "ann"), REFUSED))),
    "goals of many ids": ("ann", _goals_of_many_ids),
    "4 MiB goals": ("ann", lambda: _behind(Query(_key("goal", "ann"), b"junk"), Query(_key("goal", "ann"), LARGE))),
    "largest goals": ("ann", lambda: itertools.repeat(Query(_key("goal", "ann"), b" " * (MAX_MESSAGE - 9)))),
    "poses of many names": ("max", lambda: (Query(key, LARGE[:MAX_MESSAGE]) for key in _named("teach", "max"))),
}


def _silent_subscribers(session: zenoh.Session, over: threading.Event) -> None:
    names = itertools.cycle(("state", "records", "event", "summary"))
    kept: list[Any] = []
    while len(kept) < 500 and not over.wait(0.002):
        kept.append(session.declare_subscriber(_key(next(names)), zenoh.handlers.FifoChannel(1)))
    over.wait()


def _tokens(session: zenoh.Session, over: threading.Event) -> None:
    kept: list[Any] = []
    while not over.wait(0.001):
        kept.append(session.liveliness().declare_token(_key("here", "eva")))


def _queriers(session: zenoh.Session, over: threading.Event) -> None:
    kept: list[Any] = []
    while len(kept) < 2000 and not over.wait(0.001):
        kept.append(session.declare_querier(_key("cmd", "eva", "stop")))
        session.liveliness().get(_key("alive"), timeout=0.1)
    over.wait()


DECLARATIONS: Final[dict[str, tuple[str, Callable[[zenoh.Session, threading.Event], None]]]] = {
    "silent subscribers": ("eva", _silent_subscribers),
    "tokens": ("eva", _tokens),
    "queriers": ("eva", _queriers),
}


FLOODS: Final = dict(sorted((QUERIES | DECLARATIONS).items(), key=lambda flood: flood[1][0]))
"""All floods by name, sorted by user."""


def _send(session: zenoh.Session, over: threading.Event, queries: Iterator[Query]) -> None:
    pending = threading.Semaphore(PENDING)
    for query in queries:
        if over.is_set():
            return
        if pending.acquire(timeout=0.1):
            handler: Any = zenoh.handlers.Callback(lambda _: None, drop=pending.release, indirect=False)
            with contextlib.suppress(zenoh.ZError):  # the service may have closed the connection
                session.get(query.key, handler, payload=query.payload, attachment=query.attachment, timeout=10.0)


def _flood(name: str, locator: str, folder: str, seconds: float) -> None:
    """Send a flood from a separate process: subscribers that never read block Zenoh's threads in the whole process."""
    user, _ = FLOODS[name]
    session = zenoh_session.open_client(locator, Credentials.read(Path(folder, user)))
    over = threading.Event()
    threading.Timer(seconds, over.set).start()
    if name in QUERIES:
        _send(session, over, QUERIES[name][1]())
    else:
        DECLARATIONS[name][1](session, over)
    os._exit(0)  # to close a blocked session would also block


@contextlib.contextmanager
def _service(folder: Path) -> Iterator[tuple[own_service.Process, str, Path]]:
    """Run a service with TLS and a user of each role; yield its process, its locator and the users' folder."""
    keys = KeyFolder(folder / "keys")
    keys.create("demo", ["127.0.0.1"], 10.0)
    for user in (*USERS, REVOKED):
        keys.add(user, 10.0)
    kept = {path: path.read_bytes() for path in (keys.folder / "users" / REVOKED).iterdir()}
    keys.revoke(REVOKED)
    for path, content in kept.items():
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(content)
        path.chmod(0o600)
    config, private = own_service.private(folder)
    locator = f"tls/127.0.0.1:{free_port()}"
    users = "\n".join(f'{user} = "{role}"' for user, role in USERS.items())
    tables = f'"{locator}"]\n[zenoh.tls]\ndirectory = "{keys.folder}"\n[zenoh.users]\n{users}\n'
    text = re.sub(rf'"{re.escape(private)}"\]', lambda _: tables, config.read_text())
    # The recorder stores the last minute of cycles. The rate is low so that mainly the floods make its memory grow.
    config.write_text(re.sub(r"^rate_hz = \d+", f"rate_hz = {RATE_HZ}", text, flags=re.MULTILINE))
    with own_service.service(config, folder / "flood.rrd") as process:
        yield process, locator, keys.folder / "users"


def memory(pids: dict[str, int]) -> dict[str, float]:
    """Return the resident memory of each process [1e6 bytes]."""
    page = os.sysconf("SC_PAGE_SIZE")
    return {name: int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * page / 1e6 for name, pid in pids.items()}


def _most(of: dict[str, float], before: dict[str, float]) -> tuple[float, str]:
    """Return the growth and name of the process that has grown most."""
    return max((held - before[name], name) for name, held in of.items())


def run(seconds: float, only: str = "") -> Iterator[str]:
    """Send each flood for an equal part of the time; print the growth of the memory, and yield failures."""
    names = [name for name in FLOODS if only in name]
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__])
    with tempfile.TemporaryDirectory() as folder, _service(Path(folder)) as (service, locator, users):
        pids = processes(service.pid)
        with Robot("demo", locator, tls=users / "max") as robot:
            robot.enable()
            time.sleep(1.0)  # exclude the memory that the first messages need
            before = memory(pids)
            for user, of_user in itertools.groupby(names, lambda name: FLOODS[name][0]):
                for name in of_user:
                    arguments = name, locator, str(users), seconds / len(names)
                    flood = context.Process(target=_flood, args=arguments, daemon=True)
                    flood.start()
                    yield from _stays(f"{name} by {user}", flood, pids, before)
                yield from _returns(user, pids, before)
            robot.stop()
        if processes(service.pid) != pids:
            yield f"processes have ended: {pids} before, {processes(service.pid)} after"


def _stays(flood: str, sender: BaseProcess, pids: dict[str, int], before: dict[str, float]) -> Iterator[str]:
    """Sample the memory during a flood; yield a failure if a process exceeds the limit."""
    greatest = 0.0, ""
    while sender.is_alive():
        greatest = max(greatest, _most(memory(pids), before))
        sender.join(SAMPLE_EVERY)
    print(f"{flood:32} {greatest[0]:+5.0f} MB ({greatest[1]})")
    if sender.exitcode:
        yield f"{flood}: the flood itself has failed, see above"
    if greatest[0] > GROWS_BY:
        yield f"{flood}: the {greatest[1]} took {greatest[0]:.0f} MB more"


def _returns(user: str, pids: dict[str, int], before: dict[str, float]) -> Iterator[str]:
    """Wait until the memory has recovered after the floods of a user; yield a failure if it does not."""
    ended = time.monotonic()
    while (left := _most(memory(pids), before))[0] > KEEPS and time.monotonic() < ended + RETURNS_WITHIN:
        time.sleep(SAMPLE_EVERY)
    print(f"{'':32} {left[0]:+5.0f} MB ({left[1]}) {time.monotonic() - ended:.1f} s after those of {user}")
    if left[0] > KEEPS:
        yield f"after the floods of {user} the {left[1]} keeps {left[0]:.0f} MB"
