"""A drive's set-up gone through without writing: what it would hold, and whether it would take that."""

from __future__ import annotations

from collections.abc import Callable

from trirail_drivers.cia402.objects import MODE, MODE_DISPLAY, Key
from trirail_drivers.cia402.sdo import Remote, shown


class DryRun(Remote):
    """A drive's object dictionary that nothing is written to; where it `asks`, the drive says whether it would take it.

    What is written is read back as if the drive held it. What a drive says of a value itself, it says only when it
    gets it.
    """

    rehearsed = True

    def __init__(self, remote: Remote, *, asks: bool) -> None:
        super().__init__(remote.name, remote.client)
        self.asks = asks
        self._read, self._missing, self._writable = remote._read, remote._missing, remote._writable
        self._written: dict[Key, bytes] = {}

    async def peek(self, index: int, subindex: int = 0) -> int | None:
        """Value of an object, as it would be; None where the drive has none to tell."""
        found = await super().peek(index, subindex)
        return found if found is None else self._would_be((index, subindex), found)

    async def read(self, index: int, subindex: int = 0) -> int:
        """Value of an object, as it would be; SdoRefused where the drive has none to tell."""
        return self._would_be((index, subindex), await super().read(index, subindex))

    async def write(self, index: int, subindex: int, value: int) -> None:
        """Ask the drive whether an object may be written; SdoRefused where it may not."""
        key = index, subindex
        data = await self._encoded(key, value)
        if self.asks:
            await self._try_to_write(f"write {shown(index, subindex, value)} to", key, len(data))
        self._written[key] = data
        if key == MODE and await self.bits(*MODE_DISPLAY) == await self.bits(*MODE):
            self._written[MODE_DISPLAY] = data

    async def becomes(
        self,
        key: Key,
        so: Callable[[int], bool],  # noqa: ARG002  what is not written takes no time
        seconds: float | None = None,  # noqa: ARG002
    ) -> tuple[int | None, float]:
        """What an object would hold at once."""
        return await self.peek(*key), 0.0

    def _would_be(self, key: Key, found: int) -> int:
        data = self._written.get(key)
        return found if data is None else int.from_bytes(data, "little", signed=self._signed(key))
