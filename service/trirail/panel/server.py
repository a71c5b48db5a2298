"""Web server of the panel, on the loopback interface.

The server sends the page's files and opens a WebSocket for each tab. Every request must contain the secret token.
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

LOOPBACK_NAMES = frozenset({"127.0.0.1", "localhost", "::1"})
"""Accepted names in the Host header. A browser sends another name for a malicious page with a host name that resolves
to this machine (DNS rebinding)."""


def refused(token: str, path: str, hosts: Sequence[str], origins: Sequence[str]) -> str | None:
    """Return the reason to refuse a request; None if the request is accepted.

    `path` is the requested path /TOKEN/FILE. `hosts` and `origins` are the values of all Host and Origin headers. A
    browser sends the Origin header with every request from a script, and this origin must be that of the panel's page.
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
"""Default port of the page, which is used if it is free and no other port is requested."""
SOCKET = "socket"
"""Name after the token in the path of the page's WebSocket."""
MAX_MESSAGE = 65_536
"""Maximum size of a message from the page, such as a part of a trajectory file [bytes]."""
LANGUAGES = "languages.json"
"""Name of the file with the languages of the page: the code of each language, and its name in the same language."""
SESSIONS, RECORDING, REPORT = "sessions", "recording", "report"
"""Names after the token in the paths of requests for recordings."""
REQUEST_TIMEOUT_S = 20.0
"""Time limit for receiving a request from this machine [s]. Afterwards, the connection is closed without a response,
which must not happen only because the machine is busy."""
TYPES = {
    "html": "text/html",
    "css": "text/css",
    "js": "text/javascript",
    "svg": "image/svg+xml",
    "json": "application/json",
}
HEADERS = {
    # These headers forbid content from other origins, prevent other pages from showing this page in a frame
    # (clickjacking), and prevent a leak of the token.
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}


class Panel:
    """Context manager that serves the operator's page of one robot.

    Parameters
    ----------
    robot
        Robot that the page operates.
    port
        Port on the loopback interface. None means port 9880, or any free port if 9880 is in use.
    token
        Secret part of the address; None for a random token.

    Raises
    ------
    ServiceError
        If the port is in use, or if no service answers.
    """

    def __init__(self, robot: AsyncRobot, port: int | None = None, token: str | None = None) -> None:
        self._robot = robot
        self._loop = LoopThread()
        with contextlib.ExitStack() as opened:
            opened.callback(self._loop.close)
            self._loop.call(robot.__aenter__())
            opened.callback(lambda: self._loop.call(robot.close()))
            # As in Robot: a call that waits for a congested link cannot delay a stop in another event loop.
            self._stop_loop = LoopThread()
            opened.callback(self._stop_loop.close)
            self._stopping = self._stop_loop.call(robot._twin())
            self._feed = Feed(robot, self._loop)
            listening = _listen(port)
            self._opened = opened.pop_all()
        self._token = token or secrets.token_urlsafe(16)
        self._files = dict(_files())
        self._recordings = Recordings(robot.name, lambda: self._feed.recordings, lambda: self._feed.is_here)
        self.url = f"http://{LOOPBACK}:{listening.getsockname()[1]}/{self._token}/"
        """Address of the page. Every program on this machine that knows the address can move the robot."""
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
        Tab(opened, self._robot, self._loop, self._stopping, self._stop_loop, self._feed).serve()

    def _answer(self, opened: ServerConnection, request: Request) -> Response | None:
        """Return the response to a request; None to open the WebSocket."""
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
        if folder == RECORDING and (sent := self._recordings.send_file(opened, unquote(rest), HEADERS)):
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
    """Return a socket that listens on a port of the loopback interface.

    If `port` is None, the port is PORT, or any free port if PORT is in use. Raises ServiceError if the requested port
    cannot be used.
    """
    requested = PORT if port is None else port
    if 0 <= requested <= 65535:
        with contextlib.suppress(OSError):
            return socket.create_server((LOOPBACK, requested))
    if port is not None:
        raise ServiceError(f"port {port}: cannot listen; choose another of 1 to 65535, or 0 for any free port")
    return socket.create_server((LOOPBACK, 0))
