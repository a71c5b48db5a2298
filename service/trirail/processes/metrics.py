"""HTTP server for /metrics (Prometheus) and /healthz, in threads of the supervisor.

The supervisor outlives the other processes and checks their heartbeats. It can therefore report dead and frozen
processes. The other processes send their measurements to the supervisor, so that a scrape does not disturb them. The
server uses plain HTTP on the loopback interface. On other addresses, it uses TLS and serves only users with a role, as
with `zenoh.listen`.
"""

from __future__ import annotations

import ipaddress
import os
import socket
import ssl
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from http import HTTPStatus
from pathlib import Path
from socketserver import TCPServer
from typing import Any, ClassVar, Final
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer, make_server

import msgspec
from msgspec import structs
from prometheus_client import CollectorRegistry, Metric, make_wsgi_app
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily
from prometheus_client.exposition import ThreadingWSGIServer, choose_encoder
from prometheus_client.registry import Collector
from trirail_drivers.interface import NAMES

from trirail.config import Config, metrics_url
from trirail.errors import ServiceError
from trirail.processes.monitoring import EventCounts, Health, Histogram, Running, ServiceMeasurements
from trirail.processes.zenoh_links import ResourceUse
from trirail.telemetry.provenance import software
from trirail.wire import tls
from trirail.wire.credentials import Credentials, with_role
from trirail.wire.messages import FaultDetail
from trirail.wire.vocabulary import MODES, FaultCause

PREFIX: Final = "trirail"
Values = Mapping[Any, float]
"""Values of a metric, by the value of its label, or by a tuple of label values if the metric has several labels."""
NONE_YET: Final[Values] = {}
_NO_FAULTS: Final = {
    FaultDetail(cause.value, drive): 0
    for cause in FaultCause
    for drive in (NAMES if cause is FaultCause.FOLLOWING_ERROR else ("",))
}
"""Counts of the faults that the service detects, before the first. Without a sample of 0, Prometheus' increase() does
not see the first fault. The drives' own faults have too many codes."""
PAGE: Final = os.sysconf("SC_PAGE_SIZE")
TICKS: Final = os.sysconf("SC_CLK_TCK")


class ServiceMetrics(Collector):
    """Collector of all metrics of a service."""

    def __init__(self, robot: str, version: str, health: Health) -> None:
        self._robot = robot
        self._version = version
        self._health = health

    def collect(self) -> Iterator[Metric]:
        """Yield all metrics. Values that have not been measured yet are omitted."""
        words = "The robot and the software that runs."
        yield _gauge("service_info", words, ["robot", "version"], {(self._robot, self._version): 1.0})
        yield from self._processes()
        if (service := self._health.service) is not None:
            yield from _loop(service)
            yield from _goals(self._health.events)
            yield from _can(service)
            yield from _digital(service)
            yield from _use(service.use)
        if (recorder := self._health.recorder) is not None:
            words = "Batches of records missing in the recording or in the live view."
            lost = {"file": recorder.lost, "live": recorder.skipped}
            yield _counter("recorder_lost_batches", words, ["sink"], lost)
            words = "Cycles missing in the recording because the recorder was too slow."
            yield _counter("recorder_missing_cycles", words, value=recorder.absent)

    def _processes(self) -> Iterator[Metric]:
        words = "Whether a process is healthy, as on /healthz."
        healthy = {name: float(not trouble) for name, trouble in self._health.troubles().items()}
        yield _gauge("process_healthy", words, ["process"], healthy)
        restarts = _counter("process_restarts", "Restarts of a process.", ["process"])
        memory = _gauge("process_resident_memory_bytes", "Memory of a process.", ["process"])
        busy = _counter("process_cpu_seconds", "Processor time of a process since its start.", ["process"])
        processes = {"supervisor": Running(os.getpid(), ready=True, restarts=0), **self._health.processes}
        for name, running in processes.items():
            restarts.add_metric([name], running.restarts)
            if running.pid is not None and (used := _used(running.pid)) is not None:
                memory.add_metric([name], used[0])
                busy.add_metric([name], used[1])
        yield from (restarts, memory, busy)
        words = "Age of a process's measurements."
        yield _gauge("measurement_age_seconds", words, ["process"], self._health.ages())


def _loop(service: ServiceMeasurements) -> Iterator[Metric]:
    modes = {name: float(name == service.mode) for name in MODES}
    yield _gauge("mode", "1 for the mode that the robot is in, 0 for the others.", ["mode"], modes)
    problems = {"warning": len(service.warnings), "fault": len(service.faults)}
    words = "Number of warnings and faults in the state; /healthz lists them."
    yield _gauge("service_problems", words, ["kind"], problems)
    yield _counter("loop_cycles", "SYNCs sent since the start.", value=service.cycles)
    yield _counter("loop_missed_ticks", "Ticks missed since the start.", value=service.overruns)
    yield _histogram("loop_lateness_seconds", "Delay of a cycle after its deadline.", service.lateness)
    yield _histogram("loop_cycle_seconds", "Duration of a cycle's work.", service.cycle)


def _goals(events: EventCounts) -> Iterator[Metric]:
    yield _counter("goals", "Goals that have ended, by outcome.", ["outcome"], events.goals.copy())
    yield _histogram(
        "goal_settle_seconds", "Time from the end of a goal's path until the robot was in position.", events.settle
    )
    faults = _counter("faults", "Faults, by cause, drive and the drive's own code.", ["cause", "drive", "code"])
    for fault, times in (_NO_FAULTS | events.faults).items():
        faults.add_metric([fault.cause, fault.drive, f"0x{fault.code:04X}" if fault.code else ""], times)
    yield faults


def _can(service: ServiceMeasurements) -> Iterator[Metric]:
    load = {"measured": service.bus_load_measured, "worst": service.bus_load}
    yield _gauge("can_load_ratio", "Share of the bus in use; 1 is full.", ["kind"], load)
    frames = {
        (drive, kind): count
        for drive, counts in zip(NAMES, service.traffic, strict=True)
        for kind, count in structs.asdict(counts).items()
    }
    words = "Cyclic frames of a drive that were late or lost."
    yield _counter("can_troubled_frames", words, ["drive", "kind"], frames)


def _digital(service: ServiceMeasurements) -> Iterator[Metric]:
    yield _gauge("output", "Value of a digital output.", ["name"], service.outputs)
    yield _gauge("input", "Value of a digital input.", ["name"], service.inputs)


def _use(use: ResourceUse) -> Iterator[Metric]:
    used = {"sessions": use.sessions, "descriptors": use.descriptors}
    most = {"sessions": use.sessions_most, "descriptors": use.descriptors_most}
    yield _gauge("gateway_used", "Sessions and file descriptors of the gateway in use.", ["what"], used)
    words = "Connections to endpoints with TLS that have opened no session; a new session waits for them."
    yield _gauge("gateway_unopened_connections", words, [], {(): use.unopened})
    yield _gauge("gateway_most", "Limit of the gateway's sessions and file descriptors.", ["what"], most)


def _gauge(name: str, words: str, labels: list[str], values: Values = NONE_YET) -> GaugeMetricFamily:
    """Return a gauge with one value for each combination of label values."""
    made = GaugeMetricFamily(f"{PREFIX}_{name}", words, labels=labels)
    for each, value in values.items():
        made.add_metric([each] if isinstance(each, str) else each, value)
    return made


def _counter(
    name: str, words: str, labels: list[str] | None = None, values: Values = NONE_YET, value: float | None = None
) -> CounterMetricFamily:
    made = CounterMetricFamily(f"{PREFIX}_{name}", words, value=value, labels=labels)
    for each, count in values.items():
        made.add_metric([each] if isinstance(each, str) else each, count)
    return made


def _histogram(name: str, words: str, values: Histogram) -> HistogramMetricFamily:
    """Return a histogram with cumulative buckets, as Prometheus expects."""
    buckets: list[tuple[str, float]] = []
    so_far = 0
    for bound, count in zip((*values.bounds, float("inf")), values.counts, strict=True):
        so_far += count
        buckets.append(("+Inf" if bound == float("inf") else repr(bound), so_far))
    return HistogramMetricFamily(f"{PREFIX}_{name}", words, buckets=buckets, sum_value=values.total)


def _used(pid: int) -> tuple[float, float] | None:
    """Return the memory [bytes] and the processor time [s] of a process, from proc(5); None if it has just ended."""
    try:
        pages = Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1]
        fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    except (OSError, IndexError):
        return None
    return int(pages) * PAGE, (int(fields[11]) + int(fields[12])) / TICKS


CONNECTION_TIMEOUT_S: Final = 5.0
"""Maximum duration of a connection, from the TLS handshake to the end of the answer [s]."""
MAX_CONNECTIONS: Final = 16
"""Maximum number of connections served at the same time.

A further connection takes the place of the oldest one that has not sent a whole request; it is closed if all have.
"""

_Start = Callable[..., Any]


class MetricsServer:
    """HTTP server, used as a context manager, within which it serves requests.

    Raises ServiceError if the port is in use, or if the certificate is invalid.
    """

    def __init__(self, config: Config, health: Health) -> None:
        telemetry = config.telemetry
        self._address = telemetry.metrics_address, telemetry.metrics_port
        self._health = health
        registry = CollectorRegistry(auto_describe=False)
        registry.register(ServiceMetrics(config.robot.name, software().trirail, health))
        self._metrics = make_wsgi_app(registry)
        self._tls: ssl.SSLContext | None = None
        if config.zenoh.tls is not None and metrics_url(config).startswith("https:"):
            folder = Path(config.zenoh.tls.directory)
            self._tls = tls.server(Credentials.read(folder))
            self._users = with_role(config.zenoh.users, folder)

    def __enter__(self) -> MetricsServer:
        self._server = self._listen(*self._address)
        self._thread = threading.Thread(target=self._server.serve_forever, name="metrics", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def _listen(self, address: str, port: int) -> WSGIServer:
        kind = _ServerIPv6 if ipaddress.ip_address(address).version == 6 else _Server
        try:
            server = make_server(address, port, self._answer, kind, _Handler)
        except OSError as error:
            raise ServiceError(
                f"metrics: cannot listen on {address}:{port}: {error.strerror}; "
                "set telemetry.metrics_port to a free port, or to 0 for no metrics"
            ) from error
        if self._tls is not None:
            # start_http_server of prometheus_client is not used, because it does the handshake in the accepting thread,
            # where one silent connection blocks all others. It also does not provide the name in the certificate.
            server.socket = self._tls.wrap_socket(server.socket, server_side=True, do_handshake_on_connect=False)
        return server

    def _answer(self, environ: Mapping[str, Any], start: _Start) -> Iterable[bytes]:
        """Answer an HTTP request. This method is a WSGI application."""
        if self._tls is not None and environ[USER] not in self._users:
            return _respond(start, HTTPStatus.FORBIDDEN, {"error": f"{environ[USER] or 'this client'} has no role"})
        match environ["PATH_INFO"]:
            case "/metrics":
                try:
                    choose_encoder(environ.get("HTTP_ACCEPT", ""))  # raises for versions that are not numbers
                except (TypeError, ValueError):
                    return _respond(start, HTTPStatus.NOT_ACCEPTABLE, {"error": "the header Accept is not valid"})
                return self._metrics(environ, start)  # type: ignore[no-any-return]
            case "/healthz":
                troubles = self._health.troubles()
                fit = not any(troubles.values())
                status = HTTPStatus.OK if fit else HTTPStatus.SERVICE_UNAVAILABLE
                processes = {name: trouble or "ok" for name, trouble in troubles.items()}
                service = self._health.service
                warnings, faults = ((), ()) if service is None else (service.warnings, service.faults)
                content = {"ok": fit, "processes": processes, "warnings": warnings, "faults": faults}
                return _respond(start, status, content)
        return _respond(start, HTTPStatus.NOT_FOUND, {"error": "unknown path: use /metrics or /healthz"})


USER: Final = "trirail.user"
"""Key in the WSGI environment for the user that the client's certificate names."""


class _Handler(WSGIRequestHandler):
    served: ClassVar[list[_Handler]] = []
    """Handlers of all connections that are served, from the oldest to the newest."""
    lock = threading.Lock()
    waiting = True
    """Whether the whole request has not arrived yet."""

    def handle(self) -> None:
        with self.lock:
            if len(self.served) >= MAX_CONNECTIONS:
                if (oldest := next((each for each in self.served if each.waiting), None)) is None:
                    return
                oldest._disconnect()
                self.served.remove(oldest)
            self.served.append(self)
        try:
            self._handle_in_time()
        finally:
            with self.lock, suppress(ValueError):  # a newer connection has taken the place
                self.served.remove(self)

    def parse_request(self) -> bool:
        parsed = super().parse_request()
        self.waiting = False
        return parsed

    def _handle_in_time(self) -> None:
        """Handle the request, and end the connection after CONNECTION_TIMEOUT_S."""
        # A time-out of the socket would apply to each byte that a slow client sends.
        end = threading.Timer(CONNECTION_TIMEOUT_S, self._disconnect)
        end.daemon = True
        end.start()
        try:
            if isinstance(self.connection, ssl.SSLSocket):
                self.connection.do_handshake()
            super().handle()
        except OSError:
            pass  # the peer has disconnected
        finally:
            end.cancel()
            end.join()  # afterwards, another connection may get the descriptor

    def _disconnect(self) -> None:
        """End the connection, for which the handler may wait in another thread."""
        with suppress(OSError):  # the peer has disconnected
            socket.socket.shutdown(self.connection, socket.SHUT_RDWR)  # that of TLS would change the handler's state

    def get_environ(self) -> dict[str, Any]:
        shown = tls.peer(self.connection) if isinstance(self.connection, ssl.SSLSocket) else ""
        return super().get_environ() | {USER: shown}

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002 - the name that it has in http.server
        pass


class _Server(ThreadingWSGIServer):
    def server_bind(self) -> None:
        # HTTPServer.server_bind is not used, because it looks up the host name in the network.
        TCPServer.server_bind(self)
        self.server_name, self.server_port = str(self.server_address[0]), self.server_address[1]
        self.setup_environ()


class _ServerIPv6(_Server):
    address_family = socket.AF_INET6


def _respond(start: _Start, status: HTTPStatus, content: object) -> Iterable[bytes]:
    start(f"{status.value} {status.phrase}", [("Content-Type", "application/json"), ("Cache-Control", "no-store")])
    return [msgspec.json.encode(content) + b"\n"]
