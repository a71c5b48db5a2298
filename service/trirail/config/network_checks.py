"""What is well-formed of addresses, certificates and ports in a configuration, but impossible."""

from __future__ import annotations

import ipaddress
import itertools
from collections.abc import Iterator
from functools import partial

from trirail_drivers.driver.requirements import Rule

from trirail.config.tables import Config, Zenoh
from trirail.errors import ConfigError
from trirail.wire.endpoints import ReachableBy, fault_of, reach, same_port, tcp_address


def network_rules(config: Config) -> Iterator[Rule]:
    """Yield what refuses addresses that nobody, or the wrong ones, would reach."""
    yield from reach_rules(config.zenoh)
    reads = "telemetry.metrics_port", "zenoh"
    yield Rule("telemetry.metrics_address", reads, partial(_check_metrics, config))
    telemetry = config.telemetry
    addresses = [
        (f"zenoh.listen[{index}]", tcp_address(at)) for index, at in enumerate(config.zenoh.listen) if not fault_of(at)
    ]
    addresses += [
        ("telemetry.live_port", ("127.0.0.1", telemetry.live_port)),
        ("telemetry.metrics_port", (telemetry.metrics_address, telemetry.metrics_port)),
    ]
    listening = [(key, address) for key, address in addresses if address is not None and address[1]]
    for (key, address), (other, taken) in itertools.combinations(listening, 2):
        yield Rule(other, (key, "telemetry.metrics_address"), partial(_check_port, key, address, other, taken))


def _check_port(key: str, address: tuple[str, int], other: str, taken: tuple[str, int]) -> None:
    """Refuse a port that two would listen on."""
    if same_port(address, taken):
        raise ConfigError(f"{other}: port {taken[1]} is that of {key} too: give each a port of its own")


def _check_metrics(config: Config) -> None:
    """Refuse an address of the metrics that is none, or that lets a network read them by accident."""
    address, zenoh = config.telemetry.metrics_address, config.zenoh
    key = f"telemetry.metrics_address = {address!r}"
    try:
        loopback = ipaddress.ip_address(address).is_loopback
    except ValueError as error:
        raise ConfigError(f"{key}: it must be an IP address, as 127.0.0.1 or ::1") from error
    if config.telemetry.metrics_port and not loopback and zenoh.tls is None and not zenoh.insecure:
        raise ConfigError(
            f"{key}: whoever reaches it could read them: use an address of the loopback, [zenoh.tls] "
            "(trirail keys init), or write zenoh.insecure = true if that is what you want"
        )


def check_reach(zenoh: Zenoh) -> None:
    """Refuse a door that is open by accident, and certificates or users that would not be looked at."""
    for rule in reach_rules(zenoh):
        rule.check()


def reach_rules(zenoh: Zenoh) -> Iterator[Rule]:
    """Yield what refuses a door that is open by accident, and certificates or users that would not be looked at."""
    yield Rule("zenoh.connect", ("zenoh.tls", "zenoh.router"), partial(_check_connect, zenoh))
    yield Rule("zenoh.router", ("zenoh.tls", "zenoh.connect", "zenoh.users"), partial(_check_router, zenoh))
    yield Rule("zenoh.users", ("zenoh.tls",), partial(_check_users, zenoh))
    for key, endpoints in (("zenoh.listen", zenoh.listen), ("zenoh.connect", zenoh.connect)):
        for index, endpoint in enumerate(endpoints):
            check = partial(_check_endpoint, f"{key}[{index}]", endpoint, zenoh)
            yield Rule(f"{key}[{index}]", ("zenoh.tls", "zenoh.insecure"), check)


def _check_connect(zenoh: Zenoh) -> None:
    if zenoh.tls is not None and zenoh.connect and zenoh.router is None:
        raise ConfigError("zenoh.connect: with [zenoh.tls] give zenoh.router, the name in the router's certificate")


def _check_router(zenoh: Zenoh) -> None:
    if zenoh.router is not None and not (zenoh.tls and zenoh.connect):
        raise ConfigError("zenoh.router: it is looked at only with [zenoh.tls] and zenoh.connect")
    if zenoh.router in zenoh.users:
        raise ConfigError(f"zenoh.router: {zenoh.router} is a user: give the router a name of its own")


def _check_users(zenoh: Zenoh) -> None:
    if zenoh.users and zenoh.tls is None:
        raise ConfigError("zenoh.users: without [zenoh.tls] nobody's name is known: add it, or leave users out")


def _check_endpoint(name: str, endpoint: str, zenoh: Zenoh) -> None:
    key, by = f"{name} = {endpoint!r}", reach(endpoint)
    if fault := fault_of(endpoint):
        raise ConfigError(f"{key}: {fault}")
    if zenoh.tls is not None and by is not ReachableBy.CERTIFICATE:
        raise ConfigError(f"{key}: with [zenoh.tls] every endpoint is tls/ADDRESS:PORT, or it would go round it")
    if zenoh.tls is not None and "#" in endpoint:
        raise ConfigError(f"{key}: settings after # would go round [zenoh.tls]")
    if zenoh.tls is None and by is ReachableBy.CERTIFICATE:
        raise ConfigError(f"{key}: it needs [zenoh.tls], with the certificates that `trirail keys init` makes")
    if by is ReachableBy.NETWORK and not zenoh.insecure:
        raise ConfigError(
            f"{key}: whoever reaches it can move the robot: use tls/ with [zenoh.tls] (trirail keys init), "
            "an address of the loopback, or write insecure = true if that is what you want"
        )
