"""A whole service as who watches it sees it: health while processes die and freeze, and Prometheus's own scrape."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import time
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from ports import free_port
from processes.test_service import Service, wait_readable
from trirail.config import SIM
from waiting import WITHIN

pytestmark = pytest.mark.slow


DIGITAL = """
[outputs.valve]
drive = "A"
bit = 16

[inputs.part]
drive = "B"
bit = 16
"""


class Watched(Service):
    """A service with metrics."""

    def __init__(self, folder: Path) -> None:
        self.url = f"http://127.0.0.1:{(port := free_port())}"
        super().__init__(
            folder,
            **{
                "state_hz = 50": f"state_hz = 50\nmetrics_port = {port}",
                "\n[telemetry]\n": DIGITAL + "\n[telemetry]\n",
            },
        )

    def health(self) -> dict[str, str]:
        """What is wrong, by process."""
        try:
            with urllib.request.urlopen(f"{self.url}/healthz", timeout=WITHIN) as answer:
                body = answer.read()
        except urllib.error.HTTPError as error:
            body = error.read()
        said = json.loads(body)
        wrong = {name: trouble for name, trouble in said["processes"].items() if trouble != "ok"}
        assert said["ok"] == (not wrong)
        return wrong

    def wait_health(self, condition: Callable[[dict[str, str]], bool]) -> dict[str, str]:
        """Look until something holds; fails where it does not in time."""
        deadline = time.monotonic() + WITHIN
        while not condition(health := self.health()):
            assert time.monotonic() < deadline, health
            wait_readable(self.process, 0.05)
        return health

    def metrics(self) -> dict[str, float]:
        with urllib.request.urlopen(f"{self.url}/metrics", timeout=WITHIN) as answer:
            lines = answer.read().decode().splitlines()
        return {name: float(value) for line in lines if line[0] != "#" for name, value in [line.rsplit(" ", 1)]}

    def restarts(self) -> dict[str, float]:
        """How often each process was started again."""
        found = (
            (re.fullmatch(r'trirail_process_restarts_total{process="(.*)"}', name), n)
            for name, n in self.metrics().items()
        )
        return {match[1]: number for match, number in found if match}


@pytest.fixture
def service(tmp_path: Path) -> Iterator[Watched]:
    with Watched(tmp_path) as made:
        made.wait_up()
        yield made


@pytest.fixture(scope="module")
def lasting(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Watched]:
    """The service of those tests after which it goes on."""
    with Watched(tmp_path_factory.mktemp("watched")) as made:
        made.wait_up()
        yield made


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP], ids=["killed", "frozen"])
@pytest.mark.parametrize("name", ["gateway", "planner", "recorder"])
def test_a_process_that_goes_and_comes_back_is_counted_and_nobody_else_is_red(
    lasting: Watched, name: str, number: int
) -> None:
    """A process that was killed is back before most who ask notice: then it is the counter that tells."""
    lasting.wait_health(lambda wrong: not wrong)
    before, red = lasting.restarts(), set[str]()
    os.kill(lasting.child(name), number)
    deadline = time.monotonic() + WITHIN
    while lasting.restarts()[name] == before[name]:
        assert time.monotonic() < deadline
        red.update(lasting.health())
        wait_readable(lasting.process, 0.02)
    lasting.wait_health(lambda wrong: not wrong)
    assert red <= {name}
    assert lasting.restarts() == before | {name: before[name] + 1.0}, lasting.log.read_text()


@pytest.mark.parametrize("name", ["gateway", "planner", "recorder"])
def test_health_is_red_while_a_process_is_away_and_says_which(lasting: Watched, name: str) -> None:
    lasting.wait_health(lambda wrong: not wrong)
    processes = lasting.processes()
    os.kill(processes["fork-server"], signal.SIGSTOP)  # so that nobody brings it back
    try:
        os.kill(processes[name], signal.SIGKILL)
        assert list(lasting.wait_health(bool)) == [name]
    finally:
        os.kill(processes["fork-server"], signal.SIGCONT)
    lasting.wait_health(lambda wrong: not wrong)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP], ids=["killed", "frozen"])
def test_health_ends_red_with_the_loop(service: Watched, number: int) -> None:
    service.wait_health(lambda wrong: not wrong)
    recorder = service.child("recorder")
    os.kill(recorder, signal.SIGSTOP)  # its end is waited for, and meanwhile whoever asks is answered
    os.kill(service.child("loop"), number)
    service.wait_health(lambda wrong: "loop" in wrong)
    os.kill(recorder, signal.SIGCONT)
    assert service.process.wait(WITHIN) == 1
    with pytest.raises(OSError, match="refused"):
        service.health()


def test_what_the_robot_does_is_counted(service: Watched) -> None:
    with service.robot() as robot:
        robot.enable()
        assert robot.move_to(x=0.01, y=0.0, phi=0.0).wait(WITHIN).outcome == "done"
        robot.quick_stop()

    def counted() -> bool:
        found = service.metrics()
        return (
            found.get('trirail_goals_total{outcome="done"}') == 1.0
            and found.get('trirail_faults_total{cause="quick_stop",code="",drive=""}') == 1.0
            and found.get('trirail_mode{mode="fault"}') == 1.0
        )

    deadline = time.monotonic() + WITHIN
    while not counted() and time.monotonic() < deadline:
        wait_readable(service.process, 0.1)
    found = service.metrics()
    assert counted(), found
    cycles = found["trirail_loop_cycles_total"]
    assert 0.0 < found["trirail_loop_lateness_seconds_count"] <= cycles
    assert found["trirail_goal_settle_seconds_count"] == 1.0
    assert found['trirail_process_resident_memory_bytes{process="loop"}'] > 1e6
    assert 0.0 < found['trirail_can_load_ratio{kind="measured"}'] < 1.0


@pytest.mark.skipif(shutil.which("prometheus") is None, reason="prometheus is not installed: make ci-packages")
def test_prometheus_scrapes_it(service: Watched, tmp_path: Path) -> None:
    configured = (SIM.parent / "prometheus.yml").read_text()
    target = service.url.removeprefix("http://")
    assert "127.0.0.1:9464" in configured
    (tmp_path / "prometheus.yml").write_text(
        configured.replace("127.0.0.1:9464", target).replace("scrape_interval: 5s", "scrape_interval: 1s")
    )
    address = f"127.0.0.1:{free_port()}"
    command = ["prometheus", f"--config.file={tmp_path}/prometheus.yml", f"--storage.tsdb.path={tmp_path}/data",
               f"--web.listen-address={address}"]  # fmt: skip
    with (tmp_path / "prometheus.log").open("wb") as log:
        prometheus = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT)
    try:
        deadline = time.monotonic() + WITHIN
        while not (found := _asked(address, "trirail_loop_cycles_total > 0")) and time.monotonic() < deadline:
            wait_readable(prometheus, 0.5)
        assert found, (tmp_path / "prometheus.log").read_text()
        with service.robot() as robot:  # what there is to see of goals and faults
            robot.enable()
            assert robot.move_to(x=0.01, y=0.0, phi=0.0).wait(WITHIN).outcome == "done"
            robot.quick_stop()
        dashboard = json.loads((SIM.parent / "grafana.json").read_text())
        queries = [query["expr"] for panel in dashboard["panels"] for query in panel["targets"]]
        expressions = [each.replace("$__rate_interval", "1m").replace("$instance", ".*") for each in queries]
        deadline = time.monotonic() + WITHIN
        while lacking := [each for each in expressions if not _numbers(_asked(address, each))]:
            assert time.monotonic() < deadline, lacking
            wait_readable(prometheus, 0.5)
    finally:
        prometheus.terminate()
        prometheus.wait(WITHIN)


def _numbers(found: list[Any] | None) -> bool:
    """Whether there is data, and a number in it: a quantile of nothing is none."""
    return bool(found) and any(each["value"][1] != "NaN" for each in found or ())


def _asked(address: str, query: str) -> list[Any] | None:
    """What Prometheus answers to a query; None where it does not."""
    try:
        with urllib.request.urlopen(
            f"http://{address}/api/v1/query?{urllib.parse.urlencode({'query': query})}", timeout=10.0
        ) as answer:
            found = json.loads(answer.read())
    except OSError:
        return None
    result: list[Any] = found["data"]["result"]
    return result if found["status"] == "success" else None
