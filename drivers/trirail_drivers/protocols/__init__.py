"""Protocols of the drives; only this module lists all of them."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

from trirail_drivers.protocols.cia402 import CIA402
from trirail_drivers.protocols.odrive import ODRIVE
from trirail_drivers.protocols.protocol import Protocol

PROTOCOLS: Final[Mapping[str, Protocol]] = MappingProxyType({each.name: each for each in (CIA402, ODRIVE)})
"""Protocols by their name in `drives.protocol`."""

__all__ = ["CIA402", "ODRIVE", "PROTOCOLS", "Protocol"]
