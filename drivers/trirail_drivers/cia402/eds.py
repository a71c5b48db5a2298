"""Reading of a drive's object dictionary from its EDS, the manufacturer's electronic data sheet (CiA 306)."""

from __future__ import annotations

import configparser
import io
import logging
import re
from pathlib import Path
from typing import Final, NamedTuple

import canopen
from canopen.objectdictionary import ObjectDictionary

from trirail_drivers import files
from trirail_drivers.errors import DriveError, FileError

_OBJECT = re.compile(r"([0-9A-F]{4})(sub[0-9A-F]+|Name)?", re.IGNORECASE)
_OTHER_OBJECT = re.compile(r"[0-9A-F]{4}(Value|Denotation|ObjectLinks)|CANopenManager", re.IGNORECASE)
"""Names of further sections about an object (CiA 306)."""
_LIKE_OBJECT = re.compile(r"(0x)?[0-9A-F]{3,4}([^A-Z]|sub|$)", re.IGNORECASE)
_LIST = re.compile(r"(Mandatory|Optional|Manufacturer)Objects", re.IGNORECASE)
_INDEX = re.compile(r"0x[0-9A-F]{4}", re.IGNORECASE)
_PADDED_DIGIT = re.compile(r"0+([0-7])")
"""Digit from 0 to 7 with leading zeros, which is the same number in decimal and octal."""
_VERBATIM = ("parametervalue", "defaultvalue")
"""Keys whose digits may be an octet string, in which zeros are significant."""
_KEYWORDS = {
    keyword.casefold(): keyword
    for keyword in (
        "ParameterName",
        "ObjectType",
        "DataType",
        "AccessType",
        "PDOMapping",
        "DefaultValue",
        "ParameterValue",
        "LowLimit",
        "HighLimit",
        "StorageLocation",
        "CompactSubObj",
        "NrOfEntries",
        "Factor",
        "Unit",
        *(f"Dummy{number:04}" for number in range(1, 8)),
    )
}
"""Keys of objects in the spelling that canopen recognises. In CiA 306, they are not case-sensitive."""
_WITH_SUB_OBJECTS = (8, 9)
"""Object types of arrays and records (CiA 301)."""
_AFTER = "\x1a\0"
"""Characters that old editors wrote after the end of a text."""


class Section(NamedTuple):
    """Section of a file: its first line number and its keys."""

    name: str
    line: int
    values: dict[str, str]

    @property
    def object(self) -> int | None:
        """Index of the object that the section describes or belongs to."""
        match = _OBJECT.fullmatch(self.name)
        return int(match[1], 16) if match else None

    @property
    def parent(self) -> str:
        """Name of the object's main section, if this section belongs to a subindex or to array names, otherwise ""."""
        match = _OBJECT.fullmatch(self.name)
        return match[1].upper() if match and match[2] else ""

    def number(self, key: str) -> int | None:
        """Return the number under a key; None if there is none."""
        text = next((value for name, value in self.values.items() if name.casefold() == key.casefold()), "")
        try:
            return int(text, 0)
        except ValueError:
            return None

    def __str__(self) -> str:
        values = "\n".join(f"{key}={value}" for key, value in self.values.items())
        return f"[{self.name}]\n{values}\n"


def sections_of(text: str) -> tuple[list[Section], list[str]]:
    """Return the sections of a text, and notes about the lines that were skipped, such as contradictory duplicates.

    Comments are dropped. A key with an empty value counts as absent, since many tools write empty values.
    """
    sections: dict[str, Section] = {}
    notes: list[str] = []
    now: Section | None = None
    twice: list[Section] = []
    for number, line in enumerate(text.rstrip(_AFTER + " \r\n\t").splitlines(), 1):
        stripped = line.strip()
        if not stripped or stripped[0] in ";#":
            continue
        if stripped[0] == "[" and "]" in stripped:
            now = Section(_normalised(stripped[1 : stripped.index("]")].strip()), number, {})
            if not _OBJECT.fullmatch(now.name) and _LIKE_OBJECT.match(now.name) and not _OTHER_OBJECT.match(now.name):
                notes.append(f"[{now.name}] in line {number}: no object; expected a name such as [1018] or [1018sub1]")
            if now.name.upper() in sections:
                twice.append(now)
            else:
                sections[now.name.upper()] = now
            continue
        if now is None:
            notes.append(f"line {number}: before the first section")
        elif now.name.casefold() != "comments":
            reason = _parse_line(now.values, stripped)
            notes += [f"[{now.name}] line {number}: {reason}"] if reason else []
    differing = [again for again in twice if again.values != sections[again.name.upper()].values]
    notes += [f"[{again.name}] in line {again.line}: for the second time" for again in differing]
    sections.pop("COMMENTS", None)
    return list(sections.values()), notes


def _normalised(name: str) -> str:
    """Return a section's name in the spelling that canopen recognises, such as 1018sub1."""
    match = _OBJECT.fullmatch(name)
    if not match or not match[2]:
        return name
    return match[1] + ("Name" if match[2].casefold() == "name" else f"sub{match[2][3:]}")


def _parse_line(values: dict[str, str], line: str) -> str:
    """Add a line to a section's values; return the reason why it is skipped, or ""."""
    key, equals, value = (part.strip() for part in line.partition("="))
    if not equals:
        return "no value"
    key = _KEYWORDS.get(key.casefold(), key)
    small = _PADDED_DIGIT.fullmatch(value) if key.casefold() not in _VERBATIM else None
    value = small[1] if small else value
    if values.get(key, value) != value:
        return f"{key} for the second time"
    if value:
        values[key] = value
    return ""


def sort_sections(sections: list[Section]) -> list[Section]:
    """Return the sections sorted so that each one follows the section on which it depends."""
    return sorted(sections, key=lambda section: section.parent != "")


# canopen must not print its errors as well: the DriveError contains the reason, and only its line is shown.
logging.getLogger("canopen").addHandler(logging.NullHandler())

SERVO: Final = Path(__file__).with_name("servo.eds")
"""Object dictionary of the simulated CiA 402 servo drive; it names and types objects if no manufacturer's EDS is given.
"""
REQUIRED: Final = frozenset((0x1000, 0x6040, 0x6041, 0x6060, 0x6061, 0x6064))
"""Objects needed in every mode; a file in which one of them cannot be read is refused."""
MAX_SHOWN_NOTES: Final = 3
"""Maximum number of skipped sections and lines that a warning names."""
_UNREADABLE = configparser.Error, ValueError, KeyError, AttributeError


def load(drive: str, file: Path, node: int) -> tuple[ObjectDictionary, str]:
    """Return the objects of the drive called `drive`, and one warning about skipped lines, or "".

    Raises DriveError if the file cannot be used.
    """
    try:
        objects, notes = _read(file, node)
    except DriveError as error:
        raise DriveError(f"drive {drive}: {error}") from error
    more = f"; and {len(notes) - MAX_SHOWN_NOTES} more" if len(notes) > MAX_SHOWN_NOTES else ""
    return objects, f"skipped in {file}: {'; '.join(notes[:MAX_SHOWN_NOTES])}{more}" if notes else ""


def read(file: Path, node: int) -> ObjectDictionary:
    """Return the objects of a device with this node id. Raises DriveError if the file is not an EDS."""
    return _read(file, node)[0]


def open_text(file: Path) -> io.StringIO:
    """Open a manufacturer's file as text that canopen can read; unreadable lines are repaired or omitted.

    Raises DriveError if the file cannot be read or was cut off within an object.
    """
    return _text(file, sort_sections(_sections(file)[0]))


def _sections(file: Path) -> tuple[list[Section], list[str]]:
    """Return the sections of a file, and notes about the lines that were skipped. Raises DriveError as `open_text`."""
    sections, notes = sections_of(_content(file))
    _check_end(file, sections)
    listed = {
        int(value, 16)
        for each in sections
        if _LIST.fullmatch(each.name)
        for key, value in each.values.items()
        if key.isdigit() and _INDEX.fullmatch(value)
    }
    if missing := sorted(listed - {each.object for each in sections}):
        notes.append(
            f"{len(missing)} objects that it lists but does not describe, such as {missing[0]:04X}; is the file "
            "complete?"
        )
    return sections, notes


def _check_end(file: Path, sections: list[Section]) -> None:
    """Raise DriveError if the last object of a file lacks sub-objects, because canopen would silently omit them.

    Objects before the last are not checked: their sub-objects were not cut off, and some manufacturers count wrongly.
    """
    index = next((each.object for each in reversed(sections) if each.object is not None), None)
    own = [each for each in sections if each.object == index]
    main = next((each for each in own if not each.parent), None)
    kind = main.number("ObjectType") if main is not None else None
    if main is None or main.number("CompactSubObj") or kind not in (None, *_WITH_SUB_OBJECTS):
        return
    described = [int(each.name[7:], 16) for each in own if each.name[4:7] == "sub"]
    wanted = main.number("SubNumber") or (1 if kind in _WITH_SUB_OBJECTS else 0)
    # Some manufacturers give the highest subindex plus 1, although subindices between are missing.
    if max(len(described), *(1 + each for each in described), 0) < wanted:
        raise DriveError(
            f"{file}: it ends within object {index:04X}, with {len(described)} of {wanted} sub-objects; is the file "
            "complete?"
        )


def _content(file: Path) -> str:
    """Read a manufacturer's file in any encoding: every usual encoding represents numbers as in ASCII."""
    try:
        with files.open_regular(file) as source:
            return source.read().decode("utf-8-sig", errors="replace")
    except (FileError, OSError) as error:
        raise DriveError(f"cannot read EDS {error}") from error


def _text(file: Path, sections: list[Section]) -> io.StringIO:
    lacks = not any(section.name == "DeviceInfo" for section in sections)  # canopen refuses a file without this section
    text = io.StringIO("".join(map(str, [Section("DeviceInfo", 0, {}), *sections] if lacks else sections)))
    text.name = f"{file}.eds"  # canopen recognises an EDS by its file name, and manufacturers also use others
    return text


def _read(file: Path, node: int) -> tuple[ObjectDictionary, list[str]]:
    """Return the readable objects of a file, and notes about skipped lines. Raises DriveError."""
    sections, notes = _sections(file)
    sections = sort_sections(sections)
    try:
        objects = canopen.import_od(_text(file, sections), node)
    except _UNREADABLE:
        sound = _readable(file, sections, node, notes)
        objects = canopen.import_od(_text(file, sound), node)
    if not len(objects):
        reason = notes[0] if notes else "it has no objects"
        raise DriveError(f"{file} is not an EDS according to CiA 306: {reason}")
    return objects, notes


def _readable(file: Path, sections: list[Section], node: int, notes: list[str]) -> list[Section]:
    """Return the sections that canopen can read, and add notes about the other sections.

    Each section is tried together with the section on which it depends. Raises DriveError if an object that every drive
    needs cannot be read.
    """
    sound: dict[str, Section] = {}
    for section in sections:
        parent = sound.get(section.parent) if section.parent else None
        reason = f"there is no section [{section.parent}] that can be read" if section.parent and not parent else ""
        if not reason:
            try:
                canopen.import_od(_text(file, [parent, section] if parent else [section]), node)
            except _UNREADABLE as error:
                reason = " ".join(str(error).split())
        if not reason:
            sound[section.name.upper()] = section
            continue
        notes.append(f"[{section.name}] in line {section.line}: {reason}")
        if section.object in REQUIRED:
            raise DriveError(f"{file}: {notes[-1]}; every drive needs this object")
    return list(sound.values())
