"""The panel's server: the page's files and a WebSocket for each tab, on the loopback, for who has the token."""

from __future__ import annotations

import contextlib
import secrets
import socket
import threading
from collections.abc import Iterator
from http import HTTPStatus
from importlib import resources
from urllib.parse import unquote

import msgspec
from websockets.datastructures import Headers
from websockets.http11 import Request, Response
from websockets.sync.server import Server, ServerConnection, serve

from trirail.client.client import Robot
from trirail.errors import ServiceError
from trirail.panel.connections import Connections
from trirail.panel.feed import Feed
from trirail.panel.guard import refused
from trirail.panel.recordings import Recordings
from trirail.panel.tab import Tab
from trirail.wire.sizes import MAX_MESSAGE

HOST = "127.0.0.1"
PORT = 9880
"""The page's port, where it is free and no other is asked for."""
SOCKET = "socket"
"""The name below the token under which the page's WebSocket is."""
LONGEST = 3 * MAX_MESSAGE
"""Messages of the page are shorter than that: a file that is to be followed, as a text of JSON [bytes]."""
LANGUAGES = "languages.json"
"""The page's languages: code, and what those call it who speak it."""
SESSIONS, RECORDING, REPORT = "sessions", "recording", "report"
"""What of the recordings can be asked for."""
OPENING = 5.0
"""So long may a request take: it comes from this machine [s]."""
TYPES = {
    "html": "text/html",
    "css": "text/css",
    "js": "text/javascript",
    "svg": "image/svg+xml",
    "json": "application/json",
}
HEADERS = {
    # Nothing from elsewhere, in no frame of elsewhere (clickjacking), and the token is told to nobody.
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}


class Panel:
    """The page of one robot while the context lasts. Raises ServiceError where the port is taken or nobody answers."""

    def __init__(self, robot: Robot, port: int | None = None) -> None:
        self._robot = robot
        self._feed = Feed(robot)
        self._token = secrets.token_urlsafe(16)
        self._files = dict(_files())
        self._recordings = Recordings(robot.name, self._feed.recordings)
        listening = _listen(port)
        self.url = f"http://{HOST}:{listening.getsockname()[1]}/{self._token}/"
        """The address to open; whoever has it can move the robot."""
        self._server: Server = serve(
            self._serve,
            sock=listening,
            process_request=self._answer,
            compression=None,  # a small message at once, not a smaller one later
            server_header=None,
            max_size=LONGEST,
            open_timeout=OPENING,
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

    def _serve(self, opened: ServerConnection) -> None:
        Tab(opened, self._robot, self._feed).serve()

    def _answer(self, opened: ServerConnection, request: Request) -> Response | None:
        """Answer a request for a file, refuse what may not ask; None lets the WebSocket open."""
        headers = request.headers
        path = request.path.partition("?")[0]
        if why := refused(self._token, path, headers.get_all("Host"), headers.get_all("Origin")):
            return _response(HTTPStatus.FORBIDDEN, f"{why}\n".encode(), "txt")
        name = path.removeprefix(f"/{self._token}/") or "index.html"
        if name == SOCKET:
            if self._connections.keep(opened.socket):
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
    """Listen on a port of the loopback: the one that is asked for, or the usual one, or where that is taken any."""
    wanted = PORT if port is None else port
    if 0 <= wanted <= 65535:
        with contextlib.suppress(OSError):
            return socket.create_server((HOST, wanted))
    if port is not None:
        raise ServiceError(f"port {port} cannot be listened on: choose another of 1 to 65535, or 0 for any")
    return socket.create_server((HOST, 0))
