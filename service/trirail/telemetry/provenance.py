"""Provenance of a recording: the versions of the software, and the configuration as a file that can be used again."""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Iterator, Mapping
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import msgspec
import trirail_drivers
from trirail_drivers.interface import NAMES

from trirail.config import Config, parse_values
from trirail.errors import ConfigError
from trirail.motion.rules import RULES
from trirail.naming import Labels
from trirail.wire.decoding import INVALID, decoded, prepare

CONFIGURATION, SOFTWARE = "/configuration", "/software"
"""Entity paths of the text documents that store a recording's provenance."""
LIBRARIES = ("eclipse-zenoh", "ruckig", "rerun-sdk", "python-can", "canopen", "numpy", "numba")
Tables = dict[str, Any]
_PACKAGES = (Path(__file__).parents[1], Path(trirail_drivers.__path__[0]))


class Software(msgspec.Struct, frozen=True):
    """Versions of the software that made a recording."""

    trirail: str
    source: str
    """Hash of the source files of both packages. It distinguishes development versions with the same version number."""
    machine: str
    versions: dict[str, str]
    rules: int = 1
    """Version of the rules by which the loop changes the rate of a motion; see trirail.motion.rules."""

    def __str__(self) -> str:
        return f"trirail {self.trirail}, source {self.source}, on {self.machine}"


prepare(Software)


@cache
def software() -> Software:
    """Return the versions of the running software."""
    return Software(version("trirail"), fingerprint(), f"{platform.system()} {platform.machine()}", versions(), RULES)


def versions() -> dict[str, str]:
    """Return the versions of Python and of the relevant libraries, by name."""
    return {"python": platform.python_version()} | {name: version(name) for name in LIBRARIES}


def text_documents(config: Config) -> dict[str, str]:
    """Return the text documents to store in a recording, by entity path."""
    described = msgspec.json.format(msgspec.json.encode(software()), indent=2)
    return {CONFIGURATION: toml(config), SOFTWARE: described.decode()}


def configuration(documents: Mapping[str, str]) -> Config | None:
    """Return the configuration stored in a recording; None if it has none. Raises ConfigError if it is invalid.

    Its values are not checked against each other: an earlier version may have accepted what this version refuses.
    """
    text = documents.get(CONFIGURATION)
    return parse_values(text) if text is not None else None


def labels(documents: Mapping[str, str]) -> Labels:
    """Return the sliders' labels from a recorded configuration, or the letters A, B, C if it cannot be read."""
    try:
        config = configuration(documents)
    except ConfigError:
        config = None
    return config.geometry.labels if config else NAMES


def recorded_by(documents: Mapping[str, str]) -> Software | None:
    """Return the software versions stored in a recording; None if they are missing or cannot be decoded."""
    try:
        return decoded(documents.get(SOFTWARE, ""), Software)
    except INVALID:
        return None


def toml(config: Config) -> str:
    """Format a configuration as TOML, including default values, so that parse(toml(config)) == config."""
    tables = msgspec.to_builtins(config)
    return "\n".join(toml_lines(tables, tables, "")).lstrip() + "\n"


def toml_lines(tables: Tables, other: Tables, base: str, path: str = "") -> Iterator[str]:
    """Yield tables as lines of TOML.

    For each value that differs from `other`, a comment shows the value in `other`, which `base` names.
    """
    inner = {key: value for key, value in tables.items() if _is_tables(value)}
    plain = {key: value for key, value in tables.items() if key not in inner}
    if path and (plain or not inner):
        yield ""
        yield f"[{path}]"
    for key, value in plain.items():
        was = other.get(key)
        if value is not None:
            yield f"{key} = {_literal(value)}" + ("" if value == was else f"  # {base}: {_format_value(was)}")
        elif was is not None:
            yield f"# no {key}; {base}: {_format_value(was)}"
    for key, value in inner.items():
        name, was = f"{path}.{key}" if path else key, other.get(key)
        if isinstance(value, dict):
            yield from toml_lines(value, was if isinstance(was, dict) else {}, base, name)
            continue
        for number, table in enumerate(value):
            yield ""
            yield f"[[{name}]]"
            beside = was[number] if isinstance(was, list | tuple) and number < len(was) else {}
            yield from toml_lines(table, beside, base)


def _is_tables(value: object) -> bool:
    return isinstance(value, dict) or (isinstance(value, list | tuple) and bool(value) and isinstance(value[0], dict))


def _literal(value: object) -> str:
    """Format a value as TOML, in which strings, numbers, booleans and arrays look the same as in JSON."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def _format_value(value: object) -> str:
    return "none" if value is None else _literal(value)


def sources() -> Iterator[Path]:
    """Yield the source files of both packages, in order."""
    for package in _PACKAGES:
        yield from sorted(package.rglob("*.py"))


def fingerprint() -> str:
    """Return a hash of the source files of both packages as they are on the disk now. Raises OSError."""
    digest = hashlib.sha256()
    for path in sources():
        package = next(package for package in _PACKAGES if path.is_relative_to(package))
        digest.update(path.relative_to(package.parent).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:12]
