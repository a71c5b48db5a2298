"""Zenoh sessions of services and clients, without discovery, with limited queues, and only at configured addresses."""

from __future__ import annotations

import contextlib
import json
import os
import socket
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import zenoh

from trirail.errors import ServiceError
from trirail.wire.credentials import Credentials
from trirail.wire.dialling import connection_problem
from trirail.wire.endpoints import DEFAULT_LOCATOR, leads_to, socket_file, tcp_address
from trirail.wire.sizes import MAX_TRANSPORT
from trirail.wire.starting import is_starting

SESSIONS = 512
"""Maximum number of clients connected to a service; a router counts as one client."""
SEND_TIMEOUT_S = 2.0
"""Time for which the service waits for a client to accept a message before it disconnects the client [s].

This applies to messages that must not be dropped, such as replies and past events."""
BATCH_SIZE = 8192
"""Size of a service's send and receive buffers [bytes]; a larger message is sent in fragments.

Zenoh uses the smaller of the sizes that the two sides of a connection propose."""

_RUNTIME = "(rx: (worker_threads: 8))"
"""Threads with which a service's Zenoh handles received messages, unless ZENOH_RUNTIME is set.

When a connection to a frozen client times out, Zenoh blocks one of these threads for 10 s. It has two by default, so
that two frozen clients would delay the messages of all others.
"""
_COMMON_SETTINGS = {
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "scouting/gossip/autoconnect": {"router": [], "peer": [], "client": []},
    "transport/shared_memory/enabled": False,  # the maximum size below would not apply to shared memory
    "transport/link/rx/max_message_size": MAX_TRANSPORT,
}


def key(robot: str, *parts: str) -> str:
    """Return the key expression made of a robot's name and `parts`."""
    return "/".join(("trirail", robot, *parts))


def open_service(
    listen: Sequence[str],
    credentials: Credentials | None = None,
    access_control: Mapping[str, Any] | None = None,
    connect: Sequence[str] = (),
) -> zenoh.Session:
    """Open the session of a service, a Zenoh peer that listens only on the locators `listen`.

    With credentials, every client needs a certificate of the same authority. `access_control` is the section of this
    name in Zenoh's configuration. The session connects to the routers at the locators `connect`, and reconnects when a
    connection is lost. Raises ServiceError if the session cannot be opened.
    """
    for file in filter(None, map(socket_file, listen)):
        if os.path.lexists(file) and not file.is_socket():  # Zenoh would delete the file
            raise ServiceError(
                f"cannot listen on {file}: this file exists and is not a socket; move it away, or change zenoh.listen"
            )
    settings = {"mode": "peer", **serving(listen, credentials, access_control, connect)}
    os.environ.setdefault("ZENOH_RUNTIME", _RUNTIME)  # Zenoh reads it when the first session of the process opens
    return _open(
        settings,
        f"cannot listen on {', '.join(listen)}",
        lambda: f": {_listening_fault(listen)}",
    )


def _listening_fault(listen: Sequence[str]) -> str:
    """Return why this program cannot listen on one of the locators, and the remedy. Zenoh's errors do not tell."""
    in_use = "end the other service that may use it, or set zenoh.listen to another address"
    for locator in listen:
        if (file := socket_file(locator)) is not None:
            folder = file.parent
            if not folder.is_dir():
                return f"there is no folder {folder}; create it, or change zenoh.listen"
            if not os.access(folder, os.W_OK | os.X_OK):
                return f"this user may not write in {folder}; change its rights, or zenoh.listen"
            if (lock := Path(f"{file}.lock")).exists() and not os.access(lock, os.R_OK | os.W_OK):
                return f"{lock} belongs to another user; end that user's service and delete the file"
        elif (address := tcp_address(locator)) is not None:
            try:
                socket.create_server(address, family=socket.AF_INET6 if ":" in address[0] else socket.AF_INET).close()
            except OSError as error:
                why = os.strerror(error.errno) if isinstance(error.errno, int) and error.errno > 0 else error
                return f"{why} ({locator}); {in_use}"
    return in_use


def router(
    listen: Sequence[str],
    credentials: Credentials | None,
    access_control: Mapping[str, Any] | None,
    connect: Sequence[str],
    thinned: Mapping[str, float],
) -> dict[str, Any]:
    """Return the configuration of a router for Zenoh's program zenohd.

    `thinned` maps key expressions to the maximum rate [Hz] at which the router sends their messages to each client.
    Zenoh drops the messages in between, even if the dropped message is the newest, so use `thinned` only for states.
    Each key expression gets a separate rule, since Zenoh has one timer for each rule.
    """
    settings = _COMMON_SETTINGS | {
        "mode": "router",
        # Each robot has two sessions to the router; see trirail.processes.name_conflict.
        **serving(listen, credentials, access_control, connect, 2 * len(thinned) + SESSIONS),
        "downsampling": [
            {
                "id": f"thinned {number}",
                "messages": ["put"],
                "flows": ["egress"],
                "rules": [{"key_expr": expression, "freq": most}],
            }
            for number, (expression, most) in enumerate(thinned.items())
        ],
    }
    whole: dict[str, Any] = {}
    for path, value in settings.items():
        *tables, name = path.split("/")
        inner = whole
        for table in tables:
            inner = inner.setdefault(table, {})
        inner[name] = value
    return whole


def serving(
    listen: Sequence[str],
    credentials: Credentials | None,
    access_control: Mapping[str, Any] | None,
    connect: Sequence[str],
    sessions: int = SESSIONS,
) -> dict[str, Any]:
    """Return the settings that services and routers share, by their paths in Zenoh's configuration."""
    return {
        "listen/endpoints": list(listen),
        "connect/endpoints": list(connect),
        # Start even if a router is absent, and try to connect repeatedly. With 0 instead of -1, Zenoh would try once.
        "connect/timeout_ms": -1,
        "connect/exit_on_failure": False,
        "connect/retry": {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 2},
        # A waiting message occupies the whole buffer in which it arrived. With the default size of 65,535 bytes, 2,600
        # small messages of one user occupied 180 MB.
        "transport/link/tx/batch_size": BATCH_SIZE,
        "transport/link/rx/buffer_size": BATCH_SIZE,
        # Connections that never open a session must not block other clients. Many connections may therefore wait for a
        # session at the same time, with a short time-out.
        "transport/unicast/accept_pending": 1000,
        "transport/unicast/accept_timeout": 3000,
        "transport/unicast/max_sessions": sessions,
        "timestamping/enabled": True,  # advanced publishers sort their history by timestamp
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 0,
        "transport/link/tx/queue/congestion_control/block/wait_before_close": round(SEND_TIMEOUT_S * 1e6),
        "transport/link/tx/queue/size/data_high": 16,
        "transport/link/tx/queue/size/real_time": 16,  # replies are sent in bursts
        **_tls(credentials),
        **({"access_control": access_control} if access_control is not None else {}),
    }


def open_client(locator: str, credentials: Credentials | None = None) -> zenoh.Session:
    """Open a client's session to a service or router. Raises ServiceError if the session cannot be opened."""
    return _open(
        {
            "mode": "client",
            "connect/endpoints": [locator],
            "connect/timeout_ms": 2000,
            "connect/exit_on_failure": True,
            "connect/retry": {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 2},
            "listen/endpoints": [],
            **_tls(credentials),
        },
        f"no service at {locator}",
        lambda: _connection_advice(locator, credentials),
    )


def _connection_advice(locator: str, credentials: Credentials | None) -> str:
    """Return the reason why no session opens at a locator, which Zenoh does not report, and the next step."""
    if is_starting(locator):
        return " yet: the service is starting; try again when it reports that it is up"
    refused = "" if credentials is None else ", or rejects these certificates"
    silent = f"the program that listens there does not answer, or has the maximum number of clients{refused}"
    why = connection_problem(locator, credentials) or silent
    start = "start one with: trirail run"
    if locator != DEFAULT_LOCATOR:
        start = "start trirail run or zenohd there"
    folder = " and its authority's folder with --tls" if credentials is not None else ""
    return f": {why}; {start}, or name another address with --connect{folder} (in Python connect=)"


def linked(opened: zenoh.Session, endpoints: Sequence[str], router: str | None) -> set[str]:
    """Return the endpoints to which a session is connected.

    With `router`, only connections to a certificate with this common name count.
    """
    links = opened.info.links() if endpoints else []
    reached = [str(link.dst) for link in links if router is None or link.auth_identifier == router]
    return {endpoint for endpoint in endpoints if any(leads_to(endpoint, other) for other in reached)}


def close(opened: zenoh.Session) -> None:
    """Close a session. If Zenoh fails to close the session, it stays open until the process ends."""
    with contextlib.suppress(zenoh.ZError):
        opened.close()  # type: ignore[no-untyped-call]  # zenoh's stub leaves it so


def _tls(credentials: Credentials | None) -> dict[str, Any]:
    """Return the settings for mutual authentication with certificates of one authority.

    A connection ends when one of its certificates expires.
    """
    if credentials is None:
        return {}
    authority, certificate, key_file = map(str, credentials.files)
    return {
        "transport/link/tls": {
            "root_ca_certificate": authority,
            "enable_mtls": True,
            "listen_certificate": certificate,
            "listen_private_key": key_file,
            "connect_certificate": certificate,
            "connect_private_key": key_file,
            "verify_name_on_connect": True,
            "close_link_on_expiration": True,
        }
    }


def _open(settings: dict[str, Any], failure: str, explain: Callable[[], str]) -> zenoh.Session:
    zenoh.init_log_from_env_or("off")  # the error below contains the message that Zenoh would log
    config = zenoh.Config()
    try:
        for name, value in (_COMMON_SETTINGS | settings).items():
            config.insert_json5(name, json.dumps(value))
    except zenoh.ZError as error:
        raise ServiceError(f"{failure}: a locator is protocol/address, such as tcp/192.168.1.7:7447") from error
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise ServiceError(f"{failure}{explain()}") from error
