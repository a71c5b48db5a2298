"""A fleet on one machine: a router, two whole services and robots that stand for whole ones, all with certificates.

What is seen is seen by what `trirail fleet` shows, asked every few milliseconds; the table itself is drawn twice a
second, so that up to half a second more goes by before somebody reads it. Bytes are counted by the kernel on the
router's own connections (TCP_INFO, by `ss`), so that TLS and keep-alives are in them and headers of TCP and IP are not;
processor time is that of the router's process and of a whole service's gateway. `bench_gateways.py` says what the
robots that stand for whole ones have and lack.
"""

from __future__ import annotations

import contextlib
import json as json_format
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import bench_gateways
import numpy as np
import zenoh
from bench_gateways import ROUTER, USER
from trirail.cli.fleet_command import REFRESH
from trirail.cli.key_folder import AUTHORITY_KEY, USERS, KeyFolder
from trirail.client import own_service
from trirail.client.client import Robot
from trirail.client.fleet import Attention, Fleet
from trirail.processes.interpreter import child, python
from trirail.telemetry.sinks import free_port
from trirail.wire import zenoh_session
from trirail.wire.certificates import Pair, issue
from trirail.wire.credentials import AUTHORITY, CERTIFICATE, KEY, Credentials

LOCAL, DAYS = ("127.0.0.1", "localhost"), 2.0
WHOLE = ("whole-1", "whole-2")
PER_PROCESS = 25
"""Robots that one process stands for."""
QUANTILES = (50.0, 99.0, 100.0)
LOOK = 0.005
"""How often it is looked what the fleet shows [s]."""
WITHIN = 60.0
"""After so long without it, what is waited for does not come [s]."""
ROUTER_GONE = 2.0
"""For so long there is no router [s]."""
AIMS = {"fault_seen_s": 2.0, "killed_seen_s": 5.0, "router_back_s": 10.0, "missed_ticks": 0.0, "stop_more_ms": 10.0}
"""What is asked for; the first two with the time until the table is drawn."""


class Net:
    """Certificates, configurations and the router, all in one folder."""

    def __init__(self, folder: Path, standing_in: int) -> None:
        self.folder = folder
        self.port = free_port()
        self.locator = f"tls/127.0.0.1:{self.port}"
        self.keys = folder / "keys"
        self.standing_in = [f"stand-in-{number:03}" for number in range(standing_in)]
        self.robots = [*WHOLE, *self.standing_in]
        KeyFolder(self.keys).create(ROUTER, LOCAL, DAYS)
        by = Pair((self.keys / AUTHORITY).read_bytes(), (self.keys / AUTHORITY_KEY).read_bytes())
        for name in (*self.robots, USER):  # as KeyFolder.add, which waits for the disk with each of so many
            own = issue(by, name, DAYS, LOCAL, serves=name != USER)
            folder_of = self.keys / USERS / name
            folder_of.mkdir(parents=True)
            for file, content in ((AUTHORITY, by.certificate), (CERTIFICATE, own.certificate), (KEY, own.key)):
                (folder_of / file).write_bytes(content)
            (folder_of / KEY).chmod(0o600)
        self._config = folder / "router.toml"
        self._config.write_text(
            f"robots = {json_format.dumps(self.robots)}\n"
            f'[zenoh]\nlisten = ["{self.locator}"]\n[zenoh.tls]\ndirectory = "{self.keys}"\n'
            f'[zenoh.users]\n{USER} = "maintainer"\n'
        )

    def route(self) -> None:
        """Start the router, and wait until it says that it routes."""
        command = python("-u", "-m", "trirail", "router", str(self._config))
        self.router = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        if self.router.stdout is None or not self.router.stdout.readline().startswith("routing"):
            raise SystemExit("the router could not start")

    def kill_router(self) -> None:
        """Kill it with -9."""
        self.router.kill()
        self.router.wait()

    def whole(self, name: str) -> tuple[Path, str]:
        """Write the configuration of a whole service; return it, and where it is reached without the router."""
        folder = self.folder / name
        folder.mkdir()
        path, _ = own_service.private(folder)
        own = f"tls/127.0.0.1:{free_port()}"
        changes = {
            "name": f'"{name}"',
            "listen": f'["{own}"]\nconnect = ["{self.locator}"]\nrouter = "{ROUTER}"',
            "directory": f'"{folder}"',
        }
        text = path.read_text(encoding="utf-8")
        for key, value in changes.items():
            text = re.sub(rf"^{key} = .*$", f"{key} = {value}", text, count=1, flags=re.MULTILINE)
        text += f'\n[zenoh.tls]\ndirectory = "{self.keys}/users/{name}"\n[zenoh.users]\n{USER} = "maintainer"\n'
        path.write_text(text, encoding="utf-8")
        return path, own

    @property
    def user(self) -> Path:
        """Folder of the certificate of who measures."""
        return self.keys / "users" / USER

    def robot(self, name: str, locator: str = "") -> Robot:
        """A client, through the router if nothing else is said."""
        return Robot(name, locator or self.locator, tls=self.user)

    def fleet(self) -> Fleet:
        """What `trirail fleet` shows."""
        return Fleet(self.locator, WHOLE[0], self.user)

    def session(self) -> zenoh.Session:
        """A session through the router."""
        return zenoh_session.open_client(self.locator, Credentials.read(self.user))


@contextlib.contextmanager
def standing_in(net: Net) -> Iterator[None]:
    """The robots that stand for whole ones, in a few processes."""
    program = str(Path(bench_gateways.__file__))
    groups = [net.standing_in[n : n + PER_PROCESS] for n in range(0, len(net.standing_in), PER_PROCESS)]
    processes = [
        subprocess.Popen(
            [sys.executable, program, net.locator, str(net.keys), *names], stdout=subprocess.PIPE, text=True
        )
        for names in groups
    ]
    try:
        for process in processes:
            if process.stdout is None or process.stdout.readline() != "ready\n":
                raise SystemExit("the robots that stand for whole ones could not start")
        yield
    finally:
        for process in processes:
            process.terminate()
        for process in processes:
            process.wait()


class Used(NamedTuple):
    """What has been used since the beginning."""

    received: int
    """By the router, on all its connections [bytes]."""
    sent: int
    """[bytes]."""
    router: float
    """Processor time [s]."""
    gateway: float
    """Likewise, of a whole service's gateway [s]."""


def used(port: int, router: int, gateway: int) -> Used:
    """Look at the router's connections, and at two processes."""
    said = subprocess.run(
        ["ss", "-tniH", "state", "established", f"( sport = :{port} )"], stdout=subprocess.PIPE, text=True, check=True
    ).stdout
    received, sent = (sum(map(int, re.findall(rf"\b{name}:(\d+)", said))) for name in ("bytes_received", "bytes_sent"))
    return Used(received, sent, _processor(router), _processor(gateway))


def _processor(pid: int) -> float:
    tasks = Path(f"/proc/{pid}/task").glob("*/schedstat")  # to the nanosecond; /proc/PID/stat counts 10 ms
    return sum(int(task.read_text(encoding="ascii").split()[0]) for task in tasks) * 1e-9


def wait_for(condition: Callable[[], bool], what: str) -> float:
    """Wait until it holds; return how long that took [s]."""
    began = time.monotonic()
    while not condition():
        if time.monotonic() > began + WITHIN:
            raise SystemExit(f"not within {WITHIN:g} s: {what}")
        time.sleep(LOOK)
    return time.monotonic() - began


def is_seen(fleet: Fleet, robot: str, need: Attention) -> Callable[[], bool]:
    """Whether a robot is shown with this need."""
    return lambda: any(m.robot == robot and m.need(time.monotonic()) is need for m in fleet.members())


def are_heard(fleet: Fleet, number: int, since: float) -> Callable[[], bool]:
    """Whether so many robots were heard since then, none of them silent."""

    def heard() -> bool:
        now = time.monotonic()
        return sum(m.heard > since and m.need(now) is not Attention.SILENT for m in fleet.members()) == number

    return heard


def measure(gateways: int, seconds: float, stops: int, faults: int) -> Iterator[dict[str, Any]]:
    """Measure with so many robots that stand for whole ones, each rate over so many seconds; yield part by part."""
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="trirail-")))
        net = Net(folder, gateways)
        number = len(net.robots)
        yield {"robots": number, "whole": len(WHOLE), "quantiles": QUANTILES}
        net.route()
        stack.callback(net.kill_router)
        _say("two whole services")
        made = [net.whole(name) for name in WHOLE]
        logs = [stack.enter_context((folder / f"{name}.log").open("wb")) for name in WHOLE]
        with ThreadPoolExecutor() as both:
            services = list(both.map(own_service.start, (config for config, _ in made), logs))
        for service in services:
            stack.callback(_end, service)
        direct = [stack.enter_context(net.robot(name, own)) for name, (_, own) in zip(WHOLE, made, strict=True)]
        _say(f"{gateways} robots that stand for whole ones")
        stack.enter_context(standing_in(net))
        yield {"rates": _rates(net, net.router.pid, child(services[0].pid, "gateway"), seconds)}
        with net.fleet() as fleet:
            wait_for(are_heard(fleet, number, 0.0), "all robots heard")
            _say("faults")
            yield {"fault_seen_s": _faults(fleet, direct[0], faults)}
            _say("stops")
            yield _stops(direct[0], net, stops)
            _say("the router gone and back")
            before = _missed(direct, lambda: time.sleep(2.0 * ROUTER_GONE))
            back: list[float] = []
            missed = _missed(direct, lambda: back.append(_without_router(net, fleet)))
            yield {"router_back_s": back[0], "missed_ticks": {"meanwhile": missed, "before": before}}
            _say("a robot killed")
            direct[1].close()
            _kill(services[1])
            yield {"killed_seen_s": wait_for(is_seen(fleet, WHOLE[1], Attention.SILENT), "a killed robot seen silent")}


def _without_router(net: Net, fleet: Fleet) -> float:
    """Kill the router and start it again; return how long after it routes all robots are heard [s]."""
    net.kill_router()
    time.sleep(ROUTER_GONE)
    net.route()
    began = time.monotonic()
    wait_for(are_heard(fleet, len(net.robots), began), "all robots heard after the router came back")
    return time.monotonic() - began


def _say(what: str) -> None:
    print(f"{what} …", file=sys.stderr, flush=True)


def _rates(net: Net, router: int, gateway: int, seconds: float) -> dict[str, Any]:
    """Measure bytes and processor a second while more and more is asked for."""
    found: dict[str, Any] = {}
    number = len(net.robots)

    def over(what: str, watched: int) -> None:
        _say(f"bytes and processor: {what}")
        time.sleep(1.0)  # what is asked for has begun
        before, began = used(net.port, router, gateway), time.monotonic()
        time.sleep(seconds)
        took, after = time.monotonic() - began, used(net.port, router, gateway)
        received, sent, routed, own = ((b - a) / took for a, b in zip(before, after, strict=True))
        found[what] = {
            "robots_watched": watched, "received_per_s": received, "sent_per_s": sent,
            "router_processor": routed, "gateway_processor": own,
        }  # fmt: skip

    over("nobody watches", 0)
    with net.fleet() as fleet:
        wait_for(are_heard(fleet, number, 0.0), "all robots heard")
        over("fleet", number)
    with net.session() as session:
        nothing: zenoh.handlers.Callback[zenoh.Sample] = zenoh.handlers.Callback(lambda _: None, indirect=False)
        for what, robot, key, watched in (
            ("state of one", WHOLE[0], "state", 1),
            ("state of all", "*", "state", number),
            ("records of one", WHOLE[0], "records", 1),
        ):
            with session.declare_subscriber(zenoh_session.key(robot, key), nothing):
                over(what, watched)
    return found


def _faults(fleet: Fleet, robot: Robot, times: int) -> list[float]:
    """Bring a fault about at any time of a second, and look when it is seen; seconds at QUANTILES."""
    took = []
    for number in range(times):
        time.sleep((number * 0.618) % 1.0)
        robot.quick_stop()
        took.append(wait_for(is_seen(fleet, robot.name, Attention.FAULT), "a fault seen"))
        robot.reset()
        wait_for(is_seen(fleet, robot.name, Attention.NOTHING), "a reset seen")
    return _spread(took)


def _stops(direct: Robot, net: Net, times: int) -> dict[str, Any]:
    """Stop a robot that stands, by turns without the router and through it; milliseconds at QUANTILES."""
    took: tuple[list[float], list[float]] = [], []
    direct.enable()
    with net.robot(direct.name) as routed:
        for number in range(times + 5):
            for by, robot in zip(took, (direct, routed), strict=True):
                time.sleep((number * 0.618) % 1.0 * 0.01)  # at any phase of the cycle
                began = time.perf_counter()
                robot.stop()
                if number >= 5:  # what happens once has happened
                    by.append((time.perf_counter() - began) * 1e3)
    direct.disable()
    alone, through = (_spread(by) for by in took)
    return {"stop_direct_ms": alone, "stop_routed_ms": through, "stop_more_ms": through[1] - alone[1]}


def _missed(robots: list[Robot], during: Callable[[], None]) -> int:
    """Return how many ticks the loops miss meanwhile."""
    before = [robot.state().loop.overruns for robot in robots]
    during()
    return sum(robot.state().loop.overruns - count for robot, count in zip(robots, before, strict=True))


def _kill(service: own_service.Process) -> None:
    """Kill all of a service at once, as a machine that loses its power."""
    processes = [service.pid, *(child(service.pid, name) for name in ("gateway", "loop", "recorder", "planner"))]
    for number in (signal.SIGSTOP, signal.SIGKILL):
        for pid in processes:
            os.kill(pid, number)
    service.wait()


def _end(service: own_service.Process) -> None:
    if service.poll() is None:
        own_service.end(service)


def _spread(values: list[float]) -> list[float]:
    return [float(value) for value in np.percentile(values, QUANTILES)]


def main(gateways: int, seconds: float, stops: int, faults: int, json: bool = False) -> None:
    """Measure and print, each part when it has been measured."""
    told: dict[str, Any] = {}
    for part in measure(gateways, seconds, stops, faults):
        told |= part
        if not json:
            _show(part, told["robots"])
    if json:
        print(json_format.dumps(told))


def _show(part: dict[str, Any], robots: int) -> None:
    match part:
        case {"whole": whole}:
            print(
                f"{robots} robots behind a router on this machine, all with certificates: {whole} whole services, and "
                f"{robots - whole} sessions\nthat publish what a gateway publishes, as often, of a canned loop"
            )
        case {"rates": rates}:
            _show_rates(rates, robots)
        case {"fault_seen_s": took}:
            _against("a fault is seen, at worst, the table drawn [s]", took[-1] + REFRESH, "fault_seen_s")
        case {"stop_direct_ms": direct, "stop_routed_ms": routed, "stop_more_ms": more}:
            for name, took in (("direct", direct), ("through the router", routed)):
                print(f"a stop {name}: " + " / ".join(f"{value:.2f}" for value in took) + " ms (p50 / p99 / max)")
            _against("a stop through the router, more, p99 [ms]", more, "stop_more_ms")
        case {"router_back_s": back, "missed_ticks": missed}:
            _against("the router back: all robots heard [s]", back, "router_back_s")
            without = f"ticks missed meanwhile ({missed['before']} in {2.0 * ROUTER_GONE:g} s before)"
            _against(without, missed["meanwhile"], "missed_ticks")
        case {"killed_seen_s": took}:
            _against("a robot killed is seen, the table drawn [s]", took + REFRESH, "killed_seen_s")
    sys.stdout.flush()


def _show_rates(rates: dict[str, dict[str, float]], robots: int) -> None:
    print(f"\n{'a second':18}{'to the router':>16}{'from the router':>18}{'router':>14}{'a gateway':>14}")
    for what, rate in rates.items():
        print(
            f"{what:18}{rate['received_per_s']:>14.0f} B{rate['sent_per_s']:>16.0f} B"
            f"{rate['router_processor'] * 1e3:>11.1f} ms{rate['gateway_processor'] * 1e3:>11.1f} ms"
        )
    idle, fleet = rates["nobody watches"], rates["fleet"]
    print(
        f"a robot, fleet watched: {fleet['received_per_s'] / robots:.0f} B/s to the router "
        f"({idle['received_per_s'] / robots:.0f} of them whoever watches), "
        f"{(fleet['sent_per_s'] - idle['sent_per_s']) / robots:.0f} B/s to who watches, "
        f"{fleet['router_processor'] / robots * 1e6:.0f} µs/s of the router's processor "
        f"({idle['router_processor'] / robots * 1e6:.0f} whoever watches)\n"
    )


def _against(what: str, measured: float, aim: str) -> None:
    print(f"{what:52}{measured:>10.3g}   aim {AIMS[aim]:g}: {'met' if measured <= AIMS[aim] else 'NOT MET'}")
