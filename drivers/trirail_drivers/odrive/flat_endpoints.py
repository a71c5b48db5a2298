"""Endpoint numbers of an ODrive's settings, by firmware, from the manufacturer's flat_endpoints.json.

The numbers change with every firmware and hardware version. For known firmware versions, endpoints.json in this folder
contains the numbers that are used here. For any other version, `endpoints` in the configuration names the drive's file.
With a wrong number, a different setting would be read or written without any error, so the versions must match.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Final, NamedTuple, Self

import msgspec
from msgspec import Struct

from trirail_drivers import files
from trirail_drivers.errors import DriveError, FileError

DOWNLOADS: Final = "docs.odriverobotics.com/releases/firmware"


class Version(NamedTuple):
    """Hardware and firmware version of a drive."""

    hardware: tuple[int, int, int]
    """Product line, version, variant."""
    firmware: tuple[int, int, int]
    """Major, minor, revision."""
    unreleased: bool = False

    @classmethod
    def from_fields(cls, protocol: int, *numbers: int) -> Self:  # noqa: ARG003  it has been 2 with every firmware since 0.6
        """Return the version given the fields of Get_Version, `cansimple.VERSION`."""
        line, number, variant, major, minor, revision, unreleased = numbers
        return cls((line, number, variant), (major, minor, revision), bool(unreleased))

    @property
    def dotted(self) -> tuple[str, str]:
        """Firmware and hardware version, such as 0.6.10 and 5.2.0."""
        development = "-dev" if self.unreleased else ""
        return _dotted(self.firmware) + development, _dotted(self.hardware)

    @property
    def description(self) -> str:
        """Description for people."""
        development = ", a development version" if self.unreleased else ""
        return f"firmware {_dotted(self.firmware)}{development} on hardware {_dotted(self.hardware)}"


class Endpoint(Struct, frozen=True):
    """Number and type of a setting."""

    id: int
    type: str = ""


class Table(Struct, frozen=True):
    """Content of a flat_endpoints.json, as far as it is used here."""

    fw_version: str
    hw_version: str
    endpoints: dict[str, Endpoint]

    def matches(self, version: Version) -> bool:
        """Whether the table is valid for a drive of this version, compared as in the manufacturer's own examples."""
        same = self.fw_version.partition("-")[0] == _dotted(version.firmware)
        return same and self.hw_version == _dotted(version.hardware)


class _KnownTables(Struct, frozen=True):
    tables: tuple[Table, ...]


_DECODER: Final = msgspec.json.Decoder(Table)
KNOWN_TABLES: Final[tuple[Table, ...]] = msgspec.json.decode(
    Path(__file__).with_name("endpoints.json").read_bytes(), type=_KnownTables
).tables
"""Tables of the known firmware versions."""
_DECODER.decode(b'{"fw_version": "", "hw_version": "", "endpoints": {}}')  # loads it before any thread exists


def read(name: str, path: Path) -> Table:
    """Read the flat_endpoints.json of the drive called `name`. Raises DriveError, which states the key and the file."""
    key = f"drives.{name}.endpoints"
    try:
        return _DECODER.decode(files.text(path))
    except FileError as error:
        raise DriveError(f"{key}: {error}; download the file for your firmware from {DOWNLOADS}") from error
    except (msgspec.MsgspecError, RecursionError) as error:
        raise DriveError(
            f"{key}: {path} is not a valid flat_endpoints.json ({error}); download it: {DOWNLOADS}"
        ) from error


def endpoints_of(name: str, version: Version, own: str | None) -> Mapping[str, Endpoint] | None:
    """Return the endpoints of a drive's settings by path; None for unknown firmware.

    `own` is the file named in the configuration. Raises DriveError if that file is invalid or is for another version.
    """
    if own is None:
        known = (table.endpoints for table in KNOWN_TABLES if table.matches(version) and not version.unreleased)
        return next(known, None)
    table = read(name, Path(own))
    if not table.matches(version):
        raise DriveError(
            f"drives.{name}.endpoints: {own} is for firmware {table.fw_version} on hardware {table.hw_version}, "
            f"but the drive has {version.description}; get its file from {DOWNLOADS}"
        )
    return table.endpoints


def _dotted(numbers: tuple[int, int, int]) -> str:
    return ".".join(map(str, numbers))
