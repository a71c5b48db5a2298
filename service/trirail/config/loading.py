"""Reads configurations."""

from __future__ import annotations

import math
import tomllib
from pathlib import Path

import msgspec
from trirail_drivers import files
from trirail_drivers.errors import FileError
from trirail_drivers.interface import NAMES

from trirail.config import as_built
from trirail.config.checks import check
from trirail.config.explained import explain, leaves
from trirail.config.tables import Config, FramesTable, Limits
from trirail.errors import ConfigError
from trirail.wire.decoding import converted, prepare

_PACKAGED = Path(__file__).parents[1] / "configs"
SIM = (_PACKAGED if _PACKAGED.exists() else Path(__file__).parents[3] / "configs") / "sim.toml"
"""The configuration that needs nothing: no hardware, no rights, no other program."""
prepare(Config, Limits, FramesTable)


def load(path: Path) -> Config:
    """Read a configuration file. Raises ConfigError with the file, the key, the value and what is allowed."""
    try:
        text = files.text(path)
    except FileError as error:
        raise ConfigError(f"{error}; `trirail config copy sim` gives one to start from") from error
    try:
        config = _beside(path, _parsed(text))
        check(config)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error
    return config


def parse(text: str) -> Config:
    """Read a configuration from TOML. Raises ConfigError."""
    config = _parsed(text)
    check(config)
    return config


def _parsed(text: str) -> Config:
    """Read a configuration whose values are each possible by itself."""
    try:
        raw = tomllib.loads(text)
        given = list(leaves(raw))
    except RecursionError as error:
        raise ConfigError("not a configuration: its tables or arrays are nested too deeply") from error
    except ValueError as error:  # TOMLDecodeError, and Python's own about an integer of thousands of digits
        raise ConfigError(f"not TOML: {error}") from error
    for key, value in given:
        if isinstance(value, float) and not math.isfinite(value):
            raise ConfigError(f"{key} = {value}: it must be a finite number")
    try:
        return converted(raw, Config)
    except msgspec.ValidationError as error:
        raise ConfigError(explain(str(error), raw)) from error


def _beside(path: Path, config: Config) -> Config:
    """The configuration with what lies relative to its file: EDS files, certificates, and what is in the map's file."""
    drives = config.drives
    for name, drive in zip(NAMES, drives.each, strict=True):
        if drive.eds is not None:
            found = msgspec.structs.replace(drive, eds=str(path.parent / drive.eds))
            drives = msgspec.structs.replace(drives, **{name: found})
    zenoh = config.zenoh
    if zenoh.tls is not None:
        tls = msgspec.structs.replace(zenoh.tls, directory=str(path.parent / zenoh.tls.directory))
        zenoh = msgspec.structs.replace(zenoh, tls=tls)
    correction = config.correction
    if correction.map is not None and correction.as_built is None:
        file = path.parent / correction.map
        try:
            read = as_built.read(file)
        except ConfigError as error:
            raise ConfigError(f"correction.map: {error}") from error
        correction = msgspec.structs.replace(correction, map=str(file), as_built=read)
    return msgspec.structs.replace(config, drives=drives, zenoh=zenoh, correction=correction)
