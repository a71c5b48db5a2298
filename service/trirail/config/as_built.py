"""Map of as-built errors: reading and writing its file, and checking it against the limits.

As-built errors are the differences between a robot and its [geometry]. The file is in TOML and is written by
`tools/calibrate.py --map`. It contains the date, geometry and range of the measurement, and the nodes of
trirail.kinematics.correction.
"""

from __future__ import annotations

import dataclasses
import datetime
import tomllib
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta, Struct
from numpy.typing import ArrayLike
from trirail_drivers import files
from trirail_drivers.errors import FileError
from trirail_drivers.interface import Triple

from trirail.errors import ConfigError
from trirail.kinematics.arrays import Array
from trirail.kinematics.correction import STEEPEST, Correction
from trirail.kinematics.geometry import Geometry, Room, travels
from trirail.quantities import worded
from trirail.wire.decoding import converted, prepare
from trirail.wire.state import CorrectionInfo

RESERVE = (0.02, 0.02, 0.07)
"""Share of the sliders' velocity, acceleration and jerk limits that plans leave free (motion.feasibility.PLANNED).
Paths are sampled with the correction applied. The effect of the correction between two samples must fit into this share
everywhere."""
QUANTITIES = (("velocity", "m/s"), ("acceleration", "m/s²"), ("jerk", "m/s³"))
MAKE = "python tools/calibrate.py --map"
SAMPLES_PER_CELL = 4
"""Number of samples of the map's effect per cell along each axis."""
TRAVEL_MARGIN_M = 0.03
"""Distance beyond the sliders' travel up to which the map is sampled [m]. It ensures that no reachable pose between two
samples is missed."""
COORDINATES = (("x", "m"), ("y", "m"), ("phi", "rad"))

LARGEST = 0.02
"""Largest coefficient of a correction [m] or [rad]."""
Error = Annotated[float, Meta(ge=-LARGEST, le=LARGEST)]
"""Coefficient of the correction [m] or [rad]; a larger one belongs in [geometry]."""
Node = tuple[Error, Error, Error]
Row = Annotated[tuple[Node, ...], Meta(min_length=4, max_length=11)]
Face = Annotated[tuple[Row, ...], Meta(min_length=4, max_length=11)]
Place = Annotated[float, Meta(ge=-100.0, le=100.0)]
Words = Annotated[str, Meta(max_length=64, pattern=r"^[^\x00-\x1f\x7f]*$(?!\n)")]


class AsBuilt(Struct, frozen=True, forbid_unknown_fields=True):
    """Section [correction.as_built]: contents of the file that `map` names.

    Recordings contain this section; configuration files written by people name the file instead.
    """

    made: Words
    """Date of the measurement."""
    geometry: Annotated[str, Meta(pattern=r"^[0-9a-f]{8}$(?!\n)")]
    """Checksum of the [geometry] used for the measurement, from `geometry_of`."""
    low: tuple[Place, Place, Place]
    """Lower bounds of the map in x, y [m] and phi [rad]."""
    high: tuple[Place, Place, Place]
    """Upper bounds of the map in x, y [m] and phi [rad]."""
    nodes: Annotated[tuple[Face, ...], Meta(min_length=4, max_length=11)]
    """Coefficients of uniform cubic B-splines over x, y and phi. The splines give the corrections of a pose in x, y [m]
    and phi [rad]."""


prepare(AsBuilt)


def geometry_of(robot: Geometry) -> str:
    """Return an eight-digit checksum of a geometry rounded to nanometres and nanoradians."""
    numbers = np.round([np.hstack([*leg.keys().values()]) for leg in robot.each], 9) + 0.0
    kind = b"" if robot.kind == "3-PRP" else robot.kind.encode()  # the first maps were made before 3-PPR existed
    return f"{zlib.crc32(numbers.tobytes() + kind):08x}"


def corrected_geometry_of(robot: Geometry, as_built: AsBuilt | None) -> str:
    """Return a checksum of a geometry with its map, by the numbers of both; without a map, that of the geometry."""
    if as_built is None:
        return geometry_of(robot)
    numbers = np.hstack([np.ravel(part) for part in (as_built.low, as_built.high, as_built.nodes)])
    shape = np.array(np.shape(as_built.nodes))
    return f"{geometry_of(robot)}-{zlib.crc32((np.round(numbers, 9) + 0.0).tobytes() + shape.tobytes()):08x}"


def correction(as_built: AsBuilt) -> Correction:
    """Return the map as a correction of poses. Raises ConfigError if its nodes are invalid."""
    try:
        return Correction(as_built.low, as_built.high, np.array(as_built.nodes))
    except ValueError as error:  # rows of different length; KinematicsError
        raise ConfigError(f"correction.as_built.nodes: {error}") from error


def measured_today(errors: Correction, robot: Geometry) -> AsBuilt:
    """Return the map for a correction that was measured today on a robot with this [geometry].

    Raises ConfigError if the correction is too large for a map.
    """
    for (name, unit), most in zip(COORDINATES, np.abs(errors.nodes).max(axis=(0, 1, 2)).tolist(), strict=True):
        if not most <= LARGEST:
            raise ConfigError(
                f"the poses need corrections of up to {most:.3g} {unit} in {name}, more than {LARGEST:g}: calibrate "
                "[geometry] first, check the outermost poses, or use fewer cells"
            )
    today = datetime.datetime.now(datetime.UTC).date().isoformat()
    return AsBuilt(today, geometry_of(robot), errors.low, errors.high, errors.nodes.tolist())


def read(path: Path) -> AsBuilt:
    """Read a map from its file. Raises ConfigError, with the file and the problem in one line."""
    try:
        return parse(files.text(path))
    except FileError as error:
        raise ConfigError(f"{error}; create one with {MAKE}") from error
    except ConfigError as error:
        raise ConfigError(f"{path}: invalid map of as-built errors: {error}; create one with {MAKE}") from error


def parse(text: str) -> AsBuilt:
    """Parse a map from text. Raises ConfigError if the text is invalid."""
    try:
        return converted(tomllib.loads(text), AsBuilt)
    except RecursionError as error:
        raise ConfigError("its arrays are nested too deeply") from error
    except msgspec.ValidationError as error:
        message = " ".join(str(error).replace("`", "").replace(" - at $.", " at ").split())
        raise ConfigError(f"{message[0].lower()}{message[1:]}") from error
    except ValueError as error:  # TOMLDecodeError, or int() on thousands of digits
        raise ConfigError(f"not TOML: {error}") from error


def format_map(as_built: AsBuilt) -> str:
    """Return a map as the text of its file. Numbers are exact to the last digit, so `parse` returns an equal map."""
    rows = [
        " [\n" + "".join(f"  {[list(node) for node in row]},\n" for row in face) + " ],\n" for face in as_built.nodes
    ]
    return (
        f"# As-built errors of a robot, added to poses by [correction] map. Made by {MAKE}.\n"
        f'made = "{as_built.made}"\n'
        f'geometry = "{as_built.geometry}"\n'
        f"low = {list(as_built.low)}\n"
        f"high = {list(as_built.high)}\n"
        f"nodes = [\n{''.join(rows)}]\n"
    )


def summary(file: str | None, as_built: AsBuilt | None, backlash: Triple) -> CorrectionInfo | None:
    """Return a human-readable summary of a correction, or None if there is no correction."""
    if as_built is None:
        return CorrectionInfo("", "", (0.0, 0.0, 0.0), backlash) if any(backlash) else None
    x, y, phi = correction(as_built).greatest.tolist()
    return CorrectionInfo(file or "as_built", as_built.made, (x, y, phi), backlash)


def check(as_built: AsBuilt, robot: Geometry, room: Room, platform: ArrayLike, sliders: Sequence[Triple]) -> None:
    """Check that a map belongs to this robot, covers its limits, and cannot cause a limit to be exceeded anywhere.

    Raises ConfigError if any of these conditions is not met.

    Parameters
    ----------
    robot
        Geometry of the robot without the correction.
    platform
        Velocity, acceleration and jerk limits of x, y and phi, shape (3, 3) [m, rad, s].
    sliders
        Velocity, acceleration and jerk limits of the sliders A, B and C.
    """
    errors = correction(as_built)
    if as_built.geometry != geometry_of(robot):
        raise ConfigError(
            f"the map was measured with another [geometry] ({as_built.geometry}, here {geometry_of(robot)}): "
            f"measure again, then run {MAKE} with this configuration"
        )
    for k, (name, unit) in enumerate(COORDINATES):
        if as_built.low[k] > room.low[k] or as_built.high[k] < room.high[k]:
            raise ConfigError(
                f"the map covers {name} from {as_built.low[k]:g} to {as_built.high[k]:g} {unit}, but "
                f"limits.platform.{name} is "
                f"[{room.low[k]:g}, {room.high[k]:g}]: measure that range, or reduce the limit"
            )
    rates = np.array(platform, dtype=np.float64)
    slopes, cells = errors.adds(rates[0]), np.array(errors.low) + errors.size / 2.0
    for k, (name, _) in enumerate(COORDINATES):
        share = slopes[..., k] / rates[0, k]
        if share.max() > STEEPEST:
            place = cells + np.array(np.unravel_index(int(share.argmax()), share.shape)) * errors.size
            effect = f"adds up to {share.max():.1%} to the rate of {name}"
            raise ConfigError(_steep(place, effect, f"{STEEPEST:.0%}"))
    places, adds = _added_rates(errors, robot, room, rates)
    for order, ((quantity, unit), limit, reserve) in enumerate(zip(QUANTITIES, sliders, RESERVE, strict=True)):
        for i, leg in enumerate(robot.labels):
            more = adds[order, :, i]
            if not more.max() <= reserve * limit[i]:
                effect = f"adds up to {more.max():.3g} {unit} to slider {leg}'s {quantity}"
                raise ConfigError(_steep(places[more.argmax()], effect, f"{reserve * limit[i]:.3g} {unit}"))


def _added_rates(errors: Correction, robot: Geometry, room: Room, rates: Array) -> tuple[Array, Array]:
    """Return sample poses, (N, 3), and upper bounds of the slider rates that the correction adds there, (3, N, 3).

    Let s(pose) be the slider positions with the correction minus those without it, and s_i the partial derivatives of
    s, computed by finite differences. Then |ds/dt| <= sum |s_i| v_i; higher orders are bounded in the same way. A bound
    is infinite where a derivative is undefined.
    """
    axes = [
        np.linspace(low, high, SAMPLES_PER_CELL * n + 1)
        for low, high, n in zip(errors.low, errors.high, errors.cells, strict=True)
    ]
    places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    corrected = travels(dataclasses.replace(robot, correction=errors), places)

    def slopes(values: Array) -> Array:
        each: Array = np.array(np.gradient(values, *axes, axis=(-4, -3, -2)))
        return each

    first = slopes(corrected[0] - travels(robot, places)[0])
    second = slopes(first)
    once, twice, thrice = np.abs(first), np.abs(second), np.abs(slopes(second))
    v, a, j = rates
    velocity = np.tensordot(v, once, 1)
    acceleration = np.tensordot(a, once, 1) + np.tensordot(np.outer(v, v), twice, 2)
    jerk = np.tensordot(j, once, 1) + np.tensordot(3.0 * np.outer(a, v), twice, 2)
    jerk += np.tensordot(np.multiply.outer(np.outer(v, v), v), thrice, 3)
    reached = room.holds(corrected, TRAVEL_MARGIN_M)
    adds = np.stack([velocity, acceleration, jerk])[:, reached]
    return places[reached], np.nan_to_num(adds, nan=np.inf)


def _steep(place: Array, effect: str, limit: str) -> str:
    x, y, phi = (worded(value, unit) for value, unit in zip(place.tolist(), ("m", "m", "rad"), strict=True))
    return (
        f"too steep near x {x}, y {y}, phi {phi}: it {effect}, the limits allow {limit}; "
        "measure there again, use fewer cells, or calibrate [geometry] first"
    )
