"""Why drives are refused: one that lacks protections, and the three of them told together."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Final, Protocol

from trirail_drivers.errors import LONGEST, DriveError, shortened

_NAMED: Final = re.compile(r"\b(drive |drives\.)([ABC])\b")


class Purpose(Protocol):
    """What a protection is for, and what is so where a drive lacks it."""

    @property
    def purpose(self) -> str:
        """In words for people."""

    @property
    def without(self) -> str:
        """Likewise."""


class SetUpDrive(Protocol):
    """What a protocol tells of a drive that is set up."""

    @property
    def name(self) -> str:
        """A, B or C."""

    @property
    def notes(self) -> Sequence[str]:
        """Lines for people."""

    @property
    def lacking(self) -> Sequence[str]:
        """Protections that it does without."""


def judged(
    drive: str, lacking: Mapping[str, str], accepted: Sequence[str], protections: Mapping[str, Purpose]
) -> tuple[str, list[str]]:
    """Return why a drive is refused that lacks protections, "" where it is not, and what is told of those accepted.

    `lacking` has why each is said to lack, `accepted` is its `accept_without`.
    """
    refused = [name for name in lacking if name not in accepted]
    told = []
    for name, reason in lacking.items():
        if name in accepted:
            used = protections[name]
            told.append(f"lacks {name} ({used.purpose}): {reason}; accepted, so {used.without}")
    if not refused:
        return "", told
    what = "; ".join(f"{name}, {protections[name].purpose}: {lacking[name]}" for name in refused)
    listed = ", ".join(f'"{name}"' for name in sorted({*refused, *accepted}))
    return (
        f"drive {drive} lacks protections: {what}. To drive it all the same say "
        f"drives.{drive}.accept_without = [{listed}]"
    ), told


def raise_all(errors: Sequence[DriveError]) -> None:
    """Raise what was found of each drive: none hides another's, and what is so of several is said once."""
    if len(errors) == 1:
        raise errors[0]
    alike: dict[str, list[str]] = {}
    for error in errors:
        alike.setdefault(_NAMED.sub(r"\1_", str(error)), []).append(str(error))
    told = [first + "".join(f"; drive {_name(text)}: the same" for text in more) for first, *more in alike.values()]
    if told:
        raise DriveError("; ".join(shortened(text, LONGEST // len(told) - 2) for text in told))


def lines_by_drive(notes: Iterable[tuple[str, Sequence[str]]]) -> list[str]:
    """What people should know of drives, by name, a line each: what is so of several is said once."""
    names: dict[str, list[str]] = {}
    for name, lines in notes:
        for line in lines:
            names.setdefault(line, []).append(name)
    return [f"drive{'s' * (len(of) > 1)} {', '.join(of)}: {line}" for line, of in names.items()]


def _name(text: str) -> str:
    """Of which drive an error is."""
    found = _NAMED.search(text)
    return found[2] if found else ""
