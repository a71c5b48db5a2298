"""`trirail view`: show a service's live view, records of a remote service, or a file in Rerun's viewer or a browser."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import webbrowser
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from urllib.parse import quote, urlsplit

from trirail_drivers import files

from trirail.client.client import Robot
from trirail.errors import ServiceError
from trirail.processes.operating_system import is_here, python
from trirail.telemetry.reading import without_partial_message
from trirail.telemetry.retention import is_being_written
from trirail.telemetry.sinks import LOOPBACK, free_port
from trirail.wire.credentials import credentials_for
from trirail.wire.endpoints import is_local

WEB_PORT = 9090
"""Preferred port of the web viewer, used if it is free."""
POLL_S = 0.2
"""Interval at which the end of a viewer and of its data is checked [s]."""
START_TIMEOUT_S = 20.0
"""Time-out for the start of the web viewer [s]."""


def run(
    file: Path | None,
    robots: Sequence[str],
    connect: str,
    tls: Path | None,
    *,
    web: bool,
    records: bool,
    say: Callable[[dict[str, str], str], None],
) -> int:
    """Open a viewer and wait until it is closed, or for Ctrl-C or SIGTERM; return the exit code.

    Raises ServiceError if there is no display, no service, no live view, or no such file.
    """
    if file is not None and not file.is_file():
        raise ServiceError(f"{file} is not a file; recordings are .rrd files in the service's telemetry.directory")
    if not web and not has_display():
        raise ServiceError(
            "no display for the viewer: DISPLAY and WAYLAND_DISPLAY are not set; use trirail view --web, which "
            "needs a browser, or, on a machine with a display, trirail view --connect tcp/<this machine>:7447"
        )
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with _source(file, robots, connect, tls, records) as (source, ended), contextlib.suppress(KeyboardInterrupt):
        if web:
            _browse(source, ended, say)
        else:
            say({"source": source}, f"viewer on {source}; close it or press Ctrl-C to end")
            with _rerun(*(["--connect", source] if "://" in source else [source]), "--port", "auto") as viewer:
                _wait(viewer, ended)
    return 0


def _wait(viewer: subprocess.Popen[bytes], ended: threading.Event) -> None:
    """Wait until the viewer is closed, or until its data has ended."""
    while viewer.poll() is None and not ended.wait(POLL_S):
        pass


def has_display() -> bool:
    """Return whether a window can be opened."""
    return sys.platform != "linux" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


@contextlib.contextmanager
def _source(
    file: Path | None, robots: Sequence[str], connect: str, tls: Path | None, records: bool
) -> Iterator[tuple[str, threading.Event]]:
    """Yield the file or the address of the live view, and an event that is set when the view has ended.

    The live view is the service's own, or is drawn on this machine from records. Raises ServiceError at the end if the
    view has ended because a service was restarted.
    """
    if file is not None:
        with without_partial_message(file, growing=is_being_written(file)) as whole:
            yield str(whole), threading.Event()
        return
    infos = []
    for robot in dict.fromkeys(robots):
        with Robot(robot, connect, tls=tls) as service:
            infos.append(service.info())
    if records or len(infos) > 1 or not (is_local(connect) and is_here(infos[0].machine)):
        from trirail.cli.remote_view import RemoteView

        with RemoteView(infos, connect, credentials_for(robots[0], connect, tls)) as drawn:
            yield drawn.url, drawn.ended
        if restarted := [info.robot for info, robot in zip(infos, drawn.robots, strict=True) if robot.restarted]:
            raise ServiceError(
                f"the view has ended, because the service of {', '.join(restarted)} was restarted: its times begin "
                "again, and its configuration may have changed; run trirail view again"
            )
        return
    (info,) = infos
    if not info.live:
        raise ServiceError(
            "the service has no live view (telemetry.live_port = 0): "
            "use trirail view --records, which draws the view here from the published records"
        )
    parts = urlsplit(info.live)
    try:
        socket.create_connection((parts.hostname or LOOPBACK, parts.port or 0), timeout=2.0).close()
    except OSError as error:
        raise ServiceError(
            f"nothing answers at {info.live} on this machine: "
            "if the service runs on another machine, use trirail view --records"
        ) from error
    yield info.live, threading.Event()


def _browse(source: str, ended: threading.Event, say: Callable[[dict[str, str], str], None]) -> None:
    """Serve the web viewer on this machine's loopback only, until the viewer ends."""
    port, data_port = _web_port(), free_port()
    address = source if "://" in source else f"rerun+http://{LOOPBACK}:{data_port}/proxy"
    url = f"http://{LOOPBACK}:{port}/?url={quote(address, safe='')}&hide_welcome_screen=1"
    with _rerun("--serve-web", "--web-viewer-port", str(port), "--port", str(data_port), source) as server:
        deadline = time.monotonic() + START_TIMEOUT_S
        while not _answers(port):
            if server.poll() is not None:
                return
            if time.monotonic() > deadline:
                raise ServiceError(f"the web viewer does not answer on port {port} within {START_TIMEOUT_S:g} s")
            time.sleep(0.05)
        say({"url": url, "source": source}, f"{source} in the browser, on this machine alone, until Ctrl-C: {url}")
        if has_display():
            webbrowser.open(url)
        _wait(server, ended)


@contextlib.contextmanager
def _rerun(*arguments: str) -> Iterator[subprocess.Popen[bytes]]:
    """Run Rerun's viewer, restricted to this machine because it would otherwise listen on every network.

    The viewer is always terminated when the context ends. Raises ServiceError if the viewer fails by itself.
    """
    command = python("-m", "rerun_cli", "--bind", LOOPBACK, "--hide-welcome-screen", *arguments)
    with tempfile.TemporaryFile() as log, _settings() as environment:
        viewer = subprocess.Popen(command, stdout=log, stderr=log, start_new_session=True, env=environment)
        try:
            yield viewer
            log.seek(0)
            last = log.read().decode(errors="replace").strip().rpartition("\n")[2]
            # If the viewer cannot open its window, it prints a message but still exits with 0.
            if viewer.poll() or (viewer.poll() == 0 and last.startswith("Error: ")):
                raise ServiceError(
                    f"the viewer failed: {last}; use trirail view --web, which needs no graphics driver here"
                )
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(viewer.pid, signal.SIGTERM)  # `python -m rerun_cli` does not forward signals
            viewer.wait()


@contextlib.contextmanager
def _settings() -> Iterator[dict[str, str]]:
    """Yield an environment in which Rerun's programs send no analytics.

    Rerun 0.41 reads this setting from a file and not from a variable.
    """
    with files.temporary_folder() as folder:
        file = folder / "rerun" / "analytics.json"
        file.parent.mkdir()
        settings = {
            "analytics_enabled": False,
            "analytics_id": "",
            "config_file_path": str(file),
            "data_dir_path": str(file.parent),
        }
        file.write_text(json.dumps(settings))
        yield os.environ | {"XDG_CONFIG_HOME": str(folder)}


def _web_port() -> int:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((LOOPBACK, WEB_PORT))
        except OSError:
            return free_port()
    return WEB_PORT


def _answers(port: int) -> bool:
    try:
        socket.create_connection((LOOPBACK, port), timeout=1.0).close()
    except OSError:
        return False
    return True
