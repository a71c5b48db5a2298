"""Reading of an ODrive's settings by RxSdo and TxSdo, one request at a time."""

from __future__ import annotations

import struct
from collections.abc import Mapping

from trirail_drivers.errors import DriveError
from trirail_drivers.odrive import cansimple, flat_endpoints
from trirail_drivers.odrive.client import OdriveClient
from trirail_drivers.odrive.flat_endpoints import Endpoint, Version
from trirail_drivers.odrive.protections import REQUIRED, SETTINGS, Settings


async def read(client: OdriveClient, version: Version, own: str | None) -> Settings | None:
    """Read the settings in SETTINGS that the drive's firmware has. Return None for unknown firmware.

    `own` is the file named in the configuration. Raises DriveError, or DriveTimeout if the drive does not answer.
    """
    table = flat_endpoints.endpoints_of(client.name, version, own)
    if table is None:
        return None
    _check_table(client.name, table)
    values = {}
    for path in SETTINGS:
        if (endpoint := table.get(path)) is not None:
            values[path] = _value(client.name, endpoint, path, await client.read_setting(endpoint.id, path))
    return values


def _value(name: str, endpoint: Endpoint, path: str, data: bytes) -> float:
    try:
        (value,) = cansimple.TYPES[endpoint.type].unpack_from(data)
    except struct.error as error:
        message = f"drive {name}: its answer to {path} has {len(data)} bytes, too few for {endpoint.type}"
        raise DriveError(message) from error
    return float(value)


def _check_table(name: str, table: Mapping[str, Endpoint]) -> None:
    """Raise DriveError if a user's table lacks a required setting or has a type that does not fit in a message."""
    for path in SETTINGS:
        endpoint = table.get(path)
        if endpoint is None and path in REQUIRED:
            raise DriveError(f"drives.{name}.endpoints: the file lacks {path}; download it: {flat_endpoints.DOWNLOADS}")
        if endpoint is not None and not (endpoint.type in cansimple.TYPES and 0 <= endpoint.id <= 0xFFFF):
            problem = f"{path} is endpoint {endpoint.id} of type {endpoint.type!r}, which fits in no message"
            raise DriveError(f"drives.{name}.endpoints: {problem}; download it: {flat_endpoints.DOWNLOADS}")
