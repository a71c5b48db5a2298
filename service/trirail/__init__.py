"""trirail: a background service that drives a 3-PRP planar parallel robot in real time.

What most programs need is here; each name is loaded when it is first asked for, so that `import trirail` costs
nothing, `Robot` neither compiles nor draws, and the kinematics needs no network.

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
    from trirail.errors import ConfigError, KinematicsError, RefusalCode, RefusedError, ServiceError, TrirailError
    from trirail.kinematics.geometry import CrossLeg, Geometry, Leg
    from trirail.kinematics.robot import forward, inverse, jacobians
    from trirail.telemetry.reading import read

__all__ = [
    "AsyncRobot",
    "ConfigError",
    "CrossLeg",
    "Geometry",
    "KinematicsError",
    "Leg",
    "RefusalCode",
    "RefusedError",
    "Robot",
    "ServiceError",
    "TrirailError",
    "__version__",
    "forward",
    "inverse",
    "jacobians",
    "read",
]

_HOMES = {
    "trirail.client.async_client": ("AsyncRobot",),
    "trirail.client.client": ("Robot",),
    "trirail.errors": ("ConfigError", "KinematicsError", "RefusalCode", "RefusedError", "ServiceError", "TrirailError"),
    "trirail.kinematics.geometry": ("Geometry", "Leg", "CrossLeg"),
    "trirail.kinematics.robot": ("forward", "inverse", "jacobians"),
    "trirail.telemetry.reading": ("read",),
}
_HOME = {name: home for home, names in _HOMES.items() for name in names}


def __getattr__(name: str) -> object:
    """Load a public name from its module: PEP 562."""
    if name == "__version__":
        from importlib.metadata import version  # it takes longer than all the rest

        return version("trirail")
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(_HOME[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
