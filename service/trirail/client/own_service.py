"""Private service in a separate process, for demos, tools and tests."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO

from trirail.config import SIM
from trirail.errors import RefusedError, ServiceError, TrirailError
from trirail.processes.operating_system import STARTER, python

PATIENT = {
    "max_overruns": "1000",
    "missed_syncs": "2000",
    "missed_positions": "1000",
    "heartbeat": "1.0\nsdo_timeout = 5.0",
    "gateway_timeout": "1.0",
}
"""Configuration values with which a service tolerates that a busy machine stalls its processes for a second."""
START_WITHIN = 300.0
"""Longest time without progress during the start [s]; at the very first start, compiling a function is one step."""
END_WITHIN = 20.0
"""Time-out for the end of the service, which first stops the robot [s]."""

Process = subprocess.Popen[bytes]


@contextlib.contextmanager
def service(config: Path, recording: Path, report_start: Callable[[str], None] = lambda _: None) -> Iterator[Process]:
    """Run a service that records to the file `recording`; end the service when the context ends.

    Entering the context waits until the service is up. `report_start` is called with messages about the start, such as
    the progress of the compilation at the very first start.

    Raises ServiceError if the service cannot start. If a TrirailError other than a RefusedError ends the context, the
    service's output is first written to standard error.
    """
    with tempfile.TemporaryFile() as log:
        process = None
        try:
            process = start(config, log, "--record", str(recording), report_start=report_start)
            yield process
        except RefusedError:
            raise  # the service works, and the refusal contains the reason
        except TrirailError:
            log.seek(0)
            sys.stderr.write(log.read().decode(errors="backslashreplace"))
            raise
        finally:
            if process is not None:
                end(process)


def start(
    config: Path,
    log: IO[bytes],
    *arguments: str,
    report_start: Callable[[str], None] = lambda _: None,
    **environment: str,
) -> Process:
    """Start a service, and wait until the service is up; the caller must `end` the service. It also ends if the calling
    process ends in another way, such as by SIGKILL.

    `arguments` are appended to the command `trirail run`, and `environment` is added to the environment variables. The
    output is written to `log`. The service reports with systemd's notification protocol that it is up. A query on the
    service's port would be no substitute, since the query could reach another service and move that robot. Raises
    ServiceError if the service ends before it is up, or makes no progress for START_WITHIN seconds; the function then
    ends the service.
    """
    with tempfile.TemporaryDirectory() as folder, socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as ready:
        ready.bind(f"{folder}/ready")
        ready.settimeout(0.1)
        process = subprocess.Popen(
            python("-m", "trirail", "run", str(config), *arguments),
            stdout=log,
            stderr=log,
            start_new_session=True,
            env=os.environ | {"NOTIFY_SOCKET": ready.getsockname(), STARTER: str(os.getpid())} | environment,
        )
        try:
            _wait(process, ready, report_start)
        except BaseException:
            end(process)
            raise
        return process


def end(process: Process) -> int:
    """End a service, which first stops the robot; return the exit code, 0 for a regular end.

    Raises subprocess.TimeoutExpired if the service has not ended within END_WITHIN seconds.
    """
    process.send_signal(signal.SIGTERM)
    return process.wait(END_WITHIN)


def private(folder: Path, live_port: int = 0) -> tuple[Path, str]:
    """Write a configuration of the simulated robot for a private service, at a Unix socket in `folder`.

    The time-outs are long enough for a busy machine that stalls for a second, since only simulated sliders move.

    Parameters
    ----------
    live_port
        Port of the live view; 0 for none.

    Returns
    -------
    path
        Configuration file in `folder`.
    locator
        Zenoh locator of the service.

    """
    locator = f"unixsock-stream/{folder}/zenoh"
    text = SIM.read_text(encoding="utf-8")
    for key, value in ({"listen": f'["{locator}"]', "live_port": str(live_port)} | PATIENT).items():
        text, count = re.subn(rf"^{key} = .*$", f"{key} = {value}", text, flags=re.MULTILINE)
        if count != 1:
            raise ServiceError(f"{SIM}: {key} was expected once, but found {count} times")
    path = folder / SIM.name
    path.write_text(text, encoding="utf-8")
    return path, locator


def _wait(process: Process, ready: socket.socket, report_start: Callable[[str], None]) -> None:
    deadline = time.monotonic() + START_WITHIN
    while time.monotonic() < deadline:
        with contextlib.suppress(TimeoutError):
            notification = ready.recv(1024).decode()
            if notification == "READY=1":
                return
            deadline = time.monotonic() + START_WITHIN
            report_start(notification.partition("STATUS=")[2].partition("\n")[0])
        if process.poll() is not None:
            raise ServiceError("the service could not start, see above")
    raise ServiceError(f"the service did not start within {START_WITHIN:g} s")
