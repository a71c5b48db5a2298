"""Checks for addresses, certificates and ports that are well-formed but impossible or unsafe."""

from __future__ import annotations

import ipaddress
import itertools
import os
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

from trirail_drivers.driver.requirements import Rule

from trirail.config.tables import Config, Zenoh
from trirail.errors import ConfigError
from trirail.wire.endpoints import ReachableBy, fault_of, reach, same_port, socket_file, tcp_address
from trirail.wire.stop_protocol import SUFFIX, stop_address


def network_rules(config: Config) -> Iterator[Rule]:
    """Yield the checks that all addresses can be reached, and only by the intended users."""
    yield from reach_rules(config.zenoh)
    reads = "telemetry.metrics_port", "zenoh"
    yield Rule("telemetry.metrics_address", reads, partial(_check_metrics, config))
    for first, second in itertools.combinations(_listeners(config), 2):
        if not (first.is_stop_port and second.is_stop_port and first.endpoint_port == second.endpoint_port):
            yield Rule(second.key, (first.key, "telemetry.metrics_address"), partial(_check_port, first, second))
    sockets = {f"zenoh.listen[{index}]": socket_file(at) for index, at in enumerate(config.zenoh.listen)}
    for (first_key, file), (key, other) in itertools.combinations(sockets.items(), 2):
        if file is not None and other is not None:
            yield Rule(key, (first_key,), partial(_check_files, first_key, file, key, other))


class _Listener(NamedTuple):
    """Address at which the service listens."""

    key: str
    """Key of the configuration that determines the address."""
    address: tuple[str, int]
    endpoint_port: int = 0
    """Port of the endpoint to which a stop port belongs; 0 if the address is not that of a stop port."""

    @property
    def is_stop_port(self) -> bool:
        return self.endpoint_port != 0

    @property
    def port_name(self) -> str:
        """Name of the port for messages."""
        return f"the stop port of {self.key}" if self.is_stop_port else f"that of {self.key}"


def _listeners(config: Config) -> Iterator[_Listener]:
    """Yield the TCP addresses at which the service listens, with the stop ports first."""
    endpoints = [(f"zenoh.listen[{index}]", at) for index, at in enumerate(config.zenoh.listen)]
    for key, endpoint in endpoints:
        stop, address = stop_address(endpoint), tcp_address(endpoint)
        if stop is not None and address is not None and not isinstance(stop.where, str):
            yield _Listener(key, stop.where, address[1])
    for key, endpoint in endpoints:
        if (address := tcp_address(endpoint)) is not None:
            yield _Listener(key, address)
    telemetry = config.telemetry
    if telemetry.live_port:
        yield _Listener("telemetry.live_port", ("127.0.0.1", telemetry.live_port))
    if telemetry.metrics_port:
        yield _Listener("telemetry.metrics_port", (telemetry.metrics_address, telemetry.metrics_port))


def _check_port(first: _Listener, second: _Listener) -> None:
    """Refuse a port that two listeners would share."""
    if same_port(first.address, second.address):
        port = f"{'stop port' if second.is_stop_port else 'port'} {second.address[1]}"
        raise ConfigError(f"{second.key}: {port} is also {first.port_name}; use different ports")


def _check_files(first_key: str, first: Path, key: str, other: Path) -> None:
    """Refuse a Unix socket that shares a file with another one: the socket, its lock or the socket of its stop port."""
    if shared := _files(first) & _files(other):
        raise ConfigError(f"{key}: {min(shared)} is also a file of {first_key}; use another name for the socket")


def _files(socket: Path) -> set[str]:
    path = os.path.normpath(socket)
    return {path, f"{path}.lock", f"{path}{SUFFIX}"}


def _check_metrics(config: Config) -> None:
    """Refuse a metrics address that is not an IP address or that opens the metrics to a network by accident."""
    address, zenoh = config.telemetry.metrics_address, config.zenoh
    key = f"telemetry.metrics_address = {address!r}"
    try:
        loopback = ipaddress.ip_address(address).is_loopback
    except ValueError as error:
        raise ConfigError(f"{key}: it must be an IP address, for example 127.0.0.1 or ::1") from error
    if config.telemetry.metrics_port and not loopback and zenoh.tls is None and not zenoh.insecure:
        raise ConfigError(
            f"{key}: anyone on its network could read the metrics; use a loopback address, [zenoh.tls] "
            "(trirail keys init), or zenoh.insecure = true to allow it"
        )


def check_reach(zenoh: Zenoh) -> None:
    """Raise ConfigError for endpoints that are open by accident, or for certificates or users that have no effect."""
    for rule in reach_rules(zenoh):
        rule.check()


def reach_rules(zenoh: Zenoh) -> Iterator[Rule]:
    """Yield the checks for endpoints that are open by accident and for certificates or users that have no effect."""
    yield Rule("zenoh.connect", ("zenoh.tls", "zenoh.router"), partial(_check_connect, zenoh))
    yield Rule("zenoh.router", ("zenoh.tls", "zenoh.connect", "zenoh.users"), partial(_check_router, zenoh))
    yield Rule("zenoh.users", ("zenoh.tls",), partial(_check_users, zenoh))
    for key, endpoints in (("zenoh.listen", zenoh.listen), ("zenoh.connect", zenoh.connect)):
        for index, endpoint in enumerate(endpoints):
            check = partial(_check_endpoint, f"{key}[{index}]", endpoint, zenoh)
            yield Rule(f"{key}[{index}]", ("zenoh.tls", "zenoh.insecure"), check)


def _check_connect(zenoh: Zenoh) -> None:
    if zenoh.tls is not None and zenoh.connect and zenoh.router is None:
        raise ConfigError("zenoh.connect: with [zenoh.tls], zenoh.router must be the name in the router's certificate")


def _check_router(zenoh: Zenoh) -> None:
    if zenoh.router is not None and not (zenoh.tls and zenoh.connect):
        raise ConfigError("zenoh.router: this setting needs [zenoh.tls] and zenoh.connect")
    if zenoh.router in zenoh.users:
        raise ConfigError(f"zenoh.router: {zenoh.router} is also a user; use another name for the router")


def _check_users(zenoh: Zenoh) -> None:
    if zenoh.users and zenoh.tls is None:
        raise ConfigError(
            "zenoh.users: without [zenoh.tls], the names of users are not verified; add [zenoh.tls], or remove users"
        )


def _check_endpoint(name: str, endpoint: str, zenoh: Zenoh) -> None:
    key, by = f"{name} = {endpoint!r}", reach(endpoint)
    if fault := fault_of(endpoint):
        raise ConfigError(f"{key}: {fault}")
    if zenoh.tls is not None and by is not ReachableBy.CERTIFICATE:
        raise ConfigError(
            f"{key}: with [zenoh.tls] every endpoint must be tls/ADDRESS:PORT, because others bypass the certificates"
        )
    if zenoh.tls is not None and "#" in endpoint:
        raise ConfigError(f"{key}: settings after # would bypass [zenoh.tls]; remove them")
    if zenoh.tls is None and by is ReachableBy.CERTIFICATE:
        raise ConfigError(f"{key}: tls needs [zenoh.tls] and certificates: create them with `trirail keys init`")
    if by is ReachableBy.NETWORK and not zenoh.insecure:
        raise ConfigError(
            f"{key}: anyone on its network can move the robot; use tls/ with [zenoh.tls] (trirail keys init), "
            "a loopback address, or insecure = true to allow it"
        )
