"""What a check finds, and which robots have no hardware that could come to harm."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Literal, NamedTuple

from msgspec import Struct
from trirail_drivers.config import Can

from trirail.config import Config

Verdict = Literal["ok", "warning", "failure"]


class Check(Struct, frozen=True):
    """What was looked at, what is so, and what to do about it."""

    name: str
    verdict: Verdict
    found: str
    remedy: str = ""
    key: str = ""
    """Of the configuration, where one is to be changed."""


class Judgement(NamedTuple):
    """A check of a configuration."""

    reads: tuple[str, ...]
    """Keys, or tables for all that is in them, that the answer depends on."""
    of: Callable[[Config], Iterator[Check]]


def is_simulated(section: Can) -> bool:
    """Whether the drives are programs: on the bus of this process, or on one without a wire."""
    wireless = section.interface in {"simulated", "unix", "virtual", "udp_multicast"}
    return wireless or (section.interface == "socketcan" and section.channel.startswith("vcan"))


def value(key: str, number: float, unit: str = "") -> str:
    """Return a key with its value, as the file has it."""
    return f"{key} = {number:g}{f' {unit}' if unit else ''}"
