"""The protocols that drives may speak: the one place where all of them are named."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

from trirail_drivers.protocols.cia402 import CIA402
from trirail_drivers.protocols.odrive import ODRIVE
from trirail_drivers.protocols.protocol import Protocol

PROTOCOLS: Final[Mapping[str, Protocol]] = MappingProxyType({each.name: each for each in (CIA402, ODRIVE)})
"""Each protocol by the name that `drives.protocol` has for it."""

__all__ = ["CIA402", "ODRIVE", "PROTOCOLS", "Protocol"]
