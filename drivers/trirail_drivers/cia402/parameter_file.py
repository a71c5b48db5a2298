"""Reading and writing of files with the parameters of a drive: DCF files (CiA 306).

The TOML files that earlier versions of trirail saved can also be read.
"""

from __future__ import annotations

import configparser
import io
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, Final, NamedTuple

import canopen
import msgspec
from canopen.objectdictionary import INTEGER_TYPES, SIGNED_TYPES, ObjectDictionary, ODVariable
from canopen.objectdictionary.datatypes import OCTET_STRING, REAL32, REAL64, UNICODE_STRING, VISIBLE_STRING
from canopen.objectdictionary.eds import export_dcf
from msgspec import Meta, Struct

from trirail_drivers import files
from trirail_drivers.cia402 import eds
from trirail_drivers.cia402.objects import Key
from trirail_drivers.cia402.parameters import Parameter, Value, decode, encode, is_parameter, named, variables
from trirail_drivers.errors import DriveError, FileError

IDENTITY: Final[Mapping[str, Key]] = {
    "device_type": (0x1000, 0),
    "vendor": (0x1018, 1),
    "product": (0x1018, 2),
    "revision": (0x1018, 3),
    "serial": (0x1018, 4),
}
_UNUSED: Final = re.compile("FileInfo|Comments|DummyUsage|DeviceComm?issioning", re.IGNORECASE)
"""Names of sections that describe no object; canopen refuses some of these sections in files from other programs."""
_KEYWORDS: Final = {each.lower(): each for each in ("ParameterValue", "NodeID", "LSS_SerialNumber")}
_NEGATIVE: Final = re.compile(r"0x-[0-9a-f]+", re.IGNORECASE)
_TEXTS: Final = frozenset(
    text for kind in (VISIBLE_STRING, UNICODE_STRING) for text in (f"{kind}", f"0x{kind:x}", f"0x{kind:04x}")
)
"""Data types of texts, as they are written in files."""
_LISTS: Final = {each.upper(): each for each in ("MandatoryObjects", "OptionalObjects", "ManufacturerObjects")}
"""Sections that list the objects of a file, by their names in capital letters."""
_COMPACT: Final = re.compile("([0-9a-f]{4})value", re.IGNORECASE)
_TOML_TYPES: Final = {
    f"{'i' if each in SIGNED_TYPES else 'u'}{8 * ODVariable.STRUCT_TYPES[each].size}": each for each in INTEGER_TYPES
} | {"f32": REAL32, "f64": REAL64, "text": VISIBLE_STRING, "bytes": OCTET_STRING}

_Number = Annotated[int, Meta(ge=1)]


class Origin(Struct, frozen=True):
    """Identity of the drive in a file; None means unknown.

    0 in a file also means unknown, since it matches every drive (CiA 302-2).
    """

    node: Annotated[int, Meta(ge=1, le=127)] | None = None
    device_type: _Number | None = None
    vendor: _Number | None = None
    product: _Number | None = None
    revision: _Number | None = None
    serial: _Number | None = None


@dataclass(frozen=True, slots=True)
class SavedParameters:
    """Parameters of a drive at one point in time."""

    origin: Origin
    parameters: Mapping[Key, Parameter]
    unread: Mapping[Key, str]
    """Reason for each parameter without a value."""
    objects: ObjectDictionary = field(default_factory=ObjectDictionary, compare=False, repr=False)
    """All objects of the drive, for other programs that open the file."""
    complete: bool = field(default=True, compare=False)
    """Whether the drive certainly lacks every object that is not listed.

    False for a DCF, which may list only some, and for a drive that was read without its manufacturer's EDS, or with one
    that cannot be read completely.
    """
    unanswered: frozenset[Key] = field(default=frozenset(), compare=False)
    """Parameters without a value because the drive did not answer."""
    skipped: str = field(default="", compare=False)
    """Note for people about the parts of the drive's EDS that could not be read, or ""."""

    def knows(self, key: Key) -> bool:
        """Whether the value of an object is known, or the drive is known to lack the object."""
        return key in self.parameters or (self.complete and key not in self.unread)


class ParameterDifference(NamedTuple):
    """Parameter that differs between two drives or files."""

    key: Key
    name: str
    one: Parameter | None
    """Parameter on each side; None if that side lacks it."""
    other: Parameter | None


def comparable(one: SavedParameters, other: SavedParameters) -> list[Key]:
    """Return the objects that are known on both sides, sorted by index."""
    return [key for key in sorted({*one.parameters, *other.parameters}) if one.knows(key) and other.knows(key)]


def compare(one: SavedParameters, other: SavedParameters) -> list[ParameterDifference]:
    """Return the parameters that differ between both sides, sorted by index."""
    differences = []
    for key in comparable(one, other):
        mine, theirs = one.parameters.get(key), other.parameters.get(key)
        if mine is None or theirs is None or mine.data != theirs.data:
            known = mine or theirs
            differences.append(ParameterDifference(key, known.name if known else "", mine, theirs))
    return differences


def format_number(field: str, value: int | None) -> str:
    """Return an identity number as text for people, given the name of its field in Origin."""
    return "unknown" if value is None else str(value) if field == "node" else f"{value:08X}h"


def origin(numbers: Mapping[str, Any]) -> Origin:
    """Return an origin with the given numbers by field name; 0 becomes None. Raises ValueError."""
    return msgspec.convert({name: number for name, number in numbers.items() if number}, Origin)


def write(path: Path, saved: SavedParameters, bitrate: int | None = None) -> None:
    """Write a new DCF atomically. Raises FileError if the file exists or cannot be written."""
    objects, numbers = saved.objects, saved.origin
    for _, each in variables(objects):  # the drive's EDS may itself be a DCF with values
        vars(each).update(value=None, value_raw=None)
    info = objects.device_information
    info.vendor_number, info.product_number, info.revision_number = numbers.vendor, numbers.product, numbers.revision
    for name, key in IDENTITY.items():
        if (variable := objects.get_variable(*key)) is not None:
            number = getattr(numbers, name)
            text = None if number is None else f"0x{number:08X}"
            vars(variable).update(default=None, default_raw=None, value_raw=text)
    for (index, subindex), parameter in saved.parameters.items():
        value = decode(parameter.data_type, parameter.data)
        item = objects[index]
        variable = item if isinstance(item, ODVariable) else item[subindex]
        # canopen would write -5 as 0x-5, which it cannot read.
        vars(variable).update(value_raw=value.hex() if isinstance(value, bytes) else str(value))
        if variable.data_type != parameter.data_type or not _is_within_limits(variable, value):
            vars(variable).update(data_type=parameter.data_type, min=None, max=None, default=None, default_raw=None)
    objects.node_id, objects.bitrate = numbers.node, bitrate
    date, time = datetime.now().astimezone().strftime("%m-%d-%Y %I:%M%p").split()
    head = {"FileName": path.name, "ModifiedBy": "trirail", "ModificationDate": date, "ModificationTime": time}
    commissioning = f"[DeviceComissioning]\nLSS_SerialNumber={numbers.serial or 0}\n"
    output = io.StringIO()
    # canopen.export_od is not used, because all files that it writes in a process share one header.
    export_dcf(objects, output, head)  # type: ignore[no-untyped-call]
    try:
        files.create(path, output.getvalue().replace("[DeviceComissioning]\n", commissioning, 1).encode())
    except OSError as error:
        raise FileError(f"{path}: {error.strerror}") from error


def read(path: Path, node: int | None = None) -> SavedParameters:
    """Return the parameters in a file, which is a DCF if it has that suffix, otherwise a TOML file.

    Values relative to the node id use `node` or, if it is None, the node id in the file. Raises FileError if the file
    cannot be read, and DriveError if any of its values is wrong.
    """
    try:
        return _read_dcf(path, node) if path.suffix.lower() in (".dcf", ".eds") else _read_toml(path)
    except (configparser.Error, ValueError, LookupError, AttributeError, TypeError) as error:  # also from canopen
        raise DriveError(f"{path} is not a parameter file of a drive: {' '.join(str(error).split())}") from error


def _read_toml(path: Path) -> SavedParameters:
    content = msgspec.toml.decode(files.text(path))
    parameters = {}
    for key, entry in ((_key(name), entry) for name, entry in content["parameters"].items()):
        value = bytes.fromhex(entry["value"]) if entry["type"] == "bytes" else entry["value"]
        data_type = _TOML_TYPES[entry["type"]]
        parameters[key] = Parameter(data_type, encode(data_type, value, f"object {named(key)}: "), entry["name"])
    return SavedParameters(
        origin(content["drive"]), parameters, {_key(name): why for name, why in content["unread"].items()}
    )


def _read_dcf(path: Path, node: int | None) -> SavedParameters:
    sections, numbers = _sections(path)
    node = node or numbers.get("node")
    file = io.StringIO()
    file.name = "parameters.dcf"
    sections.write(file)
    file.seek(0)
    objects = canopen.import_od(file, node)
    texts = {key: raw for key, each in variables(objects) if (raw := getattr(each, "value_raw", None))}
    if len(texts) != sum("ParameterValue" in section for section in sections.values()) or not texts:
        raise ValueError("a ParameterValue belongs to no object" if texts else "no object has a ParameterValue")
    _check_lists(sections, set(objects))
    info = objects.device_information
    numbers |= {"vendor": info.vendor_number, "product": info.product_number, "revision": info.revision_number}
    for name, key in IDENTITY.items():
        if (variable := objects.get_variable(*key)) is not None:
            default = variable.default if name != "serial" else None
            numbers[name] = _parse(variable, texts[key]).value if key in texts else numbers.get(name) or default
    parameters: dict[Key, Parameter] = {}
    unread: dict[Key, str] = {}
    for key, variable in variables(objects):
        if not is_parameter(variable):
            continue
        if key not in texts:
            unread[key] = "the file has no value"
        elif node is None and "$NODEID" in texts[key].upper():
            unread[key] = "its value follows the node id, which the file does not have"
        else:
            parameters[key] = _parse(variable, texts[key])
    return SavedParameters(origin(numbers), parameters, unread, objects, complete=False)


def _sections(path: Path) -> tuple[configparser.RawConfigParser, dict[str, Any]]:
    """Return the sections that describe objects, in a form that canopen reads, and the node id and serial number."""
    sections = configparser.RawConfigParser(inline_comment_prefixes=(";",))
    sections.optionxform = lambda optionstr: _KEYWORDS.get(optionstr.lower(), optionstr)  # type: ignore[method-assign]
    # Unlike an EDS, a DCF with duplicates is refused: nobody can know which of two values to write into a drive.
    strict = configparser.RawConfigParser(allow_no_value=True)
    # In capital letters, because hexadecimal numbers in the names of sections may have letters of either case.
    whole = files.text(path, errors="replace")
    strict.read_string(whole.rstrip("\x1a\0 \r\n\t").upper())
    if (last := whole.splitlines(keepends=True)[-1]).lower().startswith("parametervalue") and not last.endswith("\n"):
        raise ValueError("it ends within a value; is the file complete? If it is, end its last line with a line break")
    with eds.open_text(path) as text:
        sections.read_file(text)
    commissioned: dict[str, int] = {}
    for name in sections.sections():
        for option, content in sections.items(name):
            if not content and option != "ParameterName":
                sections.remove_option(name, option)
            elif _NEGATIVE.fullmatch(content) and not _is_text(sections, name):
                # canopen writes negative numbers this way, and cannot read them.
                sections[name][option] = f"-0x{content[3:]}"
        if _UNUSED.fullmatch(name):
            commissioned |= {key: int(sections[name][key], 0) for key in _KEYWORDS.values() if key in sections[name]}
            sections.remove_section(name)
        elif compact := _COMPACT.fullmatch(name):
            _expand(sections, compact[1], sections[name])
    return sections, {"node": commissioned.get("NodeID"), "serial": commissioned.get("LSS_SerialNumber")}


def _is_text(sections: configparser.RawConfigParser, name: str) -> bool:
    """Whether a section contains texts, judging by its data type or, for array values, by that of the array."""
    described = next((each for each in (name, name[:4]) if sections.has_option(each, "DataType")), None)
    return described is not None and sections[described]["DataType"].strip().lower() in _TEXTS


def _check_lists(sections: configparser.RawConfigParser, described: set[int]) -> None:
    """Raise ValueError if the lists of objects show that the file was cut off."""
    lists = {name.upper(): sections[name] for name in sections if name.upper() in _LISTS}
    numbers = {name: [key for key in each if key.isdigit()] for name, each in lists.items()}
    listed = {int(lists[name][number], 0) for name, each in numbers.items() for number in each}
    if cut_off := sorted(listed - described):
        raise ValueError(f"it lists object {cut_off[0]:04X} but does not describe it; is the file complete?")
    if described - listed:  # some programs describe more objects than they list
        return
    # CiA 306: a file has all three lists, with SupportedObjects=0 if one is empty.
    for name, title in _LISTS.items():
        counts = [value for key, value in lists.get(name, {}).items() if key.upper() == "SUPPORTEDOBJECTS"]
        if not counts or len(numbers[name]) < int(counts[0], 0):
            raise ValueError(f"its list [{title}] is missing or too short; is the file complete?")


def _expand(sections: configparser.RawConfigParser, index: str, values: Mapping[str, str]) -> None:
    """Expand the values of an array in one section, [1234Value], into one section for each element."""
    for number in filter(str.isdigit, values):
        element = f"{index}sub{int(number):X}"
        if element not in sections:
            sections[element] = sections[index]
        sections[element]["ParameterValue"] = values[number]


def _parse(variable: ODVariable, raw: str) -> Parameter:
    """Return an object with the value that its ParameterValue states. Raises ValueError if the value is invalid."""
    where = f"object {named((variable.index, variable.subindex))}: "
    value, bits, data_type = variable.value, len(variable), variable.data_type or 0
    if data_type in SIGNED_TYPES and raw.lower().startswith("0x") and value is not None and value >> bits - 1 == 1:
        value -= 1 << bits  # a negative number in two's complement
    data = encode(data_type, raw if value is None else value, where)
    if not _is_within_limits(variable, value):
        raise ValueError(f"{where}{value} is not within its limits, {variable.min} to {variable.max}")
    return Parameter(data_type, data, variable.qualname)


def _is_within_limits(variable: ODVariable, value: Value | None) -> bool:
    """Whether the EDS allows a value. Some files contain limits that exclude every value; these limits are ignored."""
    low, high = variable.min, variable.max
    if low is None or high is None or low > high or not isinstance(value, int | float):
        return True
    return low <= value <= high


def _key(name: str) -> Key:
    index, subindex = name.split(":")
    return int(index, 16), int(subindex, 16)
