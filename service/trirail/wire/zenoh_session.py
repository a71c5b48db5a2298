"""Zenoh sessions as both sides open them: no discovery, bounded queues, nothing beyond the addresses given."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import zenoh

from trirail.errors import ServiceError
from trirail.wire.credentials import Credentials
from trirail.wire.dialling import why_not
from trirail.wire.endpoints import DEFAULT_LOCATOR, leads_to
from trirail.wire.sizes import MAX_TRANSPORT
from trirail.wire.starting import is_starting

SESSIONS = 512
"""Clients that may be connected to a service at once; a router is one."""
GIVEN_UP_AFTER = 2.0
"""Whoever takes nothing that must not be dropped, an answer or past events, is disconnected after so long [s]."""
BATCH_SIZE = 8192
"""Size of the buffers in which a service sends to its clients and receives from them; a larger message is sent in
fragments [bytes]. Zenoh agrees on the smaller size of both sides."""

_ALWAYS = {
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "scouting/gossip/autoconnect": {"router": [], "peer": [], "client": []},
    "transport/shared_memory/enabled": False,  # the memory of strangers; and the size below is for what is sent
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
    """Open the service's session: a peer that listens on the given locators and nowhere else.

    With credentials it asks every client for a certificate of the same authority; `access_control`, that section of
    Zenoh's configuration, is what each may do. It dials the routers of `connect`, and again whenever they are gone.
    """
    settings = {"mode": "peer", **serving(listen, credentials, access_control, connect)}
    return _open(
        settings,
        f"cannot listen on {', '.join(listen)}",
        lambda: "; another service may hold it: end that, or set zenoh.listen to another address",
    )


def router(
    listen: Sequence[str],
    credentials: Credentials | None,
    access_control: Mapping[str, Any] | None,
    connect: Sequence[str],
    thinned: Mapping[str, float],
) -> dict[str, Any]:
    """Return a router's configuration file, of Zenoh's own program zenohd.

    Of the keys in `thinned` no more leaves for each client than so often a second: its newest is dropped, so that this
    is for states alone. Zenoh keeps one time for a rule, hence a rule for each key.
    """
    settings = _ALWAYS | {
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
    """Return the settings of who serves others, by their paths in Zenoh's configuration."""
    return {
        "listen/endpoints": list(listen),
        "connect/endpoints": list(connect),
        # Begin without a router that is not there, and try again and again: with 0 in place of -1 it is tried once.
        "connect/timeout_ms": -1,
        "connect/exit_on_failure": False,
        "connect/retry": {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 2},
        # Connections on which nothing comes must not keep others out.
        # A message that waits keeps the whole buffer in which it arrived: with the default of 65,535 bytes, 2,600 small
        # ones of one user held 180 MB.
        "transport/link/tx/batch_size": BATCH_SIZE,
        "transport/link/rx/buffer_size": BATCH_SIZE,
        "transport/unicast/accept_pending": 1000,
        "transport/unicast/accept_timeout": 3000,
        "transport/unicast/max_sessions": sessions,
        "timestamping/enabled": True,  # advanced publishers order their history by it
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 0,
        "transport/link/tx/queue/congestion_control/block/wait_before_close": round(GIVEN_UP_AFTER * 1e6),
        "transport/link/tx/queue/size/data_high": 16,
        "transport/link/tx/queue/size/real_time": 16,  # answers come in bursts
        **_tls(credentials),
        **({"access_control": access_control} if access_control is not None else {}),
    }


def open_client(locator: str, credentials: Credentials | None = None) -> zenoh.Session:
    """Open a client's session to a service or router, with credentials where that asks for them."""
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
        lambda: _why_nobody(locator, credentials),
    )


def _why_nobody(locator: str, credentials: Credentials | None) -> str:
    """Say why no session opens at a locator, and what to do; a second look, for Zenoh does not tell."""
    if is_starting(locator):
        return " yet: it is starting; try again when it says that it is up"
    refused = "" if credentials is None else ", or these certificates are refused"
    silent = f"who listens there does not answer, or has as many clients as it may{refused}"
    why = why_not(locator, credentials) or silent
    start = "start one with: trirail run"
    if locator != DEFAULT_LOCATOR:
        start = "start what is to answer there, trirail run or zenohd"
    folder = " and its authority's folder with --tls" if credentials is not None else ""
    return f": {why}; {start}, or name another address with --connect{folder} (in Python connect=)"


def linked(opened: zenoh.Session, endpoints: Sequence[str], router: str | None) -> set[str]:
    """Return to which endpoints there is a link now; with the name of `router` only where its certificate has that."""
    links = opened.info.links()
    reached = [str(link.dst) for link in links if router is None or link.auth_identifier == router]
    return {endpoint for endpoint in endpoints if any(leads_to(endpoint, other) for other in reached)}


def close(opened: zenoh.Session) -> None:
    """Close a session; one that is stuck is left to the end of the process."""
    with contextlib.suppress(zenoh.ZError):
        opened.close()  # type: ignore[no-untyped-call]  # zenoh's stub leaves it so


def _tls(credentials: Credentials | None) -> dict[str, Any]:
    """Both sides show a certificate, each believes only its authority, and neither outlives the other's."""
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
    zenoh.init_log_from_env_or("off")  # what zenoh would print is in the error below
    config = zenoh.Config()
    try:
        for name, value in (_ALWAYS | settings).items():
            config.insert_json5(name, json.dumps(value))
    except zenoh.ZError as error:
        raise ServiceError(f"{failure}: a locator is protocol/address, tcp/192.168.1.7:7447 for one") from error
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise ServiceError(f"{failure}{explain()}") from error
