"""trirail: a background service that drives a 3-PRP planar parallel robot in real time.

This module provides the public names of the package. Each name is loaded on first access, so `import trirail` is fast,
`Robot` loads neither compiled code nor plotting libraries, and the kinematics does not load the network library.

from trirail import Robot, AsyncRobot            # a connection to a running service
from trirail import read                         # a recording, into numpy
from trirail import Geometry, Leg, inverse, forward, jacobians   # the robot's mathematics
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    __version__: str

    from trirail.client.async_client import AsyncRobot
    from trirail.client.client import Robot
    from trirail.errors import (
        ConfigError,
        KinematicsError,
        RefusalCode,
        RefusedError,
        ServiceError,
        TrirailError,
        WaitTimeoutError,
    )
    from trirail.kinematics.geometry import CrossLeg, Geometry, Leg
    from trirail.kinematics.robot import forward, inverse, jacobians
    from trirail.telemetry.reading import read
    from trirail.wire.marks import Crossing, Mark, StopAt

__all__ = [
    "AsyncRobot",
    "ConfigError",
    "CrossLeg",
    "Crossing",
    "Geometry",
    "KinematicsError",
    "Leg",
    "Mark",
    "RefusalCode",
    "RefusedError",
    "Robot",
    "ServiceError",
    "StopAt",
    "TrirailError",
    "WaitTimeoutError",
    "__version__",
    "forward",
    "inverse",
    "jacobians",
    "read",
]

_NAMES_BY_MODULE = {
    "trirail.client.async_client": ("AsyncRobot",),
    "trirail.client.client": ("Robot",),
    "trirail.errors": (
        *("ConfigError", "KinematicsError", "RefusalCode", "RefusedError", "ServiceError", "TrirailError"),
        "WaitTimeoutError",
    ),
    "trirail.kinematics.geometry": ("Geometry", "Leg", "CrossLeg"),
    "trirail.kinematics.robot": ("forward", "inverse", "jacobians"),
    "trirail.telemetry.reading": ("read",),
    "trirail.wire.marks": ("Crossing", "Mark", "StopAt"),
}
_MODULE_OF = {name: module for module, names in _NAMES_BY_MODULE.items() for name in names}


def __getattr__(name: str) -> object:
    """Load a public name from its module (PEP 562)."""
    if name == "__version__":
        from importlib.metadata import version  # its import takes longer than all others

        return version("trirail")
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(_MODULE_OF[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
