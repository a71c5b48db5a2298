"""Preparation of the calibration of a stage's geometry with cameras, from the data of the stage's service."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import TYPE_CHECKING

from trirail_drivers.interface import Triple

from trirail.alignment.images import Lens, Pair
from trirail.config import as_built, room
from trirail.errors import TrirailError
from trirail.telemetry.drawn_robot import DrawnRobot
from trirail.wire.state import Info

if TYPE_CHECKING:
    from trirail.alignment.geometry_calibration import GeometryTask

INSTALL = "pip install 'trirail[analysis]'"


def geometry_id(info: Info) -> str:
    """Return the checksum of a service's [geometry], as stored in correction maps."""
    return as_built.geometry_of(DrawnRobot.from_info(info).geometry)


def geometry_task(
    info: Info,
    field: Pair,
    views: Mapping[str, str] | None,
    lens: Lens,
    poses: int,
    looks: int,
    approach: Triple | None,
) -> GeometryTask:
    """Return the task of a geometry calibration for the stage of a service.

    Raises RefusedError if the task is invalid, and TrirailError if SciPy is not installed.
    """
    if "scipy" in sys.modules and sys.modules["scipy"] is None:
        del sys.modules["scipy"]  # processes.compiling blocks SciPy in services, since numba would import it
    try:
        from trirail.alignment.geometry_calibration import GeometryTask
    except ImportError as error:
        if (error.name or "").partition(".")[0] != "scipy":
            raise
        raise TrirailError(f"the fit needs SciPy, which is not installed: {INSTALL}") from error
    robot = DrawnRobot.from_info(info)
    task = GeometryTask(robot.geometry, room(robot.limits), field, views, lens, poses, looks, approach)
    task.check()
    return task
