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
        with files.open_regular(file) as content, io.TextIOWrapper(content, encoding="utf-8", errors="replace") as text:
            return canopen.import_od(text, node)
    except (FileError, OSError) as error:
        raise DriveError(f"drive {drive}: cannot read EDS {error}") from error
    except (configparser.Error, ValueError, KeyError, AttributeError) as error:
        reason = " ".join(str(error).split())
        raise DriveError(f"drive {drive}: {file} is not an EDS as CiA 306 has it: {reason}") from error
