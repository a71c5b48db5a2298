"""Metrics and health without processes: what is counted, what Prometheus reads of it, and who is told as dead."""

from __future__ import annotations

import contextlib
import itertools
import json
import re
import select
import socket
import ssl
import time
import urllib.error
import urllib.request
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import get_args

import msgspec
import numpy as np
import pytest
from certificates import tls_config, user
from control_rig import CONFIG
from hypothesis import given, settings
from hypothesis import strategies as st
from ports import free_port
from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.parser import text_string_to_metric_families
from trirail.config import SIM, Config, Input, Output
from trirail.errors import ServiceError
from trirail.processes import metrics
from trirail.processes.child_process import MEASURED
from trirail.processes.heartbeats import PROCESSES, Heartbeats
from trirail.processes.metrics import MAX_CONNECTIONS, MetricsServer, ServiceMetrics
from trirail.processes.monitoring import (
    MAX_FAULT_KINDS,
    MAX_SILENCE_S,
    NOT_RUNNING,
    SETTLE_BOUNDS,
    EventCounts,
    Health,
    Histogram,
    Meter,
    RecorderMeasurements,
    Running,
    ServiceMeasurements,
)
from trirail.processes.publications import StateMaker
from trirail.processes.zenoh_links import ResourceUse
from trirail.wire.messages import Event, FaultDetail, Outcome
from trirail.wire.records import DTYPE
from trirail.wire.vocabulary import FaultCause
from waiting import wait_until

TURN = 0.1


def event(seq: int, **fields: object) -> Event:
    said: dict[str, object] = {"kind": "service", "level": "info", "message": ""} | fields
    return Event(seq=seq, t=0.001 * seq, cycle=seq, time=0.0, **said)  # type: ignore[arg-type]


class Told:
    """A meter that is always due, and what it told last."""

    def __init__(self) -> None:
        self.now = 0.0
        self.warnings: tuple[str, ...] = ()
        self.measured: list[ServiceMeasurements] = []
        self.meter = Meter(self.measured.append, lambda: self.now)  # type: ignore[arg-type]
        self._states = StateMaker(
            msgspec.structs.replace(CONFIG, outputs={"valve": Output("A", 16)}, inputs={"part": Input("B", 16)})
        )

    def rows(self, **fields: object) -> None:
        rows = np.zeros(2, DTYPE)
        rows["cycle"] = (1, 2)
        for name, values in fields.items():
            rows[name] = values
        self._states.records(rows)
        self.meter.records(rows)

    def newest(self) -> ServiceMeasurements:
        self.now += 1.0
        self.meter.publish(lambda: self._states.newest(self.warnings), ResourceUse(3, 512, 40, 1024))
        return self.measured[-1]


@given(st.lists(st.floats(0.0, 20.0)))
def test_a_bucket_has_the_values_up_to_its_bound(values: list[float]) -> None:
    histogram = Histogram.empty(SETTLE_BOUNDS)
    histogram.add(np.array(values))
    for place, bound in enumerate(SETTLE_BOUNDS):
        assert sum(histogram.counts[: place + 1]) == sum(value <= bound for value in values)
    assert sum(histogram.counts) == len(values)
    assert histogram.total == pytest.approx(sum(values))


def test_goals_and_faults_are_counted_from_zero() -> None:
    """Prometheus' increase() does not see the first event of a series that begins at 1."""
    told = Told()
    told.rows()
    text = exposed(told.newest(), RecorderMeasurements(0, 0, 0), [])
    goals = re.findall(r'trirail_goals_total{outcome="(.*)"} 0.0', text)
    assert set(goals) == set(get_args(Outcome))
    faults = re.findall(r'trirail_faults_total{cause="(.*)",code="",drive="(.*)"} 0.0', text)
    assert set(faults) >= {("quick_stop", ""), ("loop", ""), ("following_error", "A"), ("following_error", "C")}
    assert len(set(faults)) == len(faults) >= len(FaultCause)


def test_what_the_service_does_is_counted() -> None:
    told = Told()
    told.rows(lateness_ns=(15_000, 3_000_000), overruns=(0, 7), mode=(4, 4), parts_ns=100_000)
    events = [
        event(1, kind="goal", id="a", outcome="done", settle=0.03),
        event(2, kind="goal", id="b", outcome="rejected"),
        event(3, kind="goal", id="c", outcome="done"),
        *(event(seq, kind="fault", level="error", fault=FaultDetail("emcy", "B", 0x8700)) for seq in (4, 5)),
    ]
    text = exposed(told.newest(), RecorderMeasurements(3, 20, 5), events)
    assert 'trirail_mode{mode="moving"} 1.0' in text
    assert 'trirail_mode{mode="holding"} 0.0' in text
    assert "trirail_loop_missed_ticks_total 7.0" in text
    assert 'trirail_loop_lateness_seconds_bucket{le="1e-05"} 0.0' in text
    assert 'trirail_loop_lateness_seconds_bucket{le="2e-05"} 1.0' in text
    assert 'trirail_loop_lateness_seconds_bucket{le="+Inf"} 2.0' in text
    assert "trirail_loop_lateness_seconds_count 2.0" in text
    assert "trirail_loop_cycle_seconds_sum 0.0016" in text
    assert 'trirail_goals_total{outcome="done"} 2.0' in text
    assert 'trirail_goals_total{outcome="rejected"} 1.0' in text
    assert "trirail_goal_settle_seconds_count 1.0" in text
    assert 'trirail_faults_total{cause="emcy",code="0x8700",drive="B"} 2.0' in text
    assert 'trirail_recorder_lost_batches_total{sink="file"} 3.0' in text
    assert 'trirail_recorder_lost_batches_total{sink="live"} 20.0' in text
    assert "trirail_recorder_missing_cycles_total 5.0" in text


@given(st.lists(st.tuples(st.sampled_from("ABC"), st.integers(0, 0xFFFF)), max_size=60))
def test_no_fault_is_left_out_however_many_kinds_there_are(faults: list[tuple[str, int]]) -> None:
    counts = EventCounts()
    for seq, (drive, code) in enumerate(faults, 1):
        counts.add(event(seq, kind="fault", fault=FaultDetail("following_error", drive, code)))
    assert sum(counts.faults.values()) == len(faults)
    assert len(counts.faults) <= MAX_FAULT_KINDS + 1


def test_what_is_told_fits_into_a_pipe_at_once() -> None:
    told = Told()
    told.rows(lateness_ns=2**62, cycle=(2**62, 2**62 + 1), overruns=2**62)
    newest = told.newest()
    # Twelve more digits in each of 28 buckets, as after years.
    assert len(msgspec.json.encode({MEASURED: newest})) + 28 * 12 <= select.PIPE_BUF
    assert msgspec.convert(msgspec.to_builtins(newest), ServiceMeasurements) == newest


def health() -> tuple[Health, Heartbeats, list[float]]:
    hearts, now = Heartbeats.create(), [0.0]
    return Health(hearts, CONFIG.period, TURN, lambda: now[0]), hearts, now


def exposed(
    service: ServiceMeasurements | None, recorder: RecorderMeasurements | None, events: Iterable[Event] = ()
) -> str:
    """What Prometheus reads."""
    looked, _, _ = health()
    for each in events:
        looked.events.add(each)
    if service is not None:
        looked.store("gateway", msgspec.to_builtins(service))
    if recorder is not None:
        looked.store("recorder", msgspec.to_builtins(recorder))
    registry = CollectorRegistry(auto_describe=False)
    registry.register(ServiceMetrics("demo", "0.1", looked))
    return generate_latest(registry).decode()


def test_before_anything_is_measured_there_are_only_the_processes() -> None:
    families = {family.name for family in text_string_to_metric_families(exposed(None, None))}
    assert "trirail_process_healthy" in families
    assert not {name for name in families if name.startswith("trirail_loop")}


def test_the_dashboard_shows_every_metric_and_no_other() -> None:
    told = Told()
    told.rows()
    events = [
        event(1, kind="goal", id="a", outcome="done", settle=0.03),
        event(2, kind="fault", fault=FaultDetail("bus")),
    ]
    families = list(text_string_to_metric_families(exposed(told.newest(), RecorderMeasurements(0, 0, 0), events)))
    samples = {sample.name: family.name for family in families for sample in family.samples}
    dashboard = json.loads((SIM.parent / "grafana.json").read_text())
    queries = [target["expr"] for panel in dashboard["panels"] for target in panel["targets"]]
    shown = {name for query in queries for name in re.findall(r"\btrirail_\w+", query)}
    assert shown <= set(samples)
    assert {samples[name] for name in shown} == {family.name for family in families}
    labels = {label for family in families for sample in family.samples for label in sample.labels}
    used = {label for query in queries for by in re.findall(r"by \(([^)]*)\)", query) for label in by.split(", ")}
    assert used <= labels | {"instance"}


ALL_UP = {name: Running(1, ready=True, restarts=0) for name in PROCESSES}


@pytest.mark.parametrize("name", PROCESSES)
def test_a_frozen_process_is_told_by_its_name(name: str) -> None:
    looked, hearts, now = health()
    for turn in range(100):
        for each in PROCESSES:
            if each != name or turn < 50:
                hearts.heart(each).beat()
        now[0] += TURN
        looked.poll(ALL_UP)
        frozen_for = (turn - 49) * TURN
        if frozen_for <= 0.0:
            assert not any(looked.troubles().values())
        elif frozen_for > MAX_SILENCE_S + 2 * TURN:
            assert {each for each, trouble in looked.troubles().items() if trouble} == {name}
            assert frozen_for < 5.0 or looked.troubles()[name] == "no sign of life"


@pytest.mark.parametrize("name", PROCESSES)
def test_a_process_that_is_dead_or_starting_is_told_at_once(name: str) -> None:
    looked, _, _ = health()
    looked.poll(ALL_UP | {name: NOT_RUNNING})
    assert looked.troubles()[name] == "not running"
    looked.poll(ALL_UP | {name: Running(2, ready=False, restarts=1)})
    assert looked.troubles()[name] == "starting"
    looked.poll(ALL_UP)
    assert not any(looked.troubles().values())


def test_a_supervisor_that_is_held_up_or_ending_is_told() -> None:
    looked, _, now = health()
    looked.poll(ALL_UP)
    now[0] += MAX_SILENCE_S + 0.1
    assert looked.troubles()["supervisor"] == "no sign of life"
    looked.poll(ALL_UP)
    assert not looked.troubles()["supervisor"]
    looked.end(ALL_UP)
    assert looked.troubles()["supervisor"] == "the service is ending"


# ---------------------------------------------------------------------- over HTTP


def served(config: Config, **telemetry: object) -> tuple[Config, MetricsServer, Health]:
    changed = msgspec.structs.replace(config.telemetry, metrics_port=free_port(), **telemetry)
    config = msgspec.structs.replace(config, telemetry=changed)
    looked, _, _ = health()
    return config, MetricsServer(config, looked), looked


def get(url: str, context: ssl.SSLContext | None = None, accept: str = "*/*") -> tuple[int, str]:
    request = urllib.request.Request(url, headers={"Accept": accept})
    try:
        with urllib.request.urlopen(request, timeout=10.0, context=context) as answer:
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, error.read().decode()


@pytest.fixture
def local() -> Iterator[tuple[str, Health]]:
    config, server, looked = served(CONFIG)
    with server:
        yield f"http://127.0.0.1:{config.telemetry.metrics_port}", looked


def test_health_is_red_until_all_are_up_and_says_which(local: tuple[str, Health]) -> None:
    url, looked = local
    status, body = get(f"{url}/healthz")
    assert status == 503
    assert json.loads(body)["processes"]["loop"] == "starting"
    looked.poll(ALL_UP)
    assert get(f"{url}/healthz") == (
        200,
        json.dumps(json.loads(get(f"{url}/healthz")[1]), separators=(",", ":")) + "\n",
    )
    looked.poll(ALL_UP | {"planner": NOT_RUNNING})
    status, body = get(f"{url}/healthz")
    assert (status, json.loads(body)) == (
        503,
        {
            "ok": False,
            "processes": dict.fromkeys((*PROCESSES, "supervisor"), "ok") | {"planner": "not running"},
            "warnings": [],
            "faults": [],
        },
    )


def test_health_and_metrics_have_the_same_warnings(local: tuple[str, Health]) -> None:
    """They are no reason to be red: the processes run, and a restart of the service would not help."""
    url, looked = local
    looked.poll(ALL_UP)
    told = Told()
    told.warnings = "the robot's name is in use", "nothing is recorded"
    told.rows()
    looked.store("gateway", msgspec.to_builtins(told.newest()))
    status, body = get(f"{url}/healthz")
    assert (status, json.loads(body)["warnings"]) == (200, [*told.warnings])
    metrics = get(f"{url}/metrics")[1]
    assert 'trirail_service_problems{kind="warning"} 2.0' in metrics
    assert 'trirail_service_problems{kind="fault"} 0.0' in metrics


def test_metrics_are_those_of_the_collector_and_all_else_is_not_found(local: tuple[str, Health]) -> None:
    url, _ = local
    status, body = get(f"{url}/metrics")
    assert status == 200
    assert 'trirail_service_info{robot="demo"' in body
    assert get(f"{url}/")[0] == get(f"{url}/metrics/../etc/passwd")[0] == 404


@pytest.mark.parametrize(
    "accept",
    ["text/plain;version=1.x.0", "application/openmetrics-text; version=zzz", "application/openmetrics-text;version"],
)
def test_an_invalid_header_is_answered_and_not_logged(
    local: tuple[str, Health], accept: str, capfd: pytest.CaptureFixture[str]
) -> None:
    url, _ = local
    status, body = get(f"{url}/metrics", accept=accept)
    assert status in (200, 406)
    assert ("error" in body) == (status == 406)
    assert capfd.readouterr().err == ""


@pytest.mark.long
def test_connections_that_say_nothing_keep_nobody_out(local: tuple[str, Health]) -> None:
    url, _ = local
    address = ("127.0.0.1", int(url.rpartition(":")[2]))
    silent = [socket.create_connection(address) for _ in range(40)]
    for connection in silent:  # those beyond the ceiling are closed at once, the others after PATIENCE
        connection.settimeout(20.0)
        assert connection.recv(1) == b""
        connection.close()
    assert get(f"{url}/metrics")[0] == 200


def drip(address: tuple[str, int], content: bytes) -> None:
    """Send a byte at a time on as many connections as are served, until the server has closed all of them."""
    slow = [socket.create_connection(address) for _ in range(MAX_CONNECTIONS)]
    for byte in itertools.islice(itertools.cycle(content), 200):
        for connection in tuple(slow):
            try:
                connection.send(bytes((byte,)))
                closed = bool(select.select([connection], [], [], 0.0)[0]) and not connection.recv(4096)
            except ConnectionError:
                closed = True
            if closed:
                slow.remove(connection)
                connection.close()
        if not slow:
            return
        time.sleep(0.05)
    raise AssertionError(f"{len(slow)} slow connections are still served")


@given(
    st.lists(st.sampled_from([b"", b"G", b"GET /healthz HTTP/1.1\r\nX: a\r\n"]), min_size=MAX_CONNECTIONS, max_size=40)
)
@settings(max_examples=5)
def test_connections_without_a_whole_request_close_no_other_one(begun: list[bytes]) -> None:
    config, server, looked = served(CONFIG)
    looked.poll(ALL_UP)
    address = ("127.0.0.1", config.telemetry.metrics_port)
    with server, contextlib.ExitStack() as held:
        for beginning in begun:
            with contextlib.suppress(ConnectionError):  # it has had to make room
                held.enter_context(socket.create_connection(address)).sendall(beginning)
            assert get(f"http://{address[0]}:{address[1]}/healthz")[0] == 200


def is_served(url: str, context: ssl.SSLContext | None = None) -> bool:
    try:
        return get(f"{url}/metrics", context)[0] == 200
    except OSError:
        return False


def client_hello() -> bytes:
    out = ssl.MemoryBIO()
    with contextlib.suppress(ssl.SSLWantReadError):
        ssl.create_default_context().wrap_bio(ssl.MemoryBIO(), out, server_hostname="robot").do_handshake()
    return out.read()


@pytest.mark.parametrize("content", [b"GET /metrics" + 200 * b"x", b"GET / HTTP/1.1\r\n" + 30 * b"X: a\r\n"])
@pytest.mark.long
def test_connections_that_say_little_at_a_time_keep_nobody_out(
    local: tuple[str, Health], monkeypatch: pytest.MonkeyPatch, content: bytes
) -> None:
    monkeypatch.setattr(metrics, "CONNECTION_TIMEOUT_S", 0.5)
    url, _ = local
    drip(("127.0.0.1", int(url.rpartition(":")[2])), content)
    wait_until(lambda: is_served(url))


def test_a_port_that_is_taken_is_told_with_the_remedy() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        telemetry = msgspec.structs.replace(CONFIG.telemetry, metrics_port=taken.getsockname()[1])
        server = MetricsServer(msgspec.structs.replace(CONFIG, telemetry=telemetry), health()[0])
        with pytest.raises(ServiceError, match=r"set telemetry\.metrics_port to a free port"), server:
            pass


@pytest.fixture(scope="module")
def beyond(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, Path]]:
    """A robot with certificates, whose metrics are listened for on every address."""
    folder = tmp_path_factory.mktemp("keys")
    config, server, looked = served(tls_config(folder), metrics_address="0.0.0.0")
    looked.poll(ALL_UP)
    with server:
        yield f"https://127.0.0.1:{config.telemetry.metrics_port}", folder


def shown(folder: Path, name: str | None) -> ssl.SSLContext:
    """A client that trusts the robot's authority, and shows a user's certificate, or none."""
    context = ssl.create_default_context(cafile=str(folder / "keys" / "ca.pem"))
    if name is not None:
        context.load_cert_chain(user(folder, name) / "cert.pem", user(folder, name) / "key.pem")
    return context


@pytest.mark.parametrize(("name", "status"), [("eva", 200), ("ann", 200), ("max", 200), ("una", 403), ("gone", 403)])
def test_beyond_the_loopback_who_has_a_role_reads_them(beyond: tuple[str, Path], name: str, status: int) -> None:
    url, folder = beyond
    for page in ("/metrics", "/healthz"):
        assert get(f"{url}{page}", shown(folder, name))[0] == status


@pytest.mark.parametrize("name", [None, "foreign", "late", "early"])
def test_beyond_the_loopback_nobody_reads_them_without_a_good_certificate(
    beyond: tuple[str, Path], name: str | None
) -> None:
    url, folder = beyond
    with pytest.raises(OSError, match=r"(?i)alert|reset|closed|EOF|broken pipe"):
        get(f"{url}/metrics", shown(folder, name))
    assert get(f"{url}/metrics", shown(folder, "eva"))[0] == 200


@pytest.mark.long
def test_handshakes_that_say_little_at_a_time_keep_nobody_out(
    beyond: tuple[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(metrics, "CONNECTION_TIMEOUT_S", 0.5)
    url, folder = beyond
    drip(("127.0.0.1", int(url.rpartition(":")[2])), client_hello())
    monkeypatch.undo()
    wait_until(lambda: is_served(url, shown(folder, "eva")))
