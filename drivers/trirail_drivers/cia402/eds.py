"""What objects a drive has, by its EDS: the file that its maker gives with it (CiA 306)."""

from __future__ import annotations

import configparser
import io
import logging
from pathlib import Path
from typing import Final

import canopen
from canopen.objectdictionary import ObjectDictionary

from trirail_drivers import files
from trirail_drivers.errors import DriveError, FileError

# What canopen would say of a file is in the DriveError; standard error is for that one line.
logging.getLogger("canopen").addHandler(logging.NullHandler())

SERVO: Final = Path(__file__).with_name("servo.eds")
"""Object dictionary of the simulated CiA 402 servo drive: names and types of objects where no maker's EDS is given."""


def load(drive: str, file: Path, node: int) -> ObjectDictionary:
    """The objects of the drive called `drive`; DriveError if the file cannot be used."""
    try:
        return read(file, node)
    except DriveError as error:
        raise DriveError(f"drive {drive}: {error}") from error


def read(file: Path, node: int) -> ObjectDictionary:
    """The objects of a device with this node id. Raises DriveError if the file is no EDS."""
    try:
        with open_text(file) as text:
            return canopen.import_od(text, node)
    except (FileError, OSError) as error:
        raise DriveError(f"cannot read EDS {error}") from error
    except (configparser.Error, ValueError, KeyError, AttributeError) as error:
        reason = " ".join(str(error).split())
        raise DriveError(f"{file} is not an EDS as CiA 306 has it: {reason}") from error


def open_text(file: Path) -> io.TextIOWrapper:
    """Open a file of a maker's, who writes names in whatever encoding he has: numbers are ASCII in all of them."""
    return io.TextIOWrapper(files.open_regular(file), encoding="utf-8", errors="replace")
