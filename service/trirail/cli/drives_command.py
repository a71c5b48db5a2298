"""`trirail drives`: show the drives on the bus and the changes of their set-up, and keep their parameters in files."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

import msgspec
from cyclopts import App, Parameter
from trirail_drivers.errors import DriveError, FileError

from trirail.cli import terminal
from trirail.cli.options import ConfigFile, Flag, Json

if TYPE_CHECKING:
    from trirail_drivers.cia402.backup import UnrestoredParameter
    from trirail_drivers.cia402.parameter_file import ParameterDifference, SavedParameters
    from trirail_drivers.cia402.parameters import Parameter as Held
    from trirail_drivers.protocols import Protocol

    from trirail.config import Config

app = App(name="drives", help="Show the drives; save, compare, restore their parameters.")
UNTESTED_NOTE = (
    "no make of drive has been tested on hardware yet: continue with trirail commission, a hand on the emergency stop"
)
"""Note about untested drives, which is also in the first line of the example files for manufacturers' drives."""
Axis = Literal["A", "B", "C"]
_MAX_NAMED: Final = 8
"""Maximum number of objects named in one line. The output of --json and the file contain all of them."""


@app.default
def drives(config: ConfigFile = None, /, *, apply: Annotated[bool, Flag] = False, json: Json = False) -> int:
    """Show each drive: identity, modes, units, and the changes of its set-up with their reasons.

    Without --apply, the command only reads. No drive gets power, and no drive stores anything. Stop the service first.

    Parameters
    ----------
    apply
        Write the differences, and read them back.
    """
    from trirail_drivers.connection.opening import open_bus
    from trirail_drivers.errors import DriveError
    from trirail_drivers.protocols import PROTOCOLS

    from trirail.commissioning import drive_report
    from trirail.config import SIM, load
    from trirail.diagnosis.check import is_simulated
    from trirail.diagnosis.drive_checks import usage_of

    settings = load(config or SIM)
    inspect = PROTOCOLS[settings.drives.protocol].inspect
    if inspect is None:
        protocol = settings.drives.protocol
        raise DriveError(
            f"drives of protocol {protocol} have no objects to show: find the drives with trirail commission"
        )
    with open_bus(settings.can, settings.drives) as bus:
        slider = settings.limits.slider
        cycle = settings.period, time.monotonic, slider.fastest
        io, timing = settings.drive_io, settings.can.timing
        reports = inspect(bus, settings.drives, *cycle, apply=apply, io=io, timing=timing, travel=slider.positions)
    fit = not any(each["refused"] for each in reports)
    if json:
        terminal.json({"ok": fit, "applied": apply, "drives": reports})
    else:
        for each in reports:
            for line in (
                *drive_report.format_identity(each, settings.geometry.labels),
                *drive_report.format_differences(each, applied=apply),
            ):
                terminal.print_line(line)
        if (used := reports[0].get("bus_load")) is not None:
            terminal.print_line(usage_of(settings, used))
        if not is_simulated(settings.can):
            terminal.print_line(UNTESTED_NOTE)
    return 0 if fit else 1


def save(
    folder: Path = Path(),
    /,
    *,
    config: ConfigFile = None,
    drive: Annotated[tuple[Axis, ...], Parameter(negative="", consume_multiple=False)] = ("A", "B", "C"),
    json: Json = False,
) -> int:
    """Save all parameters of each drive to a file, such as drive-A.dcf (CiA 306). Existing files are never overwritten.

    Objects that no drive stores are left out: read-only objects, controlwords, targets, actual values and commands.

    Parameters
    ----------
    folder
        Folder for the files. If absent, the current folder.
    drive
        Drive to read; may be repeated. If absent, all three drives.
    """
    from trirail_drivers.cia402 import parameter_file

    settings, protocol = _load_config(config)
    paths: dict[str, Path] = {name: folder / f"drive-{name}.dcf" for name in sorted(set(drive))}
    for path in paths.values():
        if path.exists():
            raise FileError(f"{path} already exists: choose another folder")
    if not folder.is_dir():
        what = "a file, not a folder; give a configuration with --config" if folder.is_file() else "no such folder"
        raise FileError(f"{folder}: {what}")
    ends = _read(settings, protocol, sorted(paths))
    failed = {name: str(end) for name, end in ends.items() if isinstance(end, DriveError)}
    read = {name: end for name, end in ends.items() if not isinstance(end, DriveError)}
    for name, saved in tuple(read.items()):
        try:
            parameter_file.write(paths[name], saved, settings.can.bitrate)
        except FileError as error:
            failed[name] = str(error)
            del read[name]
    ok = not failed and not any(saved.unanswered for saved in read.values())
    built_in = "named from the built-in servo.eds: the manufacturer's own objects need drives.{}.eds"
    notes = {
        name: built_in.format(name) if getattr(settings.drives, name).eds is None else saved.skipped
        for name, saved in read.items()
    }
    if json:
        files = {
            name: {
                "file": str(paths[name]),
                "parameters": len(saved.parameters),
                "unread": {_named(key): why for key, why in saved.unread.items()},
                "notes": [notes[name]] if notes[name] else [],
            }
            for name, saved in read.items()
        }
        terminal.json({"ok": ok, "drives": files, "failed": failed})
        return 0 if ok else 1
    for name, saved in read.items():
        number = len(saved.parameters)
        terminal.print_line(f"drive {name}, node {saved.origin.node}: {number} parameters in {paths[name]}")
        reasons: dict[str, list[str]] = {}
        for key, why in saved.unread.items():
            reasons.setdefault(why, []).append(_named(key))
        for why, objects in reasons.items():
            terminal.print_line(f"  {len(objects)} could not be read: {_abbreviate(objects)}: {why}")
        if notes[name]:
            terminal.print_line(f"  {notes[name]}")
    for words in failed.values():
        terminal.print_error(words)
    return 0 if ok else 1


def compare(
    file: Path,
    other: Path | None = None,
    /,
    *,
    config: ConfigFile = None,
    drive: Axis | None = None,
    json: Json = False,
) -> int:
    """Show the parameters that differ between two files, or between a file and the drive.

    The exit code is 0 if the products are the same, no parameter differs and the drive has answered, otherwise 1.

    Parameters
    ----------
    file
        DCF written by trirail drives save or another program, or a TOML file of an earlier version.
    other
        File to compare with. If absent, the drive itself.
    drive
        Drive to compare. If absent, the drive with the node id in the file.
    """
    from trirail_drivers.cia402 import parameter_file

    if other is not None:
        one, two, heading = parameter_file.read(file), parameter_file.read(other), str(other)
    else:
        settings, protocol = _load_config(config)
        name, one = _load_file(file, drive, settings)
        (end,) = _read(settings, protocol, [name]).values()
        if isinstance(end, DriveError):
            raise end
        two, heading = end, f"drive {name}"
    unread = {key: two.unread[key] for key in sorted(two.unanswered & one.parameters.keys())}
    differences = parameter_file.compare(one, two)
    compared = parameter_file.comparable(one, two)
    only = [
        sorted(mine.parameters.keys() - theirs.parameters - {*compared, *unread})
        for mine, theirs in ((one, two), (two, one))
    ]
    is_same_product = (one.origin.vendor, one.origin.product) == (two.origin.vendor, two.origin.product)
    ok = is_same_product and bool(compared) and not (differences or unread)
    if json:
        terminal.json(
            {
                "ok": ok,
                "one": str(file),
                "other": heading,
                "identity": {"one": msgspec.to_builtins(one.origin), "other": msgspec.to_builtins(two.origin)},
                "compared": len(compared),
                "differences": [_as_json(each) for each in differences],
                "only_one": [_named(key) for key in only[0]],
                "only_other": [_named(key) for key in only[1]],
                "unread": {_named(key): why for key, why in unread.items()},
                "notes": [two.skipped] if two.skipped else [],
            }
        )
        return 0 if ok else 1
    if two.skipped:
        terminal.print_line(two.skipped)
    for field in ("vendor", "product", "revision", "serial"):
        mine, theirs = getattr(one.origin, field), getattr(two.origin, field)
        if mine != theirs:
            here, there = (parameter_file.format_number(field, number) for number in (mine, theirs))
            terminal.print_line(f"{field}: {here} and {there}")
    if differences:
        _print_differences(str(file), heading, [(each, "") for each in differences])
    for side, keys in zip((str(file), heading), only, strict=True):
        if keys:
            terminal.print_line(f"only in {side}, not compared: {_abbreviate([_named(key) for key in keys])}")
    for key, why in unread.items():
        terminal.print_line(f"{_named(key)} not compared: {why}")
    terminal.print_line(f"{len(differences)} of {len(compared)} parameters differ")
    return 0 if ok else 1


def restore(
    file: Path,
    /,
    *,
    config: ConfigFile = None,
    drive: Axis | None = None,
    replace: Annotated[bool, Flag] = False,
    store: Annotated[bool, Flag] = False,
    json: Json = False,
) -> int:
    """Restore a drive's parameters from a file, and read them back; exit 1 if any still differs.

    The drive must be without power, and no service or other master may be on the bus. Parameters of the set-up, the
    node id and the bitrate do not change; those that differ are listed. A file for another product is refused.

    Parameters
    ----------
    file
        DCF written by trirail drives save or another program, or a TOML file of an earlier version.
    drive
        Drive to restore. If absent, the drive with the node id in the file.
    replace
        Accept a drive with another revision, serial number or node id, such as the replacement of a broken drive, and a
        file that does not name its product.
    store
        Make the drive store its parameters permanently (object 1010h) after all of them have been written. It stores
        all present values, also those that the set-up has written since power-on.
    """
    from trirail_drivers.connection.opening import open_bus

    settings, protocol = _load_config(config)
    name, saved = _load_file(file, drive, settings)
    if protocol.restore is None:
        raise _no_dictionary_error(protocol)
    with open_bus(settings.can, settings.drives) as bus:
        done = protocol.restore(
            bus, settings.drives, time.monotonic, name, saved, replace=replace, store=store, io=settings.drive_io
        )
    if json:
        left = [_as_json(each.different) | {"why": each.why, "meant": each.intended} for each in done.left]
        written = [_named(key) for key in done.written]
        summary = {"ok": done.ok, "drive": name, "written": written, "left": left, "stored": done.stored}
        terminal.json(summary | ({"not_stored": done.not_stored} if done.not_stored else {}))
        return 0 if done.ok else 1
    terminal.print_line(f"drive {name}: {len(done.written)} parameters written and read back")
    _print_unrestored(str(file), name, done.left)
    if store:
        stored = "stored in the drive"
        if any(each.by_setup for each in done.left):
            stored += ", with the present values of the set-up"
        terminal.print_line(f"  not stored: {done.not_stored}" if done.not_stored else f"  {stored}")
    return 0 if done.ok else 1


for command in (save, compare, restore):
    app.command(command)


def _load_config(config: Path | None) -> tuple[Config, Protocol]:
    from trirail_drivers.protocols import PROTOCOLS

    from trirail.config import SIM, load

    settings = load(config or SIM)
    return settings, PROTOCOLS[settings.drives.protocol]


def _load_file(file: Path, drive: Axis | None, settings: Config) -> tuple[str, SavedParameters]:
    """Return the contents of a file and the drive that they are for, selected by name or by the node id in the file."""
    from trirail_drivers.cia402 import parameter_file

    nodes: dict[str, int] = {name: getattr(settings.drives, name).node for name in ("A", "B", "C")}
    saved = parameter_file.read(file, nodes[drive] if drive else None)
    if drive:
        return drive, saved
    for name, node in nodes.items():
        if node == saved.origin.node:
            return name, saved
    file_node = "no node id" if saved.origin.node is None else f"node id {saved.origin.node}"
    raise DriveError(
        f"{file} has {file_node}, the drives have {', '.join(map(str, nodes.values()))}; select the drive with --drive"
    )


def _read(settings: Config, protocol: Protocol, names: Sequence[str]) -> dict[str, SavedParameters | DriveError]:
    """Return the parameters of drives, or the reason why a drive could not be read."""
    from trirail_drivers.connection.opening import open_bus

    if protocol.save is None:
        raise _no_dictionary_error(protocol)
    with open_bus(settings.can, settings.drives) as bus:
        return protocol.save(bus, settings.drives, time.monotonic, names)


def _no_dictionary_error(protocol: Protocol) -> DriveError:
    return DriveError(
        f"drives of protocol {protocol.name} have no object dictionary to save: use the manufacturer's tool"
    )


def _print_unrestored(file: str, name: str, left: Sequence[UnrestoredParameter]) -> None:
    if of_setup := [_named(each.different.key) for each in left if each.by_setup]:
        terminal.print_line(f"  {len(of_setup)} left as they are, written by the set-up: {', '.join(of_setup)}")
    skipped = [each for each in left if each.intended and not each.by_setup]
    for words, rows in (("left as they are", skipped), ("differ still", [each for each in left if not each.intended])):
        if rows:
            terminal.print_line(f"  {len(rows)} {words}:")
            _print_differences(file, f"drive {name}", [(each.different, each.why) for each in rows])


def _print_differences(one: str, other: str, rows: Iterable[tuple[ParameterDifference, str]]) -> None:
    table = terminal.table("object", "", one, other, "")
    for each, why in rows:
        values = (_value(each.one), _value(each.other))
        table.add_row(_named(each.key), *map(terminal.plain, (each.name, *values, why)))
    terminal.print_table(table)


def _as_json(each: ParameterDifference) -> dict[str, Any]:
    one, other = (None if held is None else _json_value(held.value) for held in (each.one, each.other))
    return {"object": _named(each.key), "name": each.name, "one": one, "other": other}


def _json_value(value: float | str) -> float | str:
    """Return a value for JSON, which has no infinity and no NaN."""
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def _value(held: Held | None) -> str:
    return "–" if held is None else str(held.value)


def _abbreviate(objects: Sequence[str]) -> str:
    more = len(objects) - _MAX_NAMED
    return ", ".join(objects[:_MAX_NAMED]) + (f" and {more} more" if more > 0 else "")


def _named(key: tuple[int, int]) -> str:
    from trirail_drivers.cia402.parameters import named

    return named(key)
