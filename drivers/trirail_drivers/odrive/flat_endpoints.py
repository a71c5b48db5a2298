"""Which number each setting of an ODrive has, by its firmware: the maker's flat_endpoints.json.

The numbers change with every firmware, and with the hardware. Those that are used here are in endpoints.json beside
this module, for the firmwares whose table is at hand; for others a user names his drive's file, `endpoints`. A number
that is another setting's would be read, or written, without any error: so the versions have to be the same.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Final, NamedTuple

import msgspec
from msgspec import Struct

from trirail_drivers import files
from trirail_drivers.errors import DriveError, FileError

DOWNLOADS: Final = "docs.odriverobotics.com/releases/firmware"


class Version(NamedTuple):
    """What Get_Version tells."""

    hardware: tuple[int, int, int]
    """Product line, version, variant."""
    firmware: tuple[int, int, int]
    """Major, minor, revision."""
    unreleased: bool = False

    @property
    def words(self) -> str:
        """For people."""
        development = ", a development version" if self.unreleased else ""
        return f"firmware {_dotted(self.firmware)}{development} on hardware {_dotted(self.hardware)}"


class Endpoint(Struct, frozen=True):
    """A setting."""

    id: int
    type: str = ""


class Table(Struct, frozen=True):
    """What is used of a flat_endpoints.json."""

    fw_version: str
    hw_version: str
    endpoints: dict[str, Endpoint]

    def is_of(self, version: Version) -> bool:
        """Whether it is of a drive, as the maker's own examples compare it."""
        same = self.fw_version.partition("-")[0] == _dotted(version.firmware)
        return same and self.hw_version == _dotted(version.hardware)


class _Known(Struct, frozen=True):
    tables: tuple[Table, ...]


_DECODER: Final = msgspec.json.Decoder(Table)
KNOWN: Final[tuple[Table, ...]] = msgspec.json.decode(
    Path(__file__).with_name("endpoints.json").read_bytes(), type=_Known
).tables
"""The firmwares whose table is at hand."""
_DECODER.decode(b'{"fw_version": "", "hw_version": "", "endpoints": {}}')  # before there are threads


def read(name: str, path: Path) -> Table:
    """Read the flat_endpoints.json of the drive called `name`. Raises DriveError with key and file."""
    key = f"drives.{name}.endpoints"
    try:
        return _DECODER.decode(files.text(path))
    except FileError as error:
        raise DriveError(f"{key}: {error}; the maker has one for each firmware: {DOWNLOADS}") from error
    except (msgspec.MsgspecError, RecursionError) as error:
        raise DriveError(f"{key}: {path} is no flat_endpoints.json ({error}); the maker's: {DOWNLOADS}") from error


def of(name: str, version: Version, own: str | None) -> Mapping[str, Endpoint] | None:
    """Return the settings of a drive of a version by their paths; None where nobody knows their numbers.

    `own` is the file that the configuration names. Raises DriveError where that is none, or another drive's.
    """
    if own is None:
        known = (table.endpoints for table in KNOWN if table.is_of(version) and not version.unreleased)
        return next(known, None)
    table = read(name, Path(own))
    if not table.is_of(version):
        raise DriveError(
            f"drives.{name}.endpoints: {own} is for firmware {table.fw_version} on hardware {table.hw_version}, "
            f"and the drive has {version.words}: get the one for it from {DOWNLOADS}"
        )
    return table.endpoints


def _dotted(numbers: tuple[int, int, int]) -> str:
    return ".".join(map(str, numbers))
