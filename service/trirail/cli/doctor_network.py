"""Judges who can reach a robot, over which endpoint, and with which certificate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from trirail.cli.key_folder import Issued
from trirail.cli.machine import Machine
from trirail.config import Config
from trirail.diagnosis import Check, Verdict
from trirail.wire.endpoints import ReachableBy, endpoint_of, reach
from trirail.wire.vocabulary import Role


def network(config: Config, machine: Machine) -> list[Check]:
    """Who can command the robot, endpoint by endpoint, and what is to be said of certificates and users."""
    remedies = {
        ReachableBy.MACHINE: "where others log in too: unixsock-stream/PATH lets in the socket's owner and group alone",
        ReachableBy.NETWORK: "trirail keys init makes certificates for [zenoh.tls]",
    }
    found = []
    for endpoint in config.zenoh.listen:
        by = reach(endpoint)
        verdict: Verdict = "warning" if by is ReachableBy.NETWORK else "ok"
        found.append(Check("network", verdict, f"{endpoint}: {by} can command", remedies.get(by, "")))
    if config.zenoh.tls is None:
        return found
    if isinstance(machine.guard, str):
        return [*found, Check("certificates", "failure", machine.guard)]
    if machine.guard is not None:
        users = ", ".join(f"{user} {role}" for user, role in machine.guard.users.items())
        found.append(Check("users", "ok" if users else "warning", users or "none, so nobody can do anything"))
        warnings = machine.guard.certificate_warnings()
        found += [Check("certificates", "warning", warning) for warning in warnings]
        found += without_certificate(machine.guard.users, machine.issued)
    return found


def without_certificate(users: Mapping[str, Role], issued: Sequence[Issued] | None) -> list[Check]:
    """Who has a role and no certificate with which to use it, as far as the authority's folder is here."""
    if issued is None:
        return []
    known = {each.name: each for each in issued}
    found = []
    for user, role in users.items():
        if user not in known:
            found.append(
                Check(
                    "certificates",
                    "warning",
                    f"{user} has a role and no certificate",
                    f"trirail keys add {user} --role {role}",
                )
            )
        elif trouble := known[user].trouble():
            found.append(Check("certificates", "warning", f"{user} cannot connect: {trouble}"))
    return found


def routers(found: Sequence[tuple[str, str]]) -> list[Check]:
    """Whether the routers answer that users come through: without them the robot goes on for who is beside it."""
    remedy = "start trirail router there, or correct zenoh.connect, zenoh.router and certificates"
    return [
        Check("router", "warning", f"{endpoint}: {why}", remedy)
        if why
        else Check("router", "ok", f"{endpoint} answers")
        for endpoint, why in found
    ]


def metrics(config: Config) -> list[Check]:
    """Who can read the metrics, where there are any."""
    telemetry = config.telemetry
    if not telemetry.metrics_port:
        return []
    endpoint = endpoint_of(telemetry.metrics_address, telemetry.metrics_port)
    by = reach(endpoint)
    if by is ReachableBy.NETWORK and config.zenoh.tls is not None:
        by = ReachableBy.CERTIFICATE
    verdict: Verdict = "warning" if by is ReachableBy.NETWORK else "ok"
    remedy = "trirail keys init makes certificates for [zenoh.tls]" if by is ReachableBy.NETWORK else ""
    return [Check("metrics", verdict, f"{endpoint}: {by} can read them", remedy)]
