"""What one drive has and should have: reads first, writes the differences alone, and notes them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from trirail_drivers.cia402.objects import PROTECTIONS, Key, Need, title, use
from trirail_drivers.cia402.sdo import Remote, SdoRefused, same, shown
from trirail_drivers.driver.refusals import judged
from trirail_drivers.errors import ConfigurationRefused, DriveError


class Difference(NamedTuple):
    """A value that a drive is to be given."""

    object: str
    """Index and subindex, as 6085:00."""
    name: str
    found: str
    """What it holds; "" where it cannot be read."""
    wanted: str
    why: str


class Differences:
    """Brings one drive's objects to what is wanted."""

    def __init__(self, remote: Remote) -> None:
        self.remote = remote
        self.found: list[Difference] = []
        self.notes: list[str] = []
        """What is done otherwise, and is told once."""
        self.lacking: dict[str, str] = {}
        """Protections that the drive lacks, as PROTECTIONS names them, and why each is said to lack."""

    async def give(self, index: int, subindex: int, value: int, also: Sequence[int] = ()) -> int | None:
        """See that an object holds a value, or one that will do `also`; return what it holds, None where it lacks.

        Raises SdoRefused for one that is needed and is not taken, ConfigurationRefused for one that reads back
        differently from what the drive took.
        """
        key = index, subindex
        if not await self.remote.has(*key):
            self.lack(key, "it has no such object")
            return None
        found = await self.remote.peek(*key)
        if found is not None and same(index, subindex, found, value):
            return value
        refusal: SdoRefused | None = None
        for candidate in (value, *also):
            if found == candidate:
                return candidate
            try:
                await self.put(key, found, candidate)
            except SdoRefused as error:
                refusal = error
                continue
            return candidate
        if refusal is None:
            return found
        self.lack(key, f"it keeps {shown(*key, found) if found is not None else 'what it has'}", refusal)
        return None

    async def is_given(self, key: Key, value: int) -> bool:
        """See that an object holds a value; return whether the drive lets it have that."""
        found = await self.remote.peek(*key)
        if found is None or not same(*key, found, value):
            try:
                await self.put(key, found, value)
            except SdoRefused:
                return False
        return True

    async def put(self, key: Key, found: int | None, value: int, why: str = "") -> None:
        """Write an object, note that, and read it back; SdoRefused where it is not taken, and as `confirm`."""
        await self.remote.write(*key, value)
        self.note(key, found, value, why)
        await self.confirm(key, value)

    async def confirm(self, key: Key, value: int) -> None:
        """Read back what was written; ConfigurationRefused where it stays another, nothing where it is not told."""
        read, waited = await self.remote.becomes(key, lambda found: same(*key, found, value))
        if read is not None and not same(*key, read, value):
            name = self.remote.name_of(key)
            raise ConfigurationRefused(self.remote.name, name, *key, shown(*key, value), shown(*key, read), waited)

    def note(self, key: Key, found: int | None, wanted: int, why: str = "") -> None:
        """Note that an object is to be given a value."""
        named = use(key)
        self.found.append(
            Difference(
                f"{key[0]:04X}:{key[1]:02X}",
                named[1].name if named else self.remote.name_of(key),
                "" if found is None else shown(*key, found),
                shown(*key, wanted),
                why or (named[1].purpose if named else ""),
            )
        )

    def lack(self, key: Key, reason: str, refusal: SdoRefused | None = None) -> None:
        """The drive lacks an object, or keeps another value: refuse it, do it otherwise, or note the protection."""
        named = use(key)
        if named is None or named[1].need is Need.NEEDED:
            if refusal is not None:
                raise refusal
            purpose = f", needed for {named[1].purpose}" if named else ""
            raise DriveError(f"drive {self.remote.name}: lacks {title(key)}{purpose}")
        name, used = named
        if refusal is not None:
            reason = f"{reason}: {str(refusal).partition(': ')[2]}"
        if used.need is Need.PROTECTION:
            self.lacking[name] = reason
        else:
            self.add_note(f"{title(key)}, for {used.purpose}: {reason}; instead: {used.without}")

    def add_note(self, text: str) -> None:
        """Note what is done otherwise."""
        if text not in self.notes:
            self.notes.append(text)

    def refusal(self, accepted: Sequence[str]) -> str:
        """Why the drive is refused: it lacks a protection that the configuration does not name. Tells of the others."""
        refused, told = judged(self.remote.name, self.lacking, accepted, PROTECTIONS)
        for text in told:
            self.add_note(text)
        return refused
