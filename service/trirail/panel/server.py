"""Server of the panel.

On the loopback interface, it serves the page's files and a WebSocket per tab to token holders.
"""

from __future__ import annotations

import contextlib
import hmac
import secrets
import socket
import threading
from collections.abc import Iterator, Sequence
from http import HTTPStatus
from importlib import resources
from urllib.parse import unquote, urlsplit

import msgspec
from websockets.datastructures import Headers
from websockets.http11 import Request, Response
from websockets.sync.server import Server, ServerConnection, serve

from trirail.client.async_client import AsyncRobot
from trirail.client.blocking import LoopThread
from trirail.errors import ServiceError
from trirail.panel.connections import Connections
from trirail.panel.feed import Feed
from trirail.panel.recordings import Recordings
from trirail.panel.tab import Tab
from trirail.wire.sizes import MAX_FILE

LOOPBACK_NAMES = frozenset({"127.0.0.1", "localhost", "::1"})
"""Accepted host names. A foreign page whose name resolves to this machine (DNS rebinding) sends a different name."""


def refused(token: str, path: str, hosts: Sequence[str], origins: Sequence[str]) -> str | None:
    """Return the reason for refusing a request; None if it is accepted.

    `path` is the requested /TOKEN/FILE; `hosts` and `origins` contain the values of all headers with these names. A
    browser sends the origin with every request from a script, and it must be the page's own origin.
    """
    try:
        (host,) = hosts
        hostname = urlsplit(f"http://{host}").hostname
    except ValueError:
        hostname = None
    if hostname not in LOOPBACK_NAMES:
        return "this page is for this machine only: open it as 127.0.0.1 or localhost, from elsewhere through ssh -L"
    if any(origin != f"http://{host}" for origin in origins):
        return "requested by a page of another origin"
    path_token = path.removeprefix("/").partition("/")[0]
    if not hmac.compare_digest(path_token.encode(), token.encode()):
        return "no such page: open the address that trirail panel printed, with its token"
    return None


LOOPBACK = "127.0.0.1"
PORT = 9880
"""Port of the page, if it is free and no other port is requested."""
SOCKET = "socket"
"""Name of the page's WebSocket below the token."""
MAX_MESSAGE = 3 * MAX_FILE
"""Maximum size of a message from the page, which may contain a file to follow as a JSON string [bytes]."""
LANGUAGES = "languages.json"
"""File with the languages of the page: their codes, and their names in the languages themselves."""
SESSIONS, RECORDING, REPORT = "sessions", "recording", "report"
"""Names of the requests for recordings."""
REQUEST_TIMEOUT_S = 5.0
"""Time limit for receiving a request, which comes from this machine [s]."""
TYPES = {
    "html": "text/html",
    "css": "text/css",
    "js": "text/javascript",
    "svg": "image/svg+xml",
    "json": "application/json",
}
HEADERS = {
    # No content from other origins, no frame of another page around this page (clickjacking), and no leak of the token.
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}


class Panel:
    """Page of one robot, served while the context is active.

    Parameters
    ----------
    robot
        Robot to operate.
    port
        Port on the loopback interface; None for 9880, or any free port if that one is in use.
    token
        Secret part of the address; None for a random token.

    Raises
    ------
    ServiceError
        The port is in use, or no service answers.
    """

    def __init__(self, robot: AsyncRobot, port: int | None = None, token: str | None = None) -> None:
        self._robot = robot
        self._loop = LoopThread()
        with contextlib.ExitStack() as opened:
            opened.callback(self._loop.close)
            self._loop.call(robot.__aenter__())
            opened.callback(lambda: self._loop.call(robot.close()))
            self._feed = Feed(robot, self._loop)
            listening = _listen(port)
            self._opened = opened.pop_all()
        self._token = token or secrets.token_urlsafe(16)
        self._files = dict(_files())
        self._recordings = Recordings(robot.name, self._feed.recordings)
        self.url = f"http://{LOOPBACK}:{listening.getsockname()[1]}/{self._token}/"
        """Address to open; anyone who has it can move the robot."""
        self._server: Server = serve(
            self._serve,
            sock=listening,
            process_request=self._answer,
            compression=None,  # latency matters more than size
            server_header=None,
            max_size=MAX_MESSAGE,
            open_timeout=REQUEST_TIMEOUT_S,
            close_timeout=1.0,
        )
        refusal = _response(HTTPStatus.SERVICE_UNAVAILABLE, b"the panel has too many connections\n", "txt").serialize()
        self._connections = Connections(listening, self._server.handler, refusal)
        self._thread = threading.Thread(target=self._connections.accept, name="panel", daemon=True)

    def __enter__(self) -> Panel:
        self._feed.start()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._feed.close()
        self._connections.close()
        self._thread.join()
        self._server.shutdown_watcher.close()
        self._server.shutdown_notifier.close()
        self._opened.close()

    def _serve(self, opened: ServerConnection) -> None:
        Tab(opened, self._robot, self._loop, self._feed).serve()

    def _answer(self, opened: ServerConnection, request: Request) -> Response | None:
        """Answer or refuse a request for a file; None opens the WebSocket."""
        headers = request.headers
        path = request.path.partition("?")[0]
        if why := refused(self._token, path, headers.get_all("Host"), headers.get_all("Origin")):
            return _response(HTTPStatus.FORBIDDEN, f"{why}\n".encode(), "txt")
        name = path.removeprefix(f"/{self._token}/") or "index.html"
        if name == SOCKET:
            if self._connections.make_tab(opened.socket):
                return None
            return _response(HTTPStatus.SERVICE_UNAVAILABLE, b"the panel is open in too many tabs: close one\n", "txt")
        if name == SESSIONS:
            return _response(HTTPStatus.OK, msgspec.json.encode(self._recordings.listed()), "json")
        folder, _, rest = name.partition("/")
        if folder == RECORDING and (sent := self._recordings.send_file(opened, rest, HEADERS)):
            return sent
        if folder == REPORT and (words := self._recordings.report(unquote(rest))):
            return _response(HTTPStatus.OK, words.encode(), "txt")
        if name not in self._files:
            return _response(HTTPStatus.NOT_FOUND, b"no such file\n", "txt")
        return _response(HTTPStatus.OK, self._files[name], name.rpartition(".")[2])


def _files() -> Iterator[tuple[str, bytes]]:
    languages = {}
    for file in (resources.files("trirail.panel") / "page").iterdir():
        yield file.name, file.read_bytes()
        if file.name.endswith(".json"):
            languages[file.name.removesuffix(".json")] = msgspec.json.decode(file.read_bytes())["language"]
    yield LANGUAGES, msgspec.json.encode(dict(sorted(languages.items())))


def _response(status: HTTPStatus, body: bytes, suffix: str) -> Response:
    kind = f"{TYPES.get(suffix, 'text/plain')}; charset=utf-8"
    headers = Headers({"Content-Type": kind, "Content-Length": str(len(body)), "Connection": "close"} | HEADERS)
    return Response(status.value, status.phrase, headers, body)


def _listen(port: int | None) -> socket.socket:
    """Listen on a port of the loopback interface: the requested port, or else the default port, or any port if it is
    taken.
    """
    requested = PORT if port is None else port
    if 0 <= requested <= 65535:
        with contextlib.suppress(OSError):
            return socket.create_server((LOOPBACK, requested))
    if port is not None:
        raise ServiceError(f"port {port}: cannot listen; choose another of 1 to 65535, or 0 for any free port")
    return socket.create_server((LOOPBACK, 0))
