"""Zenoh sessions of service and clients: no discovery, bounded queues, and only the configured addresses."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import zenoh

from trirail.errors import ServiceError
from trirail.wire.credentials import Credentials
from trirail.wire.dialling import connection_problem
from trirail.wire.endpoints import DEFAULT_LOCATOR, leads_to
from trirail.wire.sizes import MAX_TRANSPORT
from trirail.wire.starting import is_starting

SESSIONS = 512
"""Maximum number of clients connected to a service; a router counts as one."""
SEND_TIMEOUT_S = 2.0
"""Time after which a client is disconnected if it does not accept a message that must not be dropped, such as a reply
or a past event [s]."""
BATCH_SIZE = 8192
"""Size of a service's send and receive buffers [bytes]; a larger message is sent in fragments. Zenoh uses the smaller
size of the two sides."""

_COMMON_SETTINGS = {
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "scouting/gossip/autoconnect": {"router": [], "peer": [], "client": []},
    "transport/shared_memory/enabled": False,  # the maximum size below would not apply to it
    "transport/link/rx/max_message_size": MAX_TRANSPORT,
}


def key(robot: str, *parts: str) -> str:
    """Return the key expression of a robot's resource."""
    return "/".join(("trirail", robot, *parts))


def open_service(
    listen: Sequence[str],
    credentials: Credentials | None = None,
    access_control: Mapping[str, Any] | None = None,
    connect: Sequence[str] = (),
) -> zenoh.Session:
    """Return the service's session: a peer that listens on the given locators only.

    With credentials, every client needs a certificate of the same authority; `access_control` is that section of
    Zenoh's configuration. The session connects to the routers of `connect`, and reconnects when a connection is lost.
    """
    settings = {"mode": "peer", **serving(listen, credentials, access_control, connect)}
    return _open(
        settings,
        f"cannot listen on {', '.join(listen)}",
        lambda: "; end the other service that may use it, or set zenoh.listen to another address",
    )


def router(
    listen: Sequence[str],
    credentials: Credentials | None,
    access_control: Mapping[str, Any] | None,
    connect: Sequence[str],
    thinned: Mapping[str, float],
) -> dict[str, Any]:
    """Return the configuration of a router, for Zenoh's own program zenohd.

    `thinned` has the maximum rate per client of some keys [Hz]. Zenoh drops the messages in between, including the
    newest, so use it for states only. Zenoh keeps one timer per rule, hence one rule per key.
    """
    settings = _COMMON_SETTINGS | {
        "mode": "router",
        **serving(listen, credentials, access_control, connect, len(thinned) + SESSIONS),
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
    """Return the settings of a service or router, by their paths in Zenoh's configuration."""
    return {
        "listen/endpoints": list(listen),
        "connect/endpoints": list(connect),
        # Start without a router that is absent, and keep trying: 0 instead of -1 would try only once.
        "connect/timeout_ms": -1,
        "connect/exit_on_failure": False,
        "connect/retry": {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 2},
        # A waiting message occupies the whole buffer in which it arrived: with the default of 65,535 bytes, 2,600 small
        # messages of one user held 180 MB.
        "transport/link/tx/batch_size": BATCH_SIZE,
        "transport/link/rx/buffer_size": BATCH_SIZE,
        # Connections that never open a session must not keep others out: hence many, and a short time-out.
        "transport/unicast/accept_pending": 1000,
        "transport/unicast/accept_timeout": 3000,
        "transport/unicast/max_sessions": sessions,
        "timestamping/enabled": True,  # advanced publishers order their history by it
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 0,
        "transport/link/tx/queue/congestion_control/block/wait_before_close": round(SEND_TIMEOUT_S * 1e6),
        "transport/link/tx/queue/size/data_high": 16,
        "transport/link/tx/queue/size/real_time": 16,  # replies are sent in bursts
        **_tls(credentials),
        **({"access_control": access_control} if access_control is not None else {}),
    }


def open_client(locator: str, credentials: Credentials | None = None) -> zenoh.Session:
    """Return a client's session to a service or router, with credentials if it requires them."""
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
    """Return why no session opens at a locator, and the next step, because Zenoh does not report the reason."""
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
    """Return the endpoints with a connection; with `router`, only those whose certificate has that common name."""
    links = opened.info.links()
    reached = [str(link.dst) for link in links if router is None or link.auth_identifier == router]
    return {endpoint for endpoint in endpoints if any(leads_to(endpoint, other) for other in reached)}


def close(opened: zenoh.Session) -> None:
    """Close a session; a session that hangs stays open until the process ends."""
    with contextlib.suppress(zenoh.ZError):
        opened.close()  # type: ignore[no-untyped-call]  # zenoh's stub leaves it so


def _tls(credentials: Credentials | None) -> dict[str, Any]:
    """Return settings for mutual authentication by one authority; connections end when a certificate expires."""
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
    zenoh.init_log_from_env_or("off")  # the error below contains the message that zenoh would print
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
