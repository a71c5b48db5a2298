"""Comparison of a drive's objects with the required values, and correction of the differences.

Every object is read first and written only if its value differs.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from trirail_drivers.cia402.objects import PROTECTIONS, Key, Need, find_use, title
from trirail_drivers.cia402.sdo import Remote, SdoRefused, same, shown
from trirail_drivers.driver.refusals import review_protections
from trirail_drivers.errors import ConfigurationRefused, DriveError


class Difference(NamedTuple):
    """Object of a drive that must be changed, with its present and its required value."""

    object: str
    """Index and subindex, such as 6085:00."""
    name: str
    found: str
    """Current value; "" if it cannot be read."""
    wanted: str
    why: str


class Differences:
    """Record of the objects of one drive that differ from the required values, with methods that correct them."""

    def __init__(self, remote: Remote) -> None:
        self.remote = remote
        self.changes: list[Difference] = []
        self.notes: list[str] = []
        """Notes on deviations from the usual set-up."""
        self.missing_protections: dict[str, str] = {}
        """Reason why each missing protection is missing, by the protection's name in PROTECTIONS."""

    async def ensure(self, index: int, subindex: int, value: int, also: Sequence[int] = ()) -> int | None:
        """Write `value` to an object; if the drive refuses it, the values in `also` are accepted or written instead.

        Return the value that the object then has, or None if the object is missing or refuses every value. Raises
        SdoRefused if a needed object refuses every value, and ConfigurationRefused if a different value is read back.
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
        self.lack(key, f"it keeps {shown(*key, current) if current is not None else 'what it has'}", refusal)
        return None

    async def ensure_at_most(self, key: Key, limit: int) -> None:
        """Write `limit` to an object with a higher value. Any value up to `limit` may be read back."""
        current = await self.remote.peek(*key)
        if current is None or current <= limit:
            return
        try:
            await self.remote.write(*key, limit)
        except SdoRefused as refusal:
            self.lack(key, f"it keeps {shown(*key, current)}", refusal)
            return
        held, waited = await self.remote.wait_until(key, lambda held: held <= limit)
        if held is None or held <= limit:
            self.note(key, current, limit)
            return
        name = self.remote.name_of(key)
        values = shown(*key, limit), shown(*key, held)
        self.lack(key, f"it keeps {values[1]}", ConfigurationRefused(self.remote.name, name, *key, *values, waited))

    async def try_ensure(self, key: Key, value: int) -> bool:
        """Write an object unless it already has the value; return whether the drive accepts the value."""
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

        Raises ConfigurationRefused if the object still has a different value.
        """
        read, waited = await self.remote.wait_until(key, lambda current: same(*key, current, value))
        if read is not None and not same(*key, read, value):
            name = self.remote.name_of(key)
            raise ConfigurationRefused(self.remote.name, name, *key, shown(*key, value), shown(*key, read), waited)

    def note(self, key: Key, current: int | None, wanted: int, why: str = "") -> None:
        """Record that an object must be, or was, changed from `current` to `wanted`."""
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

    def lack(self, key: Key, reason: str, refusal: DriveError | None = None) -> None:
        """Handle a missing object or, with its `refusal`, an object that keeps another value.

        Raise an error if the object is needed, record a protection as missing, and otherwise add a note.
        """
        named = find_use(key)
        used = named[1] if named else None
        need, without = (Need.NEEDED, "") if not used else used.if_kept if refusal else (used.need, used.without)
        if named is None or used is None or need is Need.NEEDED:
            purpose = f"needed for {used.purpose}" if used else ""
            if refusal is not None:
                refusal.args = ("; ".join(filter(None, (str(refusal), reason, purpose))),)
                raise refusal
            raise DriveError(", ".join(filter(None, (f"drive {self.remote.name}: lacks {title(key)}", purpose))))
        if refusal is not None:
            reason = f"{reason}: {str(refusal).partition(': ')[2]}"
        if need is Need.PROTECTION:
            self.missing_protections[named[0]] = reason
        else:
            self.add_note(f"{title(key)}, for {used.purpose}: {reason}; instead: {without}")

    def add_note(self, text: str) -> None:
        """Add a note about a deviation, unless it has already been added."""
        if text not in self.notes:
            self.notes.append(text)

    def refusal(self, accepted: Sequence[str]) -> str:
        """Return an error message with the missing protections that the user has not `accepted`; "" if there are none.

        For each accepted protection that is missing, add a note.
        """
        refused, notes = review_protections(self.remote.name, self.missing_protections, accepted, PROTECTIONS)
        for text in notes:
            self.add_note(text)
        return refused
