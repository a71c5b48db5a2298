"""Edits of a configuration file that preserve the user's comments, order of keys and formatting."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

import tomlkit
from msgspec import structs
from tomlkit.items import AoT, Array, InlineTable, Table
from trirail_drivers import files
from trirail_drivers.config import Drives
from trirail_drivers.interface import NAMES, Triple

from trirail.config import Config, Tls, check, geometry, parse_values
from trirail.config.as_built import AsBuilt, geometry_of
from trirail.errors import ConfigError
from trirail.kinematics.geometry import Geometry


def edit_text(text: str, changes: Mapping[str, int | float]) -> str:
    """Return the text of a configuration with new values. The keys in `changes` are full paths, as `drives.A.node`.

    Raises ConfigError if the result is not a valid configuration, or if any other value has changed.
    """
    result = _replace_text(text, changes)
    check(_without_map(result))
    return result


def _replace_text(text: str, changes: Mapping[str, int | float]) -> str:
    """Return the result of `edit_text`, without the checks of its values against each other."""
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
    # tomlkit edits the text. Parse the result to check that nothing else has changed.
    if _without_map(result) != replace_values(_without_map(text), changes):
        raise ConfigError(f"changes {dict(changes)}: cannot be written to this file; edit it by hand")
    return result


def _without_map(text: str) -> Config:
    """Parse a configuration without its correction map, which can only be read together with the file."""
    document = tomlkit.parse(text)
    if "correction" in document:
        document["correction"].pop("map", None)
    return parse_values(tomlkit.dumps(document))


def edit_geometry(text: str, robot: Geometry, scales: Triple, map_file: str | None) -> str:
    """Return a configuration's text with the legs of `robot`, corrected encoder scales, and another correction map.

    The real position of each slider is (1 + scale) times its reading. The reading contains the offset of the drive. If
    there is an offset, it is therefore corrected too. The correction map of the old geometry is removed. `map_file` is
    the name of a new correction map; None for no map.

    A new geometry can make other values of the file impossible, for example a named pose at a limit. The result is
    therefore not checked for this; see `mark_mistake`. Raises ConfigError if a key does not accept its new value, or if
    any other value has changed.
    """
    document = tomlkit.parse(text)
    if "correction" in document:
        for key in ("map", "as_built"):
            document["correction"].pop(key, None)
    before = parse_values(tomlkit.dumps(document))
    section = document["geometry"]
    rows = [{key: _rounded(value) for key, value in leg.keys().items()} for leg in robot.each]
    if "leg" in section:
        for table, row in zip(section["leg"], rows, strict=True):
            for key, value in row.items():
                if key not in table or table[key] != value:
                    table[key] = value
    else:
        section.remove("l0")
        section["leg"] = _inline_tables(rows) if isinstance(section, InlineTable) else _tables(rows)
    axes: dict[str, float] = {}
    for name, drive, scale in zip(NAMES, before.drives.each, scales, strict=True):
        # With twelve digits, the readings are exact to 0.1 nm even if the offset is 100 m, the largest that is allowed.
        axes[f"drives.{name}.counts_per_metre"] = float(f"{drive.counts_per_metre / (1.0 + scale):.12g}")
        if drive.offset * scale:
            axes[f"drives.{name}.offset"] = float(f"{drive.offset * (1.0 + scale):.12g}")
    result = _replace_text(tomlkit.dumps(document), axes)
    after = parse_values(result)
    expected = structs.replace(replace_values(before, axes), geometry=after.geometry)
    if after != expected or geometry_of(geometry(after.geometry)) != geometry_of(robot):
        raise ConfigError("the new geometry cannot be written to this file; edit it by hand")
    if map_file is None:
        return result
    document = tomlkit.parse(result)
    document.setdefault("correction", tomlkit.table())["map"] = map_file
    return tomlkit.dumps(document)


def _tables(rows: Iterable[Mapping[str, object]]) -> AoT:
    tables = tomlkit.aot()
    for row in rows:
        tables.append(tomlkit.item(row))
    return tables


def _inline_tables(rows: Iterable[Mapping[str, object]]) -> Array:
    """Return an array of inline tables: an inline table cannot contain other tables."""
    array = tomlkit.array().multiline(True)
    for row in rows:
        table = tomlkit.inline_table()
        table.update(row)
        array.append(table)
    return array


def mark_mistake(text: str, errors: AsBuilt | None) -> tuple[str, str | None]:
    """Return a configuration's text and None, or the text with a comment on its first mistake, and the mistake.

    `errors` is the content of the correction map that the text names.
    """
    values = _without_map(text)
    try:
        check(structs.replace(values, correction=structs.replace(values.correction, as_built=errors)))
    except ConfigError as error:
        return f"# The service does not start with this file until you correct this:\n# {error}\n\n{text}", str(error)
    return text, None


def _rounded(value: object) -> object:
    """Round numbers to a nanometre or nanoradian, the resolution of the geometry's checksum."""
    if isinstance(value, tuple):
        return [round(each, 9) for each in value]
    return round(value, 9) if isinstance(value, float) else value


def replace_values(config: Config, changes: Mapping[str, int | float]) -> Config:
    """Return a configuration with new values for keys of [drives.A], [drives.B] and [drives.C]."""
    drives = config.drives
    for path, value in changes.items():
        _, name, key = path.split(".")
        drive = structs.replace(getattr(drives, name), **{key: value})
        drives = structs.replace(drives, **{name: drive})
    return structs.replace(config, drives=drives)


def add_simulated_build(text: str, drives: Drives) -> str:
    """Return a configuration's text with `can.simulated.built` set to the node, scale and direction of `drives`.

    Simulated faults are deviations from these values, so a correction in [drives] must not change the values.
    """
    document = tomlkit.parse(text)
    rows = [
        {"node": drive.node, "counts_per_metre": drive.counts_per_metre, "direction": drive.direction}
        for drive in drives.each
    ]
    can = document["can"]
    if "simulated" not in can:
        can["simulated"] = tomlkit.table()
    can["simulated"]["built"] = _inline_tables(rows)
    return tomlkit.dumps(document)


def resolve_paths(text: str, folder: Path) -> str:
    """Return a configuration's text with absolute paths of the files that it needs, which were relative to `folder`."""
    document = tomlkit.parse(text)
    tables = [document["drives"][name] for name in NAMES]
    named = [(table, key) for table in tables for key in ("eds", "endpoints")]
    named.append((document.get("correction", {}), "map"))
    if "tls" in document.get("zenoh", {}):
        tls = document["zenoh"]["tls"]
        tls.setdefault("directory", Tls().directory)
        named.append((tls, "directory"))
    for table, key in named:
        if key in table:
            table[key] = str((folder / str(table[key])).resolve())
    return tomlkit.dumps(document)


def find_free_path(path: Path, word: str = "commissioned") -> Path:
    """Return an unused path for a file that belongs to a configuration, in the folder of the configuration's `path`.

    The file's name contains `word`.
    """
    number, free = 1, path.with_name(f"{path.stem}-{word}.toml")
    while free.exists():
        number += 1
        free = path.with_name(f"{path.stem}-{word}-{number}.toml")
    return free


def check_new_file(path: Path) -> None:
    """Raise ConfigError if `write_new_file` would refuse a path, which a long measurement must not find at its end."""
    if path.exists():
        raise ConfigError(f"{path} already exists; choose another file with --out")
    if not path.parent.is_dir():
        raise ConfigError(f"{path}: there is no folder {path.parent}")


def write_new_file(path: Path, text: str) -> None:
    """Write a new file. Raises ConfigError if the file exists or cannot be written; nothing of it is left then."""
    try:
        files.create(path, text.encode())
    except FileExistsError:
        raise ConfigError(f"{path} already exists; choose another file") from None
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from error
