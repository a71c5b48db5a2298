"""Differences between a drive's objects and the required values.

Objects are read first; only differences are written.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from trirail_drivers.cia402.objects import PROTECTIONS, Key, Need, find_use, title
from trirail_drivers.cia402.sdo import Remote, SdoRefused, same, shown
from trirail_drivers.driver.refusals import review_protections
from trirail_drivers.errors import ConfigurationRefused, DriveError


class Difference(NamedTuple):
    """Value that must be changed in a drive."""

    object: str
    """Index and subindex, such as 6085:00."""
    name: str
    found: str
    """Current value; "" if it cannot be read."""
    wanted: str
    why: str


class Differences:
    """Writer that corrects and records the differing objects of one drive."""

    def __init__(self, remote: Remote) -> None:
        self.remote = remote
        self.changes: list[Difference] = []
        self.notes: list[str] = []
        """Notes on deviations from the usual set-up."""
        self.missing_protections: dict[str, str] = {}
        """Missing protections by their names in PROTECTIONS, each with the reason."""

    async def ensure(self, index: int, subindex: int, value: int, also: Sequence[int] = ()) -> int | None:
        """Write an object unless it holds `value` or one of the values in `also`; return the value that it holds, or
        None.

        Raises SdoRefused if the drive does not accept a needed object, and ConfigurationRefused if another value is
        read back.
        """
        key = index, subindex
        if not await self.remote.has(*key):
            self.lack(key, "it has no such object")
            return None
        current = await self.remote.peek(*key)
        if current is not None and same(index, subindex, current, value):
            return value
        refusal: SdoRefused | None = None
        for candidate in (value, *also):
            if current == candidate:
                return candidate
            try:
                await self.put(key, current, candidate)
            except SdoRefused as error:
                refusal = error
                continue
            return candidate
        if refusal is None:
            return current
        self.lack(key, f"it keeps {shown(*key, current) if current is not None else 'what it has'}", refusal)
        return None

    async def try_ensure(self, key: Key, value: int) -> bool:
        """Write an object unless it already holds the value; return whether the drive accepts it."""
        current = await self.remote.peek(*key)
        if current is None or not same(*key, current, value):
            try:
                await self.put(key, current, value)
            except SdoRefused:
                return False
        return True

    async def put(self, key: Key, current: int | None, value: int, why: str = "") -> None:
        """Write an object, record the change, and read the value back.

        Raises SdoRefused if the drive does not accept the value, and the errors of `confirm`.
        """
        await self.remote.write(*key, value)
        self.note(key, current, value, why)
        await self.confirm(key, value)

    async def confirm(self, key: Key, value: int) -> None:
        """Read a written value back. An object that cannot be read counts as confirmed.

        Raises ConfigurationRefused if the object keeps a different value.
        """
        read, waited = await self.remote.wait_until(key, lambda current: same(*key, current, value))
        if read is not None and not same(*key, read, value):
            name = self.remote.name_of(key)
            raise ConfigurationRefused(self.remote.name, name, *key, shown(*key, value), shown(*key, read), waited)

    def note(self, key: Key, current: int | None, wanted: int, why: str = "") -> None:
        """Record a difference."""
        named = find_use(key)
        self.changes.append(
            Difference(
                f"{key[0]:04X}:{key[1]:02X}",
                named[1].name if named else self.remote.name_of(key),
                "" if current is None else shown(*key, current),
                shown(*key, wanted),
                why or (named[1].purpose if named else ""),
            )
        )

    def lack(self, key: Key, reason: str, refusal: SdoRefused | None = None) -> None:
        """Handle a missing object or a refused value: refuse the drive, add a note, or record a missing protection."""
        named = find_use(key)
        if named is None or named[1].need is Need.NEEDED:
            if refusal is not None:
                raise refusal
            purpose = f", needed for {named[1].purpose}" if named else ""
            raise DriveError(f"drive {self.remote.name}: lacks {title(key)}{purpose}")
        name, used = named
        if refusal is not None:
            reason = f"{reason}: {str(refusal).partition(': ')[2]}"
        if used.need is Need.PROTECTION:
            self.missing_protections[name] = reason
        else:
            self.add_note(f"{title(key)}, for {used.purpose}: {reason}; instead: {used.without}")

    def add_note(self, text: str) -> None:
        """Add a note about a deviation, unless it has already been added."""
        if text not in self.notes:
            self.notes.append(text)

    def refusal(self, accepted: Sequence[str]) -> str:
        """Return the refusal for missing protections that are not `accepted`, or ""; add notes about accepted ones."""
        refused, notes = review_protections(self.remote.name, self.missing_protections, accepted, PROTECTIONS)
        for text in notes:
            self.add_note(text)
        return refused
