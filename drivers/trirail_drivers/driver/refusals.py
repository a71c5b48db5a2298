"""Error messages for drives that are refused: because a protection is missing, or because a drive was replaced."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Final, Protocol

from trirail_drivers.errors import MAX_MESSAGE_LENGTH, DriveError, shortened

_NAMED: Final = re.compile(r"\b(drive |drives\.)([ABC])\b")


class ProtectionText(Protocol):
    """Purpose of a protection, and the consequence of lacking it."""

    @property
    def purpose(self) -> str:
        """Purpose of the protection, for people."""

    @property
    def without(self) -> str:
        """Consequence of lacking the protection, for people."""


class SetUpDrive(Protocol):
    """Result of a drive's set-up in any protocol."""

    @property
    def name(self) -> str:
        """Name of the drive."""

    @property
    def notes(self) -> Sequence[str]:
        """Notes for people, one line each."""

    @property
    def missing_protections(self) -> Sequence[str]:
        """Protections that the drive lacks."""


def review_protections(
    drive: str,
    missing_protections: Mapping[str, str],
    accepted: Sequence[str],
    protections: Mapping[str, ProtectionText],
    remedy: str = "",
) -> tuple[str, list[str]]:
    """Return the error message for a drive that lacks required protections, or "", and notes on those it may lack.

    `missing_protections` maps each missing protection to the reason, `accepted` is the drive's `accept_without`, and
    `remedy` is a way to set the protections.
    """
    refused = [name for name in missing_protections if name not in accepted]
    notes = []
    for name, reason in missing_protections.items():
        if name in accepted:
            used = protections[name]
            notes.append(f"lacks {name} ({used.purpose}): {reason}; this is accepted: {used.without}")
    if not refused:
        return "", notes
    what = "; ".join(f"{name}, {protections[name].purpose}: {missing_protections[name]}" for name in refused)
    listed = ", ".join(f'"{name}"' for name in sorted({*refused, *accepted}))
    return (
        f"drive {drive} lacks protections: {what}{remedy and f'; {remedy}'}. To use it without them, set "
        f"drives.{drive}.accept_without = [{listed}]"
    ), notes


def replacement_refusal(
    drive: str, numbers: Mapping[str, tuple[object, object]], may_differ: Collection[str], *, allowed: bool
) -> str:
    """Return the error message for a drive that replaces another, or "" if it is the same or a permitted replacement.

    `numbers` maps each part of the drive's identity to its previous and present value. If a replacement is `allowed`,
    the parts in `may_differ` may differ.
    """
    differing = [
        f"{name} {now}, was {before}"
        for name, (before, now) in numbers.items()
        if now != before and not (allowed and name in may_differ)
    ]
    if not differing:
        return ""
    remedy = "" if allowed else f", or set drives.{drive}.allow_replacement = true"
    return (
        f"drive {drive}: the drive has been replaced: {', '.join(differing)}; restart the service to accept it{remedy}"
    )


def raise_combined(errors: Sequence[DriveError]) -> None:
    """Raise the errors of several drives as one DriveError; an error that several drives share appears once."""
    if len(errors) == 1:
        raise errors[0]
    alike: dict[str, list[str]] = {}
    for error in errors:
        alike.setdefault(_NAMED.sub(r"\1_", str(error)), []).append(str(error))
    texts = [first + "".join(f"; the same for drive {_name(text)}" for text in more) for first, *more in alike.values()]
    if texts:
        raise DriveError("; ".join(shortened(text, MAX_MESSAGE_LENGTH // len(texts) - 2) for text in texts))


def merge_notes(notes: Iterable[tuple[str, Sequence[str]]]) -> list[str]:
    """Return notes on drives for people, one line each; a note that several drives share becomes one line."""
    names: dict[str, list[str]] = {}
    for name, lines in notes:
        for line in lines:
            names.setdefault(line, []).append(name)
    return [f"drive{'s' * (len(of) > 1)} {', '.join(of)}: {line}" for line, of in names.items()]


def _name(text: str) -> str:
    """Return the name of the drive that an error names, or ""."""
    match = _NAMED.search(text)
    return match[2] if match else ""
