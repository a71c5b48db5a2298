"""Who reaches a Zenoh endpoint: this machine's users, those whom a socket's file lets, or a whole network."""

from __future__ import annotations

import ipaddress
from enum import StrEnum
from pathlib import Path


class ReachableBy(StrEnum):
    """Who can open a session on an endpoint, by what he must have."""

    FILE = "who may write to the socket's file"
    MACHINE = "every user of this machine"
    CERTIFICATE = "who has a role, by his certificate,"
    NETWORK = "everybody in the network"


def reach(endpoint: str) -> ReachableBy:
    """Return who reaches an endpoint; the whole network where that is not sure, as for a host name."""
    protocol = endpoint.partition("/")[0]
    if protocol == "tls":
        return ReachableBy.CERTIFICATE
    if protocol == "unixsock-stream":
        return ReachableBy.FILE
    return ReachableBy.MACHINE if is_local(endpoint) else ReachableBy.NETWORK


def endpoint_of(address: str, port: int) -> str:
    """Return an IP address and a port as an endpoint of TCP."""
    return f"tcp/[{address}]:{port}" if ":" in address else f"tcp/{address}:{port}"


def socket_file(endpoint: str) -> Path | None:
    """Return the file of an endpoint that is a Unix socket, None of any other."""
    protocol, address = _parts(endpoint)
    return Path(address) if protocol == "unixsock-stream" else None


def is_local(endpoint: str) -> bool:
    """Whether an endpoint, protocol/address, stays on this machine."""
    protocol, address = _parts(endpoint)
    host = address.rpartition(":")[0].removeprefix("[").removesuffix("]")
    if protocol in {"unixsock-stream", "unixpipe"} or host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _parts(endpoint: str) -> tuple[str, str]:
    """The protocol and the address of `protocol/address?metadata#settings`."""
    protocol, _, rest = endpoint.partition("/")
    return protocol, rest.partition("#")[0].partition("?")[0]
