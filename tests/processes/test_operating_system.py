"""What systemd is told, and what its unit allows: fed only by what is alive, hardened, real-time rights kept."""

from __future__ import annotations

import contextlib
import os
import shutil
import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from rigs import Clock
from trirail.processes.heartbeats import PROCESSES, Heartbeats
from trirail.processes.operating_system import FEEDS, Watchdog, notify
from trirail.processes.supervisor import WATCHED_BY_SYSTEMD

UNIT = Path(__file__).parents[2] / "configs" / "trirail.service"


@pytest.fixture
def told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        listening.bind(str(tmp_path / "notify"))
        listening.setblocking(False)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        yield listening


def feedings(told: socket.socket) -> int:
    number = 0
    while True:
        try:
            assert told.recv(100) == b"WATCHDOG=1"
        except BlockingIOError:
            return number
        number += 1


def turns(watchdog: Watchdog, clock: Clock, seconds: float, *beating: str, of: Heartbeats) -> None:
    for _ in range(round(seconds / 0.1)):
        clock.now += 0.1
        for name in beating:
            of.heart(name).beat()
        watchdog.feed()


def watchdog_of(hearts: Heartbeats, clock: Clock, **environment: str) -> Watchdog:
    return Watchdog([hearts.heart(name) for name in WATCHED_BY_SYSTEMD], environment, clock)


def test_it_is_fed_several_times_within_its_time(told: socket.socket) -> None:
    hearts, clock = Heartbeats.create(), Clock()
    watchdog = watchdog_of(hearts, clock, WATCHDOG_USEC="20000000", WATCHDOG_PID=str(os.getpid()))
    fed = 0
    for _ in range(10):
        turns(watchdog, clock, 10.0, *PROCESSES, of=hearts)
        fed += feedings(told)
    assert FEEDS * 5 - 1 <= fed <= FEEDS * 5 + 1


@pytest.mark.parametrize("alive", [(), ("loop",), ("gateway",), ("loop", "planner")])
def test_it_starves_unless_both_are_alive(told: socket.socket, alive: tuple[str, ...]) -> None:
    hearts, clock = Heartbeats.create(), Clock()
    watchdog = watchdog_of(hearts, clock, WATCHDOG_USEC="1000000")
    turns(watchdog, clock, 2.0, *PROCESSES, of=hearts)
    assert feedings(told) > 0
    turns(watchdog, clock, 5.0, *alive, of=hearts)
    assert feedings(told) <= 1  # for the beats since the last time
    turns(watchdog, clock, 1.0, *PROCESSES, of=hearts)
    assert feedings(told) > 0


@pytest.mark.parametrize(
    "environment", [{}, {"WATCHDOG_USEC": "1000000", "WATCHDOG_PID": "1"}, {"WATCHDOG_USEC": "soon"}]
)
def test_nothing_is_fed_that_is_not_there(told: socket.socket, environment: dict[str, str]) -> None:
    hearts, clock = Heartbeats.create(), Clock()
    turns(watchdog_of(hearts, clock, **environment), clock, 5.0, *PROCESSES, of=hearts)
    assert feedings(told) == 0


def test_a_systemd_that_does_not_read_is_not_waited_for(told: socket.socket) -> None:
    while True:  # until the kernel takes no more
        notify("WATCHDOG=1")
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as full, contextlib.suppress(BlockingIOError):
            full.setblocking(False)
            full.connect(os.environ["NOTIFY_SOCKET"])
            full.send(b"WATCHDOG=1")
            continue
        break
    notify("WATCHDOG=1")  # and it comes back
    assert feedings(told) > 0


def test_the_unit_keeps_the_loops_rights_and_has_a_watchdog() -> None:
    settings = dict(
        line.split("=", 1) for line in UNIT.read_text().splitlines() if "=" in line and not line.startswith("#")
    )
    assert settings["LimitRTPRIO"] == "99"
    assert settings["LimitMEMLOCK"] == "infinity"
    assert {"RestrictRealtime", "MemoryDenyWriteExecute", "PrivateNetwork"}.isdisjoint(settings)
    assert "AF_CAN" in settings["RestrictAddressFamilies"]
    assert int(settings["WatchdogSec"]) < int(settings["TimeoutStopSec"])


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="needs systemd-analyze: .ci/packages installs it")
def test_the_unit_is_hardened() -> None:
    judged = subprocess.run(
        ["systemd-analyze", "security", "--offline=true", "--threshold=40", "--no-pager", str(UNIT)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert judged.returncode == 0, judged.stdout[-200:]


def test_the_unit_names_each_key_whose_address_it_may_block() -> None:
    comment = UNIT.read_text().split("IPAddressDeny=")[0].rpartition("\nPrivateDevices=")[2]
    for key in ("zenoh.listen", "zenoh.connect", "telemetry.metrics_address", "can.options"):
        assert key in comment
