"""Validation and comparison of Zenoh endpoints, and classification of the users who can connect to an endpoint."""

from __future__ import annotations

import ipaddress
import os
import re
from enum import StrEnum
from pathlib import Path

DEFAULT_LOCATOR = "tcp/127.0.0.1:7447"
"""Endpoint at which a service listens by default."""
ENDPOINT_SYNTAX = "an endpoint is protocol/address, such as tcp/127.0.0.1:7447"
_WITH_PORT = frozenset({"tcp", "tls"})
"""Protocols whose endpoints have a port. Others of Zenoh have no stop port, and ws is also open to web pages."""
_UNIX = "unixsock-stream"
SOCKET_SYNTAX = f"use an absolute path, such as {_UNIX}//run/trirail/zenoh"
MAX_SOCKET_PATH = 102
"""Maximum length of the path of a Unix socket [bytes]. The kernel allows 107, unix(7), also for PATH.stop."""
LAST_PORT = 65535
_HOST_NAME = re.compile(
    r"(?=.{1,253}$)[A-Za-z0-9_]([A-Za-z0-9_-]{0,61}[A-Za-z0-9_])?(\.[A-Za-z0-9_]([A-Za-z0-9_-]{0,61}[A-Za-z0-9_])?)*"
)
_Address = ipaddress.IPv4Address | ipaddress.IPv6Address


class ReachableBy(StrEnum):
    """Group of users who can open a session at an endpoint."""

    FILE = "users with write access to the socket's file"
    MACHINE = "every user of this machine"
    CERTIFICATE = "users with a certificate and a role"
    NETWORK = "everybody in the network"


def fault_of(endpoint: str) -> str:
    """Return the problem of an endpoint and the expected form; "" if the endpoint is valid."""
    protocol, address = _parts(endpoint)
    if "/" not in endpoint or not protocol:
        return f"the protocol is missing: {ENDPOINT_SYNTAX}"
    if not address:
        return f"the address is missing: {ENDPOINT_SYNTAX}"
    if protocol == _UNIX:
        return _fault_of_path(address)
    if protocol not in _WITH_PORT:
        return f"the protocol {protocol} is unknown: use tcp, tls or {_UNIX}"
    host, colon, port = address.rpartition(":")
    if address.endswith("]") or not colon:
        return f"the port is missing: {ENDPOINT_SYNTAX}"
    if not host:
        return f"the host is missing: {ENDPOINT_SYNTAX}"
    if ":" in host and not (host.startswith("[") and host.endswith("]")):
        return f"an IPv6 address must be in brackets before the port, such as {protocol}/[::1]:7447"
    if not (port.isascii() and port.isdigit() and len(port) <= len(str(LAST_PORT)) and 1 <= int(port) <= LAST_PORT):
        return f"the port must be 1 to {LAST_PORT}: {ENDPOINT_SYNTAX}"
    return ""


def _fault_of_path(path: str) -> str:
    if not path.startswith("/"):
        return f"the path {path} is relative: {SOCKET_SYNTAX}"
    length = len(os.fsencode(path))
    return f"the path has {length} bytes: use a path of at most {MAX_SOCKET_PATH}" if length > MAX_SOCKET_PATH else ""


def tcp_address(endpoint: str) -> tuple[str, int] | None:
    """Return the host and port of an endpoint; None if it is invalid, or if it is a Unix socket."""
    protocol, address = _parts(endpoint)
    if protocol not in _WITH_PORT or fault_of(endpoint):
        return None
    host, _, port = address.rpartition(":")
    return host.strip("[]"), int(port)


def is_host(text: str) -> bool:
    """Return True if a text is an IP address or a valid host name, without protocol and port.

    Host names are those of RFC 1123, but may also contain underscores.
    """
    try:
        ipaddress.ip_address(text)
    except ValueError:
        *_, last = text.split(".")
        return _HOST_NAME.fullmatch(text) is not None and not last.isdigit()
    return True


def leads_to(endpoint: str, reached: str) -> bool:
    """Return True if the configured endpoint can be the endpoint `reached`, which contains an IP address as its host.

    A host name in the configured endpoint matches every IP address.
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
    """Return True if two programs cannot listen on these two hosts and ports at the same time.

    Host names, except localhost, conflict only if they are equal.
    """
    if one[1] != other[1]:
        return False
    try:
        first, second = (ipaddress.ip_address("127.0.0.1" if host == "localhost" else host) for host, _ in (one, other))
    except ValueError:
        return one[0] == other[0]
    return first == second or _covers(first, second) or _covers(second, first)


def _covers(every: _Address, other: _Address) -> bool:
    """Return True if `every` is a wildcard address that includes `other`. The IPv6 wildcard includes IPv4 addresses."""
    return every.is_unspecified and every.version >= other.version


def reach(endpoint: str) -> ReachableBy:
    """Return the users who can connect to an endpoint; NETWORK if this is uncertain, as for a host name."""
    protocol = endpoint.partition("/")[0]
    if protocol == "tls":
        return ReachableBy.CERTIFICATE
    if protocol == _UNIX:
        return ReachableBy.FILE
    return ReachableBy.MACHINE if is_local(endpoint) else ReachableBy.NETWORK


def endpoint_of(address: str, port: int) -> str:
    """Return the TCP endpoint of an IP address and a port."""
    return f"tcp/[{address}]:{port}" if ":" in address else f"tcp/{address}:{port}"


def socket_file(endpoint: str) -> Path | None:
    """Return the file of a Unix-socket endpoint; None if the endpoint has another protocol."""
    protocol, address = _parts(endpoint)
    return Path(address) if protocol == _UNIX else None


def is_local(endpoint: str) -> bool:
    """Return True if only programs on this machine can connect to an endpoint."""
    protocol, address = _parts(endpoint)
    host = address.rpartition(":")[0].removeprefix("[").removesuffix("]")
    if protocol in {_UNIX, "unixpipe"} or host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _parts(endpoint: str) -> tuple[str, str]:
    """Return the protocol and the address of an endpoint of the form `protocol/address?metadata#settings`."""
    protocol, _, rest = endpoint.partition("/")
    return protocol, rest.partition("#")[0].partition("?")[0]
