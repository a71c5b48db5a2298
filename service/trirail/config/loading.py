"""Reads configurations."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
from trirail_drivers import files
from trirail_drivers.errors import FileError
from trirail_drivers.interface import NAMES

from trirail.config import as_built
from trirail.config.explained import Mistake, leaves, repaired
from trirail.config.impossible import check, mistakes
from trirail.config.tables import Config, FramesTable, Limits
from trirail.errors import ConfigError
from trirail.wire.decoding import prepare

_PACKAGED = Path(__file__).parents[1] / "configs"
SIM = (_PACKAGED if _PACKAGED.exists() else Path(__file__).parents[3] / "configs") / "sim.toml"
"""The configuration that needs nothing: no hardware, no rights, no other program."""
prepare(Config, Limits, FramesTable)


def load(path: Path) -> Config:
    """Read a configuration file. Raises ConfigError with the file, the key, the value and what is allowed."""
    try:
        config, wrong = _read(path)
        _refuse(wrong)
        check(config)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error
    return config


def parse(text: str) -> Config:
    """Read a configuration from TOML. Raises ConfigError."""
    config, wrong = repaired(toml_tables(text))
    _refuse(wrong)
    check(config)
    return config


class Findings(NamedTuple):
    """What a file holds, and everything in it that is refused."""

    config: Config
    """With something possible in the place of what is not."""
    mistakes: list[Mistake]
    left: list[str]
    """Keys that were not looked at, for want of those that are impossible."""


def everything(path: Path) -> Findings:
    """Read a configuration file and find all its mistakes, where `load` ends at the first.

    Raises ConfigError for what is no TOML.
    """
    try:
        config, wrong = _read(path)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error
    more, left = mistakes(config, [each.key for each in wrong])
    return Findings(config, [*wrong, *more], left)


def _refuse(wrong: list[Mistake]) -> None:
    if wrong:
        raise ConfigError(wrong[0].text)


def _read(path: Path) -> tuple[Config, list[Mistake]]:
    """Read a file whose values may each be impossible. Raises ConfigError."""
    try:
        text = files.text(path)
    except FileError as error:
        without_path = str(error).removeprefix(f"{path}: ")
        raise ConfigError(f"{without_path}; `trirail config copy sim` gives one to start from") from error
    config, wrong = repaired(toml_tables(text))
    return _beside(path, config, wrong), wrong


def toml_tables(text: str) -> dict[str, Any]:
    """Read TOML. Raises ConfigError."""
    try:
        raw = tomllib.loads(text)
        for _ in leaves(raw):
            pass
    except RecursionError as error:
        raise ConfigError("not a configuration: its tables or arrays are nested too deeply") from error
    except ValueError as error:  # TOMLDecodeError, and Python's own about an integer of thousands of digits
        raise ConfigError(f"not TOML: {error}") from error
    return raw


def _beside(path: Path, config: Config, wrong: list[Mistake]) -> Config:
    """The configuration with what lies relative to its file: files of drives, certificates, what is in the map's."""
    drives = config.drives
    for name, drive in zip(NAMES, drives.each, strict=True):
        named = {key: getattr(drive, key) for key in ("eds", "endpoints")}
        found = {key: str(path.parent / file) for key, file in named.items() if file is not None}
        drives = msgspec.structs.replace(drives, **{name: msgspec.structs.replace(drive, **found)})
    correction = config.correction
    if correction.map is not None and correction.as_built is None:
        file = path.parent / correction.map
        try:
            correction = msgspec.structs.replace(correction, map=str(file), as_built=as_built.read(file))
        except ConfigError as error:
            wrong.append(Mistake("correction.map", f"correction.map: {error}"))
    return msgspec.structs.replace(config, drives=drives, zenoh=config.zenoh.beside(path.parent), correction=correction)
