"""Reads how ODrives are set, by RxSdo and TxSdo: one request in flight a drive, the three side by side."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from typing import Final

from trirail_drivers.bus.frames import send_in_setup
from trirail_drivers.bus.wire import Wire
from trirail_drivers.config import Drives
from trirail_drivers.errors import DriveError, DriveTimeout
from trirail_drivers.interface import NAMES, Clock
from trirail_drivers.odrive import cansimple, flat_endpoints
from trirail_drivers.odrive.asking import late
from trirail_drivers.odrive.axis import OdriveAxis
from trirail_drivers.odrive.flat_endpoints import Endpoint
from trirail_drivers.odrive.protections import NEEDED, SETTINGS, Settings

TRIES: Final = 3
"""So often a drive is asked in `sdo_timeout`: a frame may be lost."""


def read(wire: Wire, axes: Sequence[OdriveAxis], drives: Drives, clock: Clock) -> list[Settings | None]:
    """Return each drive's settings, as far as its firmware has them; None where nobody knows their numbers.

    Raises DriveError; DriveTimeout for a drive that does not answer.
    """
    tables = [
        None if axis.version is None else flat_endpoints.of(name, axis.version, drive.endpoints)
        for name, axis, drive in zip(NAMES, axes, drives.each, strict=True)
    ]
    for name, table in zip(NAMES, tables, strict=True):
        _check_table(name, table)
    found: list[dict[str, float]] = [{} for _ in axes]
    for path in SETTINGS:
        asked = [(axis, table[path]) for axis, table in zip(axes, tables, strict=True) if table and path in table]
        _read_each(wire, asked, path, drives.sdo_timeout, clock)
        for axis, endpoint in asked:
            found[axes.index(axis)][path] = _value(axis, endpoint, path)
    return [None if table is None else each for table, each in zip(tables, found, strict=True)]


def _read_each(
    wire: Wire, asked: Sequence[tuple[OdriveAxis, Endpoint]], path: str, timeout: float, clock: Clock
) -> None:
    """Ask each drive for an endpoint, until all have answered."""
    wanted = {axis.name: endpoint.id for axis, endpoint in asked}
    missing = [axis for axis, _ in asked]
    for axis in missing:
        axis.sdo = None
    for _ in range(TRIES):
        for axis in missing:
            data = cansimple.SDO.pack(cansimple.READ, wanted[axis.name], 0)
            send_in_setup(wire.bus, cansimple.command(axis.node, cansimple.RX_SDO, data))
        missing = late(
            wire, missing, clock, timeout / TRIES, lambda axis: axis.sdo is None or axis.sdo[0] != wanted[axis.name]
        )
    for axis in missing:
        raise DriveTimeout(axis.name, f"answer to RxSdo about {path}", timeout)


def _value(axis: OdriveAxis, endpoint: Endpoint, path: str) -> float:
    _, data = axis.sdo or (0, b"")
    try:
        (value,) = cansimple.TYPES[endpoint.type].unpack_from(data)
    except struct.error as error:
        said = f"drive {axis.name}: its answer about {path} has {len(data)} bytes, too few for {endpoint.type}"
        raise DriveError(said) from error
    return float(value)


def _check_table(name: str, table: Mapping[str, Endpoint] | None) -> None:
    """Refuse a user's table without what is needed, or with a type that does not go into a message."""
    for path in SETTINGS if table is not None else ():
        endpoint = table.get(path) if table is not None else None
        if endpoint is None and path in NEEDED:
            raise DriveError(f"drives.{name}.endpoints: it has no {path}; the maker's: {flat_endpoints.DOWNLOADS}")
        if endpoint is not None and not (endpoint.type in cansimple.TYPES and 0 <= endpoint.id <= 0xFFFF):
            said = f"{path} is endpoint {endpoint.id} of type {endpoint.type!r}, which no message holds"
            raise DriveError(f"drives.{name}.endpoints: {said}; the maker's: {flat_endpoints.DOWNLOADS}")
