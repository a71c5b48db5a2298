"""What objects a drive has, by its EDS: the file that its maker gives with it (CiA 306)."""

from __future__ import annotations

import configparser
import io
from collections.abc import Iterable
from pathlib import Path
from typing import Final

import canopen
from canopen.objectdictionary import ObjectDictionary

from trirail_drivers import files
from trirail_drivers.errors import DriveError, FileError

SERVO: Final = Path(__file__).with_name("servo.eds")
"""Object dictionary of a CiA 402 servo drive: names and types of every object used here."""

Key = tuple[int, int]
"""Index and subindex of an object."""

_PURPOSE: Final = {
    0x1006: "the drive's watch on SYNC",
    0x1016: "the drive's watch on this service's heartbeat",
    0x1017: "this service's watch on the drive's heartbeat",
    0x1029: "what the drive does when it hears this service no more",
    0x6007: "what the drive does when it hears this service no more",
    0x605A: "how the drive stops",
    0x605E: "how the drive stops",
    0x6065: "the drive's own watch on its following error",
    0x6085: "how the drive stops",
    0x6098: "homing",
    0x6099: "homing",
    0x609A: "homing",
    0x607C: "homing",
    0x60B1: "the velocity feed-forward",
    0x60C2: "the drive's interpolation between setpoints",
}
"""What objects that CiA 301 and 402 leave optional are needed for. None has a stand-in: a drive without a watchdog
would go on where the service promises that it stops, and one without feed-forward would lag at every speed."""
_MOST_NAMED = 3


def load(drive: str, file: Path, node: int, needed: Iterable[Key]) -> ObjectDictionary:
    """The objects of the drive called `drive`; DriveError if the file cannot be used or lacks one that is `needed`."""
    try:
        with files.opened(file) as content, io.TextIOWrapper(content, encoding="utf-8", errors="replace") as text:
            objects = canopen.import_od(text, node)
    except (FileError, OSError) as error:
        raise DriveError(f"drive {drive}: cannot read EDS {error}") from error
    except (configparser.Error, ValueError, KeyError, AttributeError) as error:
        reason = " ".join(str(error).split())
        raise DriveError(f"drive {drive}: {file} is not an EDS as CiA 306 has it: {reason}") from error
    lacking = sorted({key for key in needed if objects.get_variable(*key) is None})
    if lacking:
        named = ", ".join(_described(key) for key in lacking[:_MOST_NAMED])
        more = f" and {len(lacking) - _MOST_NAMED} more" if len(lacking) > _MOST_NAMED else ""
        raise DriveError(f"drive {drive}: EDS {file} lacks object {named}{more}")
    return objects


def _described(key: Key) -> str:
    variable = canopen.import_od(str(SERVO)).get_variable(*key)
    name = f" ({variable.qualname})" if variable is not None else ""
    purpose = f", needed for {_PURPOSE[key[0]]}" if key[0] in _PURPOSE else ""
    return f"{key[0]:04X}:{key[1]:02X}{name}{purpose}"
