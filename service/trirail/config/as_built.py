"""What a robot differs from its [geometry] by: the correction that a file holds, and whether limits have room for it.

The file is TOML, made by `tools/calibrate.py --map`: when, beside which geometry and where the robot was measured, and
the nodes of trirail.kinematics.correction.
"""

from __future__ import annotations

import dataclasses
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
from trirail.wire.state import CorrectionTold

RESERVE = (0.02, 0.02, 0.07)
"""Share of the sliders' limits of velocity, acceleration and jerk that plans leave (motion.feasibility.PLANNED). Every
path is looked at with the correction in it; what it adds between two looks must find room in this, wherever it is."""
QUANTITIES = (("velocity", "m/s"), ("acceleration", "m/s²"), ("jerk", "m/s³"))
MAKE = "python tools/calibrate.py --map"
PARTS = 4
"""Of a cell along each axis, at whose ends it is looked at what the map adds."""
BEYOND = 0.03
"""Of the sliders' travel, up to where it is looked: from between two places one of them is nearer [m]."""
COORDINATES = (("x", "m"), ("y", "m"), ("phi", "rad"))

Error = Annotated[float, Meta(ge=-0.02, le=0.02)]
"""A coefficient of the correction [m] or [rad]: whoever needs more has another geometry."""
Node = tuple[Error, Error, Error]
Row = Annotated[tuple[Node, ...], Meta(min_length=4, max_length=11)]
Face = Annotated[tuple[Row, ...], Meta(min_length=4, max_length=11)]
Place = Annotated[float, Meta(ge=-100.0, le=100.0)]
Words = Annotated[str, Meta(max_length=64, pattern=r"^[^\x00-\x1f\x7f]*$")]


class AsBuilt(Struct, frozen=True, forbid_unknown_fields=True):
    """Section [correction.as_built]: what the file of `map` holds. Recordings have it; nobody else need write it."""

    made: Words
    """When the robot was measured: a date."""
    geometry: Annotated[str, Meta(pattern=r"^[0-9a-f]{8}$")]
    """The [geometry] beside which it was measured, as `geometry_of` tells it from others."""
    low: tuple[Place, Place, Place]
    """Least x, y [m] and phi [rad] of the places that it is for."""
    high: tuple[Place, Place, Place]
    """Greatest x, y [m] and phi [rad]."""
    nodes: Annotated[tuple[Face, ...], Meta(min_length=4, max_length=11)]
    """Coefficients of uniform cubic B-splines, by x, y, phi, of what is added to a pose in x, y [m] and phi [rad]."""


prepare(AsBuilt)


def geometry_of(robot: Geometry) -> str:
    """Return eight digits that tell a geometry from others, to a nanometre and a nanoradian."""
    numbers = np.round([np.hstack([*leg.keys().values()]) for leg in robot.each], 9) + 0.0
    kind = b"" if robot.kind == "3-PRP" else robot.kind.encode()  # maps are older than the second kind
    return f"{zlib.crc32(numbers.tobytes() + kind):08x}"


def correction(found: AsBuilt) -> Correction:
    """Return the map itself. Raises ConfigError where it is none."""
    try:
        return Correction(found.low, found.high, np.array(found.nodes))
    except ValueError as error:  # rows of different length; KinematicsError
        raise ConfigError(f"correction.as_built.nodes: {error}") from error


def read(path: Path) -> AsBuilt:
    """Read a map's file. Raises ConfigError, with the file and what is wrong in one line."""
    try:
        return parse(files.text(path))
    except FileError as error:
        raise ConfigError(f"{error}; {MAKE} makes one") from error
    except ConfigError as error:
        raise ConfigError(f"{path}: no map of as-built errors: {error}; {MAKE} makes one") from error


def parse(text: str) -> AsBuilt:
    """Read a map. Raises ConfigError."""
    try:
        return converted(tomllib.loads(text), AsBuilt)
    except RecursionError as error:
        raise ConfigError("its arrays are nested too deeply") from error
    except msgspec.ValidationError as error:
        said = " ".join(str(error).replace("`", "").replace(" - at $.", " at ").split())
        raise ConfigError(f"{said[0].lower()}{said[1:]}") from error
    except ValueError as error:  # TOMLDecodeError, and Python's own about an integer of thousands of digits
        raise ConfigError(f"not TOML: {error}") from error


def written(found: AsBuilt) -> str:
    """Return a map's file, exact to the last digit; parse(written(found)) == found."""
    rows = [" [\n" + "".join(f"  {[list(node) for node in row]},\n" for row in face) + " ],\n" for face in found.nodes]
    return (
        f"# As-built errors of a robot: what a pose is told besides, for [correction] map. Made by {MAKE}.\n"
        f'made = "{found.made}"\n'
        f'geometry = "{found.geometry}"\n'
        f"low = {list(found.low)}\n"
        f"high = {list(found.high)}\n"
        f"nodes = [\n{''.join(rows)}]\n"
    )


def summary(file: str | None, found: AsBuilt | None, backlash: Triple) -> CorrectionTold | None:
    """Return what people are told of a correction; None where nothing is corrected."""
    if found is None:
        return CorrectionTold("", "", (0.0, 0.0, 0.0), backlash) if any(backlash) else None
    x, y, phi = correction(found).greatest.tolist()
    return CorrectionTold(file or "as_built", found.made, (x, y, phi), backlash)


def check(found: AsBuilt, robot: Geometry, room: Room, platform: ArrayLike, sliders: Sequence[Triple]) -> None:
    """Refuse a map that is another robot's, that does not reach all places, or that could break a limit anywhere.

    `robot` is without it; `platform` (3, 3) are the limits of velocity, acceleration and jerk of x, y, phi, `sliders`
    those of the sliders, each for A, B, C [m, rad, s]. Raises ConfigError.
    """
    errors = correction(found)
    if found.geometry != geometry_of(robot):
        raise ConfigError(
            f"it was measured beside another [geometry] ({found.geometry}, here {geometry_of(robot)}): "
            f"measure again, and {MAKE} with this configuration"
        )
    for k, (name, unit) in enumerate(COORDINATES):
        if found.low[k] > room.low[k] or found.high[k] < room.high[k]:
            raise ConfigError(
                f"it is for {name} from {found.low[k]:g} to {found.high[k]:g} {unit}, limits.platform.{name} is "
                f"[{room.low[k]:g}, {room.high[k]:g}]: measure as far, or keep the limit within"
            )
    rates = np.array(platform, dtype=np.float64)
    slopes, cells = errors.adds(rates[0]), np.array(errors.low) + errors.size / 2.0
    for k, (name, _) in enumerate(COORDINATES):
        share = slopes[..., k] / rates[0, k]
        if share.max() > STEEPEST:
            place = cells + np.array(np.unravel_index(int(share.argmax()), share.shape)) * errors.size
            what = f"adds up to {share.max():.1%} to the rate of {name}"
            raise ConfigError(_steep(place, what, f"{STEEPEST:.0%}"))
    places, adds = _adds(errors, robot, room, rates)
    for order, ((quantity, unit), limit, kept) in enumerate(zip(QUANTITIES, sliders, RESERVE, strict=True)):
        for i, leg in enumerate(robot.labels):
            more = adds[order, :, i]
            if not more.max() <= kept * limit[i]:
                what = f"adds up to {more.max():.3g} {unit} to slider {leg}'s {quantity}"
                raise ConfigError(_steep(places[more.argmax()], what, f"{kept * limit[i]:.3g} {unit}"))


def _adds(errors: Correction, robot: Geometry, room: Room, rates: Array) -> tuple[Array, Array]:
    """Return the places where it is looked, (N, 3), and what is added there to the sliders' rates at most, (3, N, 3).

    That is of s, their places with the correction less those without, as a function of the pose, with derivatives by
    differences: ds/dt is at most the sum of |s_i| v_i, and so on. Infinite where that is not known.
    """
    axes = [
        np.linspace(low, high, PARTS * n + 1)
        for low, high, n in zip(errors.low, errors.high, errors.cells, strict=True)
    ]
    places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    told = travels(dataclasses.replace(robot, correction=errors), places)

    def slopes(of: Array) -> Array:
        each: Array = np.array(np.gradient(of, *axes, axis=(-4, -3, -2)))
        return each

    first = slopes(told[0] - travels(robot, places)[0])
    second = slopes(first)
    once, twice, thrice = np.abs(first), np.abs(second), np.abs(slopes(second))
    v, a, j = rates
    velocity = np.tensordot(v, once, 1)
    acceleration = np.tensordot(a, once, 1) + np.tensordot(np.outer(v, v), twice, 2)
    jerk = np.tensordot(j, once, 1) + np.tensordot(3.0 * np.outer(a, v), twice, 2)
    jerk += np.tensordot(np.multiply.outer(np.outer(v, v), v), thrice, 3)
    reached = room.holds(told, BEYOND)
    adds = np.stack([velocity, acceleration, jerk])[:, reached]
    return places[reached], np.nan_to_num(adds, nan=np.inf)


def _steep(place: Array, what: str, right: str) -> str:
    x, y, phi = (worded(value, unit) for value, unit in zip(place.tolist(), ("m", "m", "rad"), strict=True))
    return (
        f"too steep near x {x}, y {y}, phi {phi}: it {what}, and the limits have room for {right}; "
        "measure there again, take fewer cells, or let calibrate.py find [geometry] before"
    )
