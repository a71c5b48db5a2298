"""Who reaches an endpoint: never thought to be fewer than can."""

from __future__ import annotations

import ipaddress
import socket
import tempfile
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from trirail.wire.endpoints import (
    ReachableBy,
    endpoint_of,
    fault_of,
    is_local,
    leads_to,
    reach,
    same_port,
    socket_file,
    tcp_address,
)
from trirail.wire.stop_protocol import stop_address

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


HOSTS = st.ip_addresses().map(lambda at: f"[{at}]" if at.version == 6 else str(at)) | st.sampled_from(
    ["localhost", "a.b"]
)


@given(HOSTS, st.integers(1, 65535), st.sampled_from(("tcp", "tls")), st.sampled_from(ENDS))
def test_what_an_endpoint_lacks_is_said(host: str, port: int, protocol: str, end: str) -> None:
    assert fault_of(f"{protocol}/{host}:{port}{end}") == ""
    assert fault_of(f"{host}:{port}{end}").startswith("the protocol is missing")
    assert fault_of(f"/{host}:{port}{end}").startswith("the protocol is missing")
    assert fault_of(f"{protocol}/{host}{end}").startswith("the port is missing")
    assert fault_of(f"{protocol}/:{port}{end}").startswith("the host is missing")
    assert fault_of(f"{protocol}/{end}").startswith("the address is missing")
    for wrong in ("", "0", str(port + 65535), f"-{port}", "x", "\u0665"):
        assert fault_of(f"{protocol}/{host}:{wrong}{end}").startswith("the port must be 1 to 65535")
        assert tcp_address(f"{protocol}/{host}:{wrong}{end}") is None
    for faulty in (f"{protocol}/{host}{end}", f"{protocol}/:{port}{end}", f"{protocol}/{end}"):
        assert tcp_address(faulty) is stop_address(faulty) is None
    assert tcp_address(f"{protocol}/{host}:{port}{end}") == (
        None if protocol in ("udp", "quic") else (host.strip("[]"), port)
    )


def test_an_ipv6_address_is_in_brackets_and_a_file_needs_no_port() -> None:
    for bare in ("tcp/::1", "tcp/::1:7447"):
        assert "[::1]:7447" in fault_of(bare)
    assert fault_of("unixsock-stream//run/trirail/zenoh") == ""
    assert fault_of("unixsock-stream/").startswith("the address is missing")


@given(st.text("abcdefghijklmnopqrstuvwxyz-", min_size=1, max_size=12), st.sampled_from(ENDS))
def test_a_protocol_that_zenoh_lacks_is_named(protocol: str, end: str) -> None:
    fault = fault_of(f"{protocol}/127.0.0.1:7447{end}")
    assert fault == f"the protocol {protocol} is unknown: use tcp, tls or unixsock-stream"


@given(st.integers(95, 115), st.sampled_from("a\u00e9\u20ac"))
def test_each_path_that_is_accepted_has_room_for_the_stop_port_too(length: int, letter: str) -> None:
    with tempfile.TemporaryDirectory(dir="/tmp") as folder, socket.socket(socket.AF_UNIX) as listening:
        path = f"{folder}/"
        path += letter * ((length - len(path)) // len(letter.encode()))
        stop = stop_address(f"unixsock-stream/{path}")
        assert stop is not None
        if fault_of(f"unixsock-stream/{path}"):
            with pytest.raises(OSError, match="too long"):
                listening.bind(stop.where)
        else:
            listening.bind(stop.where)
    relative = fault_of(f"unixsock-stream{path}")
    assert relative == f"the path {path.lstrip('/')} is relative: use an absolute path, such as " + (
        "unixsock-stream//run/trirail/zenoh"
    )


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        ("127.0.0.1", "127.0.0.1", True),
        ("127.0.0.1", "localhost", True),
        ("127.0.0.1", "0.0.0.0", True),
        ("127.0.0.1", "::", True),
        ("0.0.0.0", "::", True),
        ("127.0.0.1", "::1", False),
        ("0.0.0.0", "::1", False),
        ("127.0.0.1", "192.0.2.7", False),
        ("robot", "robot", True),
    ],
)
def test_a_port_can_be_listened_on_once_an_address(one: str, other: str, same: bool) -> None:
    assert same_port((one, 7447), (other, 7447)) is same_port((other, 7447), (one, 7447)) is same
    assert not same_port((one, 7447), (other, 7448))


@pytest.mark.parametrize(
    ("endpoint", "reached", "does"),
    [
        ("tls/192.0.2.9:7447", "tls/192.0.2.9:7447", True),
        ("tls/192.0.2.9:7447?rel=1", "tls/192.0.2.9:7447", True),
        ("tls/192.0.2.9:7447", "tls/192.0.2.8:7447", False),
        ("tls/192.0.2.9:7447", "tls/192.0.2.9:7448", False),
        ("tls/192.0.2.9:7447", "tcp/192.0.2.9:7447", False),
        ("tls/hub.example.org:7447", "tls/192.0.2.9:7447", True),
        ("tls/hub.example.org:7447", "tls/192.0.2.9:51234", False),  # who has dialled us, by a port of his own
        ("tls/[0:0::1]:7447", "tls/[::1]:7447", True),
        ("unixsock-stream/a/hub", "unixsock-stream/a/hub", True),
        ("unixsock-stream/a/hub", "unixsock-stream/a/other", False),
    ],
)
def test_an_endpoint_leads_to_what_may_be_the_address_behind_it(endpoint: str, reached: str, does: bool) -> None:
    assert leads_to(endpoint, reached) is does


@pytest.mark.parametrize("protocol", ["udp", "quic", "ws", "serial"])
def test_protocols_without_a_stop_port_are_refused(protocol: str) -> None:
    """A web page can open a WebSocket on this machine."""
    assert "use tcp, tls or unixsock-stream" in fault_of(f"{protocol}/127.0.0.1:7447")
