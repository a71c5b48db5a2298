"""Who reaches an endpoint: never thought to be fewer than can."""

from __future__ import annotations

import ipaddress
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from trirail.wire.endpoints import ReachableBy, endpoint_of, is_local, reach, socket_file

ENDS = ("", "#iface=eth0", "?rel=1", "?rel=1#so_sndbuf=65000")


@given(st.ip_addresses(), st.integers(1, 65535), st.sampled_from(("tcp", "udp", "ws")), st.sampled_from(ENDS))
def test_an_address_is_for_this_machine_if_it_is_the_loopbacks(
    address: ipaddress.IPv4Address | ipaddress.IPv6Address, port: int, protocol: str, end: str
) -> None:
    host = f"[{address}]" if address.version == 6 else str(address)
    own = address in ipaddress.ip_network("127.0.0.0/8" if address.version == 4 else "::1/128")
    mapped = getattr(address, "ipv4_mapped", None)
    if mapped is None:
        assert reach(f"{protocol}/{host}:{port}{end}") is (ReachableBy.MACHINE if own else ReachableBy.NETWORK)


@pytest.mark.parametrize(
    ("endpoint", "by"),
    [
        ("tcp/127.0.0.1:7447", ReachableBy.MACHINE),
        ("tcp/127.9.9.9:7447", ReachableBy.MACHINE),
        ("tcp/[::1]:7447", ReachableBy.MACHINE),
        ("tcp/localhost:7447", ReachableBy.MACHINE),
        ("tcp/0.0.0.0:7447", ReachableBy.NETWORK),
        ("tcp/[::]:7447", ReachableBy.NETWORK),
        ("tcp/[::ffff:192.0.2.1]:7447", ReachableBy.NETWORK),
        ("tcp/localhost.example.org:7447", ReachableBy.NETWORK),
        ("tcp/127.0.0.1.example.org:7447", ReachableBy.NETWORK),
        ("tcp/127.0.0.1@192.0.2.1:7447", ReachableBy.NETWORK),
        ("tcp/127.0.0.1", ReachableBy.NETWORK),
        ("tcp/:7447", ReachableBy.NETWORK),
        ("quic/192.0.2.1:7447", ReachableBy.NETWORK),
        ("serial//dev/ttyUSB0", ReachableBy.NETWORK),
        ("vsock/-1:7447", ReachableBy.NETWORK),
        ("", ReachableBy.NETWORK),
        ("unixsock-stream//run/trirail/zenoh", ReachableBy.FILE),
        ("unixpipe/trirail", ReachableBy.MACHINE),
        ("tls/0.0.0.0:7447", ReachableBy.CERTIFICATE),
    ],
)
def test_who_reaches_it(endpoint: str, by: ReachableBy) -> None:
    assert reach(endpoint) is by


@given(st.ip_addresses(), st.integers(1, 65535))
def test_an_address_and_a_port_are_an_endpoint(
    address: ipaddress.IPv4Address | ipaddress.IPv6Address, port: int
) -> None:
    host = f"[{address}]" if address.version == 6 else str(address)
    assert endpoint_of(str(address), port) == f"tcp/{host}:{port}"


def test_what_stays_on_this_machine_is_local() -> None:
    local = ["unixsock-stream//run/trirail/zenoh", "unixpipe/trirail", "tcp/localhost:7447", "tls/[::1]:7447"]
    assert all(map(is_local, local))
    assert not any(map(is_local, ["tcp/192.0.2.1:7447", "tls/0.0.0.0:7447", "udp/robot.example.org:7447", ""]))


@pytest.mark.parametrize("end", ENDS)
def test_only_a_unix_socket_has_a_file(end: str) -> None:
    assert socket_file(f"unixsock-stream//run/trirail/zenoh{end}") == Path("/run/trirail/zenoh")
    assert socket_file(f"tcp/127.0.0.1:7447{end}") is None
