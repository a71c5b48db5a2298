"""Zenoh sessions as both sides open them: no discovery, bounded queues, nothing beyond the addresses given."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import msgspec
import zenoh

from service.errors import ServiceError

DEFAULT_LOCATOR = "tcp/127.0.0.1:7447"
JSON, MSGPACK, BINARY = "application/json", "application/msgpack", "application/octet-stream"
TRANSPORT_LIMIT = 1 << 16
"""A goal or command larger than this is thrown away by the transport, before anything is answered [bytes]."""

_NO_DISCOVERY = {
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "scouting/gossip/autoconnect": {"router": [], "peer": [], "client": []},
}


def key(robot: str, *parts: str) -> str:
    """Return the key expression of a robot's resource."""
    return "/".join(("trirail", robot, *parts))


def open_service(robot: str, listen: Sequence[str]) -> zenoh.Session:
    """Open the service's session: a peer that listens on the given locators and nowhere else."""
    limited = [key(robot, "goal", "**"), key(robot, "cmd", "**")]
    return _open(
        {
            "mode": "peer",
            "listen/endpoints": list(listen),
            "connect/endpoints": [],
            "timestamping/enabled": True,  # advanced publishers order their history by it
            "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 0,
            "transport/link/tx/queue/size/data_high": 16,
            "low_pass_filter": [
                {
                    "id": "requests",
                    "flows": ["ingress"],
                    "messages": ["put", "query"],
                    "key_exprs": limited,
                    "size_limit": TRANSPORT_LIMIT,
                }
            ],
        },
        f"cannot listen on {', '.join(listen)}",
        "another service may hold it: end that, or set zenoh.listen to another address",
    )


def open_client(locator: str) -> zenoh.Session:
    """Open a client's session to a service or router."""
    return _open(
        {
            "mode": "client",
            "connect/endpoints": [locator],
            "connect/timeout_ms": 2000,
            "connect/exit_on_failure": True,
            "connect/retry": {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 2},
            "listen/endpoints": [],
        },
        f"no service at {locator}",
        "start one with: trirail run configs/sim.toml, or name its address with --connect",
    )


def _open(settings: dict[str, Any], failure: str, remedy: str) -> zenoh.Session:
    zenoh.init_log_from_env_or("off")  # what zenoh would print is in the error below
    config = zenoh.Config()
    for name, value in (_NO_DISCOVERY | settings).items():
        config.insert_json5(name, json.dumps(value))
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise ServiceError(f"{failure}; {remedy}") from error


def encode(content: msgspec.Struct, encoding: str = JSON) -> bytes:
    """Encode a message as the encoding says."""
    return msgspec.msgpack.encode(content) if encoding.startswith(MSGPACK) else msgspec.json.encode(content)
