"""Reads an EDS, or a DCF, for a simulated drive: what `canopen` makes of it, and what it leaves out."""

from __future__ import annotations

import configparser
import io
from pathlib import Path

import canopen
from canopen.objectdictionary import ObjectDictionary

from trirail_drivers import files
from trirail_drivers.errors import DriveError, FileError


def read(file: Path, node: int) -> ObjectDictionary:
    """The objects of a device with this node id. Raises DriveError if the file is none."""
    try:
        with _text(file) as text:
            return canopen.import_od(text, node)
    except (FileError, OSError) as error:
        raise DriveError(f"cannot read EDS {error}") from error
    except (configparser.Error, ValueError, KeyError, AttributeError) as error:
        reason = " ".join(str(error).split())
        raise DriveError(f"{file} is not an EDS as CiA 306 has it: {reason}") from error


def compact_arrays(file: Path) -> dict[int, int]:
    """How many sub-objects arrays have whose elements the file does not list one by one (CiA 306, CompactSubObj)."""
    eds = configparser.RawConfigParser(inline_comment_prefixes=(";",), strict=False)
    with _text(file) as text:
        eds.read_file(text)
    return {
        int(section, 16): int(eds.get(section, "CompactSubObj"), 0)
        for section in eds.sections()
        if eds.has_option(section, "CompactSubObj")
    }


def _text(file: Path) -> io.TextIOWrapper:
    # Makers write names in whatever encoding they have; numbers are ASCII in all of them.
    return io.TextIOWrapper(files.open_regular(file), encoding="utf-8", errors="replace")
