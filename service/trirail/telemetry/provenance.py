"""Where a recording comes from: the configuration, as a file that can be run again, and the software."""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Iterator, Mapping
from functools import cache
from importlib.metadata import version
from pathlib import Path

import msgspec
import trirail_drivers
from trirail_drivers.interface import NAMES

from trirail.config import Config, parse
from trirail.errors import ConfigError
from trirail.naming import Labels
from trirail.wire.decoding import decoded, prepare

CONFIGURATION, SOFTWARE = "/configuration", "/software"
"""Where a recording has what made it, as text documents: entity paths."""
LIBRARIES = ("eclipse-zenoh", "ruckig", "rerun-sdk", "python-can", "canopen", "numpy", "numba")
_PACKAGES = (Path(__file__).parents[1], Path(trirail_drivers.__path__[0]))


class Software(msgspec.Struct, frozen=True):
    """What ran."""

    trirail: str
    source: str
    """Fingerprint of the packages' source files: it tells versions apart that have not been given a number."""
    machine: str
    versions: dict[str, str]

    def __str__(self) -> str:
        return f"trirail {self.trirail}, source {self.source}, on {self.machine}"


prepare(Software)


@cache
def software() -> Software:
    """Return what runs here."""
    return Software(version("trirail"), _fingerprint(), f"{platform.system()} {platform.machine()}", versions())


def versions() -> dict[str, str]:
    """Return the versions of Python and of the libraries that matter, by name."""
    return {"python": platform.python_version()} | {name: version(name) for name in LIBRARIES}


def texts(config: Config) -> dict[str, str]:
    """Return what a recording says of itself, by entity path."""
    described = msgspec.json.format(msgspec.json.encode(software()), indent=2)
    return {CONFIGURATION: toml(config), SOFTWARE: described.decode()}


def configuration(found: Mapping[str, str]) -> Config | None:
    """Return the configuration among a recording's texts, None where there is none. Raises ConfigError."""
    text = found.get(CONFIGURATION)
    return parse(text) if text is not None else None


def labels(found: Mapping[str, str]) -> Labels:
    """Return what people call the sliders, by a recording's texts; their letters where these do not say it."""
    try:
        config = configuration(found)
    except ConfigError:
        config = None
    return config.geometry.labels if config else NAMES


def recorded_by(found: Mapping[str, str]) -> Software | None:
    """Return the software among a recording's texts, None where there is none, or it is written as no version here."""
    try:
        return decoded(found.get(SOFTWARE, ""), Software)
    except msgspec.DecodeError:
        return None


def toml(config: Config) -> str:
    """Write a configuration as TOML: all of it, defaults included; parse(toml(config)) == config."""
    return "\n".join(_table("", msgspec.to_builtins(config))).lstrip() + "\n"


def _table(path: str, table: dict[str, object]) -> Iterator[str]:
    """Yield the lines of a table: first its values, then the tables in it."""
    values = {name: value for name, value in table.items() if value is not None and not isinstance(value, dict)}
    if values and path:
        yield from ("", f"[{path}]")
    for name, value in values.items():
        yield f"{name} = {_value(value)}"
    for name, value in table.items():
        if isinstance(value, dict):
            yield from _table(f"{path}.{name}" if path else name, value)


def _value(value: object) -> str:
    if isinstance(value, dict):
        inner = (f"{name} = {_value(inner)}" for name, inner in value.items() if inner is not None)
        return "{ " + ", ".join(inner) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_value, value)) + "]"
    # Strings, numbers and truth values are written in TOML as in JSON; repr of a number is exact in both.
    return json.dumps(value, ensure_ascii=False)


def sources() -> Iterator[Path]:
    """Yield the source files of both packages, in order."""
    for package in _PACKAGES:
        yield from sorted(package.rglob("*.py"))


def _fingerprint() -> str:
    digest = hashlib.sha256()
    for path in sources():
        package = next(package for package in _PACKAGES if path.is_relative_to(package))
        digest.update(path.relative_to(package.parent).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:12]
