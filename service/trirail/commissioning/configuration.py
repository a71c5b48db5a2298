"""A configuration file with some keys changed: the user's comments, order and spelling stay."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import msgspec
import tomlkit
from tomlkit.items import Table
from trirail_drivers.config import Drives
from trirail_drivers.interface import NAMES

from trirail.config import Config, parse
from trirail.errors import ConfigError


def changed(text: str, changes: Mapping[str, int | float]) -> str:
    """Return a configuration's text with other values for keys of tables, each by its whole path.

    Raises ConfigError where what comes of it is no configuration, or says anything else differently.
    """
    document = tomlkit.parse(text)
    for path, value in changes.items():
        *tables, key = path.split(".")
        table: object = document
        for name in tables:
            table = table[name]  # type: ignore[index]
        if not isinstance(table, Table) or key in table:
            table[key] = value  # type: ignore[index]
        else:
            table.add(key, value)
    result = tomlkit.dumps(document)
    if parse(result) != with_changes(parse(text), changes):
        raise ConfigError(f"the changes {dict(changes)} cannot be written into this file: make them by hand")
    return result


def with_changes(config: Config, changes: Mapping[str, int | float]) -> Config:
    """Return a configuration with other values for keys of [drives.A], [drives.B] and [drives.C]."""
    drives = config.drives
    for path, value in changes.items():
        _, name, key = path.split(".")
        drive = msgspec.structs.replace(getattr(drives, name), **{key: value})
        drives = msgspec.structs.replace(drives, **{name: drive})
    return msgspec.structs.replace(config, drives=drives)


def with_built(text: str, drives: Drives) -> str:
    """Return a configuration's text that says how its simulated sliders are built: as `drives` say.

    So faults on demand stay what they were, whatever is corrected in [drives].
    """
    document = tomlkit.parse(text)
    rows = tomlkit.array().multiline(True)
    for drive in drives.each:
        row = tomlkit.inline_table()
        row.update({"node": drive.node, "counts_per_metre": drive.counts_per_metre, "direction": drive.direction})
        rows.append(row)
    can = document["can"]
    if "simulated" not in can:
        can["simulated"] = tomlkit.table()
    can["simulated"]["built"] = rows
    return tomlkit.dumps(document)


def with_whole_paths(text: str, folder: Path) -> str:
    """Return a configuration's text with the drives' EDS files, relative to `folder`, named wherever they lie."""
    document = tomlkit.parse(text)
    for name in NAMES:
        drive = document["drives"][name]
        if "eds" in drive:
            drive["eds"] = str((folder / str(drive["eds"])).resolve())
    return tomlkit.dumps(document)


def free_name(path: Path) -> Path:
    """Return a name beside a configuration that no file has yet."""
    number, found = 1, path.with_name(f"{path.stem}-commissioned.toml")
    while found.exists():
        number += 1
        found = path.with_name(f"{path.stem}-commissioned-{number}.toml")
    return found


def write(path: Path, text: str) -> None:
    """Write a new file; ConfigError where there is one already."""
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        raise ConfigError(f"{path} exists already: name another file") from None
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from error
