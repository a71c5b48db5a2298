"""`trirail config`: list and copy the shipped configurations, and show the effective values of a file."""

from __future__ import annotations

import json as json_text
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
from cyclopts import App
from trirail_drivers import files

from trirail.cli import terminal
from trirail.cli.options import ConfigFile, Json
from trirail.errors import ConfigError

app = App(name="config", help="List and copy shipped configurations, show effective values.")

BASE = "sim.toml"
"""Shipped configuration with which other configurations are compared."""
_Tables = dict[str, Any]


def _folder() -> Path:
    """Return the folder of the shipped configurations, either in the installed package or in a checkout."""
    from trirail.config import SIM

    return SIM.parent


@app.default
def shipped(*, json: Json = False) -> int:
    """List the shipped configurations with their purposes; `trirail config copy` copies one."""
    files = shipped_files()
    if json:
        terminal.json({"folder": str(_folder()), "files": files})
        return 0
    width = max(map(len, files))
    for name, purpose in files.items():
        terminal.print_line(f"{name:{width}}  {purpose}")
    terminal.print_line(f"in {_folder()}; one to start from: trirail config copy sim.toml my.toml")
    return 0


@app.command
def copy(name: str, dest: Path | None = None, /, *, json: Json = False) -> int:
    """Copy a shipped file, such as a configuration or the systemd unit, so that you can change the copy.

    An existing file is never overwritten.

    Parameters
    ----------
    name
        Name, as listed by `trirail config`; ".toml" may be left out.
    dest
        Destination file or folder. If absent, the current folder.
    """
    source = shipped_file(name)
    target = dest or Path()
    if target.is_dir():
        target /= source.name
    try:
        files.create(target, source.read_bytes())
    except FileExistsError:
        raise ConfigError(f"{target} already exists: choose another file") from None
    except OSError as error:
        raise ConfigError(f"{target}: {error.strerror}") from error
    if json:
        terminal.json({"source": str(source), "file": str(target)})
    else:
        terminal.print_line(f"{target}: a copy of the shipped {source.name}")
    return 0


@app.command
def show(config: ConfigFile = None, /, *, json: Json = False) -> int:
    """Print a configuration with every default, and mark its differences from the shipped sim.toml.

    The output is a valid configuration.
    """
    from trirail.telemetry.provenance import toml_lines

    base = _folder() / BASE
    effective, simulated = (_tables(path) for path in (config or base, base))
    different = {
        key: {"value": value, BASE: other} for key, value, other in _paired(effective, simulated) if value != other
    }
    if json:
        terminal.json({"config": effective, "differences": different})
        return 0
    for line in toml_lines(effective, simulated, BASE):
        terminal.print_line(line)
    return 0


def shipped_files() -> dict[str, str]:
    """Return the names of the shipped files, each with the line that states its purpose."""
    return {_name(path): _purpose(path) for path in _shipped()}


def _shipped() -> list[Path]:
    files = [
        path for suffix in ("toml", "service", "conf", "nft", "yml", "json") for path in _folder().glob(f"*.{suffix}")
    ]
    return sorted(files) + sorted(_folder().glob("drives/*.toml"))


def _name(path: Path) -> str:
    """Return the name of a shipped file, which is its path relative to the folder of shipped files."""
    return path.relative_to(_folder()).as_posix()


def _purpose(path: Path) -> str:
    """Return the purpose of a file from the comment in its first line, or from a field if the file is JSON."""
    if path.suffix == ".json":
        return str(json_text.loads(path.read_bytes())["description"])
    with path.open(encoding="utf-8") as file:
        return file.readline().lstrip("# ").rstrip(":\n")


def shipped_file(name: str) -> Path:
    """Return the shipped file with this name; ".toml" may be left out. Raises ConfigError if there is none."""
    for path in _shipped():
        if name in (_name(path), _name(path).removesuffix(".toml")):
            return path
    raise ConfigError(f"no configuration {name!r} is shipped: use one of {', '.join(map(_name, _shipped()))}")


def _tables(path: Path) -> _Tables:
    """Return the configuration in a file as tables, with arrays as lists."""
    from trirail.config import load  # numba, with the kinematics

    config = load(path)
    if config.correction.map is not None:  # the map stays in its own file
        config = msgspec.structs.replace(config, correction=msgspec.structs.replace(config.correction, as_built=None))
    tables: _Tables = json_text.loads(msgspec.json.encode(config))
    return tables


def _paired(tables: _Tables, other: _Tables, path: str = "") -> Iterator[tuple[str, object, object]]:
    """Yield the full path of each key in either table with both values; a missing value is None."""
    for key in {**tables, **other}:
        name = f"{path}.{key}" if path else key
        value, was = tables.get(key), other.get(key)
        if isinstance(value, dict) or isinstance(was, dict):
            yield from _paired(value or {}, was or {}, name)
        else:
            yield name, value, was
