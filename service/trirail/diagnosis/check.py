"""Check results, checks of a configuration, and the test for robots without hardware."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Literal, NamedTuple

from msgspec import Struct
from trirail_drivers.config import Can

from trirail.config import Config

Verdict = Literal["ok", "warning", "failure"]


class Check(Struct, frozen=True):
    """Result of a check: its subject, verdict, finding and remedy."""

    name: str
    verdict: Verdict
    found: str
    remedy: str = ""
    key: str = ""
    """Configuration key to correct, if there is one."""


class ConfigCheck(NamedTuple):
    """Check of a configuration."""

    reads: tuple[str, ...]
    """Keys, or whole tables, that the result depends on."""
    run: Callable[[Config], Iterator[Check]]


def is_simulated(section: Can) -> bool:
    """Return True if the drives are programs: on this process's own bus, or on a bus without a wire."""
    wireless = section.interface in {"simulated", "unix", "virtual", "udp_multicast"}
    return wireless or (section.interface == "socketcan" and section.channel.startswith("vcan"))


def format_value(key: str, number: float, unit: str = "") -> str:
    """Return a key with its value, as in the file."""
    return f"{key} = {number:g}{f' {unit}' if unit else ''}"
