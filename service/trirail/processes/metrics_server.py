"""/metrics for Prometheus and /healthz for whoever watches the service, over HTTP, in threads of the supervisor.

In the supervisor, since it outlives the others and sees their heartbeats: a gateway, loop, planner or recorder that is
dead or frozen is told all the same. What the others measured has come on their pipes, so that a scrape asks nobody.
On the loopback plain HTTP; beyond it TLS, for users that have a role, as with `zenoh.listen`.
"""

from __future__ import annotations

import ipaddress
import socket
import ssl
import threading
from collections.abc import Callable, Iterable, Mapping
from http import HTTPStatus
from pathlib import Path
from socketserver import ThreadingMixIn
from typing import Any, Final
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer

import msgspec
from prometheus_client import CollectorRegistry, make_wsgi_app

from trirail.config import Config, metrics_url
from trirail.errors import ServiceError
from trirail.processes.metrics import ServiceMetrics
from trirail.processes.monitoring import Health
from trirail.telemetry.provenance import software
from trirail.wire import tls
from trirail.wire.credentials import Credentials, with_role

PATIENCE: Final = 2.0
"""How long a connection may take for a request [s]."""
AT_ONCE: Final = 16
"""So many connections are served at once; more are closed."""

_Start = Callable[..., Any]


class MetricsServer:
    """Serves while the context lasts. Raises ServiceError where the port is taken or a certificate is no good."""

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
        self._server = _listen(*self._address, self._tls)
        self._server.set_app(self._answer)
        self._thread = threading.Thread(target=self._server.serve_forever, name="metrics", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def _answer(self, environ: Mapping[str, Any], start: _Start) -> Iterable[bytes]:
        """Answer a request, as WSGI has it."""
        if self._tls is not None and environ[USER] not in self._users:
            return _say(start, HTTPStatus.FORBIDDEN, {"error": f"{environ[USER] or 'nobody'} has no role"})
        match environ["PATH_INFO"]:
            case "/metrics":
                return self._metrics(environ, start)  # type: ignore[no-any-return]
            case "/healthz":
                troubles = self._health.troubles()
                fit = not any(troubles.values())
                status = HTTPStatus.OK if fit else HTTPStatus.SERVICE_UNAVAILABLE
                processes = {name: trouble or "ok" for name, trouble in troubles.items()}
                service = self._health.service
                warnings = service.warnings if service is not None else ()
                return _say(start, status, {"ok": fit, "processes": processes, "warnings": warnings})
        return _say(start, HTTPStatus.NOT_FOUND, {"error": "there are /metrics and /healthz"})


USER: Final = "trirail.user"
"""Of a request: in whose name the certificate is that was shown."""


class _Handler(WSGIRequestHandler):
    timeout = PATIENCE

    def setup(self) -> None:
        super().setup()
        if isinstance(self.connection, ssl.SSLSocket):
            self.connection.do_handshake()  # here, in a thread of its own and with a timeout

    def get_environ(self) -> dict[str, Any]:
        shown = tls.peer(self.connection) if isinstance(self.connection, ssl.SSLSocket) else ""
        return super().get_environ() | {USER: shown}

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002 - the name that it has in http.server
        pass


class _Server(ThreadingMixIn, WSGIServer):
    daemon_threads = True
    tls: ssl.SSLContext | None = None

    def __init__(self, address: tuple[str, int], tls: ssl.SSLContext | None) -> None:
        self.address_family = socket.AF_INET6 if ipaddress.ip_address(address[0]).version == 6 else socket.AF_INET
        self.tls = tls
        self._places = threading.BoundedSemaphore(AT_ONCE)
        super().__init__(address, _Handler)

    def server_bind(self) -> None:
        # Not that of http.server, which asks the network for the name of the address.
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self.socket.bind(self.server_address)
        self.server_address = self.socket.getsockname()
        self.server_name, self.server_port = str(self.server_address[0]), self.server_address[1]
        self.setup_environ()

    def get_request(self) -> tuple[socket.socket, Any]:
        connection, address = super().get_request()
        if self.tls is not None:
            connection = self.tls.wrap_socket(connection, server_side=True, do_handshake_on_connect=False)
        return connection, address

    def process_request(self, request: Any, client_address: Any) -> None:
        if not self._places.acquire(blocking=False):
            self.shutdown_request(request)
            return
        try:
            super().process_request(request, client_address)
        except RuntimeError:  # no thread could be started
            self._places.release()
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._places.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Let a connection go that came to nothing: there is nobody to be told."""


def _listen(address: str, port: int, tls: ssl.SSLContext | None) -> _Server:
    try:
        return _Server((address, port), tls)
    except OSError as error:
        raise ServiceError(
            f"metrics: cannot listen on {address}:{port}: {error.strerror}; "
            "set telemetry.metrics_port to a free port, or to 0 for no metrics"
        ) from error


def _say(start: _Start, status: HTTPStatus, content: object) -> Iterable[bytes]:
    start(f"{status.value} {status.phrase}", [("Content-Type", "application/json"), ("Cache-Control", "no-store")])
    return [msgspec.json.encode(content) + b"\n"]
