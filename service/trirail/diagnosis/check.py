"""Types for checks of a configuration and their results."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Literal, NamedTuple

from msgspec import Struct
from trirail_drivers.config import Can

from trirail.config import Config

Verdict = Literal["ok", "warning", "failure"]


class Check(Struct, frozen=True):
    """Result of a check, with the subject, the verdict, the finding and a remedy."""

    name: str
    verdict: Verdict
    found: str
    remedy: str = ""
    key: str = ""
    """Configuration key to correct; "" if there is no such key."""


class ConfigCheck(NamedTuple):
    """Check of a configuration, and the keys on which the result depends."""

    reads: tuple[str, ...]
    """Configuration keys, or whole tables, on which the result depends."""
    run: Callable[[Config], Iterator[Check]]


def is_simulated(section: Can) -> bool:
    """Return True if the drives are simulated, because the CAN interface exists only in software."""
    wireless = section.interface in {"simulated", "unix", "virtual", "udp_multicast"}
    return wireless or (section.interface == "socketcan" and section.channel.startswith("vcan"))


def format_value(key: str, number: float, unit: str = "") -> str:
    """Return a key with its value, in the form `key = value unit`."""
    return f"{key} = {number:g}{f' {unit}' if unit else ''}"
