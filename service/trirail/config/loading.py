"""Loading of configuration files."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
from trirail_drivers import files
from trirail_drivers.errors import FileError
from trirail_drivers.interface import NAMES

from trirail.config import as_built
from trirail.config.explained import Mistake, repaired
from trirail.config.impossible import check, mistakes
from trirail.config.tables import Config, FramesTable, Limits, resolved
from trirail.errors import ConfigError
from trirail.wire.decoding import prepare
from trirail.wire.text import printable

_PACKAGED = Path(__file__).parents[1] / "configs"
SIM = (_PACKAGED if _PACKAGED.exists() else Path(__file__).parents[3] / "configs") / "sim.toml"
"""Default configuration. Its drives are simulated, so it needs no hardware, no special rights and no other program."""
MAX_DEPTH = 32
"""Greatest number of tables and arrays inside each other, several times that of any valid file."""
prepare(Config, Limits, FramesTable)


def load(path: Path) -> Config:
    """Read a configuration file. Raises ConfigError, which names the file, key, value and allowed values."""
    try:
        config, wrong = _read(path)
        _refuse(wrong)
        check(config)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error
    return config


def parse(text: str) -> Config:
    """Parse a configuration in TOML. Raises ConfigError if it is invalid."""
    config = parse_values(text)
    check(config)
    return config


def parse_values(text: str) -> Config:
    """Parse a configuration in TOML, but do not check its values against each other.

    Raises ConfigError if it is not TOML, or if a key does not accept its value.
    """
    config, wrong = repaired(toml_tables(text))
    _refuse(wrong)
    return config


class Findings(NamedTuple):
    """Contents of a configuration file and all its mistakes."""

    config: Config
    """Configuration in which possible values replace the wrong ones."""
    mistakes: list[Mistake]
    unchecked: list[str]
    """Keys that were not checked because their checks depend on a wrong value."""


def everything(path: Path) -> Findings:
    """Read a configuration file and find all its mistakes, whereas `load` stops at the first.

    Raises ConfigError if the file is not TOML.
    """
    try:
        config, wrong = _read(path)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error
    more, unchecked = mistakes(config, [each.key for each in wrong])
    return Findings(config, [*wrong, *more], unchecked)


def _refuse(wrong: list[Mistake]) -> None:
    if wrong:
        raise ConfigError(wrong[0].text)


def _read(path: Path) -> tuple[Config, list[Mistake]]:
    """Read a file; return a configuration without its mistakes, and the mistakes.

    Raises ConfigError if the file cannot be read or is not TOML.
    """
    try:
        text = files.text(path)
    except FileError as error:
        without_path = str(error).removeprefix(f"{path}: ")
        raise ConfigError(
            f"{without_path}; create a configuration to start from with `trirail config copy sim`"
        ) from error
    config, wrong = repaired(toml_tables(text))
    return _resolve_paths(path, config, wrong), wrong


def toml_tables(text: str) -> dict[str, Any]:
    """Parse TOML into tables. Raises ConfigError if it is invalid."""
    try:
        raw = tomllib.loads(text)
        _check_depth(raw, MAX_DEPTH)
    except RecursionError as error:
        raise ConfigError("not a configuration: its tables or arrays are nested too deeply") from error
    except ValueError as error:  # TOMLDecodeError, or int() on thousands of digits
        raise ConfigError(f"not TOML: {printable(str(error))}") from error
    return raw


def _check_depth(value: object, most: int) -> None:
    """Raise RecursionError if tables and arrays are nested deeper than `most`."""
    if isinstance(value, dict | list):
        if most == 0:
            raise RecursionError
        for inner in value.values() if isinstance(value, dict) else value:
            _check_depth(inner, most - 1)


def _resolve_paths(path: Path, config: Config, wrong: list[Mistake]) -> Config:
    """Return the configuration with its relative paths resolved and its map of as-built errors loaded.

    Paths are relative to the configuration file.
    """

    def resolve(key: str, value: str) -> str:
        try:
            return resolved(value, path.parent)
        except ConfigError as error:
            wrong.append(Mistake(key, f"{key}: {error}"))
            return value

    drives = config.drives
    for name, drive in zip(NAMES, drives.each, strict=True):
        named = {key: getattr(drive, key) for key in ("eds", "endpoints")}
        files_of = {key: resolve(f"drives.{name}.{key}", file) for key, file in named.items() if file is not None}
        drives = msgspec.structs.replace(drives, **{name: msgspec.structs.replace(drive, **files_of)})
    correction = config.correction
    if correction.map is not None and correction.as_built is None:
        count, file = len(wrong), resolve("correction.map", correction.map)
        try:
            if len(wrong) == count:
                correction = msgspec.structs.replace(correction, map=file, as_built=as_built.read(Path(file)))
        except ConfigError as error:
            wrong.append(Mistake("correction.map", f"correction.map: {error}"))
    telemetry = config.telemetry
    if not path.resolve().is_relative_to(SIM.parent):  # recordings are never written next to the shipped files
        telemetry = msgspec.structs.replace(telemetry, directory=resolve("telemetry.directory", telemetry.directory))
    zenoh = config.zenoh
    try:
        zenoh = zenoh.beside(path.parent)
    except ConfigError as error:
        wrong.append(Mistake("zenoh.tls.directory", f"zenoh.tls.directory: {error}"))
    return msgspec.structs.replace(config, drives=drives, zenoh=zenoh, correction=correction, telemetry=telemetry)
