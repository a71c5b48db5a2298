"""What an endpoint of Zenoh lacks, and who reaches it: a machine's users, those of a socket's file, a whole network."""

from __future__ import annotations

import ipaddress
import re
from enum import StrEnum
from pathlib import Path

DEFAULT_LOCATOR = "tcp/127.0.0.1:7447"
"""Where a service is, if nothing else is said."""
LIKE = "an endpoint is protocol/address, as tcp/127.0.0.1:7447"
_WITH_PORT = frozenset({"tcp", "tls", "udp", "quic", "ws"})
LAST_PORT = 65535
_HOST = re.compile(
    r"(?=.{1,253}$)[A-Za-z0-9_]([A-Za-z0-9_-]{0,61}[A-Za-z0-9_])?(\.[A-Za-z0-9_]([A-Za-z0-9_-]{0,61}[A-Za-z0-9_])?)*"
)
_Address = ipaddress.IPv4Address | ipaddress.IPv6Address


class ReachableBy(StrEnum):
    """Who can open a session on an endpoint, by what he must have."""

    FILE = "who may write to the socket's file"
    MACHINE = "every user of this machine"
    CERTIFICATE = "who has a role, by his certificate,"
    NETWORK = "everybody in the network"


def fault_of(endpoint: str) -> str:
    """Return what an endpoint lacks, and what one looks like, in words; "" where it lacks nothing."""
    protocol, address = _parts(endpoint)
    if "/" not in endpoint or not protocol:
        return f"the protocol is missing: {LIKE}"
    if not address:
        return f"the address is missing: {LIKE}"
    if protocol not in _WITH_PORT:
        return ""
    host, colon, port = address.rpartition(":")
    if address.endswith("]") or not colon:
        return f"the port is missing: {LIKE}"
    if not host:
        return f"the host is missing: {LIKE}"
    if ":" in host and not (host.startswith("[") and host.endswith("]")):
        return f"an IPv6 address is in brackets, and the port behind them, as {protocol}/[::1]:7447"
    if not (port.isascii() and port.isdigit() and len(port) <= len(str(LAST_PORT)) and 1 <= int(port) <= LAST_PORT):
        return f"its port must be 1 to {LAST_PORT}: {LIKE}"
    return ""


def tcp_address(endpoint: str) -> tuple[str, int] | None:
    """Return host and port of an endpoint that has them and takes a port of TCP, None of any other."""
    protocol, address = _parts(endpoint)
    host, _, port = address.rpartition(":")
    return (host.strip("[]"), int(port)) if protocol in {"tcp", "tls", "ws"} else None


def is_host(text: str) -> bool:
    """Whether it is an IP address or may be a host name (RFC 1123, and with _), without port and protocol."""
    try:
        ipaddress.ip_address(text)
    except ValueError:
        *_, last = text.split(".")
        return _HOST.fullmatch(text) is not None and not last.isdigit()
    return True


def leads_to(endpoint: str, reached: str) -> bool:
    """Whether an endpoint that is dialled leads to one that was reached, of whose host the IP address is known.

    A host name may stand for any address.
    """
    (protocol, address), (as_protocol, as_address) = _parts(endpoint), _parts(reached)
    if protocol != as_protocol or protocol not in _WITH_PORT:
        return (protocol, address) == (as_protocol, as_address)
    (host, _, port), (as_host, _, as_port) = address.rpartition(":"), as_address.rpartition(":")
    try:
        same_host = ipaddress.ip_address(host.strip("[]")) == ipaddress.ip_address(as_host.strip("[]"))
    except ValueError:
        same_host = True
    return same_host and port == as_port


def same_port(one: tuple[str, int], other: tuple[str, int]) -> bool:
    """Whether two hosts and ports cannot be listened on at once; of host names only those that are equal."""
    if one[1] != other[1]:
        return False
    try:
        first, second = (ipaddress.ip_address("127.0.0.1" if host == "localhost" else host) for host, _ in (one, other))
    except ValueError:
        return one[0] == other[0]
    return first == second or _covers(first, second) or _covers(second, first)


def _covers(every: _Address, other: _Address) -> bool:
    """Whether one address stands for all of a machine's, the other among them; that of IPv6 also for those of IPv4."""
    return every.is_unspecified and every.version >= other.version


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
